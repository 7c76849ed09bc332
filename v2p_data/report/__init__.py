"""What happened in a run, as pictures and as one page that people look at.

In: a run's folders, `<root>/<stage>/<item>-<fingerprint>/`, finished or not. Out: `report.html`, which needs
no network and no other file, and contact sheets of experts at work.
"""

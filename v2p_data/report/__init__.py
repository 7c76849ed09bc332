"""What happened in a run, as pictures and as one page that people look at.

In: a run's folders, `<root>/<stage>/<item>-<fingerprint>/`, finished or not. Out: `report.html`, which needs
no network and no other file; contact sheets of experts at work; and `review.html`, on which a person judges scenes
and marks what was not found.
"""

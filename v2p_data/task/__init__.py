"""A scene comes in, audited task code goes out: what to reach, what to see, what to be rewarded for.

`generate.generate_task` writes eight samples (`templates`), lets each run in a child process (`sandbox`,
`smoke`), holds its success function against the video and against probes (`probes`, `audit`) and picks one.
On disk (`task.TaskBundle` and `generate.GeneratedTask.save`): `task.json`, `task.py` (the picked code),
`audit.json`, `samples/0.py ...` and a copy of the scene. `referee` holds the success functions that judge a
finished policy; no training sees them.
"""

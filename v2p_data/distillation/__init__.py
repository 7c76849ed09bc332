"""An expert that sees states becomes the teacher of a policy that sees masks.

In: demonstrations, and per task its code and its expert. Out: handover episodes under `rounds/<number>/<item>/`,
staged as all episodes are, and the student that collected the last of them under `student/`.

Read `handover` (one batch of episodes), then `rounds` (training and collecting in turn).
"""

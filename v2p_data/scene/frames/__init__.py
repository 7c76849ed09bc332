"""A clip becomes working frames, and the scene network says of every pixel what it shows.

Comes in: a `Clip`. Goes out: a `Working clip` (frames 320 px wide with their stills), the table's
colour, and the network's class probabilities for every frame (`Segmentation`).

Reading order: working_clip, stabilise with camera_motion and edge_fit (a camera that sways),
colour, table, mask_ops (outlines and small helpers on masks), classes,
network, segmentation (the network over a whole clip), hand (where a hand ends).
"""

"""Mask tracks become a camera, sizes and poses, in camera heights: the camera stands 1 above the table.

Comes in: a `ObjectTrack` per object. Goes out: a `Placement` with the camera and a `PlacedObject` per object.

Reading order: placement (the order of the steps), silhouette (one outline, one shape), cuboid_network (how a box is turned),
trajectory (poses between first and last), tool_pose (a tool in a hand), hand_scale (the hand as a ruler), refine_pose (the last
pose once more, with the mesh), ring_mask (the hole of a ring), by_model (learned models).
"""

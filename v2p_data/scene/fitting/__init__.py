"""Mask tracks become a camera, sizes and poses, in camera heights: the camera stands 1 above the table.

Comes in: an `ObjectTrack` per object, and a guess of the camera. Goes out: a `Placement` with the
    camera and a `PlacedObject` per object.

Reading order:
    placement       the order of the steps
    plans           one plan per kind of task: where the object starts, how it moves, where it ends
    camera_guess, pitch             the camera
    object_view                     what is seen of an object at both ends
    silhouette, shape_fit, cuboid_network   one shape under one outline; how a box is turned
    end_poses, trajectory           poses at both ends, and between
    tool_pose                       a tool in a hand
    hand_scale      the hand as a ruler
    metric          camera heights become metres
    by_model        learned models
"""

"""The caption's phrases become mask tracks: which pixels are which object, in every frame.

Comes in: working frames, and what the scene network sees in them. Goes out: a `ObjectTrack` per object, all of them in a `GroundedObjects`.

Reading order: ground_objects (the order of the steps), moved_by_network and moved_by_change (what moved), static_objects (what stood
still), held_tool (a tool in a hand), hint_masks (what a person or a detector marked), outlines, tracking, by_model (learned models).
"""

"""The caption's phrases become mask tracks: which pixels are which object, in every frame.

Comes in: working frames, and what the scene network sees in them. Goes out: an `ObjectTrack` per object, all of them in a
`GroundedObjects`.

Reading order:
    ground_objects      the order of the steps
    moved_object        the manipulated object, by all ways together
    moved_by_network    what moved, by the scene network
    moved_by_change, change_blobs       what moved, by colours and vanishing edges
    static_objects      what stood still, by the scene network
    static_by_change    what stood still, by colours and places
    held_tool, tool_pieces              a tool in a hand
    hint_masks          what a person or a detector marked
    outlines            an outline is corrected
    tracking, mask_follower             a mask is carried through the clip
    by_model            learned models
    hands_by_model      a model that knows hands
    handled             where a hand takes an object and puts it down
"""

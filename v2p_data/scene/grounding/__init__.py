"""The caption's phrases become mask tracks: which pixels are which object, in every frame.

Comes in: working frames, and what the scene network sees in them. Goes out: an `ObjectTrack` per
object, all of them in a `GroundedObjects`.

Reading order:
    ground_objects      the order of the steps
    methods             who marks objects before the network is asked: a person's hints, a detector
    spot_masks, model_outlines          a click becomes an outline; a model that knows edges draws outlines
    moved_object        the manipulated object, followed from end to end
    moved_by_network    what moved, by the scene network
    static_objects, static_cues         what stood still, by the scene network
    candidates          what both searches choose from
    outlines            an outline is corrected
    tracking, mask_follower             a mask is carried through the clip
    brought, mirror_image               a search backwards in time, and one in the mirror image
    marked_table        a person's mark on the bare table
    by_model            learned models of outlines and masks
"""

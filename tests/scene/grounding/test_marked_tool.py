"""A tool in a hand: the network takes it for hand, so that a person marks it."""

from dataclasses import replace

import pytest
from drawn_parts import GREEN, RED, large, square

from v2p_data.errors import ItemRejectedError
from v2p_data.scene.frames.classes import HAND, MOVED
from v2p_data.scene.frames.mask_ops import iou
from v2p_data.scene.grounding.ground_objects import ground_objects
from v2p_data.video.captions import parse_caption


def test_a_marked_tool_is_followed_and_an_unmarked_one_is_asked_for(segmentation_of, draw):
    sticks = [square(74 - 3 * i, 44, 30, 6) for i in range(12)]
    blocks = [square(60 - 3 * i, 40, 14, 14) for i in range(12)]
    pairs = zip(blocks, sticks, strict=True)
    working, segmentation = segmentation_of(
        [[(block, RED, MOVED), (stick, GREEN, HAND)] for block, stick in pairs]
    )
    clip = replace(draw(num_frames=12), caption="Pushing red block with stick")
    meaning = parse_caption(clip.caption, ())
    marked = replace(clip, hints={"stick": {"frame": 0, "box": [74.0, 44.0, 104.0, 50.0]}})

    block, stick = ground_objects(marked, working, meaning, segmentation, 0.5).objects

    assert (block.role, block.in_hand) == ("manipulated", False)
    assert (stick.role, stick.in_hand, stick.moves) == ("tool", True, True)
    assert iou(stick.masks[8], large(sticks[8], working.shape)) > 0.6
    with pytest.raises(ItemRejectedError, match="the 'stick' was not found") as error:
        ground_objects(clip, working, meaning, segmentation, 0.5)
    assert error.value.reason == "reference_not_found"

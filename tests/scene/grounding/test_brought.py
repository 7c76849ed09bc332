"""What a hand brings: it is found where it comes to rest, unless it lay elsewhere before."""

from dataclasses import replace

import cv2
import numpy as np
import pytest

from v2p_data.errors import ItemRejectedError
from v2p_data.scene.config import SceneConfig
from v2p_data.scene.data_types import ObjectTrack
from v2p_data.scene.frames.classes import HAND, MOVED
from v2p_data.scene.frames.mask_ops import iou
from v2p_data.scene.frames.working_clip import working_clip_of
from v2p_data.scene.grounding.brought import find_brought, seen_backwards
from v2p_data.scene.grounding.moved_object import brought_object
from v2p_data.scene.reconstruct import reconstruct
from v2p_data.scene.scale.nouns import noun_for

BLUE, SKIN = (40, 60, 190), (205, 150, 125)


def rectangle(top, left, height=18, width=24):
    mask = np.zeros((90, 120), bool)
    mask[max(0, top) : top + height, left : left + width] = True
    return mask


def frames_of(segmentation_of, *, first=None, look=BLUE):
    """Return 13 frames in which a hand lowers a block from above.

    `first` is where one like it lies in the first four.
    """
    frames = []
    for i in range(13):
        top = min(50, -20 + 10 * i)
        parts = [(rectangle(top, 60), BLUE, MOVED)] if top > -18 else []
        if 1 < i < 9:
            parts.append((rectangle(0, 66, max(1, top), 12), SKIN, HAND))
        if first is not None and i < 4:
            parts.append((first, look, MOVED))
        frames.append(parts)
    return segmentation_of(frames)


def test_what_a_hand_brings_is_found_where_it_leaves_it(segmentation_of):
    working, segmentation = frames_of(segmentation_of)

    found = find_brought(working, segmentation, "blue block", None)

    assert not found.first.any()
    left = cv2.resize(rectangle(50, 60).astype(np.uint8), working.shape[::-1]) > 0
    assert iou(found.last, left) > 0.8
    assert found.score > 0.5


def test_what_lay_elsewhere_before_is_not_brought(segmentation_of):
    working, segmentation = frames_of(segmentation_of, first=rectangle(60, 10))

    with pytest.raises(ItemRejectedError, match="no hand brings"):
        find_brought(working, segmentation, "blue block", None)


def test_another_thing_that_vanishes_does_not_count(segmentation_of):
    working, segmentation = frames_of(segmentation_of, first=rectangle(60, 10), look=(40, 160, 60))

    assert find_brought(working, segmentation, "blue block", None).last.any()


def test_where_nothing_comes_to_rest_nothing_is_brought(segmentation_of):
    working, segmentation = segmentation_of([[(rectangle(0, 66), SKIN, HAND)]] * 12)

    with pytest.raises(ItemRejectedError, match="no hand brings"):
        find_brought(working, segmentation, "blue block", None)


def test_its_track_ends_where_it_rests_and_agrees_with_what_the_hand_held(segmentation_of):
    working, segmentation = frames_of(segmentation_of)
    nothing = np.zeros((0, 0, 0), bool)
    thing = ObjectTrack(
        phrase="blue block",
        role="manipulated",
        noun=noun_for("block"),
        masks=nothing,
        quality=np.zeros(0),
        moves=False,
        at=0,
        known_m=None,
        sure=0.0,
        why="",
    )

    track, moved = brought_object(thing, working, segmentation, None)

    assert track.brought
    assert track.moves
    assert track.at == len(working.rgb) - 1
    np.testing.assert_array_equal(track.last, moved.last)
    assert track.agreement > 0.6
    assert not track.masks[0].any()


def test_the_clip_run_backwards_is_turned_back(draw):
    clip = draw(num_frames=12)
    working = working_clip_of(clip)

    seen = seen_backwards(clip, working)

    assert seen.idx.tolist() == list(range(12))
    for at, plane in ((0, seen.early), (-1, seen.late)):
        assert iou(seen.shares[at, MOVED] > 0.5, plane[MOVED] > 0.5) > 0.6
    assert (
        np.argwhere(seen.early[MOVED] > 0.5).mean(0)[1]
        > 30 + (np.argwhere(seen.late[MOVED] > 0.5).mean(0)[1])
    )


def with_a_plate(clip):
    frames = clip.frames.copy()
    for frame in frames:
        cv2.ellipse(frame, (68, 118), (32, 15), 0, 0, 360, (200, 60, 50), -1, cv2.LINE_AA)
        cv2.ellipse(frame, (68, 116), (23, 10), 0, 0, 360, (215, 80, 70), -1, cv2.LINE_AA)
    return replace(clip, frames=frames)


CAPTION = "Putting blue box next to red plate"


def test_a_scene_of_what_is_brought_starts_on_the_table_beside_its_end(draw):
    clip = with_a_plate(draw(comes_at=0.45, caption=CAPTION, objects=("blue box", "red plate")))

    scene = reconstruct(clip, SceneConfig(min_confidence=0.2), np.random.default_rng(0))

    box, plate = scene.objects
    first, last = box.T_world_objs[[0, -1], :3, 3]
    other = plate.T_world_objs[0, :3, 3]
    assert scene.kind == "push_next_to"
    assert first[2] == pytest.approx(last[2], abs=0.005)
    np.testing.assert_allclose(first[:2], 0, atol=1e-6)
    assert np.linalg.norm(first - other) > np.linalg.norm(last - other) + 0.05
    assert box.confidences[0] <= 0.1
    assert "a place that was chosen" in " ".join(scene.warnings)

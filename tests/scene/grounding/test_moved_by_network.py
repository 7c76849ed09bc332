"""The network's word is drawn by hand here: what is made of it must not depend on how well it was trained."""

from dataclasses import replace

import numpy as np
import pytest
from drawn_parts import BLUE, RED, SKIN, H, W, large, square

from v2p_data.scene.data_types import ObjectTrack
from v2p_data.scene.frames.classes import CLASSES, HAND, MOVED, OTHER, TABLE
from v2p_data.scene.frames.colour import histogram
from v2p_data.scene.frames.mask_ops import iou as mask_iou
from v2p_data.scene.grounding.candidates import Moved
from v2p_data.scene.grounding.moved_by_network import Given, find_moved_by_network
from v2p_data.scene.grounding.moved_object import hidden_in_container
from v2p_data.scene.grounding.outlines import (
    disjoint_ends,
    without_table,
)
from v2p_data.scene.grounding.tracking import carried, track
from v2p_data.scene.scale.nouns import noun_for


def pushed(colour_a, colour_b):
    """Two squares move from left to right, `a` above `b`."""
    frames = []
    for i in range(12):
        shift = 3 * i
        frames.append(
            [(square(15 + shift, 20), colour_a, MOVED), (square(15 + shift, 60), colour_b, MOVED)]
        )
    return frames


def iou(mask, truth):
    """Return how far a mask at working size overlaps one of the drawn frames."""
    return mask_iou(mask, large(truth, mask.shape))


@pytest.mark.parametrize(("phrase", "y"), [("red box", 20), ("blue box", 60)])
def test_of_two_things_that_move_the_one_of_the_named_colour_is_taken(segmentation_of, phrase, y):
    working, segmentation = segmentation_of(pushed(RED, BLUE))

    found, _ = find_moved_by_network(working, segmentation, phrase, "push_right")

    assert iou(found.first, square(15, y)) > 0.8
    assert iou(found.last, square(48, y)) > 0.8


def test_the_wrong_direction_makes_the_finding_less_sure(segmentation_of):
    working, segmentation = segmentation_of([[parts[0]] for parts in pushed(RED, BLUE)])

    right, _ = find_moved_by_network(working, segmentation, "red box", "push_right")
    left, _ = find_moved_by_network(working, segmentation, "red box", "push_left")

    assert left.score < 0.3 * right.score


def test_the_tool_is_what_the_hand_holds(segmentation_of):
    frames = pushed(RED, BLUE)
    for i, parts in enumerate(frames):
        if 2 < i < 10:
            parts.append((square(15 + 3 * i - 8, 58, 8), (200, 150, 120), HAND))
            parts.append((square(15 + 3 * i - 8, 66, 20), (200, 150, 120), HAND))
    working, segmentation = segmentation_of(frames)

    thing, tool = find_moved_by_network(working, segmentation, "box", "push_with", "stick")

    assert iou(thing.first, square(15, 20)) > 0.8
    assert iou(tool.first, square(15, 60)) > 0.8


def test_nothing_that_moved_is_nothing_found(segmentation_of):
    working, segmentation = segmentation_of([[(square(40, 40), RED, OTHER)] for _ in range(12)])

    assert find_moved_by_network(working, segmentation, "red box", "push_right") is None


def test_a_mask_given_by_hand_is_taken_as_it_is(segmentation_of):
    working, segmentation = segmentation_of([[parts[0]] for parts in pushed(RED, BLUE)])
    given = np.zeros(working.shape, bool)
    given[60:100, 50:90] = True

    found, _ = find_moved_by_network(
        working, segmentation, "box", "push_right", marked=Given(first=given)
    )

    np.testing.assert_array_equal(found.first, given)


def put_into(bin_shows_at_the_end):
    """A red square goes from the table to a blue bin and is gone, or is still seen there."""
    bin_, frames = (square(70, 40, 36), BLUE, OTHER), []
    for i in range(12):
        inside = i > 8
        thing = (square(10 + 8 * i if not inside else 80, 50), RED, MOVED)
        frames.append([bin_] + ([thing] if not inside or bin_shows_at_the_end else []))
    return frames


@pytest.mark.parametrize("seen_at_the_end", [False, True])
def test_what_goes_into_a_bin_and_is_gone_was_swallowed(segmentation_of, seen_at_the_end):
    working, segmentation = segmentation_of(put_into(seen_at_the_end))
    h, w = working.shape
    masks = segmentation.shares[:, MOVED] > 0.5
    lost = np.zeros((h, w), bool)
    lost[:5, :5] = True
    masks[9:] = masks[9:] if seen_at_the_end else lost  # where the tracker went astray
    common = {"moves": True, "at": 0, "known_m": None, "sure": 0.9, "why": ""}
    thing = ObjectTrack(
        phrase="red cube",
        role="manipulated",
        noun=noun_for("cube"),
        masks=masks,
        quality=np.ones(12),
        **common,
    )
    bin_ = replace(
        thing,
        role="container",
        noun=noun_for("bin"),
        moves=False,
        masks=np.repeat((segmentation.early[OTHER] > 0.5)[None], 12, 0),
    )

    found = hidden_in_container(segmentation, thing, bin_)

    assert found.hidden_in_container is not seen_at_the_end
    if found.hidden_in_container:
        np.testing.assert_array_equal(found.last, masks[8])
        assert (found.quality[9:] == 0).all()
    assert not hidden_in_container(
        segmentation, thing, replace(bin_, noun=noun_for("cereal box"))
    ).hidden_in_container


def test_what_a_leg_uncovers_elsewhere_does_not_hide_that_the_marked_bin_swallowed_it(
    segmentation_of,
):
    frames = put_into(bin_shows_at_the_end=False)
    plug = (square(3, 3), BLUE, MOVED)
    _, segmentation = segmentation_of([*frames[:10], [*frames[10], plug], [*frames[11], plug]])
    thing = ObjectTrack(
        phrase="red cube",
        role="manipulated",
        noun=noun_for("cube"),
        masks=segmentation.shares[:, MOVED] > 0.5,
        quality=np.ones(12),
        moves=True,
        at=0,
        known_m=None,
        sure=0.9,
        why="",
    )
    bin_ = replace(
        thing,
        role="container",
        noun=noun_for("bin"),
        moves=False,
        masks=np.repeat((segmentation.early[OTHER] > 0.5)[None], 12, 0),
    )

    assert not hidden_in_container(segmentation, thing, bin_).hidden_in_container
    assert hidden_in_container(segmentation, thing, replace(bin_, hinted=True)).hidden_in_container


def test_an_outline_at_the_end_that_shows_something_else_is_not_believed(segmentation_of):
    frames = [[(square(10 + 6 * i, 40), RED, MOVED)] for i in range(12)]
    frames[-1] = [(square(76, 40), BLUE, MOVED)]
    working, segmentation = segmentation_of(frames)
    first, last = large(square(10, 40), working.shape), large(square(76, 40), working.shape)
    moved = Moved(
        first=first, last=last, score=1.0, colour_hist=histogram(working.rgb[0][first]), cues={}
    )

    tracked = track(working, moved, moving=lambda i: segmentation.at(i)[MOVED])

    assert tracked.quality[0] == 1
    assert tracked.quality[5] > 0.5
    assert tracked.quality[-1] < 0.4


@pytest.mark.parametrize(("lies_there_from", "believed"), [(0, 0.0), (8, 1.0)])
def test_a_look_alike_that_lay_there_all_along_is_not_the_thing_at_the_end(
    segmentation_of, lies_there_from, believed
):
    """A thing disappears behind an arm; what is taken for it at the end was there from a frame on."""
    gone, there = square(10, 40), square(80, 20)
    frames = []
    for i in range(12):
        parts = [(gone, RED, MOVED)] if i < 4 else []
        parts += [(square(6, 36, 40), SKIN, HAND)] if 4 <= i < 8 else []
        frames.append([*parts, (there, RED, OTHER)] if i >= lies_there_from else parts)
    working, _ = segmentation_of(frames)
    first, last = large(gone, working.shape), large(there, working.shape)
    moved = Moved(
        first=first, last=last, score=1.0, colour_hist=histogram(working.rgb[0][first]), cues={}
    )

    tracked = track(working, moved)

    assert tracked.quality[0] == 1
    assert tracked.quality[-1] == believed


def test_where_the_network_surely_sees_bare_table_nothing_is_followed(segmentation_of):
    """It knows the thing at first; what looks like it later is table to the network, while a fist hides the thing."""
    frames = [[(square(10 + 6 * i, 40), RED, MOVED if i < 6 else TABLE)] for i in range(12)]
    working, segmentation = segmentation_of(frames)
    first, last = large(square(10, 40), working.shape), large(square(76, 40), working.shape)
    moved = Moved(
        first=first, last=last, score=1.0, colour_hist=histogram(working.rgb[0][first]), cues={}
    )

    def told(**also):
        return track(working, moved, moving=lambda i: segmentation.at(i)[MOVED], **also).quality

    assert (told(bare=lambda i: segmentation.at(i)[TABLE]) > 0.5).tolist() == [True] * 6 + [
        False
    ] * 6
    assert (told()[:10] > 0.5).all()


def test_what_lies_there_still_keeps_its_whole_outline(segmentation_of):
    """The network sees half of a thing that nobody has touched yet; the other half has nearly the table's colours."""
    frames = []
    for i in range(12):
        x = 10 + 9 * max(0, i - 7)
        upper, lower = square(x, 40), square(x, 40)
        upper[47:], lower[:47] = False, False
        frames.append([(upper, RED, MOVED), (lower, (165, 150, 110), MOVED)])
    working, _ = segmentation_of(frames)
    first, last = large(square(10, 40), working.shape), large(square(46, 40), working.shape)
    half = first.copy()
    half[: round(47 / H * len(half))] = False
    moved = Moved(
        first=first, last=last, score=1.0, colour_hist=histogram(working.rgb[0][first]), cues={}
    )

    tracked = track(working, moved, moving=lambda i: np.where(half, 0.0, 0.7 * first))

    for i in range(1, 7):
        assert iou(tracked.masks[i], square(10, 40)) > 0.9, i


def test_the_hand_that_holds_a_thing_at_the_end_is_cut_off_by_its_colours(segmentation_of):
    frames = [[(square(10 + 6 * i, 40), RED, MOVED)] for i in range(12)]
    arm = square(76, 54, 30)
    frames[-1] = [(arm, SKIN, MOVED), (square(76, 40), RED, MOVED)]
    working, segmentation = segmentation_of(frames)
    hand = replace(working, hand_hist=histogram(np.tile(np.array(SKIN, np.uint8), (400, 1))))
    first, thing = large(square(10, 40), working.shape), large(square(76, 40), working.shape)
    last = thing | large(arm, working.shape)
    moved = Moved(
        first=first, last=last, score=1.0, colour_hist=histogram(working.rgb[0][first]), cues={}
    )

    tracked = track(hand, moved, moving=lambda i: segmentation.at(i)[MOVED])

    assert (tracked.masks[-1] & thing).sum() > 0.85 * thing.sum()
    assert (tracked.masks[-1] & ~thing).sum() < 0.15 * thing.sum()


def test_where_a_thing_will_stand_is_not_part_of_its_first_outline(segmentation_of):
    working, _ = segmentation_of([[(square(30 + 2 * i, 40), RED, MOVED)] for i in range(10)])
    first, last = large(square(30, 40), working.shape), large(square(48, 40), working.shape)
    moved = Moved(first=first | last, last=last, score=1.0, colour_hist=np.zeros((12, 24, 24)))

    freed = disjoint_ends(working, moved)

    assert iou(freed.first, square(30, 40)) > 0.9
    assert (freed.last == last).all()
    assert freed.colour_hist.sum() == pytest.approx(1)
    assert (disjoint_ends(working, moved, keep=(0,)).first == (first | last)).all()


def seen_as(**sure):
    """Return what the network says of every pixel: each class where its mask is, `table` elsewhere, 0.95 sure."""
    label = np.full((H, W), TABLE)
    for what, mask in sure.items():
        label[mask] = {"moved": MOVED, "other": OTHER}[what]
    return (0.0125 + 0.9375 * (label == np.arange(len(CLASSES))[:, None, None])).astype(np.float32)


def test_a_marked_outline_loses_what_surely_is_table_but_no_part_of_the_thing():
    body, beside, handle = square(40, 30, 20), square(60, 36, 8), square(60, 48, 14)

    found = without_table(
        body | beside | handle, seen_as(other=body | handle & ~square(60, 48, 2))
    )

    assert not found[beside & ~handle].any()
    assert found[body].all()
    assert found[handle].mean() > 0.9


def test_what_is_hidden_at_the_end_is_found_by_where_it_was_last_seen(segmentation_of):
    working, segmentation = segmentation_of(put_into(bin_shows_at_the_end=False))

    found = find_moved_by_network(working, segmentation, "red cube", "insert")

    assert found is not None
    assert iou(found[0].first, square(10, 50)) > 0.7
    assert iou(found[0].last, square(10 + 8 * 8, 50)) > 0.7
    assert find_moved_by_network(working, segmentation, "red cube", "push_right") is None


def test_a_tool_marked_in_one_frame_is_followed_both_ways_until_it_is_gone(segmentation_of):
    path = [None, None, *((20 + 6 * i, 40) for i in range(8)), None, None]
    working, segmentation = segmentation_of(
        [[(square(*at), RED, MOVED)] if at else [] for at in path]
    )
    mask = segmentation.shares[5, MOVED] > 0.5

    tracked = carried(working, mask, 5, moving=lambda i: segmentation.at(i)[MOVED])

    for i, at in enumerate(path):
        if at is None:
            assert not tracked.masks[i].any(), i
        else:
            assert iou(tracked.masks[i], square(*at)) > 0.6, i
    assert tracked.quality[5] == 1


def test_a_thing_marked_on_its_way_is_found_at_both_ends_by_how_it_looks(segmentation_of):
    """Of two that move alike the blue one is meant: a mark in the middle says so, and is no outline of either end."""
    frames = pushed(RED, BLUE)
    working, segmentation = segmentation_of(frames)
    there = large(square(15 + 3 * 6, 60), working.shape)

    moved, _ = find_moved_by_network(
        working,
        segmentation,
        "thing",
        "push_right",
        marked=Given(colour_hist=histogram(working.rgb[6][there])),
    )

    assert iou(moved.first, square(15, 60)) > 0.8
    assert iou(moved.last, square(15 + 33, 60)) > 0.8


def test_a_thing_is_cut_by_its_colour_from_the_arm_that_was_taken_along(segmentation_of):
    """At first the network takes the arm for a part of what moves; it comes from outside of the picture."""
    arm = np.zeros((H, W), bool)
    arm[26:36, :30] = True
    frames = pushed(RED, RED)
    frames = [parts[:1] for parts in frames]
    frames[0] = [(arm | square(15, 20), SKIN, MOVED), (square(15, 20), RED, MOVED)]
    frames[1] = [(arm, SKIN, HAND), *frames[1]]
    working, segmentation = segmentation_of(frames)

    red, _ = find_moved_by_network(working, segmentation, "red box", "push_right")
    any_, _ = find_moved_by_network(working, segmentation, "box", "push_right")

    assert iou(red.first, square(15, 20)) > 0.8
    assert any_.first[large(arm & ~square(13, 18, 18), working.shape)].mean() > 0.5, (
        "nothing says which"
    )
    assert red.score > 0.3, "the whole is no rival of its piece"

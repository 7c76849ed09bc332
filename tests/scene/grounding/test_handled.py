"""A hand's fingertips say where an object was taken from and put down: drawn hands go along with drawn objects."""

from dataclasses import replace

import numpy as np
import pytest
from drawn_parts import RED, W, large, square

from v2p_data.errors import ItemRejectedError
from v2p_data.scene.frames.classes import MOVED
from v2p_data.scene.frames.hand_track import HandTrack
from v2p_data.scene.grounding.ground_objects import check_hand
from v2p_data.scene.grounding.handled import handling_in
from v2p_data.scene.grounding.moved_by_network import Given, find_moved_by_network

FRAMES, SIZE = 12, 14
UPPER_Y, LOWER_Y = 20, 60


def two_alike():
    """Two squares that look alike move side by side to the right."""
    return [
        [(square(15 + 3 * i, y), RED, MOVED) for y in (UPPER_Y, LOWER_Y)] for i in range(FRAMES)
    ]


def hand_along(working, y: int, num_sampled: int = FRAMES) -> HandTrack:
    """Return a hand whose fingertips are right of the square in row `y`, with a palm of 10 drawn px."""
    scale = working.shape[1] / W
    tips = np.array([[15 + 3 * i + SIZE + 1, y + SIZE / 2] for i in range(FRAMES)])
    px = np.repeat(tips[:, None], 21, 1)
    px[:, 0] += [10, 0]
    return HandTrack(
        at=np.arange(FRAMES),
        px=px * scale,
        metres=np.zeros((FRAMES, 21, 3)),
        num_sampled=num_sampled,
    )


@pytest.mark.parametrize("y", [UPPER_Y, LOWER_Y])
def test_of_two_alike_the_one_that_a_hand_takes_and_puts_down_is_moved(segmentation_of, y: int):
    working, seen = segmentation_of(two_alike())
    working = replace(working, hands=hand_along(working, y))

    found, _ = find_moved_by_network(working, seen, "red box", "place_onto")

    assert (found.first & large(square(15, y), working.shape)).sum() > 0.8 * found.first.sum()
    assert (found.last & large(square(48, y), working.shape)).sum() > 0.8 * found.last.sum()
    assert found.cues["first taken by a hand"] == 1.0
    assert found.cues["last put down by a hand"] == 1.0
    assert found.cues["no rival"] > 0.9


def test_an_outline_that_no_hand_reaches_weighs_less(segmentation_of):
    working, seen = segmentation_of(two_alike())

    handling = handling_in(hand_along(working, LOWER_Y), seen)

    assert handling is not None
    for weight, x in ((handling.taken_from, 15), (handling.put_at, 48)):
        assert weight(large(square(x, UPPER_Y), working.shape)) == pytest.approx(0.3)
        assert weight(large(square(x, LOWER_Y), working.shape)) == 1.0


def test_what_a_person_marked_is_not_weighed(segmentation_of):
    working, seen = segmentation_of(two_alike())
    working = replace(working, hands=hand_along(working, LOWER_Y))
    marked = Given(first=large(square(15, UPPER_Y), working.shape))

    found, _ = find_moved_by_network(working, seen, "red box", "place_onto", marked=marked)

    assert "first taken by a hand" not in found.cues
    np.testing.assert_array_equal(found.first, marked.first)


def test_where_an_object_is_pushed_its_end_may_be_out_of_reach(segmentation_of):
    working, seen = segmentation_of(two_alike())
    working = replace(working, hands=hand_along(working, LOWER_Y))

    found, _ = find_moved_by_network(working, seen, "red box", "push_right")

    assert "last put down by a hand" not in found.cues


def test_hands_found_in_few_frames_say_nothing(segmentation_of):
    working, seen = segmentation_of(two_alike())
    alone, _ = find_moved_by_network(working, seen, "red box", "place_onto")

    for hands in (None, hand_along(working, LOWER_Y, num_sampled=100)):
        some = replace(working, hands=hands)
        found, _ = find_moved_by_network(some, seen, "red box", "place_onto")
        assert handling_in(hands, seen) is None
        assert found.cues == alone.cues
        np.testing.assert_array_equal(found.first, alone.first)
        np.testing.assert_array_equal(found.last, alone.last)


def test_a_hand_that_a_model_sees_counts_where_our_network_sees_none(segmentation_of, draw):
    working, seen = segmentation_of(two_alike())
    clip = draw()

    check_hand(clip, replace(working, hands=hand_along(working, LOWER_Y)), seen)

    for hands in (None, replace(hand_along(working, LOWER_Y), at=np.zeros(FRAMES, int))):
        with pytest.raises(ItemRejectedError) as caught:
            check_hand(clip, replace(working, hands=hands), seen)
        assert caught.value.reason == "no_hand"

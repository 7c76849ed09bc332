"""Which thing that stands there is meant: what the network sees is drawn here, the weights are the learned ones."""

import json
from dataclasses import replace

import numpy as np
import pytest
from drawn_parts import BLUE, GREEN, RED, SKIN, large, square

from v2p_data.scene.frames.classes import BACKGROUND, HAND, MOVED, OTHER, TABLE
from v2p_data.scene.frames.mask_ops import iou
from v2p_data.scene.frames.table import find_table
from v2p_data.scene.grounding.ground_objects import seen_on_table
from v2p_data.scene.grounding.static_cues import (
    WEIGHTS,
    StaticSearch,
    static_share,
    usual_area_px,
)
from v2p_data.scene.grounding.static_objects import candidates, find_static_object
from v2p_data.scene.scale.camera_height import SeenCamera
from v2p_data.scene.scale.nouns import noun_for

CAMERA = SeenCamera(
    pitch_rad=0.6, pitch_sd_rad=0.1, focal_widths=0.9, table_width_m=0.9, table_width_sd=0.2
)


def pushed_to(x, others):
    """A red square goes along y = 40 from x = 5 to x; others stand there."""
    return [
        [
            *((mask, rgb, OTHER) for mask, rgb in others),
            (square(round(5 + (x - 5) * i / 11), 40), RED, MOVED),
        ]
        for i in range(12)
    ]


def searched(segmentation_of, frames, phrase, kind, ends, moved="thing"):
    working, segmentation = segmentation_of(frames)
    first, last = (large(mask, working.shape) for mask in ends)
    return StaticSearch(
        working=working,
        table=find_table(working.always, segmentation.early[TABLE] > 0.5),
        segmentation=segmentation,
        phrase=phrase,
        moved=noun_for(moved),
        kind=kind,
        ends=(first, last),
        taken=np.zeros(working.shape, bool),
    )


def meant(*asked):
    search = searched(*asked)
    mask, sure = find_static_object(search) or (None, 0.0)
    return mask, sure, search.working


def test_of_two_things_the_one_that_was_pushed_to_is_meant(segmentation_of):
    near, far = square(70, 40), square(100, 5)
    frames = pushed_to(52, [(near, BLUE), (far, BLUE)])

    found, _, working = meant(
        segmentation_of, frames, "box", "push_next_to", (square(5, 40), square(52, 40))
    )

    assert iou(found, large(near, working.shape)) > 0.8


def test_a_basket_that_fills_a_third_of_the_picture_is_still_a_thing(segmentation_of):
    basket, small = square(50, 20, 62), square(5, 5)
    frames = pushed_to(60, [(basket, BLUE), (small, BLUE)])

    found, _, working = meant(
        segmentation_of, frames, "laundry basket", "throw_into", (square(5, 40), square(60, 40))
    )

    assert iou(found, large(basket, working.shape)) > 0.8


def test_a_table_that_seems_to_be_a_thing_is_too_large_to_be_a_cup(segmentation_of):
    table, cup = square(50, 20, 62), square(66, 44, 12)
    frames = pushed_to(60, [(table, GREEN), (cup, BLUE)])
    ends = square(5, 40), square(60, 40)

    search = searched(segmentation_of, frames, "cup", "throw_into", ends)

    assert max(one.mask.mean() for one in candidates(search)) < 0.2


def test_a_named_colour_outweighs_a_little_distance(segmentation_of):
    near, far = square(60, 62), square(70, 15)
    frames = pushed_to(60, [(near, BLUE), (far, GREEN)])
    ends = square(5, 40), square(60, 40)

    blue, _, working = meant(segmentation_of, frames, "blue box", "push_next_to", ends)
    green, _, _ = meant(segmentation_of, frames, "green box", "push_next_to", ends)

    assert iou(blue, large(near, working.shape)) > 0.8
    assert iou(green, large(far, working.shape)) > 0.8


def test_one_alone_is_surer_than_one_of_two_that_are_alike(segmentation_of):
    ends = square(5, 40), square(50, 40)
    one, two = square(72, 28), square(72, 52)

    _, alone, _ = meant(segmentation_of, pushed_to(50, [(one, BLUE)]), "box", "push_next_to", ends)
    _, either, _ = meant(
        segmentation_of, pushed_to(50, [(one, BLUE), (two, BLUE)]), "box", "push_next_to", ends
    )

    assert either < alone - 0.1


def test_what_an_arm_hides_at_first_is_found_where_it_is_seen_later(segmentation_of):
    bin_, arm = square(70, 30, 24), square(60, 20, 40)
    frames = pushed_to(30, [(bin_, BLUE)])
    for parts in frames[:4]:
        parts.append((arm, SKIN, HAND))
    found, _, working = meant(
        segmentation_of, frames, "blue bin", "throw_into", (square(5, 40), square(72, 34, 10))
    )

    assert iou(found, large(bin_, working.shape)) > 0.8


def test_where_nothing_stands_nothing_is_believed(segmentation_of):
    """The edge of the moved thing's trace may stand out from the table."""
    ends = square(5, 40), square(50, 40)
    _, sure, _ = meant(segmentation_of, pushed_to(50, []), "box", "push_next_to", ends)

    assert sure < 0.2


def test_print_on_the_table_is_no_part_of_what_stands_beside_it(segmentation_of):
    thing, print_ = square(70, 40), square(72, 54, 10)
    frames = [[(print_, BLUE, TABLE), *parts] for parts in pushed_to(52, [(thing, BLUE)])]

    found, _, working = meant(
        segmentation_of, frames, "blue box", "push_next_to", (square(5, 40), square(52, 40))
    )

    assert iou(found, large(thing, working.shape)) > 0.85


def test_what_is_uncovered_is_looked_for_where_the_cover_stood(segmentation_of):
    under, beside = square(22, 44, 8), square(90, 60, 8)
    frames = [
        [(beside, BLUE, OTHER), (under, BLUE, MOVED), (square(18 + 4 * i, 36, 20), RED, MOVED)]
        for i in range(12)
    ]
    found, _, working = meant(
        segmentation_of, frames, "box", "uncover", (square(18, 36, 20), square(62, 36, 20))
    )

    assert iou(found, large(under, working.shape)) > 0.6


def test_pixels_count_in_the_frames_that_show_them(segmentation_of):
    bin_ = square(70, 30, 24)
    frames = pushed_to(30, [(bin_, BLUE)])
    for parts in frames[:8]:
        parts.append((bin_, SKIN, HAND))
    working, segmentation = segmentation_of(frames)

    assert static_share(segmentation, "insert")[large(bin_, working.shape)].min() > 0.7


def test_where_all_seems_too_small_things_are_compared_with_what_moves(segmentation_of):
    """The camera is taken to be near, and the scene is far away: then the box that is pushed looks like a matchbox."""
    frames, ends = pushed_to(50, [(square(72, 28), BLUE)]), (square(5, 40), square(50, 40))

    alone, beside = (
        searched(segmentation_of, frames, "blue suitcase", "slide_to", ends, moved)
        for moved in ("thing", "suitcase")
    )

    assert alone.log_scale == 0
    assert beside.log_scale < -0.3
    cues = [max(candidates(one), key=lambda c: c.cues["seen"]).cues for one in (alone, beside)]
    assert cues[1]["smaller than usual"] == pytest.approx(
        cues[0]["smaller than usual"] + beside.log_scale
    )


@pytest.mark.parametrize("kind", ["insert", "slide_to", "uncover", "lift_up"])
def test_every_candidate_has_the_cues_that_were_learned(segmentation_of, kind):
    frames, ends = pushed_to(50, [(square(72, 28), BLUE)]), (square(5, 40), square(50, 40))
    learned = json.loads(WEIGHTS.read_text())
    assert set(learned["sure"]) == {"offset", "odds", *learned["choice"]}

    for one in candidates(searched(segmentation_of, frames, "blue box", kind, ends)):
        assert set(one.cues) == set(learned["choice"])


def test_what_stands_is_apart_from_table_and_wall(segmentation_of):
    thing = square(60, 50)
    parts = [(square(0, 0, 30), (90, 90, 90), BACKGROUND), (thing, RED, OTHER)]
    working, segmentation = segmentation_of([parts for _ in range(12)])

    assert iou(static_share(segmentation, "push_left") > 0.5, large(thing, working.shape)) > 0.8


def test_what_has_table_beneath_it_stands_on_the_table_whatever_its_colours_say(segmentation_of):
    on, off = square(60, 50), square(5, 5)
    wall = square(0, 0, 40)
    parts = [(wall, (90, 90, 90), BACKGROUND), (on, RED, OTHER), (off, RED, OTHER)]
    working, segmentation = segmentation_of([parts for _ in range(12)])
    nowhere = replace(
        find_table(working.always, segmentation.early[TABLE] > 0.5),
        hull=np.zeros(working.shape, bool),
    )

    assert seen_on_table(nowhere, large(on, working.shape), segmentation) == 1
    assert seen_on_table(nowhere, large(off, working.shape), segmentation) < 1


@pytest.mark.parametrize(("phrase", "far"), [("ball", False), ("plate", False), ("box", True)])
def test_usual_things_cover_as_many_pixels_as_their_size_says(phrase, far):
    noun = noun_for(phrase)
    row = 40.0 if far else 120.0
    area = usual_area_px(noun, CAMERA, (240, 320), row)

    # The middle row shows 0.9 m of the table on 320 pixels; things above it are farther away, and smaller.
    across_px = 320 / 0.9 * np.array(noun.size_m)
    most, least = across_px[0] * (across_px[1] + across_px[2]), 0.4 * across_px.min() ** 2
    assert least < area < most
    assert far == (area < usual_area_px(noun, CAMERA, (240, 320), 120.0) * 0.9)

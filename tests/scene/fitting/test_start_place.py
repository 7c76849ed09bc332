"""Where a task starts whose object a hand brings: on free table in the picture, beside the goal."""

from dataclasses import replace

import numpy as np
import pytest

from v2p_data.errors import ItemRejectedError
from v2p_data.geometry.mesh import outline_points
from v2p_data.geometry.pose import transform
from v2p_data.scene.data_types import Fit, GroundedObjects, ObjectTrack, PlacedObject, Placement
from v2p_data.scene.fitting.end_poses import raised
from v2p_data.scene.fitting.silhouette import camera_above
from v2p_data.scene.fitting.start_place import with_start_place
from v2p_data.scene.frames.table import Table
from v2p_data.scene.remarks import remarks_on
from v2p_data.scene.scale.nouns import noun_for

CAMERA = camera_above((240, 320), 0.61, 1.01)
EMPTY = np.zeros((240, 320), bool)
GOAL_XY = (1.4, 0.0)


def fit_at(x, y, z, size):
    T = transform(np.eye(3), np.array([x, y, z]))
    return Fit(size=size, T_world_obj=T, iou=0.9, visible=1.0, cost=0.1)


def placed(fit):
    return PlacedObject(
        first=fit,
        last=fit,
        last_i=11,
        last_mask=EMPTY,
        hidden=EMPTY,
        last_hidden=EMPTY,
        frames=(11,),
        T_world_objs=fit.T_world_obj[None],
        confidences=(0.9,),
        observed=("full",),
        rival=None,
    )


def track(phrase, masks, *, brought):
    return ObjectTrack(
        phrase=phrase,
        role="manipulated" if brought else "reference",
        noun=noun_for("block"),
        masks=masks,
        quality=np.ones(12),
        moves=brought,
        at=11 if brought else 0,
        known_m=None,
        sure=0.9,
        why="",
        brought=brought,
    )


@pytest.fixture
def scene(segmentation_of):
    """Return objects and placement of a block that a hand brings from the right onto a low box.

    A camera height is 0.5 m.
    """
    working, segmentation = segmentation_of([[]] * 12)
    masks = np.zeros((12, 240, 320), bool)
    masks[3, 100:120, 290:310] = True
    masks[11, 100:120, 150:170] = True
    grounded = GroundedObjects(
        objects=(
            track("block", masks, brought=True),
            track("low box", masks[[11] * 12], brought=False),
        ),
        working=working,
        table=Table(seen=~EMPTY, hull=~EMPTY, lab=np.zeros((240, 320, 3), np.float32), noise=5.0),
        segmentation=segmentation,
        warnings=(),
    )
    placement = Placement(
        camera=CAMERA,
        pitch_rad=0.61,
        objects=(
            placed(fit_at(*GOAL_XY, 0.1, (0.08, 0.08, 0.08))),
            placed(fit_at(*GOAL_XY, 0.03, (0.3, 0.3, 0.06))),
        ),
        height_m=0.5,
        scale_spread=0.1,
        upright_cost=0.0,
    )
    return grounded, placement


def test_it_starts_on_the_table_clear_of_its_goal_where_the_hand_came_from(scene):
    started = with_start_place(scene[0], scene[1], "place_onto").objects[0]

    x, y, z = started.first.T_world_obj[:3, 3]
    assert z == pytest.approx(0.04)
    assert y < -0.19 - 0.02 / 0.5
    assert abs(x - GOAL_XY[0]) < abs(y)
    np.testing.assert_array_equal(started.T_world_objs[0], started.first.T_world_obj)
    np.testing.assert_array_equal(started.T_world_objs[1], started.last.T_world_obj)
    np.testing.assert_array_equal(started.T_world_seen, started.last.T_world_obj)
    assert started.frames == (0, 11)
    corners = outline_points("box", (0.08, 0.08, 0.08)) + started.first.T_world_obj[:3, 3]
    pixels = CAMERA.project(corners)
    assert (pixels > 0).all()
    assert (pixels < (320, 240)).all()


def test_what_ends_beside_another_thing_does_not_come_through_it(scene):
    grounded, placement = scene
    _, box = placement.objects
    left = placed(fit_at(GOAL_XY[0], 0.25, 0.04, (0.08, 0.08, 0.08)))
    beside = replace(placement, objects=(left, box))

    started = with_start_place(grounded, beside, "push_next_to").objects[0]

    assert started.first.T_world_obj[1, 3] >= 0.25 - 1e-9


def test_without_free_table_in_the_picture_the_clip_stays_rejected(scene):
    grounded, placement = scene
    bare = replace(grounded, table=replace(grounded.table, hull=EMPTY))

    with pytest.raises(ItemRejectedError, match="no free table") as caught:
        with_start_place(bare, placement, "place_onto")

    assert caught.value.reason == "not_there_at_first"


def test_the_scene_says_that_the_first_place_was_chosen(scene):
    grounded, placement = scene
    started = with_start_place(grounded, placement, "place_onto")
    away_m = 0.5 * np.linalg.norm(started.objects[0].first.T_world_obj[:2, 3] - GOAL_XY)

    said = [
        remark for remark in remarks_on("place_onto", grounded, started, 12) if "chosen" in remark
    ]

    assert said == [
        "a hand brings 'block': nothing shows it on the table at first; its first pose is a place that was chosen, "
        f"{100 * away_m:.0f} cm from where it ends"
    ]


def test_what_is_raised_covers_the_same_pixels_and_is_smaller():
    """From height 1 a thing on a support of 0.2 is seen as one on the table from height 0.8."""
    low = fit_at(1.5, 0.2, 0.1, (0.2, 0.3, 0.2))

    high = raised(low, 0.2, CAMERA)

    assert high.size == pytest.approx((0.16, 0.24, 0.16))
    np.testing.assert_allclose(high.T_world_obj[:3, 3], [1.2, 0.16, 0.28])
    pixels = [
        CAMERA.project(outline_points("box", fit.size) + fit.T_world_obj[:3, 3])
        for fit in (low, high)
    ]
    np.testing.assert_allclose(pixels[0], pixels[1], atol=1e-6)

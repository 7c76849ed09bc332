"""Truth and reconstruction are compared by what can be seen and used; numbers by hand."""

import numpy as np
import pytest
import trimesh
from scipy.spatial.transform import Rotation

from drawn_clips.score import score_clip, turn_between
from drawn_clips.score_types import FoundClip, FoundThing, TrueClip, TrueThing
from drawn_clips.shape_overlap import shape_ious
from v2p_data.geometry.mesh import mesh_for
from v2p_data.geometry.pose import transform

BOX_M = (0.12, 0.08, 0.04)
CAMERA = transform(np.diag([1.0, -1.0, -1.0]), np.array([0, 0, 0.5]))


def about(axis: str, degrees: float) -> np.ndarray:
    return Rotation.from_euler(axis, degrees, degrees=True).as_matrix()


def mask(rows: slice, columns: slice) -> np.ndarray:
    image = np.zeros((40, 60), bool)
    image[rows, columns] = True
    return image


SEEN = mask(slice(10, 20), slice(10, 20))


def true_thing(size=BOX_M, form="box", hollow=False, symmetry="box", move=(0.1, 0, 0), **more):
    mesh = mesh_for(form, size, hollow=hollow)
    T = np.tile(np.eye(4), (10, 1, 1))
    T[:, :3, 3] = np.linspace(0, 1, 10)[:, None] * move + [0, 0, size[2] / 2]
    values = {
        "phrase": "red box",
        "manipulated": True,
        "size_m": size,
        "hollow": hollow,
        "symmetry": symmetry,
        "mesh": mesh,
        "T_world_objs": T,
        "masks": {0: SEEN, 5: SEEN, 9: SEEN},
    }
    return TrueThing(**{**values, **more})


def found_thing(size=BOX_M, form="box", hollow=False, move=(0.1, 0, 0), **more):
    at = np.array([0, 0, size[2] / 2])
    values = {
        "phrase": "red box",
        "size_m": size,
        "hollow": hollow,
        "is_round": form == "cylinder",
        "is_ball": form == "sphere",
        "mesh": mesh_for(form, size, hollow=hollow),
        "T_world_first": transform(np.eye(3), at),
        "T_world_last": transform(np.eye(3), at + move),
        "last_frame": 9,
        "masks": {0: SEEN, 5: SEEN, 9: SEEN},
    }
    return FoundThing(**{**values, **more})


def scored(true, found, kind="push_left", found_kind=None):
    return score_clip(
        TrueClip(kind=kind, things=(true,), T_world_cam=CAMERA),
        FoundClip(kind=found_kind or kind, things=(found,), T_world_cam=CAMERA),
    )


def test_the_truth_itself_is_a_usable_scene_without_error():
    score = scored(true_thing(), found_thing())

    assert score.usable
    thing = score.things[0]
    assert (thing.box_iou, thing.iou_mean, thing.shape_iou) == (1, 1, 1)
    assert thing.size_error_m == 0
    assert thing.position_last_m == pytest.approx(0)
    assert thing.turn_last_rad == pytest.approx(0, abs=1e-6)


def test_errors_are_distances_between_centres_in_metres():
    thing = scored(true_thing(), found_thing(move=(0.1, 0.03, 0.04))).things[0]

    assert thing.position_first_m == pytest.approx(0)
    assert thing.position_last_m == pytest.approx(0.05)


def test_a_quarter_turn_of_a_square_box_is_nothing_and_of_a_long_one_a_quarter_turn():
    square = (0.08, 0.08, 0.04)
    of_square = turn_between(
        true_thing(square), found_thing(square), np.eye(3), about("z", 90 + 12)
    )
    of_long = turn_between(true_thing(), found_thing(), np.eye(3), about("z", 90))

    assert np.degrees(of_square) == pytest.approx(12)
    assert np.degrees(of_long) == pytest.approx(90)


def test_of_a_can_only_the_axis_counts_and_of_a_cup_its_direction_too():
    size = (0.07, 0.07, 0.11)
    can = true_thing(size, "cylinder", symmetry="round"), found_thing(size, "cylinder")
    cup = (
        true_thing(size, "cylinder", hollow=True, symmetry="round"),
        found_thing(size, "cylinder", hollow=True),
    )
    over, spun = about("x", 180), about("z", 70)

    assert turn_between(*can, np.eye(3), spun) == pytest.approx(0, abs=1e-6)
    assert turn_between(*can, np.eye(3), over) == pytest.approx(0, abs=1e-6)
    assert np.degrees(turn_between(*can, np.eye(3), about("x", 80))) == pytest.approx(80)
    assert np.degrees(turn_between(*cup, np.eye(3), over)) == pytest.approx(180)


def test_shapes_overlap_as_their_volumes_do():
    cube = trimesh.creation.box((1, 1, 1))
    ball, can = trimesh.creation.icosphere(4, 0.5), trimesh.creation.cylinder(0.5, 1, sections=64)
    plain = {"hollow": (False, False), "cavity_matters": False}

    assert shape_ious(cube, ball, **plain)[0] == pytest.approx(np.pi / 6, abs=0.01)
    assert shape_ious(cube, can, **plain)[0] == pytest.approx(np.pi / 4, abs=0.01)
    assert shape_ious(cube, mesh_for("box", (3.0, 1.0, 0.2)), **plain)[0] == 1


def test_the_wrong_place_in_the_picture_fails_grounding_and_segmentation():
    elsewhere = mask(slice(10, 20), slice(16, 26))  # 4 of 16 columns in common
    found = found_thing(masks={0: elsewhere, 9: elsewhere})
    score = scored(true_thing(), found)

    assert score.things[0].box_iou == pytest.approx(0.25)
    assert score.things[0].iou_mean == pytest.approx(0.25)
    assert set(score.failures) == {"grounding", "segmentation"}
    assert score.trouble == ("grounding", "'red box': box IoU 0.25")


def test_what_is_hidden_at_first_is_looked_for_at_the_end():
    hidden = np.zeros_like(SEEN)
    true = true_thing(masks={0: hidden, 5: hidden, 9: SEEN})
    found = found_thing(masks={0: ~SEEN, 9: SEEN})

    thing = scored(true, found).things[0]
    assert thing.box_iou == 1
    assert thing.iou_mean == 1


@pytest.mark.parametrize(
    ("found", "stage"),
    [
        (found_thing(move=(0.16, 0, 0)), "pose"),
        (found_thing((0.2, 0.08, 0.04)), "size"),
        (
            found_thing(T_world_last=transform(about("z", 40), np.array([0.1, 0, 0.02]))),
            "pose",
        ),
        (
            found_thing(mesh=trimesh.Trimesh([[0, 0, 0], [1, 0, 0], [0, 1, 1]], [[0, 1, 2]])),
            "mesh",
        ),
    ],
)
def test_a_scene_with_one_fault_is_not_usable(found, stage):
    trouble = scored(true_thing(), found).trouble

    assert trouble is not None
    assert trouble[0] == stage


def test_a_missing_second_object_fails_grounding():
    true = true_thing(), true_thing(phrase="can", manipulated=False)
    score = score_clip(
        TrueClip(kind="push_next_to", things=true, T_world_cam=CAMERA),
        FoundClip(kind="push_next_to", things=(found_thing(),), T_world_cam=CAMERA),
    )

    assert "'can'" in score.failures["grounding"]
    assert not score.things[0].failures()

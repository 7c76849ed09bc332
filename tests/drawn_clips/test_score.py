"""Truth and reconstruction are compared by what can be seen and used; numbers by hand."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import trimesh
from scipy.spatial.transform import Rotation

from drawn_clips.score import found_of, rejected, score_clip, shown_at, size_sides, turn_between
from drawn_clips.score_types import FoundClip, FoundThing, TrueClip, TrueThing
from drawn_clips.shape_overlap import opening, shape_ious
from v2p_data.geometry.mesh import mesh_for
from v2p_data.geometry.pose import transform
from v2p_data.scene.data_types import Estimate, Reconstruction
from v2p_data.scene.fitting.silhouette import camera_above
from v2p_data.scene.scale.nouns import noun_for
from v2p_data.scene.shapes.spoon import spoons
from v2p_data.video.clip import Clip

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


def test_a_depth_that_the_scene_does_not_claim_to_know_is_told_apart():
    sight = np.array([0.1, 0, -0.48]) / np.hypot(
        0.1, 0.48
    )  # from the camera to where it truly ends
    move = np.array([0.1, 0.01, 0]) + 0.06 * sight

    claimed = scored(true_thing(), found_thing(move=move)).things[0]
    open_ = scored(true_thing(), found_thing(move=move, last_depth_seen=False)).things[0]

    assert claimed.position_last_m == pytest.approx(np.hypot(0.01, 0.06))
    assert claimed.position_last_depth_m is None
    assert "pose" in claimed.failures()
    assert open_.position_last_m == pytest.approx(0.01)
    assert open_.position_last_depth_m == pytest.approx(0.06)
    assert "pose" not in open_.failures()


def test_a_camera_that_is_taken_to_be_higher_shows_in_its_own_frame_only():
    true, found = true_thing(), found_thing()
    higher = CAMERA.copy()
    higher[2, 3] += 0.07
    thing = score_clip(
        TrueClip(kind="push_left", things=(true,), T_world_cam=CAMERA),
        FoundClip(kind="push_left", things=(found,), T_world_cam=higher),
    ).things[0]

    assert thing.position_first_m == pytest.approx(0)
    assert thing.position_first_cam_m == pytest.approx(0.07)


def test_a_box_may_name_its_sides_in_another_order():
    found = found_thing(size=(BOX_M[1], BOX_M[0], BOX_M[2]))
    swapped = turn_between(true_thing(), found, np.eye(3), about("z", 90))
    unturned = turn_between(true_thing(), found, np.eye(3), np.eye(3))

    assert swapped == pytest.approx(0, abs=1e-6)
    assert np.degrees(unturned) == pytest.approx(90)


@pytest.mark.parametrize(("axis", "degrees"), [("x", 180), ("y", 180), ("z", 180)])
def test_a_box_turned_by_half_a_turn_is_the_same_box(axis, degrees):
    turn = turn_between(true_thing(), found_thing(), np.eye(3), about(axis, degrees))

    assert turn == pytest.approx(0, abs=1e-6)


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


def test_a_ball_has_no_orientation():
    ball = true_thing((0.07,) * 3, "sphere", symmetry="sphere")

    assert turn_between(ball, found_thing(), np.eye(3), about("y", 77)) == 0


def test_a_can_taken_for_a_box_has_the_mean_side_as_its_diameter():
    can = true_thing((0.07, 0.07, 0.11), "cylinder", symmetry="round")
    # lies on its side in its own frame: the axis is x
    sides, ours = size_sides(can, found_thing((0.12, 0.06, 0.08)))

    assert sides.tolist() == pytest.approx([0.07, 0.11])
    assert ours.tolist() == pytest.approx([0.07, 0.12])


def test_the_size_error_of_a_box_is_of_its_sorted_sides():
    thing = scored(true_thing(), found_thing((0.05, 0.13, 0.08))).things[0]

    # 12 8 4 against 13 8 5 cm
    assert thing.size_error_m == pytest.approx(0.02 / 3)
    assert thing.size_error_share == pytest.approx((1 / 12 + 0 + 1 / 4) / 3)


def test_shapes_overlap_as_their_volumes_do():
    cube = trimesh.creation.box((1, 1, 1))
    ball, can = trimesh.creation.icosphere(4, 0.5), trimesh.creation.cylinder(0.5, 1, sections=64)
    plain = {"hollow": (False, False), "cavity_matters": False}

    assert shape_ious(cube, ball, **plain)[0] == pytest.approx(np.pi / 6, abs=0.01)
    assert shape_ious(cube, can, **plain)[0] == pytest.approx(np.pi / 4, abs=0.01)
    assert shape_ious(cube, mesh_for("box", (3.0, 1.0, 0.2)), **plain)[0] == 1


def test_a_lying_mesh_is_turned_upright_before_it_is_compared():
    cone = trimesh.creation.cone(0.04, 0.1)
    lying = cone.copy()
    lying.apply_transform(trimesh.transformations.rotation_matrix(np.pi / 2, [1, 0, 0]))

    volume, shape = shape_ious(cone, lying, hollow=(False, False), cavity_matters=False)

    assert volume == shape
    assert volume > 0.95


def test_an_open_box_is_open_upwards_and_a_closed_one_nowhere():
    bin_ = mesh_for("box", (0.2, 0.15, 0.1), hollow=True)
    over = bin_.copy()
    over.apply_transform(trimesh.transformations.rotation_matrix(np.pi, [1, 0, 0]))

    assert opening(mesh_for("box", BOX_M)) is None
    assert opening(mesh_for("sphere", (0.1, 0.1, 0.1))) is None
    up, down = opening(bin_), opening(over)
    assert up is not None
    assert down is not None
    assert (up[2], down[2]) == (1, -1)


def test_a_thicker_wall_is_no_broken_mesh_but_a_solid_container_is_one():
    size = (0.16, 0.12, 0.08)
    thin = mesh_for("box", size, hollow=True)
    thick = trimesh.util.concatenate(  # walls of 1 cm, a floor of 1 cm
        [
            trimesh.creation.box((0.16, 0.12, 0.01)).apply_translation((0, 0, -0.035)),
            trimesh.creation.box((0.01, 0.12, 0.07)).apply_translation((0.075, 0, 0.005)),
            trimesh.creation.box((0.01, 0.12, 0.07)).apply_translation((-0.075, 0, 0.005)),
            trimesh.creation.box((0.14, 0.01, 0.07)).apply_translation((0, 0.055, 0.005)),
            trimesh.creation.box((0.14, 0.01, 0.07)).apply_translation((0, -0.055, 0.005)),
        ]
    )
    assert isinstance(thick, trimesh.Trimesh)
    volume, shape = shape_ious(thin, thick, hollow=(True, True), cavity_matters=True)
    true = true_thing(size, hollow=True)

    assert volume < 0.6 < 0.75 < shape
    assert "mesh" in scored(true, found_thing(size), kind="insert").failures
    assert "mesh" not in scored(true, found_thing(size), kind="push_left").failures


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


def test_what_comes_and_goes_is_looked_for_where_it_shows_most():
    hidden, leaving = np.zeros_like(SEEN), mask(slice(10, 20), slice(0, 4))
    masks = {0: hidden, 4: SEEN, 6: SEEN, 9: leaving}
    true = true_thing(masks=masks)

    assert shown_at(true) == 6
    assert scored(true, found_thing(masks={6: SEEN, 9: ~SEEN})).things[0].box_iou == 1
    assert scored(true, found_thing(masks={6: leaving, 9: leaving})).things[0].box_iou == 0
    assert shown_at(true_thing(masks=dict.fromkeys(masks, hidden))) is None


def test_a_reconstruction_that_stops_before_the_motion_fails_its_pose():
    # after frame 3 of 9 a third of the way is done, and the pose is right
    found = found_thing(move=(0.1 / 3, 0, 0), last_frame=3)

    assert scored(true_thing(), found).failures == {
        "pose": "'red box': ends after 33% of the motion"
    }


@pytest.mark.parametrize(
    ("found", "stage"),
    [
        (found_thing(move=(0.16, 0, 0)), "pose"),
        (found_thing((0.2, 0.08, 0.04)), "size"),
        (
            found_thing(T_world_last=transform(about("z", 40), np.array([0.1, 0, 0.02]))),
            "pose",
        ),
        (found_thing(mesh=trimesh.Trimesh([[0, 0, 0], [1, 0, 0], [0, 1, 1]], [[0, 1, 2]])), "mesh"),
    ],
)  # fmt: skip
def test_a_scene_with_one_fault_is_not_usable(found, stage):
    trouble = scored(true_thing(), found).trouble

    assert trouble is not None
    assert trouble[0] == stage


def test_another_kind_of_task_is_not_usable():
    assert scored(true_thing(), found_thing(), found_kind="lift_up").trouble == (
        "kind",
        "lift_up instead of push_left",
    )


def test_a_missing_second_object_fails_grounding():
    true = true_thing(), true_thing(phrase="can", manipulated=False)
    score = score_clip(
        TrueClip(kind="push_next_to", things=true, T_world_cam=CAMERA),
        FoundClip(kind="push_next_to", things=(found_thing(),), T_world_cam=CAMERA),
    )

    assert "'can'" in score.failures["grounding"]
    assert not score.things[0].failures()


def test_objects_are_matched_by_what_the_caption_calls_them():
    true = (
        true_thing(),
        true_thing(phrase="can", manipulated=False),
        true_thing(phrase="cup", manipulated=False),
    )
    others = [replace(found_thing(), phrase=p) for p in ("cup", "can")]
    moved = replace(others[0], T_world_first=transform(np.eye(3), np.array([1.0, 0, 0.02])))
    score = score_clip(
        TrueClip(kind="generic", things=true, T_world_cam=CAMERA),
        FoundClip(kind="generic", things=(found_thing(), moved, others[1]), T_world_cam=CAMERA),
    )

    assert score.things[1].position_first_m == pytest.approx(0)
    assert score.things[2].position_first_m == pytest.approx(1)


def test_what_is_called_otherwise_is_matched_by_its_part():
    true = (true_thing(phrase="the can", manipulated=False),)  # what covers it has no name
    found = (found_thing(phrase="object"), found_thing(phrase="can", size=(0.07, 0.07, 0.11)))
    score = score_clip(
        TrueClip(kind="uncover", things=true, T_world_cam=CAMERA),
        FoundClip(kind="uncover", things=found, T_world_cam=CAMERA),
    )

    # 12 8 4 against 11 7 7 cm
    assert score.things[0].size_error_m == pytest.approx(0.05 / 3)


def test_a_rejected_clip_fails_every_stage_with_its_slug():
    true = TrueClip(kind="push_left", things=(true_thing(),), T_world_cam=CAMERA)

    assert set(rejected(true, "camera_moves").failures.values()) == {"camera_moves"}
    assert not rejected(true, "camera_moves").usable


def test_a_tool_is_compared_from_where_it_comes_into_the_picture():
    """It moves 10 cm in nine frames and is seen from the fifth on."""
    seen = {0: np.zeros_like(SEEN), 5: SEEN, 9: SEEN}
    true = true_thing(masks=seen)
    late = found_thing(T_world_first=transform(np.eye(3), np.array([0.1 * 5 / 9, 0, 0.02])))

    at_its_own = scored(true, replace(late, first_frame=5)).things[0]
    at_the_start = scored(true_thing(), replace(late, first_frame=5)).things[0]

    assert at_its_own.position_first_m == pytest.approx(0, abs=1e-9)
    assert at_the_start.position_first_m == pytest.approx(0.1 * 5 / 9)  # it was there all the time


def test_a_tool_need_not_be_followed_out_of_the_picture():
    """What it pushes rests from the fifth frame on; the tool goes on for half of its way."""
    pushed = true_thing()
    T = pushed.T_world_objs.copy()
    T[:, 0, 3] = [0.0, 0.02, 0.04, 0.06, 0.08, 0.1, 0.1, 0.1, 0.1, 0.1]
    pushed = replace(pushed, T_world_objs=T)
    tool = true_thing(phrase="stick", manipulated=False, move=(0.2, 0, 0))

    def share_at(last_frame):
        found = (found_thing(), replace(found_thing(), phrase="stick", last_frame=last_frame))
        return (
            score_clip(
                TrueClip(kind="push_with", things=(pushed, tool), T_world_cam=CAMERA),
                FoundClip(kind="push_with", things=found, T_world_cam=CAMERA),
            )
            .things[1]
            .travel_share
        )

    assert share_at(5) == pytest.approx(1)
    assert share_at(9) == pytest.approx(1)
    assert share_at(2) == pytest.approx(0.4)


def test_of_a_pose_whose_depth_is_declared_unseen_only_what_is_seen_counts():
    """The camera looks straight down: 3 cm too high is depth, 2 cm aside is not."""
    off = found_thing(T_world_first=transform(np.eye(3), np.array([0.02, 0, 0.05])))

    seen, unseen = (
        scored(true_thing(), replace(off, first_depth_seen=known)).things[0]
        for known in (True, False)
    )

    assert seen.position_first_m == pytest.approx(np.hypot(0.02, 0.03))
    assert seen.position_first_depth_m is None
    assert unseen.position_first_m == pytest.approx(0.02, abs=2e-3)
    assert unseen.position_first_depth_m == pytest.approx(0.03, abs=2e-3)


def test_what_goes_out_and_comes_half_way_back_has_gone_all_its_way_at_the_end():
    true = true_thing()
    T = true.T_world_objs.copy()
    T[:, 0, 3] = [0.0, 0.05, 0.1, 0.15, 0.2, 0.2, 0.16, 0.12, 0.1, 0.1]
    true = replace(true, T_world_objs=T)

    thing = scored(true, found_thing()).things[0]
    early = scored(true, found_thing(last_frame=5, move=(0.2, 0, 0))).things[0]

    assert thing.travel_share == pytest.approx(1)
    assert early.travel_share == pytest.approx(2 / 3)


def test_of_a_mug_with_its_handle_and_a_round_one_the_open_side_is_compared():
    handled = true_thing(size=(0.074, 0.106, 0.078), hollow=True, symmetry="none")
    plain = found_thing(size=(0.065, 0.065, 0.075), form="cylinder", hollow=True)

    assert turn_between(handled, plain, about("z", 75), np.eye(3)) == pytest.approx(0, abs=1e-6)
    assert np.degrees(turn_between(handled, plain, np.eye(3), about("x", 90))) == pytest.approx(90)


@pytest.mark.parametrize(("name", "hollow"), [("spoon", False), ("bowl", True)])
def test_what_arches_is_no_vessel_and_what_is_open_is_one(name, hollow):
    """Room under a spoon's handle is not closed before spoons are compared."""
    noun, T = noun_for(name), np.eye(4)
    solids = {"spoon": spoons(noun.size_m, T)[0].mesh, "bowl": None}
    thing = Estimate(
        name=name, label=name, role="manipulated", noun=noun, size_m=noun.size_m, rgba=(1.0, 1.0, 1.0, 1.0), frames=(0, 1),
        T_world_objs=np.stack([T, T]), confidences=(1.0, 1.0), masks={}, source={}, mass_kg=0.1, mesh=solids[name],
    )  # fmt: skip
    clip = Clip(
        item="a", path=Path("a.mp4"), caption="", objects=(), hints={}, frames=np.zeros((2, 8, 8, 3), np.uint8), fps=12.0, total_frames=2,
        source_fps=12.0, source_frame=np.arange(2), times_s=np.arange(2) / 12, source_size_px=(8, 8), warnings=(),
    )  # fmt: skip
    made = Reconstruction(
        clip=clip, kind="lift_up", objects=(thing,), camera=camera_above((8, 8), 0.6, 1.0), confidence=1.0, warnings=(), stages={},
    )  # fmt: skip

    (found,) = found_of(made).things

    assert found.hollow is hollow

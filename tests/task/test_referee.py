from pathlib import Path

import numpy as np
import pytest

from v2p_data.geometry.camera import Camera, intrinsics, look_at
from v2p_data.kinds import KINDS, meanings_table
from v2p_data.scene.scene import Scene, SceneObject
from v2p_data.task.referee import RULES, ObjectTrack, Trajectory, referee_success

STEPS = 20
UPRIGHT = (1.0, 0.0, 0.0, 0.0)
LYING = (np.sqrt(0.5), np.sqrt(0.5), 0.0, 0.0)


def thing(name: str, size=(0.04, 0.04, 0.04), role="manipulated", shape="box") -> SceneObject:
    return SceneObject(
        name=name,
        label=name,
        role=role,
        shape=shape,
        size_m=size,
        mass_kg=0.1,
        friction=0.8,
        frames=(0, 1),
        poses_world=((0.0, 0.0, 0.02, *UPRIGHT), (0.0, 0.12, 0.02, *UPRIGHT)),
        confidences=(1.0, 1.0),
    )


def scene(kind: str, *objects: SceneObject) -> Scene:
    camera = Camera(
        width_px=64,
        height_px=48,
        K=intrinsics(64, 48, 1.0),
        T_world_cam=look_at(np.array([-0.5, 0.0, 0.5]), np.zeros(3)),
    )
    return Scene(
        title="clip",
        video="clip.mp4",
        description="",
        kind=kind,
        objects=objects,
        camera=camera,
        fps=20.0,
        num_frames=2,
        confidence=1.0,
    )


def track(
    start, end, *, quat_end=UPRIGHT, touched_last=False, touched_before=True, size=(0.04,) * 3
):
    """Three steps of rest, ten of moving in a straight line, then seven of rest, in one world."""
    share = np.clip((np.arange(STEPS) - 3) / 10, 0, 1)[:, None]
    pos = np.array(start) + share * (np.array(end) - np.array(start))
    quat = np.where(share < 1, np.array(UPRIGHT), np.array(quat_end))
    touched = np.zeros((STEPS, 1), bool)
    touched[3:13] = touched_before
    touched[13:] = touched_last
    return ObjectTrack(
        pos=pos[:, None],
        quat_wxyz=quat[:, None],
        size_m=np.array([size], float),
        by_arm=touched,
        touched=touched,
        grasped=touched,
    )


def verdict(kind, tracks, *objects) -> bool:
    """Judge with the tool's centre in what it handles, or 5 cm behind of what it pushes."""
    handled = tracks[1 if KINDS[kind].grasps == "tool" else 0]
    behind = 0.0 if KINDS[kind].grasps in ("manipulated", "tool") else 0.05
    trajectory = Trajectory(
        objects=dict(zip([o.name for o in objects], tracks, strict=True)),
        eef_pos=handled.pos - [0.0, behind, 0.0],
        opening_m=np.full((STEPS, 1), 0.04),
    )
    return bool(referee_success(kind, scene(kind, *objects), trajectory)[0])


BOX = thing("box")
REF = thing("ref", role="reference")
BOWL = thing("bowl", size=(0.12, 0.12, 0.05), role="container")
HERE = (0.5, 0.0, 0.02)
STILL = track((0.5, 0.2, 0.02), (0.5, 0.2, 0.02), touched_before=False)


def test_a_lift_is_high_and_held_at_the_end():
    up = (0.5, 0.0, 0.12)
    assert verdict("lift_up", [track(HERE, up, touched_last=True)], BOX)
    assert not verdict("lift_up", [track(HERE, up)], BOX)
    assert not verdict("lift_up", [track(HERE, (0.5, 0.0, 0.07), touched_last=True)], BOX)


def test_a_thing_on_its_way_through_the_air_is_not_held_up():
    still, waved = (track(HERE, (0.5, 0.0, 0.14), touched_last=True) for _ in range(2))
    waved.pos[-5:, 0, 1] = [0.0, 0.02, 0.04, 0.06, 0.08]
    assert verdict("lift_up", [still], BOX)
    assert not verdict("lift_up", [waved], BOX)


def test_a_box_leaning_into_the_table_was_pressed_through_it():
    # Standing on an edge, a 4 cm box reaches 28 mm below its centre: at 20 mm it is 8 mm deep in the table.
    edge = (np.cos(np.pi / 8), np.sin(np.pi / 8), 0.0, 0.0)
    far = dict(end=(0.5, 0.1, 0.02), quat_end=edge)
    assert not verdict("generic", [track(HERE, **far)], BOX)
    assert verdict("generic", [track(HERE, (0.5, 0.1, 0.029), quat_end=edge)], BOX)


def test_left_is_plus_y():
    left = [track(HERE, (0.5, 0.1, 0.02))]
    assert verdict("push_left", left, BOX)
    assert not verdict("push_right", left, BOX)
    assert verdict("push_right", [track(HERE, (0.5, -0.1, 0.02))], BOX)


@pytest.mark.parametrize(
    "cheat",
    [
        track(HERE, (0.5, 0.05, 0.02)),
        track(HERE, (0.6, 0.1, 0.02)),
        track(HERE, (0.5, 0.1, 0.02), quat_end=LYING),
        track(HERE, (0.5, 0.1, 0.10), touched_last=True),
        track(HERE, (0.5, 0.1, -0.01)),
    ],
    ids=["too short", "mostly forward", "toppled", "carried", "pressed through the table"],
)
def test_a_push_that_cheats_does_not_count(cheat):
    assert not verdict("push_left", [cheat], BOX)


def test_a_thing_tipped_over_lies_on_the_table():
    tall = thing("box", size=(0.04, 0.04, 0.12))
    size = (0.04, 0.04, 0.12)
    start, lies, floats = (0.5, 0, 0.06), (0.5, 0.08, 0.02), (0.5, 0.08, 0.1)
    assert verdict("tip_over", [track(start, lies, quat_end=LYING, size=size)], tall)
    assert not verdict("tip_over", [track(start, (0.5, 0.1, 0.06), size=size)], tall)
    assert not verdict("tip_over", [track(start, floats, quat_end=LYING, size=size)], tall)


def test_next_to_means_a_small_gap_to_a_thing_that_stayed():
    # Outlines of 4 cm boxes touch at 4 cm between centres; 6 cm leaves a gap of 2 cm.
    assert verdict("push_next_to", [track(HERE, (0.5, 0.14, 0.02)), STILL], BOX, REF)
    assert not verdict("push_next_to", [track(HERE, (0.5, 0.12, 0.02)), STILL], BOX, REF)
    fled = track((0.5, 0.2, 0.02), (0.5, 0.24, 0.02))
    assert not verdict("push_next_to", [track(HERE, (0.5, 0.18, 0.02)), fled], BOX, REF)


def carried(end, *, touched_last=False) -> ObjectTrack:
    path = track(HERE, end, touched_last=touched_last)
    path.pos[4:12, 0, 2] = 0.15
    return path


def bowl_track() -> ObjectTrack:
    at = (0.5, 0.2, 0.025)
    return track(at, at, touched_before=False, size=(0.12, 0.12, 0.05))


def test_inserted_means_carried_in_let_go_and_above_the_floor():
    inside = (0.5, 0.21, 0.03)
    assert verdict("insert", [carried(inside), bowl_track()], BOX, BOWL)
    assert not verdict("insert", [carried(inside, touched_last=True), bowl_track()], BOX, BOWL)
    assert not verdict("insert", [carried((0.5, 0.21, 0.0)), bowl_track()], BOX, BOWL)
    assert not verdict("insert", [track(HERE, (0.5, 0.12, 0.02)), bowl_track()], BOX, BOWL)


@pytest.mark.parametrize(
    ("lift_m", "thick_m", "counts"),
    [
        (0.028, 0.011, True),
        (0.018, 0.011, False),
        (0.028, 0.025, False),
        (0.035, 0.025, True),
    ],
)
def test_what_is_put_onto_something_low_needs_no_higher_lift(lift_m, thick_m, counts):
    size = (0.12, 0.12, thick_m)
    there = (0.5, 0.2, thick_m / 2)
    put = track(HERE, (0.5, 0.2, thick_m + 0.02))
    put.pos[4:12, 0, 2] = 0.02 + lift_m

    coaster = thing("coaster", size=size, role="reference")
    low = track(there, there, touched_before=False, size=size)
    assert verdict("place_onto", [put, low], BOX, coaster) == counts


def test_a_thing_lowered_into_a_bowl_was_not_thrown():
    assert not verdict("throw_into", [carried((0.5, 0.2, 0.03)), bowl_track()], BOX, BOWL)
    far = carried((0.5, 0.2, 0.03))
    far.by_arm[8:] = False  # let go 10 cm before the bowl's middle ...
    assert not verdict("throw_into", [far, bowl_track()], BOX, BOWL)
    far.by_arm[5:] = False  # ... and here 16 cm before it, 10 cm before its rim
    assert verdict("throw_into", [far, bowl_track()], BOX, BOWL)


def test_in_front_of_is_the_robots_side():
    near, far = (0.44, 0.2, 0.02), (0.56, 0.2, 0.02)
    assert verdict("drop_in_front_of", [carried(near), STILL], BOX, REF)
    assert not verdict("drop_in_front_of", [carried(far), STILL], BOX, REF)


def test_a_lid_toppled_is_not_uncovered():
    lid = thing("lid", size=(0.08, 0.08, 0.04), role="cover")
    under = track(HERE, HERE, touched_before=False)
    lifted = track(HERE, (0.5, 0.2, 0.02), size=(0.08, 0.08, 0.04))
    toppled = track(HERE, (0.5, 0.2, 0.04), quat_end=LYING, size=(0.08, 0.08, 0.04))
    for lid_track in (lifted, toppled):
        lid_track.pos[4:12, 0, 2] = 0.15
    assert verdict("uncover", [lifted, under], lid, REF)
    assert not verdict("uncover", [toppled, under], lid, REF)


def test_the_tool_must_do_the_pushing():
    tool = track((0.5, -0.05, 0.02), (0.5, 0.05, 0.02), touched_last=True)
    by_tool = track(HERE, (0.5, 0.1, 0.02), touched_before=False)
    by_hand = track(HERE, (0.5, 0.1, 0.02))
    assert verdict("push_with", [by_tool, tool], BOX, REF)
    assert not verdict("push_with", [by_hand, tool], BOX, REF)


@pytest.mark.parametrize("kind", sorted(RULES))
def test_doing_nothing_is_no_success(kind):
    still = track(HERE, HERE, touched_before=False)
    assert not verdict(kind, [still, STILL], BOX, REF)


def test_the_page_prints_the_table_that_the_referee_reads():
    page = Path(__file__).parents[2] / "docs" / "experts.md"

    assert meanings_table() in page.read_text(encoding="utf-8")


@pytest.mark.parametrize("moves_before", [False, True])
def test_what_moves_before_the_arms_contact_moves_by_itself(moves_before: bool):
    way = track(HERE, (0.5, 0.1, 0.02))
    if moves_before:
        way.by_arm[:8] = False

    assert verdict("push_left", [way], BOX) != moves_before


def test_what_starts_at_its_goal_must_leave_it_and_is_no_success_where_it_comes_back_to():
    onto = (0.5, 0.2, 0.045)
    block = thing("block", size=(0.12, 0.12, 0.025), role="reference")
    low = track(
        (0.5, 0.2, 0.0125), (0.5, 0.2, 0.0125), touched_before=False, size=(0.12, 0.12, 0.025)
    )
    there, elsewhere = track((0.5, 0.16, 0.045), onto), track(HERE, onto)
    for put in (there, elsewhere):
        put.pos[4:12, 0, 2] = 0.15

    assert verdict("place_onto", [elsewhere, low], BOX, block)
    assert not verdict("place_onto", [there, low], BOX, block)

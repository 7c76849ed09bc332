"""The twin: its mechanisms, what it tells and hides, and that it is fixed."""

from dataclasses import fields, replace

import mujoco
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from v2p_data.errors import V2PError
from v2p_data.experts.teacher import Teacher
from v2p_data.sim.env.targets import DOWN, ToolPose
from v2p_data.sim.robot.robot import HOME_QPOS, tool_state
from v2p_data.sim.wrappers.gym_env import stream_seed
from v2p_data.task.benchmark import load_benchmark
from v2p_data.twin.arm import TwinArm
from v2p_data.twin.camera import RAW_PX, Optics
from v2p_data.twin.control import tool_pose
from v2p_data.twin.parameters import changed, draw, nominal
from v2p_data.twin.robot import TwinRobot
from v2p_data.twin.world import TIMESTEP_S

DIGEST = "119909d1c31be3037b6f2ba784b375fadd587dcfc4795a7f179de938efecbd13"


@pytest.fixture(scope="module")
def bundle():
    return load_benchmark("lift_up")


@pytest.fixture(scope="module")
def arm(bundle):
    return TwinArm(bundle)


@pytest.fixture(scope="module")
def robot(arm) -> TwinRobot:
    return arm.robot


def held_still(arm: TwinArm, pos, seconds: float = 1.0, opening: float = 1.0) -> None:
    """Hold the tool at a place for a while, without the leashes."""
    arm.reset(0)
    arm.robot.command(ToolPose(pos=np.array(pos), rotation=DOWN, opening=opening))
    arm.robot.step(seconds)


def tool_truth(robot: TwinRobot) -> np.ndarray:
    """Return where the tool really is."""
    mujoco.mj_forward(robot.world.model, robot._data)
    return robot._data.site_xpos[robot.world.model.site("tcp").id].copy()


def tool_read(robot: TwinRobot) -> np.ndarray:
    """Return where the tool is by what the joints report."""
    now = robot.measure()
    return tool_pose(now.joints, now.opening).pos


def test_the_nominal_twin_is_the_one_that_was_drawn_before_any_policy_was_scored():
    assert nominal().digest() == DIGEST


def test_every_parameter_lies_in_its_range_and_names_its_source():
    twins = [nominal(), draw(1), draw(2)]

    for f in fields(nominal()):
        low, high = f.metadata["low"], f.metadata["high"]
        values = np.array([np.atleast_1d(getattr(twin, f.name)) for twin in twins])
        assert ((low <= values) & (values <= high)).all(), f.name
        assert len(np.unique(values)) == values.size, f.name
        assert f.metadata["source"], f.name


def test_a_sweep_changes_one_number_and_refuses_what_is_none():
    late = changed({"command_latency_s": 0.3})

    assert replace(late, command_latency_s=nominal().command_latency_s) == nominal()
    with pytest.raises(V2PError, match="command_latency_s"):
        changed({"comand_latency_s": 0.3})
    for name, value in (
        ("command_latency_s", float("nan")),
        ("command_latency_s", -0.1),
        ("mass_scale", 0.0),
        ("jpeg_quality", 300.0),
    ):
        with pytest.raises(V2PError, match=name):
            changed({name: value})


def test_mechanisms_differ_from_the_training_simulators(arm):
    ours, theirs = arm.robot.world.model, arm.mirror.world.model

    assert ours.opt.integrator != theirs.opt.integrator
    assert ours.opt.cone != theirs.opt.cone
    assert ours.opt.timestep != theirs.opt.timestep
    mesh = int(mujoco.mjtGeom.mjGEOM_MESH)
    theirs_first = list(arm.mirror.world.objects[0].geom_ids)
    assert set(theirs.geom_type[theirs_first].tolist()) != {mesh}
    for obj in arm.robot.world.objects:
        assert set(ours.geom_type[list(obj.geom_ids)].tolist()) == {mesh}
    # Torques at joints on one side, Cartesian servos at a site on the other.
    joint = int(mujoco.mjtTrn.mjTRN_JOINT)
    assert set(ours.actuator_trntype[:7].tolist()) == {joint}
    assert set(ours.actuator_biastype[:7].tolist()) == {int(mujoco.mjtBias.mjBIAS_NONE)}
    assert joint not in theirs.actuator_trntype[:4].tolist()


def test_joint_readings_give_the_tools_pose_up_to_what_calibration_misses(arm):
    held_still(arm, [0.52, 0.06, 0.2])

    assert np.linalg.norm(tool_read(arm.robot) - tool_truth(arm.robot)) < 1e-3


def test_a_twin_without_errors_reads_the_sites_pose_exactly(bundle):
    none = dict.fromkeys(("backlash_rad", "reading_latency_s", "latency_jitter_s"), 0.0)
    zeros = {"joint_offset_rad": (0.0,) * 7, "mount_pos_m": (0.0,) * 3, "mount_rad": (0.0,) * 3}
    exact = TwinRobot(bundle, replace(nominal(), **none, **zeros))
    exact.command(ToolPose(pos=np.array([0.5, 0.0, 0.2]), rotation=DOWN, opening=1.0))
    exact.step(0.3)

    np.testing.assert_allclose(tool_read(exact), tool_truth(exact), atol=1e-9)


def test_the_arm_settles_where_it_is_told_to_without_overshoot(arm):
    arm.reset(0)
    goal = np.array([0.55, 0.1, 0.15])
    arm.robot.command(ToolPose(pos=goal, rotation=DOWN, opening=1.0))
    way = goal - tool_truth(arm.robot)
    beyond = []
    for _ in range(30):
        arm.robot.step(0.05)
        beyond.append((tool_truth(arm.robot) - goal) @ way / np.linalg.norm(way))

    assert np.linalg.norm(tool_truth(arm.robot) - goal) < 0.005
    assert max(beyond) < 0.01


def test_the_gripper_needs_its_stroke_time_and_reports_in_counts(arm):
    held_still(arm, [0.5, 0.25, 0.3])
    arm.robot.command(ToolPose(pos=np.array([0.5, 0.25, 0.3]), rotation=DOWN, opening=0.0))
    openings = []
    for _ in range(60):
        arm.robot.step(0.05)
        openings.append(arm.robot.measure().opening)

    closed_s = 0.05 * (1 + int(np.argmax(np.array(openings) < 0.03)))
    stroke_s = 0.085 / nominal().gripper_speed_m_s
    assert stroke_s - 0.05 < closed_s < stroke_s + 0.25
    counts = np.array(openings) * 255
    np.testing.assert_allclose(counts, np.rint(counts), atol=1e-9)


@pytest.mark.parametrize("latency_s", [0.0, 0.02, 0.3])
def test_a_command_moves_nothing_before_its_latency_is_over(bundle, latency_s):
    late = replace(nominal(), command_latency_s=latency_s, latency_jitter_s=0.0)
    robot = TwinRobot(bundle, late)
    robot.step(0.5)  # so that the arm rests
    before = robot._control.reference.copy()

    robot.command(ToolPose(pos=np.array([0.5, 0.1, 0.3]), rotation=DOWN, opening=1.0))
    steps = 0
    while np.abs(robot._control.speed).max() < 0.02 and steps < 300:
        robot.step(TIMESTEP_S)
        steps += 1

    assert not np.array_equal(before, robot._control.reference)
    assert 0 < steps - round(latency_s / TIMESTEP_S) <= 3


def test_readings_are_late_by_the_latency(bundle):
    late = replace(nominal(), reading_latency_s=0.1, latency_jitter_s=0.0)
    robot = TwinRobot(bundle, late)
    robot.command(ToolPose(pos=np.array([0.5, 0.1, 0.3]), rotation=DOWN, opening=1.0))
    encoders = [robot._encoders()]
    for _ in range(100):
        robot.step(TIMESTEP_S)
        encoders.append(robot._encoders())

    np.testing.assert_array_equal(robot.measure().joints, encoders[-1 - 50])


def test_rectification_undoes_the_lens_within_half_a_pixel():
    p = nominal()
    exact = {"calibration_focal_scale": 1.0, "calibration_k_scale": 1.0}
    zeros = dict.fromkeys(("calibration_m", "calibration_rad"), (0.0,) * 3)
    optics = Optics(parameters=replace(p, **exact, **zeros, calibration_centre_px=(0.0, 0.0)))
    points = np.random.default_rng(0).uniform([0.4, -0.25, 0], [0.65, 0.25, 0.2], (50, 3))

    # Forwards: through the true pinhole and lens. Backwards: where rectification fetches the pixel.
    rectified = optics.rectified.project(points)
    raw = optics.raw_of_rectified(rectified)
    drawn = optics.pinhole_of_raw(raw)
    assert ((raw > 0) & (raw < RAW_PX)).all()
    assert np.abs(drawn - optics.pinhole.project(points)).max() < 0.5
    corner = np.array([[24.0, 24.0]])
    straight = optics.true_lens.undistort(corner)[:, :2]
    bent = (corner - optics.true_lens.K[:2, 2]) / optics.true_lens.K[[0, 1], [0, 1]]
    assert np.abs(straight - bent).max() * RAW_PX > 4  # there is something to be undone


@pytest.mark.parametrize("seed", [0, 7])
def test_episodes_start_as_the_training_simulators_of_the_same_seed(arm, seed):
    arm.reset(seed)
    truth = arm.robot.truth()
    env = type(arm.mirror)(arm.mirror.bundle)
    env.reset_seeded(np.array([0]), [stream_seed(seed)])
    states = env.states()

    for k, name in enumerate(env.object_names):
        np.testing.assert_allclose(
            truth.object_poses[k, :2], states[f"{name}_pos"][0, :2], atol=1e-6
        )
        np.testing.assert_allclose(truth.object_poses[k, 3:], states[f"{name}_quat"][0], atol=1e-6)
    np.testing.assert_allclose(
        tool_state(truth.joints[None], np.zeros((1, 7))).pos[0], states["eef_pos"][0], atol=1e-6
    )


def test_a_scripted_grasp_lifts_and_the_referee_sees_it(arm):
    teacher = Teacher(arm.mirror)
    teacher.name = "lift"
    arm.reset(0)
    held, deepest = [], 0.0
    for _ in range(60):
        held.append(arm.act(teacher.act()[0]).held[0])
        deepest = max(deepest, arm.robot.truth().deepest_m)

    assert held[-1]
    assert arm.mirror.referee.verdict()[0]
    assert not held[0]
    assert deepest < 0.003


def test_the_referee_denies_an_episode_in_which_nothing_happens(arm):
    arm.reset(0)
    outcomes = [arm.act(np.zeros(7)) for _ in range(8)]

    assert not any(o.held[0] or o.terminated[0] for o in outcomes)
    assert not arm.mirror.referee.verdict()[0]


def test_a_seed_repeats_its_episode(arm):
    action = np.array([0.3, -0.2, -0.5, 0.0, 0.1, 0.2, 0.5])

    def end():
        arm.reset(5)
        for _ in range(6):
            arm.act(action)
        return np.concatenate([arm.state(), arm.robot.truth().object_poses.ravel()])

    first = end()
    np.testing.assert_array_equal(first, end())


def test_readings_tell_nothing_of_the_objects(arm):
    arm.reset(0)
    first = arm.robot.measure()
    arm.robot._data.qpos[arm.robot.world.object_qpos[:, 0]] += 0.2
    arm.robot.step(0.02)
    moved = arm.robot.measure()
    arm.reset(0)
    arm.robot.measure()
    arm.robot.step(0.02)

    np.testing.assert_array_equal(moved.joints, arm.robot.measure().joints)
    assert first.opening == 1.0


def test_true_labels_show_the_objects_where_the_true_camera_sees_them(arm):
    arm.reset(0)
    labels = arm.robot.true_labels()
    poses = arm.robot.truth().object_poses
    # From the true camera to the rectified picture: what the calibration believes is off by a few pixels.
    at = arm.robot.optics.rectified.project(poses[:, :3])

    for k in range(len(poses)):
        rows, columns = np.nonzero(labels == 2 + k)
        middle = np.array([columns.mean() + 0.5, rows.mean() + 0.5])
        assert np.linalg.norm(middle - at[k]) < 12
    assert labels.shape == (256, 256)
    assert {0, 1, 2} <= set(np.unique(labels))


def test_pictures_show_what_the_labels_say(arm):
    arm.reset(0)
    try:
        picture = arm.robot.picture()
    except V2PError as error:
        pytest.skip(str(error))
    raw = arm.robot.camera.raw_picture(arm.robot._data.qpos)
    labels = arm.robot.true_labels()
    thing = picture[labels == 2].astype(float)
    table = picture[labels == 0].astype(float)

    assert picture.shape == (256, 256, 3)
    assert raw.shape == (RAW_PX, RAW_PX, 3)
    assert np.abs(thing.mean(0) - table.mean(0)).max() > 20
    again = arm.robot.picture().astype(int)
    assert 0.2 < np.abs(again - picture).mean() < 6  # noise differs, the scene does not


def test_the_nominal_kinematics_are_those_of_the_training_simulator():
    pose = tool_pose(np.array(HOME_QPOS), 0.5)

    tool = tool_state(np.array([HOME_QPOS]), np.zeros((1, 7)))
    np.testing.assert_allclose(pose.pos, tool.pos[0])
    turn = pose.rotation * Rotation.from_quat(tool.quat_wxyz[0], scalar_first=True).inv()
    assert turn.magnitude() < 1e-9

"""Targets of the tool and of joints say what a step says, and lead worlds to where the step leads."""

from dataclasses import replace

import mujoco
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from v2p_data.episodes.dataset.features import STATE_NAMES, action_column, state_column
from v2p_data.errors import V2PError
from v2p_data.geometry.rotation import quats_about_z
from v2p_data.sim.env.actions import bounds_of, joints_near, steps_to, targets_of
from v2p_data.sim.env.batch_env import BatchEnv, SimConfig
from v2p_data.sim.env.ranges import RandomizationConfig
from v2p_data.sim.robot.action_names import DELTA_NAMES, TOOL_NAMES, action_names, actions_named
from v2p_data.sim.robot.robot import HOME_QPOS
from v2p_data.sim.wrappers.gym_env import V2PEnv

STEPS = 20


@pytest.fixture
def worlds_of(make_bundle, lift_task):
    """Return worlds that are commanded exactly, unless noise is asked for."""

    def make(noise: float = 0.0) -> BatchEnv:
        cfg = SimConfig(randomization=replace(RandomizationConfig(), action_noise=noise))
        return BatchEnv(make_bundle(), cfg, num_envs=6, seed=2, num_threads=1, task=lift_task)

    return make


def wandering() -> np.ndarray:
    """Return steps within the arm's reach that turn, tilt, and open and close to the fingers' ends."""
    rng = np.random.default_rng(0)
    steps = rng.uniform(-0.3, 0.3, (STEPS, 6, 7)) + rng.uniform(-0.15, 0.15, (1, 6, 7))
    steps[:, :, 6] *= 3
    steps[:, :, 3:5] *= 0.2
    return np.clip(steps, -1, 1).astype(np.float32)


@pytest.mark.parametrize("actions", ["absolute_tool", "joints"])
def test_a_target_becomes_the_step_that_leads_to_it(worlds_of, actions):
    worlds = worlds_of(noise=0.02)
    for step in wandering():
        target = targets_of(worlds, step, actions)

        made = steps_to(worlds, target, actions)

        for wanted, led in zip(
            worlds.targets_after(step), worlds.targets_after(made), strict=True
        ):
            assert np.abs(wanted - led).max() < 1e-8  # steps are rounded to 32 bits
        worlds.step(step)


@pytest.mark.parametrize("actions", ["absolute_tool", "joints"])
def test_recorded_targets_play_again(worlds_of, actions):
    first, again = worlds_of(), worlds_of()
    for step in wandering():
        target = targets_of(first, step, actions)
        first.step(step)

        again.step(steps_to(again, target, actions))

        assert np.abs(first.robot_state() - again.robot_state()).max() < 1e-6
        assert np.abs(first.motion()[0] - again.motion()[0]).max() < 1e-6


def test_a_target_of_the_tool_is_told_as_the_state_tells_where_it_is(worlds_of):
    worlds = worlds_of()
    still = np.zeros((6, 7), np.float32)
    for _ in range(STEPS):
        worlds.step(still)
    pos, _, finger = worlds.targets

    target = targets_of(worlds, still, "absolute_tool")

    np.testing.assert_allclose(target[:, :3], pos, atol=1e-12)
    # The tool has arrived by now.
    np.testing.assert_allclose(target[:, :6], worlds.robot_state()[:, :6], atol=2e-3)
    np.testing.assert_allclose(target[:, 6], finger / worlds.world.robot.finger_travel_m)


def test_targets_hold_no_more_than_the_controller_goes_for(worlds_of):
    worlds = worlds_of()
    down = np.zeros((6, 7), np.float32)
    down[:, 2] = -1
    for _ in range(STEPS):
        worlds.step(down)

    target = targets_of(worlds, down, "absolute_tool")

    low, _ = bounds_of("absolute_tool", 7)
    assert target[:, 2] == pytest.approx(low[2])


def test_joints_hold_the_tool_where_it_shall_be_by_the_shortest_way(worlds_of):
    robot = worlds_of().world.robot
    home = np.tile(HOME_QPOS, (3, 1))
    here = robot.tool_state(home, np.zeros((3, 7)))
    pos = here.pos + np.array([[0, 0, 0], [0.05, 0, 0], [0, -0.05, 0.05]])
    quat = np.array([[0, 1, 0, 0]] * 3, float)

    qpos = joints_near(home, pos, quat, robot)

    there = robot.tool_state(qpos, np.zeros((3, 7)))
    np.testing.assert_allclose(there.pos, pos, atol=1e-12)
    np.testing.assert_allclose(np.abs((there.quat_wxyz * quat).sum(1)), 1, atol=1e-12)
    assert np.abs(qpos - home).max() < 0.3


def test_a_pose_out_of_reach_leaves_joints_finite(worlds_of):
    robot = worlds_of().world.robot
    home = np.tile(HOME_QPOS, (1, 1))

    qpos = joints_near(home, np.array([[5.0, 0, 0]]), quats_about_z(np.zeros(1)).T, robot)

    assert np.isfinite(qpos).all()


def test_steps_of_the_tool_stay_as_they_are(worlds_of):
    worlds, steps = worlds_of(), wandering()[0]

    assert steps_to(worlds, steps, "delta_tool") is steps
    assert targets_of(worlds, steps, "delta_tool") is steps


@pytest.mark.parametrize("actions", ["delta_tool", "absolute_tool", "joints"])
def test_another_number_of_entries_is_told(worlds_of, actions):
    with pytest.raises(V2PError, match=rf"an action has 11 entries, and '{actions}' of the arm"):
        steps_to(worlds_of(), np.zeros((6, 11)), actions)


def test_names_tell_what_actions_say():
    for actions in ("delta_tool", "absolute_tool", "joints"):
        names = action_names(actions)
        assert actions_named(list(names)) == actions_named(names) == actions
        assert actions_named(names[:-1]) is None
    assert actions_named(action_names("joints", 6)) == "joints"
    for others in (None, [], {"motors": list(DELTA_NAMES)}, ["x"], 3):
        assert actions_named(others) is None


@pytest.mark.parametrize("actions", ["absolute_tool", "joints"])
def test_the_environment_goes_for_targets(actions, make_bundle, tmp_path):
    from v2p_data.task.benchmark import load_benchmark

    bundle = load_benchmark("push_left")
    (tmp_path / "scene").mkdir()
    bundle.scene.save(tmp_path / "scene")
    replace(bundle, scene=replace(bundle.scene, folder=tmp_path / "scene")).save(tmp_path / "task")
    by_steps, by_targets = (
        V2PEnv(str(tmp_path / "task"), size_px=32, actions=a) for a in ("delta_tool", actions)
    )
    for env in (by_steps, by_targets):
        env.reset(seed=3)

    for step in wandering()[:8, 0]:
        target = targets_of(by_targets._world, step[None], actions)[0]
        assert by_targets.action_space.contains(target.astype(np.float32))
        there, *_ = by_steps.step(step)
        here, *_ = by_targets.step(target)
        # At its end the gripper feels the noise that a step beyond the end does not let through.
        np.testing.assert_allclose(here["agent_pos"][:6], there["agent_pos"][:6], atol=1e-4)
    with pytest.raises(V2PError, match="an action has 3 entries"):
        by_targets.step(np.zeros(3))


def tool_sites(worlds: BatchEnv) -> tuple[np.ndarray, Rotation]:
    """Return where MuJoCo has the tools' sites, and how they are turned, in the robot's base frame."""
    data = mujoco.MjData(worlds.world.model)
    pos, turned = [], []
    for qpos in worlds.motion()[0]:
        data.qpos[:] = qpos
        mujoco.mj_kinematics(worlds.world.model, data)
        pos.append(data.site("tcp").xpos.copy())
        turned.append(data.site("tcp").xmat.reshape(3, 3).copy())
    return np.stack(pos), Rotation.from_matrix(np.stack(turned))


def test_the_tool_moves_and_turns_in_the_frames_and_units_that_the_table_of_features_says(
    worlds_of,
):
    """About x, y and z of the base, both ways, after a turn that makes the tool's axes other ones than the base's."""
    worlds = worlds_of()
    action, state = (c.feature for c in (action_column(DELTA_NAMES), state_column(STATE_NAMES)))
    frame = dict(zip(action["names"], action["info"]["frames"], strict=True))
    frame |= dict(zip(state["names"], state["info"]["frames"], strict=True))
    still, turn, step = (np.zeros((6, 7), np.float32) for _ in range(3))
    turn[:, 5] = 0.8
    step[range(6), [3, 3, 4, 4, 5, 5]] = np.tile([0.5, -0.5], 3)
    step[:, :3] = [[0.2, 0.1, 0.3]]
    for each in [turn] * 5 + [still] * 20:
        worlds.step(each)

    begun, before = tool_sites(worlds)
    for each in [step] * 3 + [still] * 20:
        worlds.step(each)
    ended, after = tool_sites(worlds)

    assert action["info"]["units"][:6] == ["x 0.03 m"] * 3 + ["x 0.2 rad"] * 3
    assert frame["delta_x.pos"] == "base"
    way = 3 * step[:, :3] * 0.03 * worlds.bundle.motion_scale
    np.testing.assert_allclose(ended - begun, way, atol=4e-3)
    in_frame = {"base": after * before.inv(), "tool": before.inv() * after}
    for k, name in enumerate(DELTA_NAMES[3:6]):
        turned = in_frame[frame[name]].as_rotvec()[:, k]
        np.testing.assert_allclose(turned, 3 * step[:, 3 + k] * 0.2, atol=0.03)
    seen = worlds.robot_state()
    assert frame["eef_x.pos"] == frame["lead_x.pos"] == "base"
    np.testing.assert_allclose(seen[:, :3], ended, atol=1e-5)
    np.testing.assert_allclose(seen[:, 7:10], worlds.targets[0] - ended, atol=1e-5)
    down, vector = Rotation.from_quat([1, 0, 0, 0]), Rotation.from_rotvec(seen[:, 3:6])
    said = {"tool": down * vector, "base": vector * down}[frame["eef_rz.pos"]]
    assert (said.inv() * after).magnitude().max() < 1e-4
    target = action_column(TOOL_NAMES).feature["info"]["frames"]
    assert target[3:6] == state["info"]["frames"][3:6]  # as targets_of makes them, see above

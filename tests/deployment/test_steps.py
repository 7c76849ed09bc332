"""Policies that say where tool or joints shall be move a robot as the steps do that lead there."""

import numpy as np
import pytest

from v2p_data.deployment.rig import Rig
from v2p_data.deployment.robot import ActionScale, Reading
from v2p_data.deployment.steps import StepMaker
from v2p_data.errors import V2PError
from v2p_data.sim.env.actions import joints_near
from v2p_data.sim.env.targets import DOWN
from v2p_data.sim.robot.action_names import action_names
from v2p_data.sim.robot.interface import ArmInterface


def reading(joints=None) -> Reading:
    state = np.array([0.5, 0.1, 0.3, 0.1, -0.2, 0.3, 1.0, 0.01, 0.0, 0.0, 0.8])
    return Reading(
        state=state, picture=None, labels=None, joints_rad=joints, opening=1.0, force_n=None
    )


@pytest.mark.slow
@pytest.mark.parametrize("actions", ["absolute_tool", "joints"])
def test_targets_move_the_twin_as_the_steps_do_that_lead_to_them(twin, actions):
    by_steps, by_targets = twin(), twin(actions=actions, joint_state=True)
    by_steps.connect()
    by_targets.connect()
    names, robot = action_names(actions), by_steps.arm.mirror.world.robot
    assert list(by_targets.action_features) == list(names)
    rng = np.random.default_rng(2)
    wanted, start = np.zeros(7), by_steps.arm.target.pos
    for _ in range(25):
        wanted = np.clip(0.7 * wanted + rng.normal(0, 0.4, 7), -1, 1)
        by_steps.send_action(dict(zip(by_steps.action_features, wanted.tolist(), strict=True)))
        target = by_steps.arm.target
        where = np.concatenate([target.pos, (DOWN.inv() * target.rotation).as_rotvec()])
        if actions == "joints":
            quat = target.rotation.as_quat(scalar_first=True)[None]
            where = joints_near(by_steps.joints()[None], target.pos[None], quat, robot)[0]
        asked = dict(zip(names, [*where.tolist(), target.opening], strict=True))
        assert by_targets.send_action(asked) == asked

    ours, theirs = by_targets.arm, by_steps.arm
    assert np.abs(ours.target.pos - theirs.target.pos).max() < 1e-5
    assert (ours.target.rotation * theirs.target.rotation.inv()).magnitude() < 1e-4
    assert ours.target.opening == pytest.approx(theirs.target.opening, abs=1e-5)
    assert np.linalg.norm(theirs.target.pos - start) > 0.03
    seen = by_targets.get_observation()
    assert [seen[f"joint_{k}.pos"] for k in range(1, 8)] == by_targets.joints().tolist()
    assert set(by_targets.observation_features) == set(seen)
    assert Rig(by_targets).read().joints_rad.tolist() == by_targets.joints().tolist()


def test_a_target_out_of_reach_of_one_step_is_approached_as_fast_as_a_step_may():
    maker = StepMaker(ArmInterface(actions="absolute_tool"), ActionScale())
    far = np.array([0.9, 0.1, 0.3, 0.1, -0.2, 0.3, 0.8])

    assert np.allclose(maker.step(far, reading()), [1, 0, 0, 0, 0, 0, 0])


def test_turns_that_were_sent_count_until_the_tool_has_made_them():
    maker = StepMaker(ArmInterface(actions="absolute_tool"), ActionScale())
    turned = np.array([0.51, 0.1, 0.3, 0, 0, 0, 0.8])
    turned[3:6] = reading().state[3:6]
    turned[5] += 0.1
    first = maker.step(turned, reading())
    maker.sent(first, reading())

    assert np.abs(first[3:6]).max() > 0.3
    assert np.allclose(maker.step(turned, reading())[3:6], 0, atol=1e-9)


def test_a_target_that_is_no_number_is_no_step():
    for actions in ("absolute_tool", "joints"):
        maker = StepMaker(ArmInterface(actions=actions))
        assert np.isnan(maker.step(np.full(len(action_names(actions)), np.nan), reading())).all()


def test_angles_of_joints_follow_in_the_state_where_the_robot_gives_them():
    maker = StepMaker(ArmInterface(joint_state=True))

    assert maker.state(reading(np.arange(7.0)))[11:].tolist() == list(range(7))
    with pytest.raises(V2PError, match="the robot gives none"):
        maker.state(reading())

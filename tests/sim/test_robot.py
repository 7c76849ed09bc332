import mujoco
import numpy as np
import pytest

from v2p_data.errors import V2PError
from v2p_data.sim.robot.arms import RobotConfig, read_arm
from v2p_data.sim.robot.robot import (
    COARSE,
    FINE,
    HOME_QPOS,
    JOINT_RANGES_RAD,
    NUM_ARM_JOINTS,
    PhysicsConfig,
    ServoConfig,
    arm_qpos_for,
    option_xml,
    tool_state,
)


def robot_model(physics: PhysicsConfig) -> mujoco.MjModel:
    arm = read_arm(RobotConfig(), physics, ServoConfig())
    world = mujoco.MjSpec.from_string(
        f'<mujoco><compiler angle="radian" autolimits="true"/>{option_xml(physics)}'
        f'<worldbody><site name="base"/>{arm.bodies_xml}</worldbody>{arm.servos_xml}</mujoco>'
    )
    arm.put_into(world)
    return world.compile()


def settled(model: mujoco.MjModel, pos: np.ndarray, qpos: np.ndarray) -> mujoco.MjData:
    data = mujoco.MjData(model)
    data.qpos[:NUM_ARM_JOINTS] = qpos
    data.ctrl[:] = [*pos, 0, 1, 0, 0, 0.0425]
    for _ in range(round(3.0 / model.opt.timestep)):
        mujoco.mj_step(model, data)
    mujoco.mj_forward(model, data)
    return data


def test_tool_pose_and_velocity_agree_with_mujoco():
    model = robot_model(COARSE)
    assert model.jnt_range[:7].tolist() == [list(limits) for limits in JOINT_RANGES_RAD]
    data = mujoco.MjData(model)
    rng = np.random.default_rng(0)
    qpos, qvel = rng.uniform(-1.5, 1.5, (5, 7)), rng.normal(size=(5, 7))
    tcp = model.site("tcp").id

    ours = tool_state(qpos, qvel)

    for i in range(5):
        data.qpos[:7], data.qvel[:7] = qpos[i], qvel[i]
        mujoco.mj_forward(model, data)
        velocity = np.zeros(6)
        mujoco.mj_objectVelocity(model, data, mujoco.mjtObj.mjOBJ_SITE, tcp, velocity, 0)
        quat = np.zeros(4)
        mujoco.mju_mat2Quat(quat, data.site_xmat[tcp])
        np.testing.assert_allclose(ours.pos[i], data.site_xpos[tcp], atol=1e-12)
        np.testing.assert_allclose(ours.rotation[i].ravel(), data.site_xmat[tcp], atol=1e-12)
        assert abs(ours.quat_wxyz[i] @ quat) == pytest.approx(1, abs=1e-12)
        np.testing.assert_allclose(ours.vel_angular[i], velocity[:3], atol=1e-12)
        np.testing.assert_allclose(ours.vel_linear[i], velocity[3:], atol=1e-12)


def test_joint_angles_for_a_tool_pose_lead_back_to_it():
    rng = np.random.default_rng(1)
    pos = rng.uniform([0.35, -0.3, 0.02], [0.7, 0.3, 0.4], (64, 3))
    yaw = rng.uniform(-1, 1, 64)

    tool = tool_state(arm_qpos_for(pos, yaw), np.zeros((64, 7)))

    np.testing.assert_allclose(tool.pos, pos, atol=1e-6)
    np.testing.assert_allclose(tool.rotation[:, 2, 2], -1, atol=1e-6)  # straight down
    np.testing.assert_allclose(tool.rotation[:, 0, 0], np.cos(yaw), atol=1e-6)


def test_a_tool_pose_out_of_reach_is_refused():
    with pytest.raises(V2PError, match="out of the arm's reach"):
        arm_qpos_for(np.array([[1.2, 0.0, 0.3]]), np.zeros(1))


@pytest.mark.parametrize("physics", [COARSE, FINE], ids=["coarse", "fine"])
def test_a_held_target_is_reached_to_a_tenth_of_a_millimetre_and_degree(physics: PhysicsConfig):
    model = robot_model(physics)
    pos = np.array([0.6, 0.15, 0.12])

    data = settled(model, pos, np.asarray(HOME_QPOS))

    tool = tool_state(data.qpos[None, :7], data.qvel[None, :7])
    assert np.linalg.norm(tool.pos[0] - pos) < 1e-4
    assert np.degrees(np.arccos(min(1.0, -tool.rotation[0, 2, 2]))) < 0.1
    assert abs(data.qpos[2]) < 0.02  # the spring brings joint 3 home


@pytest.mark.parametrize("physics", [COARSE, FINE], ids=["coarse", "fine"])
def test_the_tool_lags_a_moving_target_by_kv_over_kp(physics: PhysicsConfig):
    model = robot_model(physics)
    pos = np.array([0.5, -0.2, 0.2])
    data = settled(model, pos, arm_qpos_for(pos[None], np.zeros(1))[0])
    speed, lags = 0.3, []

    for k in range(round(1.2 / physics.timestep_s)):
        data.ctrl[1] = pos[1] + speed * (k + 1) * physics.timestep_s
        mujoco.mj_step(model, data)
        tool = tool_state(data.qpos[None, :7], data.qvel[None, :7])
        lags.append(data.ctrl[1] - tool.pos[0, 1])

    servo = ServoConfig()
    expected = speed * servo.position_kv / servo.position_kp  # 15 mm
    assert lags[-1] == pytest.approx(expected, rel=0.15)
    assert max(lags) < 1.3 * expected


def test_time_steps_too_long_for_their_contacts_are_refused():
    with pytest.raises(ValueError, match="twice"):
        PhysicsConfig(timestep_s=0.01, substeps=5, solref_s=0.01)


def test_both_physics_make_control_steps_of_50_ms():
    assert pytest.approx(0.05) == COARSE.control_dt_s == FINE.control_dt_s

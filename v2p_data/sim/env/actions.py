"""What an `action` says: the step of the tool, or where tool or joints shall be after it; and the state.

Worlds carry out steps of the tool alone (`delta_tool`). Targets are those of the controller after
a step, leashes included, without the noise that randomisation adds; so each is turned back into
the step that leads to it. World frame.
"""

import numpy as np
from jaxtyping import Float, Float32

from v2p_data.errors import V2PError
from v2p_data.geometry.rotation import conjugates, log, product, quats_from_down, rotvec_from_down
from v2p_data.sim.env.batch_env import BatchEnv
from v2p_data.sim.robot.action_names import DELTA_NAMES, Actions, action_names
from v2p_data.sim.robot.arms import Robot
from v2p_data.sim.robot.interface import ArmInterface
from v2p_data.sim.robot.robot import TARGET_HIGH_M, TARGET_LOW_M

LARGEST_RAD = 2 * np.pi
_NEWTON_STEPS, _NEAR, _LONGEST = 30, 1e-13, 0.3


def state_as_seen(
    state: Float32[np.ndarray, "env 11"], worlds: BatchEnv, interface: ArmInterface
) -> Float32[np.ndarray, "env state"]:
    """Return the robots' state, followed by the angles of their joints [rad] where the interface has them."""
    if not interface.joint_state:
        return state
    joints = worlds.motion()[0][:, worlds.world.robot.arm]
    return np.concatenate([state, joints], axis=1, dtype=np.float32)


def targets_of(
    worlds: BatchEnv, step: Float[np.ndarray, "env 7"], actions: Actions
) -> Float[np.ndarray, "env act"]:
    """Return the actions that say what a step of the tool says, in worlds as they are before it."""
    if actions == "delta_tool":
        return step
    pos, quat, finger = worlds.targets_after(step)
    robot = worlds.world.robot
    if actions == "absolute_tool":
        where = np.concatenate([pos, rotvec_from_down(quat.T).T], axis=1)
    else:
        where = joints_near(worlds.motion()[0][:, robot.arm], pos, quat, robot)
    return np.concatenate([where, finger[:, None] / robot.finger_travel_m], axis=1)


def steps_to(
    worlds: BatchEnv, target: Float[np.ndarray, "env act"], actions: Actions
) -> Float[np.ndarray, "env 7"]:
    """Return the steps of the tool, each entry in [-1, 1], that lead to the targets, or as near as one step can.

    Steps of the tool (`delta_tool`) are returned as they are. Of joint angles the tool's pose counts, not the elbow's.

    Raises:
        V2PError: the actions have not as many entries as the arm takes.
    """
    robot, cfg = worlds.world.robot, worlds.cfg
    names = action_names(actions, robot.num_joints)
    if target.shape[1] != len(names):
        raise V2PError(
            f"an action has {target.shape[1]} entries, and '{actions}' of the arm of task '{worlds.bundle.title}' has"
            f" {len(names)} ({', '.join(names)}): evaluate the policy with the actions and the arm of its dataset"
        )
    if actions == "delta_tool":
        return target
    target = target.astype(float)
    if actions == "absolute_tool":
        pos, quat = target[:, :3], quats_from_down(target[:, 3:6].T)
    else:
        # No joint turns further; what a policy predicts may lie anywhere.
        angles = np.clip(target[:, :-1], -LARGEST_RAD, LARGEST_RAD)
        tool = robot.tool_state(angles, np.zeros_like(angles))
        pos, quat = tool.pos, tool.quat_wxyz.T
    from_pos, from_quat, from_finger = worlds.targets
    turn = log(product(quat, conjugates(from_quat.T))).T
    close = from_finger - target[:, -1] * robot.finger_travel_m
    far = (pos - from_pos) / (cfg.position_step_m * worlds.bundle.motion_scale)
    step = [far, turn / cfg.rotation_step_rad, close[:, None] / cfg.finger_step_m]
    # In 32 bits, as `play` carries steps out, so that an environment does the same.
    return np.clip(np.concatenate(step, axis=1), -1.0, 1.0).astype(np.float32)


def bounds_of(actions: Actions, num_joints: int) -> tuple[list[float], list[float]]:
    """Return the lowest and highest value of each entry, for an environment's space of actions."""
    turn = [np.pi] * 3
    match actions:
        case "delta_tool":
            return [-1.0] * len(DELTA_NAMES), [1.0] * len(DELTA_NAMES)
        case "absolute_tool":
            return [*TARGET_LOW_M, *(-a for a in turn), 0.0], [*TARGET_HIGH_M, *turn, 1.0]
        case "joints":
            return [-LARGEST_RAD] * num_joints + [0.0], [LARGEST_RAD] * num_joints + [1.0]


def joints_near(
    qpos: Float[np.ndarray, "env joint"],
    pos: Float[np.ndarray, "env 3"],
    quat_wxyz: Float[np.ndarray, "env 4"],
    robot: Robot,
) -> Float[np.ndarray, "env joint"]:
    """Return joint angles that hold the tool there, each time by the shortest way from `qpos`.

    Newton's steps with the least change of joints. Out of reach they end near the pose.
    """
    qpos = qpos.copy()
    count, joints = qpos.shape
    each = np.tile(np.eye(joints), (count, 1))
    for _ in range(_NEWTON_STEPS):
        tool = robot.tool_state(np.repeat(qpos, joints, axis=0), each)
        # A joint's speed of 1 moves the tool by a column of the Jacobian.
        across = np.concatenate([tool.vel_linear, tool.vel_angular], axis=1).reshape(
            count, joints, 6
        )
        turn = product(quat_wxyz.T, conjugates(tool.quat_wxyz[::joints].T))
        error = np.concatenate([pos - tool.pos[::joints], log(turn).T], axis=1)
        if not (np.abs(error) > _NEAR).any():
            break
        square = across.transpose(0, 2, 1) @ across + 1e-12 * np.eye(6)
        change = (across @ np.linalg.solve(square, error[..., None]))[..., 0]
        qpos += np.clip(change, -_LONGEST, _LONGEST)
    return qpos

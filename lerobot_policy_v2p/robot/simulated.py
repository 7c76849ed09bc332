"""The simulated arm behind the robot type `v2p_franka`: one episode of a task, seen as a real arm would be.

Time passes only while an action is carried out.
"""

import logging
from pathlib import Path

import numpy as np
from jaxtyping import Float, UInt8

from lerobot_policy_v2p.robot.config_v2p_franka import V2PFrankaConfig
from v2p_data.deployment.robot import ActionScale
from v2p_data.geometry.camera import CV_FROM_GL, Camera, intrinsics
from v2p_data.geometry.pose import matrix_from_quat, transform
from v2p_data.sim.wrappers.gym_env import V2PEnv
from v2p_data.task.task import TaskBundle

logger = logging.getLogger(__name__)


class SimulatedArm:
    """One episode of a task."""

    is_real = is_limited = False  # its gripper is that of the training

    def __init__(self, config: V2PFrankaConfig) -> None:
        self.env = V2PEnv(config.task_folder)
        self.task_description = self.env.task_description
        scale = TaskBundle.load(Path(config.task_folder)).motion_scale
        self.action_scale = ActionScale(position_step_m=ActionScale.position_step_m * scale)
        self.restart(config.seed)

    def restart(self, seed: int) -> None:
        """Start the episode of a seed."""
        self.seen, _ = self.env.reset(seed=seed)
        self.env.contact_torques()  # from now on they are kept
        self.steps = 0
        self.ended = self.has_succeeded = False

    def state(self) -> Float[np.ndarray, "11"]:
        """Return `observation.state`."""
        return self.seen["agent_pos"].astype(float)

    def mask(self) -> UInt8[np.ndarray, "h w 3"]:
        """Return the true labels as greys."""
        return self.seen["pixels"]["mask"]

    def picture(self) -> UInt8[np.ndarray, "h w 3"]:
        """Return the camera's colour picture."""
        return self.env.picture()

    def calibration(self) -> Camera:
        """Return the camera, exactly."""
        moment = self.env.moment()
        height, width = self.mask().shape[:2]
        rotation = matrix_from_quat(moment.camera_quat[0]) @ CV_FROM_GL
        return Camera(
            width_px=width,
            height_px=height,
            K=intrinsics(width, height, np.radians(float(moment.camera_fovy_deg[0]))),
            T_world_cam=transform(rotation, moment.camera_pos[0]),
        )

    def joints(self) -> Float[np.ndarray, "7"]:
        """Return the joint angles [rad]."""
        return self.env.moment().qpos[0, self.env.world.robot.arm]

    def opening(self) -> float:
        """Return the gripper's opening, 0 to 1."""
        return float(self.seen["agent_pos"][6])

    def force_n(self) -> float:
        """Return the contact force at the tool, from the joints' torques as a real arm estimates it."""
        if not self.steps:
            return 0.0  # nothing has moved yet
        robot, joints = self.env.world.robot, self.joints()
        count = len(joints)
        # The tool's speed per joint, a joint at a time: rows of the transposed Jacobian.
        lever = robot.tool_state(np.tile(joints, (count, 1)), np.eye(count)).vel_linear
        force, *_ = np.linalg.lstsq(lever, self.env.contact_torques())
        return float(np.linalg.norm(force))

    def carry_out(self, step: Float[np.ndarray, "7"]) -> None:
        """Carry out a step of the tool and let 50 ms pass."""
        self.seen, _, terminated, truncated, info = self.env.step(step)
        self.steps += 1
        self.has_succeeded |= bool(info["is_success"])
        if (terminated or truncated) and not self.ended:
            self.ended = True
            tell(self.env.task, self.steps, is_success=bool(info["is_success"]))

    def hold(self) -> None:
        """Do nothing: time stands still."""

    def close(self) -> None:
        if not self.ended:
            tell(self.env.task, self.steps, is_success=False)
        self.env.close()


def tell(title: str, steps: int, *, is_success: bool) -> None:
    """Log how an episode went. LeRobot's tools go on for the time or the rows that they were told."""
    if is_success:
        logger.info(
            "task '%s' succeeded after %d steps; what follows no longer counts", title, steps
        )
    elif steps:
        logger.info("task '%s' did not succeed in %d steps", title, steps)

"""A real arm behind the robot type `v2p_franka`, through the library franky. HAS NEVER BEEN RUN: no arm was at hand."""

import importlib
from collections.abc import Callable
from typing import Any, NoReturn

import numpy as np
from scipy.spatial.transform import Rotation

from lerobot_policy_v2p.robot.config_v2p_franka import V2PFrankaConfig
from v2p_data.deployment.robot import ActionScale, bytes_of
from v2p_data.errors import V2PError
from v2p_data.sim.env.batch_env import SimConfig
from v2p_data.sim.env.targets import ToolPose, next_target
from v2p_data.sim.render.masks import labels_to_rgb

GRIPPER_TOLERANCE = 0.05
"""The real gripper takes a new command when the wanted opening has changed by this share of its width."""


class FrankyArm:
    """A real arm. Never run by us; see the first lines of `v2p_franka`."""

    is_real = is_limited = True
    action_scale, has_succeeded, task_description = ActionScale(), False, ""

    def __init__(self, config: V2PFrankaConfig) -> None:
        try:
            franky = importlib.import_module("franky")
        except ImportError as error:
            raise V2PError(
                "the backend 'franky' needs the library of that name: pip install franky-control"
            ) from error
        self.config = config
        self.cfg = SimConfig()
        self.labels = _function_named(config.masks)
        self.franky = franky
        self.robot = franky.Robot(config.ip)
        self.robot.relative_dynamics_factor = config.relative_dynamics
        self.robot.recover_from_errors()
        self.gripper = franky.Gripper(config.ip)
        self.max_width_m = float(self.gripper.max_width)
        self.target = self._measure()
        self.sent_opening = self.target.opening
        self.pending: Any = None

    def state(self) -> np.ndarray:
        return self._measure().state(self.target)

    def mask(self) -> np.ndarray:
        return labels_to_rgb(bytes_of(self.labels(), self.config.masks, ()))

    def _lacks(self) -> NoReturn:
        raise V2PError(
            "the backend 'franky' gives no pictures and no angles of joints; use 'sim' or 'network'"
        )

    picture = calibration = joints = opening = _lacks

    def force_n(self) -> None:
        """Return nothing: it is not reported."""

    def carry_out(self, step: np.ndarray) -> None:
        self.target = next_target(
            self.target, self._measure(), step, self.cfg, self.max_width_m / 2
        )
        flange = self.target.pos - self.target.rotation.apply([0, 0, self.config.tool_offset_m])
        goal = self.franky.Affine(flange.tolist(), self.target.rotation.as_quat().tolist())
        self.robot.move(self.franky.CartesianMotion(goal), asynchronous=True)
        self._move_gripper()

    def hold(self) -> None:
        self.robot.stop()
        self.target = self._measure()

    def close(self) -> None:
        self.robot.stop()

    def _measure(self) -> ToolPose:
        pose = self.robot.current_cartesian_state.pose.end_effector_pose
        rotation = Rotation.from_quat(np.asarray(pose.quaternion, float))
        offset = rotation.apply([0, 0, self.config.tool_offset_m])
        return ToolPose(
            pos=np.asarray(pose.translation, float).reshape(3) + offset,
            rotation=rotation,
            opening=float(np.clip(self.gripper.width / self.max_width_m, 0, 1)),
        )

    def _move_gripper(self) -> None:
        """Send the wanted opening when it has changed and the last command is done: the gripper is no servo."""
        busy = self.pending is not None and not self.pending.wait(0)
        change = self.target.opening - self.sent_opening
        if busy or abs(change) < GRIPPER_TOLERANCE:
            return
        width, speed = self.target.opening * self.max_width_m, self.config.gripper_speed_m_s
        if change < 0:
            self.pending = self.gripper.grasp_async(
                width, speed, self.config.grip_force_n, epsilon_inner=1.0, epsilon_outer=1.0
            )
        else:
            self.pending = self.gripper.move_async(width, speed)
        self.sent_opening = self.target.opening


def _function_named(path: str) -> Callable[[], np.ndarray]:
    module, _, name = path.partition(":")
    try:
        return getattr(importlib.import_module(module), name)
    except (ImportError, AttributeError, ValueError) as error:
        raise V2PError(
            f"--robot.masks names '{path}', which cannot be imported ({error}); it must be 'package.module:name'"
        ) from error

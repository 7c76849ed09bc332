"""The physics of many worlds: arms that go for targets. `cpu_physics` and `warp_physics` let the time pass.

Actions move a target for the tool, which two leashes hold near the tool itself: 6 cm for the position, 8 mm for the
fingers. Without the latter the command to close winds up and a policy practically never finds out how to release.
"""

from abc import ABC, abstractmethod
from dataclasses import dataclass, field
from typing import Literal

import numpy as np
import torch
from jaxtyping import Bool, Float, Float32, Int

from v2p_data.geometry.rotation import (
    exp,
    limited_to,
    product,
    quats_pointing_down,
    rotvec_from_down,
    tilt_limited,
)
from v2p_data.sim.env.ranges import RandomizationConfig
from v2p_data.sim.model.world import World
from v2p_data.sim.robot.arms import RobotConfig
from v2p_data.sim.robot.robot import QUAT_DOWN, TARGET_HIGH_M, TARGET_LOW_M, ToolState

Backend = Literal["cpu", "warp"]

Targets = tuple[Float[np.ndarray, "env 3"], Float[np.ndarray, "env 4"], Float[np.ndarray, "env"]]
"""Of the controller: the tool's position [m] and quaternion `wxyz`, and the travel of a finger [m]."""
_TARGET_LOW_M = np.array([TARGET_LOW_M]).T
_TARGET_HIGH_M = np.array([TARGET_HIGH_M]).T


@dataclass(frozen=True, kw_only=True)
class SimConfig:
    """How a task is simulated."""

    fine: bool = False
    """Small time steps, for evaluation and recording; else large ones, for training."""
    backend: Backend = "cpu"
    """MuJoCo on CPU cores, or MuJoCo Warp on a GPU, for training only."""
    device: str = "cuda:0"
    """Of the backend `warp`."""
    base_reset: bool = False
    """Place objects as the environment does, whatever the task's own reset says."""
    robot: RobotConfig = field(default_factory=RobotConfig)
    """Without a path, the task's own, which is the built-in arm unless the task says otherwise."""
    randomization: RandomizationConfig = field(default_factory=RandomizationConfig)
    position_step_m: float = 0.03
    """Target displacement at action 1, per control step."""
    rotation_step_rad: float = 0.2
    finger_step_m: float = 0.012
    position_leash_m: float = 0.06
    """The target stays this near the tool, per axis."""
    rotation_leash_rad: float = 0.5
    finger_leash_m: float = 0.008
    """The target of a finger that is blocked by an object runs ahead by this much at most."""
    tilt_limit_rad: float = 0.35
    """How far the gripper may lean from pointing straight down."""
    bonus_ratio: float = 1.0
    """What a step of success earns on top, in full rewards (`FULL_REWARD`); PPO knows only this ratio, for it scales
    rewards by their returns. See docs/rewards.md for the measurement."""


class Physics(ABC):
    """Worlds of one model, and what their controllers go for. Rows of all arrays are worlds.

    Args:
        world: the model.
        cfg: how far an action moves the targets, and how far they may run ahead.
        motion_scale: of the tool's steps in this task.
        num_envs: number of worlds.

    Attributes:
        qpos, qvel: positions and velocities; what is written here counts.
        object_qpos, object_qvel: the objects' part of them.
        ctrl: `[x, y, z, qw, qx, qy, qz, finger]`, what the servos are told.
        sensordata: of the last time step.
        tool: where the tools are.
        broken: where the simulation broke down at the last step.
    """

    qpos: Float[np.ndarray, "env q"]
    qvel: Float[np.ndarray, "env v"]
    ctrl: Float[np.ndarray, "env 8"]
    sensordata: Float[np.ndarray, "env sensor"]
    device = torch.device("cpu")
    """Where who learns in these worlds computes."""

    def __init__(self, world: World, cfg: SimConfig, motion_scale: float, num_envs: int) -> None:
        self._robot, self._cfg, self._motion_scale = world.robot, cfg, motion_scale
        self.num_envs = num_envs
        count = len(world.objects)
        q, v = world.objects[0].qpos_adr, world.objects[0].dof_adr
        self.object_qpos = self.qpos[:, q : q + 7 * count].reshape(num_envs, count, 7)
        self.object_qvel = self.qvel[:, v : v + 6 * count].reshape(num_envs, count, 6)
        if not np.shares_memory(self.object_qpos, self.qpos):
            raise RuntimeError("object poses must be a view of qpos")
        self.target_pos = np.zeros((3, num_envs)).T
        self.target_quat = np.tile(np.array([QUAT_DOWN]).T, num_envs).T
        self.target_finger = np.zeros(num_envs)
        self.broken = np.zeros(num_envs, bool)
        self.tool = self.tool_of(slice(None))

    @abstractmethod
    def expand(self, name: str) -> np.ndarray:
        """Return a field of the model with a leading axis of worlds. What is written there counts from a reset on."""

    @abstractmethod
    def reset(self, ids: Int[np.ndarray, "n"]) -> None:
        """Forget what happened in the worlds `ids`."""

    @abstractmethod
    def state(self) -> dict[str, np.ndarray]:
        """Return what the next step depends on besides targets and fields, by name.

        To go on from another state, write to these arrays and call `resume`.
        """

    def touches(self) -> Float[np.ndarray, "env object 3"]:
        """Return 1 where the left pad, the right pad, and any part of the arm touch each object.

        The pads at the last time step, the arm at any time step of the last control step.
        """
        count = self.object_qpos.shape[1]
        pads = self.sensordata[:, : 2 * count].reshape(self.num_envs, count, 2)
        return np.concatenate([pads > 0, self._arm_touches()[:, :, None]], axis=2).astype(float)

    def _arm_touches(self) -> Bool[np.ndarray, "env object"]:
        """Return whether any part of the arm touched each object; here at the last time step."""
        return self.sensordata[:, 2 * self.object_qpos.shape[1] :] > 0

    @abstractmethod
    def contact_torques(self) -> Float[np.ndarray, "env joint"]:
        """Return the torques that contacts and joint limits put on the arms' joints at the last time step [N m]."""

    @abstractmethod
    def _advance(self, moving: Int[np.ndarray, "n"] | None) -> None:
        """Let the time of one control step pass, in the worlds `moving` at least."""

    @abstractmethod
    def _warned(self) -> Bool[np.ndarray, "env"]:
        """Return which worlds the simulator itself takes for broken."""

    @abstractmethod
    def _settle(self, ids: Int[np.ndarray, "n"]) -> None:
        """Let a delay not move the worlds `ids`, whose targets were set anew."""

    def resume(self) -> None:
        """Go on from what was written to the arrays of `state`."""
        self.tool = self.tool_of(slice(None))

    def place_arms(
        self,
        ids: Int[np.ndarray, "n"],
        arm: Float[np.ndarray, "n joint"],
        tool_pos: Float[np.ndarray, "n 3"],
        yaw: Float[np.ndarray, "n"],
    ) -> None:
        """Put the arms of the worlds `ids` at rest with open grippers.

        Args:
            ids: the worlds.
            arm: joint angles [rad].
            tool_pos: where that brings the tools [m].
            yaw: how the tools, which point down, are turned [rad].
        """
        self.qpos[ids, self._robot.arm] = arm
        self.qpos[ids, self._robot.fingers] = self._robot.finger_travel_m
        self.target_pos[ids] = tool_pos
        self.target_quat[ids] = quats_pointing_down(yaw).T
        self.target_finger[ids] = self._robot.finger_travel_m
        self._write_controls(ids)
        self._settle(ids)

    def step(self, action: Float[np.ndarray, "7 env"], moving: Int[np.ndarray, "n"] | None) -> int:
        """Move the targets and let 50 ms pass in the worlds `moving`; return how many broke down."""
        self.target_pos, self.target_quat, self.target_finger = self.moved(action)
        self._write_controls(slice(None))
        self._advance(moving)
        return self.look()

    def look(self) -> int:
        """Find out where the tools are and which worlds broke down; return how many did so anew."""
        self.tool = self.tool_of(slice(None))
        warned = self._warned()
        finite_pos, finite_vel = np.isfinite(self.qpos), np.isfinite(self.qvel)
        before = self.broken
        if finite_pos.all() and finite_vel.all() and not warned.any():
            self.broken = np.zeros(len(before), bool)
            return 0
        self.broken = warned | ~(finite_pos.all(1) & finite_vel.all(1))
        return int((self.broken & ~before).sum())

    def look_at(self, ids: Int[np.ndarray, "n"]) -> ToolState:
        """Find out where the tools of the worlds `ids` are, and return it."""
        tool = self.tool_of(ids)
        for name in ("pos", "rotation", "quat_wxyz", "vel_linear", "vel_angular"):
            getattr(self.tool, name)[ids] = getattr(tool, name)
        return tool

    def moved(self, action: Float[np.ndarray, "7 env"]) -> Targets:
        """Return what the controllers would go for after an action."""
        cfg, tool = self._cfg, self.tool
        scale = self._motion_scale
        pos, tool_pos = self.target_pos.T, tool.pos.T
        pos = pos + action[:3] * (cfg.position_step_m * scale)
        leash = cfg.position_leash_m * scale
        pos = np.minimum(np.maximum(pos, tool_pos - leash), tool_pos + leash)
        pos = np.minimum(np.maximum(pos, _TARGET_LOW_M), _TARGET_HIGH_M)
        turn = exp(action[3:6] * cfg.rotation_step_rad)
        quat = product(turn, self.target_quat.T)
        quat = limited_to(quat, tool.quat_wxyz.T, cfg.rotation_leash_rad)
        quat = tilt_limited(quat, cfg.tilt_limit_rad)
        left, right = self.qpos[:, self._robot.fingers].T
        travel = 0.5 * (left + right)
        finger = self.target_finger - action[6] * cfg.finger_step_m
        finger = np.maximum(finger, travel - cfg.finger_leash_m)
        finger = np.minimum(np.maximum(finger, 0.0), self._robot.finger_travel_m)
        for target, safe in ((pos, [[0.5], [0.0], [0.2]]), (quat, np.array([QUAT_DOWN]).T)):
            if not np.isfinite(target).all():  # broken worlds wait for their reset
                target[:, ~np.isfinite(target).all(0)] = safe
        if not np.isfinite(finger).all():
            finger[~np.isfinite(finger)] = self._robot.finger_travel_m
        return pos.T, quat.T, finger

    def robot_state(self) -> Float32[np.ndarray, "env 11"]:
        """Return `observation.state`.

        Tool position [m], its rotation vector from straight down [rad], gripper opening (0 to 1), then what the
        controller knows of its command: target position minus tool position [m], target opening (0 to 1).
        """
        travel = self._robot.finger_travel_m
        fingers = self.qpos[:, self._robot.fingers].sum(1, keepdims=True)
        return np.concatenate(
            [
                self.tool.pos,
                rotvec_from_down(self.tool.quat_wxyz.T).T,
                np.clip(fingers / (2 * travel), 0.0, 1.0),
                self.target_pos - self.tool.pos,
                self.target_finger[:, None] / travel,
            ],
            axis=1,
            dtype=np.float32,
        )

    def tool_of(self, rows: slice | np.ndarray) -> ToolState:
        """Return where the tools of some worlds are, from their joints."""
        robot = self._robot
        return robot.tool_state(self.qpos[rows, robot.arm], self.qvel[rows, robot.arm_dofs])

    def _write_controls(self, rows: slice | np.ndarray) -> None:
        self.ctrl[rows, 0:3] = self.target_pos[rows]
        self.ctrl[rows, 3:7] = self.target_quat[rows]
        self.ctrl[rows, 7] = self.target_finger[rows]

"""The robot type `v2p_franka`: the dataset's state and action names on a simulated or a real Franka arm.

The simulated arm runs the very environment that policies are evaluated in. The real one uses the library
`franky` (pip install franky-control); that code follows its documentation and HAS NEVER BEEN RUN: no arm was
at hand. Try it slowly, with the stop button in your hand. Run with `lerobot-rollout`, always with
`--return_to_initial_position=false`: actions are displacements, so positions must not be played back as actions.
"""

import importlib
import logging
from collections.abc import Callable
from typing import Any, Protocol

import numpy as np
from lerobot.robots import Robot
from scipy.spatial.transform import Rotation

from lerobot_policy_v2p.robot.config_v2p_franka import V2PFrankaConfig
from v2p_data.episodes.features import ACTION_NAMES, STATE_NAMES
from v2p_data.errors import V2PError
from v2p_data.sim.batch_env import SimConfig
from v2p_data.sim.gym_env import V2PEnv
from v2p_data.sim.masks import labels_to_rgb
from v2p_data.sim.targets import ToolPose, next_target

logger = logging.getLogger(__name__)

MASK_PX = 256
GRIPPER_TOLERANCE = 0.05
"""The real gripper takes a new command when the wanted opening has changed by this share of its width."""


class Arm(Protocol):
    """What stands behind the robot."""

    def read(self) -> tuple[np.ndarray, np.ndarray]:
        """Return `observation.state` and the mask as greys, h x w x 3 uint8."""
        ...

    def act(self, action: np.ndarray) -> None:
        """Carry out one action in [-1, 1]."""
        ...

    def close(self) -> None: ...


class SimulatedArm:
    """One episode of a task."""

    def __init__(self, config: V2PFrankaConfig) -> None:
        self.env = V2PEnv(config.task_folder)
        self.seen, _ = self.env.reset(seed=config.seed)
        self.steps = 0
        self.ended = False

    def read(self) -> tuple[np.ndarray, np.ndarray]:
        return self.seen["agent_pos"], self.seen["pixels"]["mask"]

    def act(self, action: np.ndarray) -> None:
        self.seen, _, terminated, truncated, info = self.env.step(action)
        self.steps += 1
        if (terminated or truncated) and not self.ended:
            self.ended = True
            outcome = "succeeded" if info["is_success"] else "ended without success"
            logger.info("task '%s' %s after %d steps", self.env.task, outcome, self.steps)

    def close(self) -> None:
        self.env.close()


class FrankyArm:
    """A real arm. Never run by us; see the module's first lines."""

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

    def read(self) -> tuple[np.ndarray, np.ndarray]:
        return self._measure().state(self.target), labels_to_rgb(
            np.asarray(self.labels(), np.uint8)
        )

    def act(self, action: np.ndarray) -> None:
        self.target = next_target(
            self.target, self._measure(), action, self.cfg, self.max_width_m / 2
        )
        flange = self.target.pos - self.target.rotation.apply([0, 0, self.config.tool_offset_m])
        goal = self.franky.Affine(flange.tolist(), self.target.rotation.as_quat().tolist())
        self.robot.move(self.franky.CartesianMotion(goal), asynchronous=True)
        self._move_gripper()

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


ARMS: dict[str, Callable[[V2PFrankaConfig], Arm]] = {"sim": SimulatedArm, "franky": FrankyArm}


class V2PFranka(Robot):
    """A Franka arm as LeRobot sees it."""

    config_class = V2PFrankaConfig
    name = "v2p_franka"

    def __init__(self, config: V2PFrankaConfig) -> None:
        super().__init__(config)
        self.config = config
        self.arm: Arm | None = None

    @property
    def observation_features(self) -> dict[str, Any]:
        return {**dict.fromkeys(STATE_NAMES, float), "mask": (MASK_PX, MASK_PX, 3)}

    @property
    def action_features(self) -> dict[str, Any]:
        return dict.fromkeys(ACTION_NAMES, float)

    @property
    def cameras(self) -> dict[str, Any]:
        """Return nothing: masks come from the arm's backend, no camera of LeRobot's is opened."""
        return {}

    @property
    def is_connected(self) -> bool:
        return self.arm is not None

    @property
    def is_calibrated(self) -> bool:
        return True

    def connect(self, calibrate: bool = True) -> None:
        """Start the simulation, or reach the arm; there is nothing to calibrate."""
        if self.arm is None:
            self.arm = ARMS[self.config.backend](self.config)

    def calibrate(self) -> None: ...

    def configure(self) -> None: ...

    def get_observation(self) -> dict[str, Any]:
        """Return the state's entries by name, and `mask`."""
        state, mask = self._connected().read()
        return {**dict(zip(STATE_NAMES, state.tolist(), strict=True)), "mask": mask}

    def send_action(self, action: dict[str, Any]) -> dict[str, Any]:
        """Carry out an action and return it as it was carried out: clipped to [-1, 1]."""
        clipped = np.clip([float(action[name]) for name in ACTION_NAMES], -1.0, 1.0)
        self._connected().act(clipped)
        return dict(zip(ACTION_NAMES, clipped.tolist(), strict=True))

    def disconnect(self) -> None:
        if self.arm is not None:
            self.arm.close()
            self.arm = None

    def _connected(self) -> Arm:
        if self.arm is None:
            raise V2PError("the robot is not connected; call connect() first")
        return self.arm


def _function_named(path: str) -> Callable[[], np.ndarray]:
    module, _, name = path.partition(":")
    try:
        return getattr(importlib.import_module(module), name)
    except (ImportError, AttributeError, ValueError) as error:
        raise V2PError(
            f"--robot.masks names '{path}', which cannot be imported ({error}); it must be 'package.module:name'"
        ) from error

"""What the robot types of this plugin share: the dataset's names on an arm that needs no calibration by LeRobot.

Under LeRobot's own tools a robot does by itself what `v2p deploy` does around one: masks, limits,
a check of the policy.
"""

import logging
import time
from abc import abstractmethod
from pathlib import Path
from typing import Any, Protocol

import numpy as np
from jaxtyping import Float, UInt8
from lerobot.configs import parser
from lerobot.robots import Robot

from lerobot_policy_v2p.robot.config_arm import ArmRobotConfig
from v2p_data.deployment.checks import HZ, check_meaning, names_of
from v2p_data.deployment.limits import STEP_S
from v2p_data.deployment.rig import MASK_NAME, Rig
from v2p_data.deployment.robot import ActionScale
from v2p_data.deployment.sight import Sight, clicks_from
from v2p_data.episodes.dataset.features import ACTION_NAMES
from v2p_data.errors import V2PError
from v2p_data.geometry.camera import Camera
from v2p_data.sim.render.masks import labels_to_rgb
from v2p_data.sim.robot.interface import STEPS
from v2p_data.twin.interface import RGB_NAME, RGB_PX

MASK_PX = 256

logger = logging.getLogger(__name__)


class Arm(Protocol):
    """What stands behind a robot."""

    is_real: bool
    """Whether time passes by itself."""
    is_limited: bool
    """Whether actions pass limits."""

    action_scale: ActionScale
    has_succeeded: bool
    """Whether a simulated task has; a real one never says so."""
    task_description: str
    """The simulated task in words."""

    def state(self) -> Float[np.ndarray, "11"]:
        """Ask the arm and return `observation.state`; what follows belongs to the same moment."""
        ...

    def mask(self) -> UInt8[np.ndarray, "h w 3"]:
        """Return the label greys of an arm that segments by itself."""
        ...

    def picture(self) -> UInt8[np.ndarray, "h w 3"]: ...

    def calibration(self) -> Camera: ...

    def joints(self) -> Float[np.ndarray, "7"]: ...

    def opening(self) -> float: ...

    def force_n(self) -> float | None:
        """Return the contact force at the tool; None where it is not reported."""
        ...

    def carry_out(self, step: Float[np.ndarray, "7"]) -> None:
        """Carry out a step of the tool, each entry in [-1, 1]."""
        ...

    def hold(self) -> None:
        """Stay there, at once; safe to call while another call waits."""
        ...

    def close(self) -> None: ...


class ArmRobot[A: Arm, C: ArmRobotConfig](Robot):
    """An arm as LeRobot sees it, and as `v2p deploy` does (`v2p_data.twin.interface.RobotWithCamera`)."""

    picture_name: str
    """Key of the picture in an observation."""
    picture_px: int
    """Its width and height."""

    def __init__(self, config: C) -> None:
        super().__init__(config)
        self.config = config
        is_rgb = config.pictures == "rgb"
        self.picture_name, self.picture_px = (RGB_NAME, RGB_PX) if is_rgb else (MASK_NAME, MASK_PX)
        # With colour pictures it is `v2p deploy` that acts, which makes steps of targets itself.
        self.interface = STEPS if is_rgb else config.interface
        del self.calibration  # LeRobot's dict of motors, which would hide the method
        self.arm: A | None = None
        self._rig: Rig | None = None
        """With masks: what sees and limits."""
        self._state: dict[str, Any] | None = None
        """Of the last observation, until an action follows it."""
        self._next_s = 0.0
        """When the next action may be sent."""

    @abstractmethod
    def make_arm(self) -> A:
        """Start the simulation, or reach the arm."""

    @property
    def observation_features(self) -> dict[str, Any]:
        size = self.picture_px
        return {
            **dict.fromkeys(names_of(self.interface)[0], float),
            self.picture_name: (size, size, 3),
        }

    @property
    def action_features(self) -> dict[str, Any]:
        return dict.fromkeys(names_of(self.interface)[1], float)

    @property
    def cameras(self) -> dict[str, Any]:
        """Return nothing: pictures come from the arm, no camera of LeRobot's is opened."""
        return {}

    @property
    def is_connected(self) -> bool:
        return self.arm is not None

    @property
    def is_calibrated(self) -> bool:
        return True

    def calibrate(self) -> None: ...

    def configure(self) -> None: ...

    def connect(self, calibrate: bool = True) -> None:
        """Start the simulation, or reach the arm; there is nothing to calibrate."""
        if self.arm is not None:
            return
        self.arm = self.make_arm()
        self._state = None
        try:
            check_policy_of(self.config, self.action_scale, self.task_description)
            check_recording()
            self._rig = None if self.picture_name == RGB_NAME else self._own_rig(self.arm)
        except BaseException:
            self.disconnect()
            raise

    def disconnect(self) -> None:
        arm, self.arm, self._rig = self.arm, None, None
        if arm is not None:
            arm.close()

    def get_observation(self) -> dict[str, Any]:
        """Return the state's entries by name, and `mask` or `rgb`.

        Raises:
            V2PError: the arm does not answer, or what was clicked is lost; the arm then holds its position.
        """
        arm = self._connected()
        self._state = state = self._named_state(arm)
        if self._rig is None:
            return {**state, self.picture_name: arm.picture()}
        if self._rig.sight is None:
            return {**state, self.picture_name: arm.mask()}
        with self._rig.held_on_error():
            seen = self._rig.see(self._rig.reading_of({**state, RGB_NAME: arm.picture()}))
        return {**state, self.picture_name: labels_to_rgb(seen.labels)}

    def send_action(self, action: dict[str, Any]) -> dict[str, Any]:
        """Carry out an action; return a step as it was carried out, a target as it was asked for.

        A step is clipped to [-1, 1] and, with masks, to the limits.

        Raises:
            V2PError: a limit ends the run, and the arm holds its position; or it does not answer.
        """
        arm = self._connected()
        step = np.array([float(action[name]) for name in self.action_features])
        if not np.isfinite(step).all():
            self.hold()
            raise V2PError(f"an action holds a value that is no number: {action}")
        if self._rig is not None:
            reading = self._rig.reading_of(self._state or self._named_state(arm))
            with self._rig.held_on_error():
                self._rig.check(reading)
                step = self._rig.limited(step, reading).action
            self._rig.maker.sent(step, reading)
            if arm.is_real:
                # LeRobot sends 30 actions a second unless told otherwise: the arm would be faster than its limits.
                time.sleep(max(0.0, self._next_s - time.monotonic()))
                self._next_s = time.monotonic() + STEP_S
        step = np.clip(step, -1.0, 1.0)
        arm.carry_out(step)
        self._state = None
        if self.interface.actions != "delta_tool":
            return action
        return dict(zip(ACTION_NAMES, step.tolist(), strict=True))

    @property
    def action_scale(self) -> ActionScale:
        """What an action of 1 means in this task: some tasks, such as throwing, take larger steps."""
        return self._connected().action_scale

    @property
    def has_succeeded(self) -> bool:
        """Whether a simulated task has."""
        return self.arm is not None and self.arm.has_succeeded

    @property
    def task_description(self) -> str:
        """The simulated task in words."""
        return self._connected().task_description

    def calibration(self) -> Camera:  # pyright: ignore[reportIncompatibleVariableOverride]
        """Return the camera of `rgb` as calibrated, in the arm's base frame."""
        return self._connected().calibration()

    def joints(self) -> Float[np.ndarray, "7"]:
        """Return the joint angles of the last observation [rad]."""
        return self._connected().joints()

    def opening(self) -> float:
        """Return the gripper's opening of the last observation, 0 closed, 1 open."""
        return self._connected().opening()

    def force_n(self) -> float | None:
        """Return the contact force at the tool [N]; None where the arm does not report it."""
        return self._connected().force_n()

    def hold(self) -> None:
        """Stay there, at once."""
        self._connected().hold()

    def _own_rig(self, arm: A) -> Rig:
        cfg, sight = self.config, None
        if cfg.clicks:
            clicks = clicks_from(cfg.clicks.split())
            sight = Sight(self.calibration(), clicks, training_view=cfg.training_view)
        return Rig(self, cfg.limits if arm.is_limited else None, sight, cfg.interface)

    def _named_state(self, arm: A) -> dict[str, Any]:
        """Ask the arm and return `observation.state` by name."""
        state = arm.state()
        if self.interface.joint_state:
            state = np.concatenate([state, arm.joints()])
        return dict(zip(names_of(self.interface)[0], state.tolist(), strict=True))

    def _connected(self) -> A:
        if self.arm is None:
            raise V2PError(f"the robot {self.name} is not connected; call connect() first")
        return self.arm


def check_recording() -> None:
    """Demand that what a LeRobot tool records says the rate of the arm's steps; it says 30 unless told otherwise.

    Raises:
        V2PError: it would say another.
    """
    is_replay = parser.parse_arg("dataset.episode") is not None
    if parser.parse_arg("dataset.repo_id") is None or is_replay:
        return
    fps = parser.parse_arg("dataset.fps") or "30"
    if float(fps) != HZ:
        raise V2PError(
            f"the recording would say {fps} frames a second, and this arm takes {HZ} steps a second;"
            f" say --dataset.fps={HZ}"
        )


def check_policy_of(config: ArmRobotConfig, scale: ActionScale, task: str) -> None:
    """Compare the policy that is about to act with a robot; say so where it is not known or not here.

    LeRobot's tools do not tell a robot which policy acts; their parser knows what `--policy.path` says.

    Args:
        config: the robot's settings.
        scale: what an action of 1 means on it.
        task: in words, of a simulated robot; LeRobot's `--task` comes first.

    Raises:
        V2PError: its palette, names, rate or action scale are not the robot's.
    """
    path = config.policy_path or parser.get_path_arg("policy") or ""
    if not path or not config.check_policy:
        return
    if not Path(path).is_dir():
        logger.warning(
            "the policy %s is no folder here, so its action scale is not checked; fetch it and "
            "say --robot.policy_path=FOLDER",
            path,
        )
        return
    check_meaning(Path(path), scale, parser.parse_arg("task") or task, config.interface)

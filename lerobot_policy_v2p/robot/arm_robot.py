"""What the robot types of this plugin share: the dataset's names, and one arm that needs no calibration by LeRobot."""

from abc import abstractmethod
from collections.abc import Generator
from contextlib import contextmanager
from typing import Any, Protocol

import numpy as np
from jaxtyping import Float
from lerobot.robots import Robot

from lerobot_policy_v2p.robot.config_arm import ArmRobotConfig
from lerobot_policy_v2p.robot.unattended import Unattended
from v2p_data.deployment.checks import names_of
from v2p_data.deployment.robot import MASK_NAME
from v2p_data.episodes.dataset.features import ACTION_NAMES, state_names
from v2p_data.errors import V2PError
from v2p_data.sim.robot.interface import STEPS
from v2p_data.twin.interface import RGB_NAME, RGB_PX

MASK_PX = 256


class StatefulArm(Protocol):
    """What stands behind a robot."""

    def state(self) -> Float[np.ndarray, "11"]: ...

    def close(self) -> None: ...


class ArmRobot[Arm: StatefulArm](Robot):
    """A robot of LeRobot's whose arm speaks in the dataset's states and actions."""

    picture_name: str
    """Key of the picture in an observation."""
    picture_px: int
    """Its width and height."""

    def __init__(self, config: ArmRobotConfig) -> None:
        super().__init__(config)
        is_rgb = config.pictures == "rgb"
        self.picture_name, self.picture_px = (RGB_NAME, RGB_PX) if is_rgb else (MASK_NAME, MASK_PX)
        # With colour pictures it is `v2p deploy` that acts, which makes steps of targets itself.
        self.interface = STEPS if is_rgb else config.interface
        del self.calibration  # LeRobot's dict of motors, which would hide the method
        self.arm: Arm | None = None
        self._unattended: Unattended | None = None

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

    @abstractmethod
    def joints(self) -> Float[np.ndarray, "7"]:
        """Return the joint angles of the last observation [rad]."""

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

    def disconnect(self) -> None:
        arm, self.arm, self._unattended = self.arm, None, None
        if arm is not None:
            arm.close()

    @contextmanager
    def closed_on_error(self) -> Generator[None]:
        """Leave no arm connected where what is done with it fails."""
        try:
            yield
        except BaseException:
            self.disconnect()
            raise

    def _named_state(self, arm: StatefulArm) -> dict[str, Any]:
        """Ask the arm and return `observation.state` by name."""
        state = arm.state()
        if self.interface.joint_state:
            state = np.concatenate([state, self.joints()])
        return dict(zip(state_names(len(state)), state.tolist(), strict=True))

    def _step(self, action: dict[str, Any], state: dict[str, Any]) -> Float[np.ndarray, "7"]:
        """Return the step of the tool that an action asks for, in [-1, 1]; with masks, what the limits leave of it."""
        asked = np.array([float(action[name]) for name in self.action_features])
        if not np.isfinite(asked).all():
            raise V2PError(f"an action holds a value that is no number: {action}")
        if self._unattended is not None:
            asked = self._unattended.step(asked, state)
        return np.clip(asked, -1.0, 1.0)

    def _sent(self, action: dict[str, Any], step: Float[np.ndarray, "7"]) -> dict[str, Any]:
        """Return an action as LeRobot records it: a step as carried out, a target as asked."""
        if self.interface.actions != "delta_tool":
            return action
        return dict(zip(ACTION_NAMES, step.tolist(), strict=True))

    def _connected(self) -> Arm:
        if self.arm is None:
            raise V2PError(f"the robot {self.name} is not connected; call connect() first")
        return self.arm

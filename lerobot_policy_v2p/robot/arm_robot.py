"""What the robot types of this plugin share: the dataset's names, and one arm that needs no calibration by LeRobot."""

from collections.abc import Generator
from contextlib import contextmanager
from typing import Any, Protocol

import numpy as np
from jaxtyping import Float
from lerobot.robots import Robot

from lerobot_policy_v2p.robot.config_arm import ArmRobotConfig
from v2p_data.deployment.robot import MASK_NAME
from v2p_data.episodes.dataset.features import ACTION_NAMES, STATE_NAMES
from v2p_data.errors import V2PError
from v2p_data.twin.interface import RGB_NAME, RGB_PX

MASK_PX = 256


class Closable(Protocol):
    """What stands behind a robot."""

    def close(self) -> None: ...


class ArmRobot[Arm: Closable](Robot):
    """A robot of LeRobot's whose arm speaks in the dataset's states and actions."""

    picture_name: str
    """Key of the picture in an observation."""
    picture_px: int
    """Its width and height."""

    def __init__(self, config: ArmRobotConfig) -> None:
        super().__init__(config)
        sees = config.pictures == "rgb"
        self.picture_name, self.picture_px = (RGB_NAME, RGB_PX) if sees else (MASK_NAME, MASK_PX)
        del self.calibration  # LeRobot's dict of motors, which would hide the method
        self.arm: Arm | None = None

    @property
    def observation_features(self) -> dict[str, Any]:
        size = self.picture_px
        return {**dict.fromkeys(STATE_NAMES, float), self.picture_name: (size, size, 3)}

    @property
    def action_features(self) -> dict[str, Any]:
        return dict.fromkeys(ACTION_NAMES, float)

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
        if self.arm is not None:
            self.arm.close()
            self.arm = None

    @contextmanager
    def closed_on_error(self) -> Generator[None]:
        """Leave no arm connected where what is done with it fails."""
        try:
            yield
        except BaseException:
            self.disconnect()
            raise

    def _connected(self) -> Arm:
        if self.arm is None:
            raise V2PError(f"the robot {self.name} is not connected; call connect() first")
        return self.arm


def action_of(named: dict[str, Any]) -> Float[np.ndarray, "7"]:
    """Return an action by name as an array."""
    return np.array([float(named[name]) for name in ACTION_NAMES])


def named_action(action: Float[np.ndarray, "7"]) -> dict[str, float]:
    """Return an action's entries by name."""
    return dict(zip(ACTION_NAMES, action.tolist(), strict=True))


def named_state(state: Float[np.ndarray, "11"]) -> dict[str, Any]:
    """Return a state's entries by name."""
    return dict(zip(STATE_NAMES, state.tolist(), strict=True))

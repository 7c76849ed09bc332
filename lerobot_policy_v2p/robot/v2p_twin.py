"""The robot type `v2p_twin`: the dataset's state and action names, and an RGB picture, on the twin of a Franka arm.

It is a `v2p_data.twin.interface.RobotWithCamera`: what it gives is what a real arm with a calibrated camera gives.
Everything done with it is sim-to-sim. How the episode went is logged, and asked of `arm.mirror` by judges.
"""

import logging
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float
from lerobot.robots import Robot

from lerobot_policy_v2p.robot.config_v2p_twin import V2PTwinConfig
from v2p_data.episodes.features import ACTION_NAMES, STATE_NAMES
from v2p_data.errors import V2PError
from v2p_data.geometry.camera import Camera
from v2p_data.task.task import TaskBundle
from v2p_data.twin.arm import TwinArm
from v2p_data.twin.interface import RGB_NAME, RGB_PX
from v2p_data.twin.parameters import changed

logger = logging.getLogger(__name__)


class V2PTwin(Robot):
    """The twin as LeRobot sees it."""

    config_class = V2PTwinConfig
    name = "v2p_twin"

    def __init__(self, config: V2PTwinConfig) -> None:
        super().__init__(config)
        del self.calibration  # LeRobot's dict of motors, which would hide the method
        self.config = config
        self.arm: TwinArm | None = None
        self._steps = 0
        self._has_succeeded = False

    @property
    def observation_features(self) -> dict[str, Any]:
        return {**dict.fromkeys(STATE_NAMES, float), RGB_NAME: (RGB_PX, RGB_PX, 3)}

    @property
    def action_features(self) -> dict[str, Any]:
        return dict.fromkeys(ACTION_NAMES, float)

    @property
    def cameras(self) -> dict[str, Any]:
        """Return nothing: the picture comes from the twin, no camera of LeRobot's is opened."""
        return {}

    @property
    def is_connected(self) -> bool:
        return self.arm is not None

    @property
    def is_calibrated(self) -> bool:
        return True

    def connect(self, calibrate: bool = True) -> None:
        """Start the episode; the camera is calibrated already."""
        if self.arm is None:
            bundle = TaskBundle.load(Path(self.config.task_folder))
            self.arm = TwinArm(bundle, changed(self.config.change))
            self.restart(self.config.seed)

    def calibrate(self) -> None: ...

    def configure(self) -> None: ...

    def restart(self, seed: int) -> None:
        """Start the episode of another seed."""
        self._connected().reset(seed)
        self._steps, self._has_succeeded = 0, False

    def get_observation(self) -> dict[str, Any]:
        """Return the state's entries by name, and `rgb`.

        Raises:
            V2PError: there is no OpenGL.
        """
        arm = self._connected()
        state = dict(zip(STATE_NAMES, arm.state().tolist(), strict=True))
        return {**state, RGB_NAME: arm.picture()}

    def send_action(self, action: dict[str, Any]) -> dict[str, Any]:
        """Carry out an action for 50 ms and return it as it was carried out: clipped to [-1, 1]."""
        arm = self._connected()
        clipped = np.clip([float(action[name]) for name in ACTION_NAMES], -1.0, 1.0)
        outcome = arm.act(clipped)
        self._steps += 1
        if outcome.is_held and not self._has_succeeded and arm.mirror.verdict():
            self._has_succeeded = True
            title = arm.mirror.bundle.title
            logger.info("task '%s' succeeded in the twin after %d steps", title, self._steps)
        return dict(zip(ACTION_NAMES, clipped.tolist(), strict=True))

    def calibration(self) -> Camera:  # pyright: ignore[reportIncompatibleVariableOverride]
        """Return the camera of `rgb` as calibrated, in the arm's base frame."""
        return self._connected().robot.calibration()

    def joints(self) -> Float[np.ndarray, "7"]:
        """Return the joint angles of the last observation [rad]."""
        return self._connected().measured.joints

    def opening(self) -> float:
        """Return the gripper's opening of the last observation, 0 closed, 1 open."""
        return self._connected().measured.opening

    @property
    def has_succeeded(self) -> bool:
        """Whether the task has."""
        return self._has_succeeded

    @property
    def task_description(self) -> str:
        """The task in words."""
        return self._connected().mirror.bundle.description

    def disconnect(self) -> None:
        if self.arm is not None:
            self.arm.close()
            self.arm = None

    def _connected(self) -> TwinArm:
        if self.arm is None:
            raise V2PError("the twin is not connected; call connect() first")
        return self.arm

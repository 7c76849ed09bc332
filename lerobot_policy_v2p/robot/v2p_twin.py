"""The robot type `v2p_twin`: the dataset's state and action names, and an RGB picture, on the twin of a Franka arm.

It is a `v2p_data.twin.interface.RobotWithCamera`: what it gives is what a real arm with a calibrated camera gives.
Everything done with it is sim-to-sim. How the episode went is logged, and asked of `arm.mirror` by judges.
"""

import logging
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float

from lerobot_policy_v2p.robot.arm_robot import ArmRobot, action_of, named_action, named_state
from lerobot_policy_v2p.robot.config_v2p_twin import V2PTwinConfig
from v2p_data.deployment.robot import ActionScale
from v2p_data.geometry.camera import Camera
from v2p_data.task.task import TaskBundle
from v2p_data.twin.arm import TwinArm
from v2p_data.twin.interface import RGB_NAME, RGB_PX
from v2p_data.twin.parameters import changed

logger = logging.getLogger(__name__)


class V2PTwin(ArmRobot[TwinArm]):
    """The twin as LeRobot sees it."""

    config_class = V2PTwinConfig
    name = "v2p_twin"
    picture_name, picture_px = RGB_NAME, RGB_PX

    def __init__(self, config: V2PTwinConfig) -> None:
        super().__init__(config)
        self.config = config
        self._steps = 0
        self._has_succeeded = False

    def connect(self, calibrate: bool = True) -> None:
        """Start the episode; the camera is calibrated already."""
        if self.arm is None:
            bundle = TaskBundle.load(Path(self.config.task_folder))
            self.arm = TwinArm(bundle, changed(self.config.change))
            self.restart(self.config.seed)

    @property
    def action_scale(self) -> ActionScale:
        """What an action of 1 means in this task: some tasks, such as throwing, take larger steps."""
        cfg = self._connected().cfg
        return ActionScale(
            position_step_m=cfg.position_step_m,
            rotation_step_rad=cfg.rotation_step_rad,
            finger_step_m=cfg.finger_step_m,
        )

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
        return {**named_state(arm.state()), RGB_NAME: arm.picture()}

    def send_action(self, action: dict[str, Any]) -> dict[str, Any]:
        """Carry out an action for 50 ms and return it as it was carried out: clipped to [-1, 1]."""
        arm = self._connected()
        clipped = np.clip(action_of(action), -1.0, 1.0)
        outcome = arm.act(clipped)
        self._steps += 1
        if outcome.is_held and not self._has_succeeded and arm.mirror.verdict():
            self._has_succeeded = True
            title = arm.mirror.bundle.title
            logger.info("task '%s' succeeded in the twin after %d steps", title, self._steps)
        return named_action(clipped)

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

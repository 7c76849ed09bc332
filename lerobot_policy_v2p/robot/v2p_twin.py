"""The robot type `v2p_twin`: the dataset's state and action names, and masks or a picture, on the twin of a Franka arm.

It is a `v2p_data.twin.interface.RobotWithCamera`: with `pictures=rgb` it gives what a real arm with a calibrated camera
gives. Everything done with it is sim-to-sim. How the episode went is logged, and asked of `arm.mirror` by judges.
"""

import logging
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float

from lerobot_policy_v2p.robot.arm_robot import ArmRobot
from lerobot_policy_v2p.robot.config_v2p_twin import V2PTwinConfig
from lerobot_policy_v2p.robot.unattended import Unattended, check_policy_of
from v2p_data.deployment.robot import ActionScale
from v2p_data.deployment.view import allowing_for_place
from v2p_data.geometry.camera import Camera
from v2p_data.sim.render.masks import labels_to_rgb
from v2p_data.task.task import TaskBundle
from v2p_data.twin.arm import TwinArm
from v2p_data.twin.judge import true_labels
from v2p_data.twin.parameters import changed

logger = logging.getLogger(__name__)


class V2PTwin(ArmRobot[TwinArm]):
    """The twin as LeRobot sees it."""

    config_class = V2PTwinConfig
    name = "v2p_twin"

    def __init__(self, config: V2PTwinConfig) -> None:
        super().__init__(config)
        self.config = config
        self._steps = 0
        self._has_succeeded = False

    def connect(self, calibrate: bool = True) -> None:
        """Start the episode; the camera is calibrated already."""
        if self.arm is not None:
            return
        bundle = TaskBundle.load(Path(self.config.task_folder))
        self.arm = TwinArm(bundle, changed(self.config.change))
        with self.closed_on_error():
            check_policy_of(self.config, self.action_scale, self.task_description)
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
        arm = self._connected()
        arm.reset(seed)
        self._steps, self._has_succeeded = 0, False
        self._unattended = None
        if self.config.pictures == "mask":
            labels = (allowing_for_place if self.config.training_view else true_labels)(arm)
            self._unattended = Unattended(
                self, self.config, lambda: labels_to_rgb(labels()), arm.picture
            )

    def get_observation(self) -> dict[str, Any]:
        """Return the state's entries by name, and `mask` or `rgb`.

        Raises:
            V2PError: there is no OpenGL for pictures, or what was clicked is lost.
        """
        arm = self._connected()
        state = self._named_state(arm)
        if self._unattended is None:
            return {**state, self.picture_name: arm.picture()}
        return {**state, self.picture_name: self._unattended.mask(state)}

    def send_action(self, action: dict[str, Any]) -> dict[str, Any]:
        """Carry out an action for 50 ms; return a step as carried out: clipped to [-1, 1] and, with masks, to the limits.

        Raises:
            V2PError: a limit ends the run.
        """
        arm = self._connected()
        step = self._step(action, self._named_state(arm))
        outcome = arm.act(step)
        self._steps += 1
        if outcome.held[0] and not self._has_succeeded and arm.mirror.referee.verdict()[0]:
            self._has_succeeded = True
            title = arm.mirror.bundle.title
            logger.info("task '%s' succeeded in the twin after %d steps", title, self._steps)
        return self._sent(action, step)

    def calibration(self) -> Camera:  # pyright: ignore[reportIncompatibleVariableOverride]
        """Return the camera of `rgb` as calibrated, in the arm's base frame."""
        return self._connected().robot.calibration()

    def joints(self) -> Float[np.ndarray, "7"]:
        """Return the joint angles of the last observation [rad]."""
        return self._connected().measured.joints

    def opening(self) -> float:
        """Return the gripper's opening of the last observation, 0 closed, 1 open."""
        return self._connected().measured.opening

    def hold(self) -> None:
        """Do nothing: time stands still."""

    @property
    def has_succeeded(self) -> bool:
        """Whether the task has."""
        return self._has_succeeded

    @property
    def task_description(self) -> str:
        """The task in words."""
        return self._connected().mirror.bundle.description

"""The robot type `v2p_twin`: the dataset's state and action names, and masks or a picture, on the twin of a Franka arm.

With `pictures=rgb` it gives what a real arm with a calibrated camera gives. Everything done with
it is sim-to-sim. How the episode went is logged, and asked of `arm.mirror` by judges.
"""

from pathlib import Path

import numpy as np
from jaxtyping import Float, UInt8

from lerobot_policy_v2p.robot.arm_robot import ArmRobot
from lerobot_policy_v2p.robot.config_v2p_twin import V2PTwinConfig
from lerobot_policy_v2p.robot.simulated import tell
from v2p_data.deployment.robot import ActionScale
from v2p_data.deployment.view import allowing_for_place
from v2p_data.geometry.camera import Camera
from v2p_data.sim.render.masks import labels_to_rgb
from v2p_data.task.task import TaskBundle
from v2p_data.twin.arm import TwinArm
from v2p_data.twin.judge import true_labels
from v2p_data.twin.parameters import changed


class TwinBehindRobot(TwinArm):
    """One episode in the twin."""

    is_real, is_limited = False, True

    def __init__(self, config: V2PTwinConfig) -> None:
        self.has_succeeded, self.steps = False, 0
        super().__init__(TaskBundle.load(Path(config.task_folder)), changed(config.change))
        self.action_scale = ActionScale(position_step_m=self.cfg.position_step_m)
        self.task_description = self.mirror.bundle.description
        self.reset(config.seed)
        self._labels = (allowing_for_place if config.training_view else true_labels)(self)

    def mask(self) -> UInt8[np.ndarray, "h w 3"]:
        return labels_to_rgb(self._labels())

    def calibration(self) -> Camera:
        return self.robot.calibration()

    def joints(self) -> Float[np.ndarray, "7"]:
        return self.measured.joints

    def opening(self) -> float:
        return self.measured.opening

    def force_n(self) -> None:
        """Return nothing: it is not reported."""

    def carry_out(self, step: Float[np.ndarray, "7"]) -> None:
        """Let the twin go on for 50 ms, and log when its task succeeds."""
        outcome = self.act(step)
        self.steps += 1
        if outcome.held[0] and not self.has_succeeded and self.mirror.referee.verdict()[0]:
            self.has_succeeded = True
            tell(self.mirror.bundle.title, self.steps, is_success=True)

    def hold(self) -> None:
        """Do nothing: time stands still."""

    def close(self) -> None:
        if not self.has_succeeded:
            tell(self.mirror.bundle.title, self.steps, is_success=False)
        super().close()


class V2PTwin(ArmRobot[TwinBehindRobot, V2PTwinConfig]):
    """The twin as LeRobot sees it."""

    config_class = V2PTwinConfig
    name = "v2p_twin"

    def make_arm(self) -> TwinBehindRobot:
        return TwinBehindRobot(self.config)

"""The robot type `v2p_franka`: the dataset's state and action names on a simulated or a real Franka arm.

The simulated arm runs the very environment that policies are evaluated in. A real one stands behind a driver that speaks
the protocol of docs/deploy.md (`network`), or is driven by the library `franky` (pip install franky-control); the code for
`franky` follows its documentation and HAS NEVER BEEN RUN: no arm was at hand. Try it slowly, with the stop button in your
hand. Run with `v2p deploy`, or with `lerobot-rollout`, always with `--return_to_initial_position=false`: actions are
displacements, so positions must not be played back as actions.
"""

import time
from collections.abc import Callable
from typing import Any, Protocol, runtime_checkable

import numpy as np
from jaxtyping import Float

from lerobot_policy_v2p.robot.arm_robot import ArmRobot
from lerobot_policy_v2p.robot.config_v2p_franka import V2PFrankaConfig
from lerobot_policy_v2p.robot.franky import FrankyArm
from lerobot_policy_v2p.robot.network import NetworkArm
from lerobot_policy_v2p.robot.simulated import SimulatedArm
from lerobot_policy_v2p.robot.unattended import Unattended, check_policy_of
from v2p_data.deployment.limits import STEP_S
from v2p_data.deployment.robot import ActionScale
from v2p_data.errors import V2PError
from v2p_data.geometry.camera import Camera


class Arm(Protocol):
    """What stands behind the robot."""

    action_scale: ActionScale

    def state(self) -> Float[np.ndarray, "11"]:
        """Ask the arm and return `observation.state`; what follows belongs to the same moment."""
        ...

    def mask(self) -> np.ndarray:
        """Return the label greys, h x w x 3 uint8, of an arm that segments by itself."""
        ...

    def act(self, action: np.ndarray) -> np.ndarray:
        """Carry out one action in [-1, 1] and return it as carried out."""
        ...

    def hold(self) -> None:
        """Stay there, at once; safe to call while another call waits."""
        ...

    def close(self) -> None: ...


@runtime_checkable
class SeeingArm(Arm, Protocol):
    """An arm with a calibrated camera."""

    def picture(self) -> np.ndarray: ...

    def calibration(self) -> Camera: ...

    def joints(self) -> Float[np.ndarray, "7"]: ...

    def opening(self) -> float: ...

    def force_n(self) -> float | None: ...


ARMS: dict[str, Callable[[V2PFrankaConfig], Arm]] = {
    "sim": SimulatedArm,
    "network": NetworkArm,
    "franky": FrankyArm,
}


class V2PFranka(ArmRobot[Arm]):
    """A Franka arm as LeRobot sees it, and as `v2p deploy` does."""

    config_class = V2PFrankaConfig
    name = "v2p_franka"

    def __init__(self, config: V2PFrankaConfig) -> None:
        super().__init__(config)
        self.config = config
        self._state: dict[str, Any] | None = None
        self._next_s = 0.0
        """When the next action may be sent."""

    @property
    def action_scale(self) -> ActionScale:
        return self._connected().action_scale

    def connect(self, calibrate: bool = True) -> None:
        """Start the simulation, or reach the arm; there is nothing to calibrate."""
        if self.arm is not None:
            return
        self.arm = ARMS[self.config.backend](self.config)
        self._state = self._unattended = None
        with self.closed_on_error():
            check_policy_of(self.config, self.action_scale, self.task_description)
            if self.config.pictures == "mask":
                self._unattended = Unattended(
                    self, self.config, self.arm.mask, lambda: self._seeing().picture(),
                    is_limited=self.config.backend != "sim",
                )  # fmt: skip

    def get_observation(self) -> dict[str, Any]:
        """Return the state's entries by name, and `mask` or `rgb`.

        Raises:
            V2PError: the arm does not answer, or what was clicked is lost; the arm then holds its position.
        """
        self._state = self._named_state(self._connected())
        if self._unattended is None:
            return {**self._state, self.picture_name: self._seeing().picture()}
        return {**self._state, self.picture_name: self._unattended.mask(self._state)}

    def send_action(self, action: dict[str, Any]) -> dict[str, Any]:
        """Carry out an action and return a step as it was carried out: clipped to [-1, 1] and, on real arms, to the limits.

        Raises:
            V2PError: a limit ends the run, and the arm holds its position; or it does not answer.
        """
        arm = self._connected()
        step = self._step(action, self._state or self._named_state(arm))
        if self._unattended is not None and self.config.backend != "sim":
            # LeRobot sends 30 actions a second unless it is told otherwise, and the arm would be faster than its limits.
            time.sleep(max(0.0, self._next_s - time.monotonic()))
            self._next_s = time.monotonic() + STEP_S
        return self._sent(action, arm.act(step))

    def calibration(self) -> Camera:  # pyright: ignore[reportIncompatibleVariableOverride]
        """Return the camera of `rgb`."""
        return self._seeing().calibration()

    def joints(self) -> Float[np.ndarray, "7"]:
        """Return the joint angles of the last observation [rad]."""
        return self._seeing().joints()

    def opening(self) -> float:
        """Return the gripper's opening of the last observation, 0 closed, 1 open."""
        return self._seeing().opening()

    def force_n(self) -> float | None:
        """Return the contact force at the tool [N]; None where the arm does not report it."""
        arm = self._connected()
        return arm.force_n() if isinstance(arm, SeeingArm) else None

    def hold(self) -> None:
        """Stay there, at once."""
        self._connected().hold()

    @property
    def has_succeeded(self) -> bool:
        """Whether a simulated task has; a real one never says so."""
        return isinstance(self.arm, SimulatedArm) and self.arm.succeeded

    @property
    def task_description(self) -> str:
        """The simulated task in words."""
        return self.arm.env.task_description if isinstance(self.arm, SimulatedArm) else ""

    def _seeing(self) -> SeeingArm:
        arm = self._connected()
        if not isinstance(arm, SeeingArm):
            raise V2PError(
                f"the backend '{self.config.backend}' gives no pictures and no angles of joints; use 'sim' or 'network'"
            )
        return arm

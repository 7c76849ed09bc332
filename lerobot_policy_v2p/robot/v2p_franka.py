"""The robot type `v2p_franka`: the dataset's state and action names on a simulated or a real Franka arm.

The simulated arm runs the very environment that policies are evaluated in. A real one stands behind a driver that speaks
the protocol of docs/deploy.md (`network`), or is driven by the library `franky` (pip install franky-control); the code for
`franky` follows its documentation and HAS NEVER BEEN RUN: no arm was at hand. Try it slowly, with the stop button in your
hand. Run with `v2p deploy`, or with `lerobot-rollout`, always with `--return_to_initial_position=false`: actions are
displacements, so positions must not be played back as actions.
"""

from collections.abc import Callable
from typing import Any, Protocol, runtime_checkable

import numpy as np
from jaxtyping import Float

from lerobot_policy_v2p.robot.arm_robot import ArmRobot, action_of, named_action, named_state
from lerobot_policy_v2p.robot.config_v2p_franka import V2PFrankaConfig
from lerobot_policy_v2p.robot.franky import FrankyArm
from lerobot_policy_v2p.robot.network import NetworkArm
from lerobot_policy_v2p.robot.simulated import SimulatedArm
from v2p_data.deployment.limits import Guard
from v2p_data.deployment.robot import MASK_NAME, ActionScale, Rig
from v2p_data.deployment.sight import LOST_AFTER, Sight, clicks_from
from v2p_data.errors import V2PError
from v2p_data.geometry.camera import Camera
from v2p_data.sim.masks import labels_to_rgb
from v2p_data.twin.interface import RGB_NAME, RGB_PX

MASK_PX = 256


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
        sees = config.pictures == "rgb"
        self.picture_name, self.picture_px = (RGB_NAME, RGB_PX) if sees else (MASK_NAME, MASK_PX)
        self._sight: Sight | None = None
        self._is_started = False
        self._guard: Guard | None = None
        self._state: np.ndarray | None = None

    @property
    def action_scale(self) -> ActionScale:
        return self._connected().action_scale

    def connect(self, calibrate: bool = True) -> None:
        """Start the simulation, or reach the arm; there is nothing to calibrate."""
        if self.arm is None:
            self.arm = ARMS[self.config.backend](self.config)
            self._is_started = False
            self._sight = None
            if self.config.clicks and self.config.pictures == "mask":
                self._sight = Sight(self.calibration(), clicks_from(self.config.clicks.split()))
            if self.config.backend != "sim":
                self._guard = Guard(self.config.limits, self.arm.action_scale)

    def get_observation(self) -> dict[str, Any]:
        """Return the state's entries by name, and `mask` or `rgb`.

        Raises:
            V2PError: the arm does not answer, or what was clicked is lost; the arm then holds its position.
        """
        arm = self._connected()
        self._state = arm.state()
        state = named_state(self._state)
        if self.config.pictures == "rgb":
            return {**state, RGB_NAME: self._seeing().picture()}
        if self._sight is None:
            return {**state, MASK_NAME: arm.mask()}
        return {**state, MASK_NAME: self._tracked(self._sight, state)}

    def send_action(self, action: dict[str, Any]) -> dict[str, Any]:
        """Carry out an action and return it as it was carried out: clipped to [-1, 1] and, on real arms, to the limits.

        Raises:
            V2PError: a limit ends the run, and the arm holds its position; or it does not answer.
        """
        arm = self._connected()
        wanted = action_of(action)
        if self._guard is not None and self.config.pictures == "mask":
            state = self._state if self._state is not None else arm.state()
            reading = Rig(self).reading_of(named_state(state))
            try:
                self._guard.look(reading)
                wanted = self._guard.limit(wanted, reading).action
            except V2PError:
                arm.hold()
                raise
        done = arm.act(np.clip(wanted, -1.0, 1.0))
        return named_action(done)

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

    def _tracked(self, sight: Sight, state: dict[str, Any]) -> np.ndarray:
        reading = Rig(self).reading_of({**state, RGB_NAME: self._seeing().picture()})
        try:
            seen = sight.see(reading) if self._is_started else sight.start(reading)
        except V2PError:
            self._connected().hold()
            raise
        self._is_started = True
        if max(seen.missed) >= LOST_AFTER:
            self._connected().hold()
            raise V2PError(
                f"object {int(np.argmax(seen.missed)) + 1} is no longer seen; the robot holds its position"
            )
        return labels_to_rgb(seen.labels)

    def _seeing(self) -> SeeingArm:
        arm = self._connected()
        if not isinstance(arm, SeeingArm):
            raise V2PError(
                f"the backend '{self.config.backend}' gives no pictures; use 'sim' or 'network'"
            )
        return arm

"""A connected robot as policies use it: it sees by tracking, and its actions pass limits.

`v2p deploy` and the robots of LeRobot's own tools use the same `Rig`. Beyond `RobotWithCamera`
three things are used where a robot has them: `hold()` stops at once, `force_n()` gives the contact
force at the tool, `action_scale` says what an action of 1 means.
"""

from collections.abc import Iterator
from contextlib import contextmanager, suppress
from typing import Any

import numpy as np
from jaxtyping import Float

from v2p_data.deployment.limits import Guard, Limited, LimitsConfig
from v2p_data.deployment.robot import ActionScale, Reading, bytes_of
from v2p_data.deployment.sight import LOST_AFTER, Seen, Sight
from v2p_data.deployment.steps import StepMaker
from v2p_data.episodes.dataset.features import ACTION_NAMES, STATE_NAMES
from v2p_data.errors import V2PError
from v2p_data.sim.render.masks import rgb_to_labels
from v2p_data.sim.robot.action_names import joint_names
from v2p_data.sim.robot.interface import STEPS, ArmInterface
from v2p_data.sim.robot.robot import NUM_ARM_JOINTS
from v2p_data.twin.interface import RGB_NAME, RobotWithCamera

JOINTS = joint_names(NUM_ARM_JOINTS)
MASK_NAME = "mask"
"""Key of the label greys in the observation of a robot that segments by itself."""


class LostError(V2PError):
    """An object is no longer seen."""


class Rig:
    """A connected robot with what it sees and what it may do.

    Args:
        robot: it.
        limits: of its actions; None for an arm that can do no harm.
        sight: what it sees; None for a robot that segments by itself.
        interface: what the policy sees of the arm and tells it.
    """

    def __init__(
        self,
        robot: RobotWithCamera,
        limits: LimitsConfig | None = None,
        sight: Sight | None = None,
        interface: ArmInterface = STEPS,
    ) -> None:
        self.robot, self.sight = robot, sight
        self.scale: ActionScale = getattr(robot, "action_scale", ActionScale())
        self.guard = None if limits is None else Guard(limits, self.scale)
        self.maker = StepMaker(interface, self.scale)
        self._is_seeing = self._is_checked = False
        self.waits = not getattr(getattr(robot, "arm", None), "is_real", True)
        """Whether the robot is simulated here: its time stands still until the next action, however long that takes."""

    def see(self, reading: Reading) -> Seen:
        """Return what a reading shows; the first one is searched for what was clicked.

        Raises:
            LostError: an object is no longer seen.
            V2PError: a click is on no object, or there is nothing to see.
        """
        if self.sight is None:
            if reading.labels is None:
                raise V2PError("the robot gives pictures; click on the objects with --click X,Y")
            return Seen(
                labels=reading.labels, confidences=(), missed=(), in_picture=reading.labels
            )
        seen = self.sight.see(reading) if self._is_seeing else self.sight.start(reading)
        self._is_seeing = True
        if max(seen.missed) >= LOST_AFTER:
            raise LostError(
                f"object {int(np.argmax(seen.missed)) + 1} was lost from sight: it is hidden or "
                "has left the picture; put it"
                " back and start again"
            )
        return seen

    def look_anew(self) -> None:
        """Search the next reading for what was clicked."""
        self._is_seeing = False

    def check(self, reading: Reading) -> None:
        """Stop for what the robot reports; at first also for where it stands.

        Raises:
            LimitStop: a limit ends the run.
        """
        if self.guard is not None:
            (self.guard.look if self._is_checked else self.guard.check_start)(reading)
        self._is_checked = True

    def limited(self, action: Float[np.ndarray, " act"], reading: Reading) -> Limited:
        """Return the step of the tool that an action asks for, and what of it may be done.

        Raises:
            LimitStop: the action is no number.
        """
        step = self.maker.step(action, reading)
        return (
            Limited(action=step, acted=())
            if self.guard is None
            else self.guard.limit(step, reading)
        )

    @contextmanager
    def held_on_error(self) -> Iterator[None]:
        """Let the arm hold its position where what is done fails."""
        try:
            yield
        except V2PError:
            self.hold()
            raise

    def read(self) -> Reading:
        """Return what the robot says now.

        Raises:
            V2PError: it does not answer, or answers something else.
        """
        return self.reading_of(self.robot.get_observation())

    def reading_of(self, seen: dict[str, Any]) -> Reading:
        """Return an observation of the robot's, checked; one without pictures tells state and force only.

        Raises:
            V2PError: entries are missing, no finite numbers, or no picture of bytes.
        """
        missing = [name for name in STATE_NAMES if name not in seen]
        if missing:
            raise V2PError(
                f"the robot's observation lacks {', '.join(missing)}; it has {', '.join(seen)}"
            )
        state = _finite({name: seen[name] for name in STATE_NAMES})
        picture, mask = (
            None if seen.get(name) is None else bytes_of(seen[name], name)
            for name in (RGB_NAME, MASK_NAME)
        )
        joints, opening = None, float(state[6])
        if picture is not None:
            angles = np.ravel(self.robot.joints()).tolist()
            if len(angles) != len(JOINTS):
                raise V2PError(
                    f"the robot reports {len(angles)} angles of joints; give {len(JOINTS)}"
                )
            joints = _finite(dict(zip(JOINTS, angles, strict=True)))
            opening = float(_finite({"opening": self.robot.opening()})[0])
        elif JOINTS[0] in seen:
            joints = _finite({name: seen.get(name) for name in JOINTS})
        ask_force = getattr(self.robot, "force_n", None)
        force = None if ask_force is None else ask_force()
        return Reading(
            state=state,
            picture=picture,
            labels=None if mask is None else rgb_to_labels(mask),
            joints_rad=joints,
            opening=opening,
            force_n=None if force is None else float(_finite({"force_n": force})[0]),
        )

    def act(self, action: Float[np.ndarray, "7"]) -> Float[np.ndarray, "7"]:
        """Send an action and return it as carried out."""
        sent = self.robot.send_action(dict(zip(ACTION_NAMES, action.tolist(), strict=True)))
        return np.array([float(sent[name]) for name in ACTION_NAMES])

    @property
    def can_hold(self) -> bool:
        """Whether the robot can be told to hold at any time, from another thread too."""
        return hasattr(self.robot, "hold")

    def hold(self) -> None:
        """Let the arm stay where it is, fingers as they are."""
        if self.can_hold:
            self.robot.hold()  # pyright: ignore[reportAttributeAccessIssue]
        else:
            self.act(np.zeros(len(ACTION_NAMES)))


def _finite(values: dict[str, Any]) -> Float[np.ndarray, " n"]:
    """Return what a robot reports as numbers.

    Raises:
        V2PError: one is no finite number.
    """
    for name, value in values.items():
        with suppress(TypeError, ValueError, OverflowError):
            if np.isfinite(float(value)):
                continue
        raise V2PError(f"the robot reports '{name}' = {value}, which is no finite number")
    return np.array([float(value) for value in values.values()])

"""One reading of a robot, and the robot as the loop uses it.

Beyond `RobotWithCamera` three things are used where a robot has them: `hold()` stops at once, `force_n()` gives the
contact force at the tool, `action_scale` says what an action of 1 means. World frame: the arm's base, +x forward, +y left, +z up. Times are of `time.monotonic`.
"""

import time
from dataclasses import dataclass
from typing import Any

import numpy as np
from jaxtyping import Float, UInt8
from scipy.spatial.transform import Rotation

from v2p_data.episodes.dataset.features import ACTION_NAMES, STATE_NAMES
from v2p_data.errors import V2PError
from v2p_data.sim.env.batch_env import SimConfig
from v2p_data.sim.env.targets import DOWN
from v2p_data.sim.render.masks import rgb_to_labels
from v2p_data.sim.robot.action_names import joint_names
from v2p_data.sim.robot.robot import FINGER_TRAVEL_M, NUM_ARM_JOINTS
from v2p_data.twin.interface import RGB_NAME, RobotWithCamera

JOINTS = joint_names(NUM_ARM_JOINTS)
MASK_NAME = "mask"
"""Key of the label greys in the observation of a robot that segments by itself."""


@dataclass(frozen=True, kw_only=True)
class ActionScale:
    """What an action of 1 means in one control step."""

    position_step_m: float = SimConfig.position_step_m
    rotation_step_rad: float = SimConfig.rotation_step_rad
    finger_step_m: float = SimConfig.finger_step_m


@dataclass(frozen=True, kw_only=True)
class Reading:
    """What a robot said at one time."""

    state: Float[np.ndarray, "11"]
    """`observation.state`."""
    picture: UInt8[np.ndarray, "h w 3"] | None
    """RGB; None from a robot that segments by itself."""
    labels: UInt8[np.ndarray, "h w"] | None
    """Its own label image; None from a robot that gives pictures."""
    joints_rad: Float[np.ndarray, "7"] | None
    opening: float
    force_n: float | None
    """None from a robot that does not report it."""
    time_s: float
    """When it was asked for."""

    @property
    def tool_pos(self) -> Float[np.ndarray, "3"]:
        """Tool position [m]."""
        return self.state[:3]

    @property
    def target_pos(self) -> Float[np.ndarray, "3"]:
        """Where the controller is told to bring the tool [m]."""
        return self.state[:3] + self.state[7:10]

    @property
    def target_opening(self) -> float:
        """What the gripper is told to open to, 0 to 1."""
        return float(self.state[10])

    @property
    def rotation(self) -> Rotation:
        """How the tool is turned."""
        return DOWN * Rotation.from_rotvec(self.state[3:6])


class Rig:
    """A connected robot as the loop uses it.

    Args:
        robot: it.
    """

    def __init__(self, robot: RobotWithCamera) -> None:
        self.robot = robot
        self.scale: ActionScale = getattr(robot, "action_scale", ActionScale())

    def read(self) -> Reading:
        """Return what the robot says now.

        Raises:
            V2PError: it does not answer, or answers something else.
        """
        asked = time.monotonic()
        return self.reading_of(self.robot.get_observation(), asked)

    def reading_of(self, seen: dict[str, Any], asked: float | None = None) -> Reading:
        """Return an observation of the robot's, checked; one without pictures tells state and force only.

        Raises:
            V2PError: entries are missing or no numbers.
        """
        missing = [name for name in STATE_NAMES if name not in seen]
        if missing:
            raise V2PError(
                f"the robot's observation lacks {', '.join(missing)}; it has {', '.join(seen)}"
            )
        state = np.array([float(seen[name]) for name in STATE_NAMES])
        if not np.isfinite(state).all():
            bad = STATE_NAMES[int(np.flatnonzero(~np.isfinite(state))[0])]
            raise V2PError(f"the robot reports '{bad}' = {seen[bad]}, which is no finite number")
        picture, mask = seen.get(RGB_NAME), seen.get(MASK_NAME)
        joints = None
        if picture is not None:
            joints = np.asarray(self.robot.joints(), float)
        elif JOINTS[0] in seen:
            joints = np.array([float(seen[name]) for name in JOINTS])
        ask_force = getattr(self.robot, "force_n", None)
        force = None if ask_force is None else ask_force()
        return Reading(
            state=state,
            picture=None if picture is None else np.asarray(picture, np.uint8),
            labels=None if mask is None else rgb_to_labels(np.asarray(mask, np.uint8)),
            joints_rad=joints,
            opening=float(state[6]) if picture is None else float(self.robot.opening()),
            force_n=None if force is None else float(force),
            time_s=time.monotonic() if asked is None else asked,
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


def fingers_m(opening: float) -> float:
    """Return the travel of one finger of the arm that policies were trained with [m]."""
    return float(np.clip(opening, 0.0, 1.0)) * FINGER_TRAVEL_M

"""One reading of a robot. World frame: the arm's base, +x forward, +y left, +z up."""

from dataclasses import dataclass
from typing import Any

import numpy as np
from jaxtyping import Float, UInt8
from scipy.spatial.transform import Rotation

from v2p_data.errors import V2PError
from v2p_data.sim.env.batch_env import SimConfig
from v2p_data.sim.env.targets import DOWN
from v2p_data.sim.robot.robot import FINGER_TRAVEL_M


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


def fingers_m(opening: float) -> float:
    """Return the travel of one finger of the arm that policies were trained with [m]."""
    return float(np.clip(opening, 0.0, 1.0)) * FINGER_TRAVEL_M


def bytes_of(image: Any, name: str, num_channels: tuple[int, ...] = (3,)) -> np.ndarray:
    """Return an image that a robot gives.

    Raises:
        V2PError: its values are no bytes: black and white of 0 to 1 would both be read as black.
    """
    found = np.asarray(image)
    if (
        found.dtype != np.uint8
        or found.ndim != 2 + len(num_channels)
        or found.shape[2:] != num_channels
    ):
        raise V2PError(
            f"the robot's picture '{name}' holds {found.dtype} of shape {found.shape}; give uint8, 0 to 255, of shape"
            f" {('height', 'width', *num_channels)}"
        )
    return found

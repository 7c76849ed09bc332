"""What a deployed policy may ask of an arm with a camera, real or twin. Nothing here gives poses of objects."""

from typing import Any, Protocol, runtime_checkable

import numpy as np
from jaxtyping import Float

from v2p_data.geometry.camera import Camera

RGB_PX = 256
"""Width and height of the picture `rgb`."""
RGB_NAME = "rgb"
"""Key of the picture in an observation; uint8, `RGB_PX` x `RGB_PX` x 3."""


@runtime_checkable
class RobotWithCamera(Protocol):
    """An arm that reports its joints, and a picture from a calibrated camera.

    `lerobot_policy_v2p.robot.v2p_twin.V2PTwin` is one; a class around a real arm can be another.
    """

    def get_observation(self) -> dict[str, Any]:
        """Return the entries of `episodes.features.STATE_NAMES` as floats, and `rgb`.

        The picture is rectified: a pinhole picture with the matrix and orientation of `calibration()`.
        """
        ...

    def send_action(self, action: dict[str, Any]) -> dict[str, Any]:
        """Carry out an action for one control step of 50 ms; return it as carried out, clipped to [-1, 1]."""
        ...

    def calibration(self) -> Camera:
        """Return the camera of `rgb` as calibrated: `K` in pixels and `T_world_cam`, OpenCV axes.

        The world frame is the arm's base frame. The true camera differs by the calibration error.
        """
        ...

    def joints(self) -> Float[np.ndarray, "7"]:
        """Return the joint angles of the last observation [rad]."""
        ...

    def opening(self) -> float:
        """Return the gripper's opening of the last observation, 0 closed, 1 open."""
        ...

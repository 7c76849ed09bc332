"""What one sees through a ring is no part of it: outlines are fitted whole, and lose their hole once it is known where the ring lies."""

import cv2
import numpy as np
from jaxtyping import Bool, Float

from v2p_data.geometry.camera import Camera
from v2p_data.geometry.pose import apply

_AROUND = 32
"""Points on a rim."""


def seen_through(
    size_m: tuple[float, float, float],
    bore: float,
    T_world_obj: Float[np.ndarray, "4 4"],
    camera: Camera,
) -> Bool[np.ndarray, "h w"]:
    """Return the pixels in which the camera looks through a ring: within both of its inner rims.

    Args:
        size_m: the ring's extents, its axis being its own z [m].
        bore: inner over outer diameter.
        T_world_obj: pose of its middle.
        camera: of the picture, in the world frame.
    """
    angle = np.linspace(0, 2 * np.pi, _AROUND, endpoint=False)
    x, y = (bore * side / 2 for side in size_m[:2])
    through = np.ones((camera.height_px, camera.width_px), bool)
    for z in (-size_m[2] / 2, size_m[2] / 2):
        rim = np.stack([x * np.cos(angle), y * np.sin(angle), np.full(_AROUND, z)], 1)
        pixels = camera.project(apply(T_world_obj, rim))
        drawn = np.zeros(through.shape, np.uint8)
        if np.isfinite(pixels).all() and np.abs(pixels).max() < 4 * max(through.shape):
            hull = cv2.convexHull(((pixels - 0.5) * 16).astype(np.int32))
            cv2.fillConvexPoly(drawn, hull, 1, cv2.LINE_8, 4)
        through &= drawn > 0
    return through

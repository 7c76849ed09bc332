"""The hole of a ring is cut out of its masks. Outlines are fitted whole.

The hole follows once the ring's pose is known.
"""

import cv2
import numpy as np
from jaxtyping import Bool, Float

from v2p_data.geometry.camera import Camera
from v2p_data.geometry.pose import apply
from v2p_data.geometry.raster import fill, in_parts
from v2p_data.scene.frames.mask_ops import iou

_AROUND = 32
"""Number of points on a rim."""
_LIES_THERE = 0.6
"""IoU of the posed ring with the mask, below which the pose does not tell where the hole is: in a
hand a ring is tilted."""


def without_hole(
    mask: Bool[np.ndarray, "h w"],
    size_m: tuple[float, float, float],
    bore: float,
    T_world_obj: Float[np.ndarray, "4 4"],
    camera: Camera,
) -> Bool[np.ndarray, "h w"]:
    """Return a ring's mask without what is seen through it, where the ring as posed covers the mask.

    Args:
        mask: the ring's visible pixels, its hole among them.
        size_m: the ring's extents, its axis being its own z [m].
        bore: inner over outer diameter.
        T_world_obj: pose of its middle.
        camera: of the mask, in the world frame.
    """
    rims = _rims(size_m, 1.0, T_world_obj)
    if iou(_hull(np.concatenate(rims), camera), mask) < _LIES_THERE:
        return mask
    return mask & ~seen_through(size_m, bore, T_world_obj, camera)


def seen_through(
    size_m: tuple[float, float, float],
    bore: float,
    T_world_obj: Float[np.ndarray, "4 4"],
    camera: Camera,
) -> Bool[np.ndarray, "h w"]:
    """Return the pixels in which the camera looks through a ring: within both of its inner rims.

    Arguments as of `without_hole`.
    """
    below, above = (_hull(rim, camera) for rim in _rims(size_m, bore, T_world_obj))
    return below & above


def _rims(
    size_m: tuple[float, float, float], share: float, T_world_obj: Float[np.ndarray, "4 4"]
) -> list[Float[np.ndarray, "n 3"]]:
    """Return points around the lower and the upper face, at a share of the radius."""
    angle = np.linspace(0, 2 * np.pi, _AROUND, endpoint=False)
    x, y, z = (side / 2 for side in size_m)
    around = [share * x * np.cos(angle), share * y * np.sin(angle)]
    return [
        apply(T_world_obj, np.stack([*around, np.full(_AROUND, height)], 1)) for height in (-z, z)
    ]


def _hull(points_world: Float[np.ndarray, "n 3"], camera: Camera) -> Bool[np.ndarray, "h w"]:
    """Return the pixels of the points' convex hull.

    None where it is not all in front of the camera and near the picture.
    """
    drawn = np.zeros((camera.height_px, camera.width_px), np.uint8)
    pixels = camera.project(points_world)
    if np.isfinite(pixels).all() and np.abs(pixels).max() < 4 * max(drawn.shape):
        fill(drawn, cv2.convexHull(in_parts(pixels)))
    return drawn > 0

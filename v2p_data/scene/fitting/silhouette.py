"""One outline, cropped and scaled so that comparing it with a projected shape is cheap."""

from functools import cached_property
from typing import TYPE_CHECKING

import cv2
import numpy as np
from jaxtyping import Bool, Float, UInt8

from v2p_data.geometry.camera import Camera, intrinsics
from v2p_data.geometry.pose import inverse, transform
from v2p_data.geometry.raster import PARTS, fill, in_parts
from v2p_data.scene.frames.mask_ops import bounding_box, is_cut

if TYPE_CHECKING:
    from v2p_data.scene.fitting.cuboid_network import CuboidGuess

_WORK_PX = 110
"""Longer side of the crop in which silhouettes are compared."""
_LOOK_WEIGHT = 0.01
"""Cost in units of IoU of each nat by which the cuboid network finds a box less likely: outlines
hardly tell a cube's yaw."""
_MOST_BY_LOOK = 0.15
"""Greatest cost by the cuboid network, in units of IoU: real boxes look different from the drawn
ones it learned from."""
_LEAST_FACE_PX = 10
"""Side of the outline's bounding box below which a box shows nothing of its turn."""


def camera_above(
    shape: tuple[int, int], pitch_rad: float, fov_rad: float, height: float = 1.0
) -> Camera:
    """Return the camera at (0, 0, height) that looks along +x, `pitch_rad` below the horizon.

    `fov_rad` is the horizontal field of view; roll is zero.
    """
    h, w = shape
    fovy = 2 * np.arctan(np.tan(fov_rad / 2) * h / w)
    c, s = np.cos(pitch_rad), np.sin(pitch_rad)
    forward, right = np.array([c, 0.0, -s]), np.array([0.0, -1.0, 0.0])
    rotation = np.stack([right, np.cross(forward, right), forward], axis=1)
    return Camera(
        width_px=w,
        height_px=h,
        K=intrinsics(w, h, float(fovy)),
        T_world_cam=transform(rotation, np.array([0.0, 0.0, height])),
    )


class Silhouette:
    """One mask, cropped and scaled so that comparing outlines is cheap."""

    def __init__(
        self,
        mask: Bool[np.ndarray, "h w"],
        unknown: Bool[np.ndarray, "h w"] | None,
        camera: Camera,
        image: UInt8[np.ndarray, "h w 3"] | None = None,
    ) -> None:
        """Crop the mask.

        `unknown` is what may hide the object, `image` shows how a box is turned, where that is
        asked.
        """
        x, y, w, h = bounding_box(mask)
        pad = int(0.35 * max(w, h)) + 3
        self.camera, self.box, self.mask = camera, (x, y, w, h), mask
        size = (w + 2 * pad, h + 2 * pad)
        zoom = _WORK_PX / max(size)
        crop = np.array([[zoom, 0, zoom * (pad - x)], [0, zoom, zoom * (pad - y)], [0, 0, 1.0]])
        # World to crop pixels in one matrix: a fit asks ten thousand times.
        self._matrix = crop @ camera.K @ inverse(camera.T_world_cam)[:3]
        move, canvas = crop[:2], (max(8, round(size[0] * zoom)), max(8, round(size[1] * zoom)))
        warped = cv2.warpAffine(mask.astype(np.float32), move, canvas, flags=cv2.INTER_LINEAR)
        known = cv2.warpAffine(np.ones(mask.shape, np.float32), move, canvas) > 0.5
        if unknown is not None:
            known &= ~(cv2.warpAffine((unknown & ~mask).astype(np.float32), move, canvas) > 0.5)
        self._known = known
        self._mask = _filled(warped > 0.5) & known
        self._area = int(self._mask.sum())
        self._at_border = is_cut(mask)
        self._picture = image if min(w, h) >= _LEAST_FACE_PX else None

    @cached_property
    def _guess(self) -> "CuboidGuess":
        """What the box network says, asked where a box is fitted."""
        from v2p_data.scene.fitting.cuboid_network import (
            cuboid_guess,
        )  # torch takes a second to import

        assert self._picture is not None
        return cuboid_guess(self._picture, self.mask, self.camera)

    def iou(self, points_world: Float[np.ndarray, "n 3"], hidden_weight: float = 0.0) -> float:
        """Return how well the convex hull of the projected points covers the mask, where it could be seen.

        With a `hidden_weight`, pixels that may be hidden count that much: else a shape grows behind the hand for ever.
        """
        overlap = self._overlap(points_world)
        if overlap is None:
            return -1.0
        common, wrong, hidden, _ = overlap
        return common / max(1.0, self._area + wrong + hidden_weight * hidden)

    def appearance_cost(
        self,
        form: str,
        size: Float[np.ndarray, "3"] | tuple[float, float, float],
        T_world_obj: Float[np.ndarray, "4 4"],
    ) -> float:
        """Return what a box costs that is not turned, or whose sides are not, as it looks, in units of IoU.

        Nothing without a picture, and for other forms.
        """
        if self._picture is None or form != "box":
            return 0.0
        return min(_MOST_BY_LOOK, _LOOK_WEIGHT * self._guess.cost(size, T_world_obj))

    def visible(self, points_world: Float[np.ndarray, "n 3"]) -> float:
        """Return the share of the projected hull that the mask confirms."""
        overlap = self._overlap(points_world)
        return 0.0 if overlap is None else overlap[0] / max(1.0, overlap[3])

    def _overlap(
        self, points_world: Float[np.ndarray, "n 3"]
    ) -> tuple[float, float, float, float] | None:
        """Return the hull's area on the mask, off it, on hidden pixels, and in all."""
        homogeneous = points_world @ self._matrix[:, :3].T + self._matrix[:, 3]
        if homogeneous[:, 2].min() < 1e-6:
            return None
        pixels = homogeneous[:, :2] / homogeneous[:, 2:]
        if not np.abs(pixels).max() <= 4000:  # of what is not finite, too
            return None
        drawn = np.zeros(self._mask.shape, np.uint8)
        hull = cv2.convexHull(in_parts(pixels))
        fill(drawn, hull)
        covered = drawn > 0
        total = float(np.count_nonzero(covered))
        seen = covered & self._known
        common, known = (float(np.count_nonzero(m)) for m in (seen & self._mask, seen))
        beyond = 0.0 if self._at_border else max(0.0, cv2.contourArea(hull) / PARTS**2 - total)
        return common, known - common + beyond, total - known, total + beyond

    @property
    def centre(self) -> Float[np.ndarray, "2"]:
        """Return the middle of the mask's bounding box [px]."""
        x, y, w, h = self.box
        return np.array([x + w / 2, y + h / 2])


def _filled(mask: Bool[np.ndarray, "h w"]) -> Bool[np.ndarray, "h w"]:
    """Return the mask without holes: what is fitted is convex, a ring's hole says nothing against it."""
    outlines, _ = cv2.findContours(mask.astype(np.uint8), cv2.RETR_EXTERNAL, cv2.CHAIN_APPROX_NONE)
    return cv2.drawContours(np.zeros(mask.shape, np.uint8), outlines, -1, 1, cv2.FILLED) > 0

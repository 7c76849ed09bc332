"""One view's outline, cropped and brought to one size: meshes are drawn over it and compared."""

from dataclasses import dataclass

import cv2
import numpy as np
import trimesh
from jaxtyping import Bool, Float

from v2p_data.geometry.camera import Camera, between_centres
from v2p_data.geometry.pose import inverse
from v2p_data.geometry.raster import fill, in_parts
from v2p_data.scene.frames.mask_ops import bounding_box

_CROP_PX = 160
"""Longer side of the mask's crop, in which outlines are compared."""


@dataclass(frozen=True, kw_only=True)
class SilhouetteView:
    """The object in one frame."""

    mask: Bool[np.ndarray, "h w"]
    """Its visible pixels, at the camera's size."""
    T_world_obj: Float[np.ndarray, "4 4"]
    """Pose of the shape that is compared with the mask: the fitted primitive, or a mesh [m]."""
    hidden: Bool[np.ndarray, "h w"] | None = None
    """Pixels that say nothing, because something may stand in front."""


class SilhouetteCrop:
    """One view's mask, cropped and brought to one size."""

    def __init__(self, view: SilhouetteView, camera: Camera) -> None:
        x, y, w, h = bounding_box(view.mask)
        pad = int(0.3 * max(w, h)) + 3
        zoom = _CROP_PX / (max(w, h) + 2 * pad)
        move = np.array([[zoom, 0, zoom * (pad - x)], [0, zoom, zoom * (pad - y)], [0, 0, 1.0]])
        canvas = (max(8, round(zoom * (w + 2 * pad))), max(8, round(zoom * (h + 2 * pad))))
        self.camera = camera
        self.matrix = move @ camera.K @ inverse(camera.T_world_cam)[:3]
        """World to crop pixels."""

        def cropped(picture: Bool[np.ndarray, "h w"]) -> Bool[np.ndarray, "i j"]:
            affine = between_centres(move)[:2]
            return cv2.warpAffine(picture.astype(np.float32), affine, canvas) > 0.5

        self.mask = cropped(view.mask)
        self.known = cropped(np.ones_like(view.mask))
        if view.hidden is not None:
            self.known &= ~cropped(view.hidden & ~view.mask)
        height, width = view.mask.shape
        self.at_border = x <= 1 or y <= 1 or x + w >= width - 1 or y + h >= height - 1
        self.may = self.mask | ~self.known
        """Where the object can be."""

    def pixels(self, points_world: Float[np.ndarray, "*n 3"]) -> Float[np.ndarray, "*n 2"]:
        """Return crop pixels, NaN behind the camera."""
        uvw = points_world @ self.matrix[:, :3].T + self.matrix[:, 3]
        return uvw[..., :2] / np.where(uvw[..., 2:] > 1e-6, uvw[..., 2:], np.nan)

    def looked_up(
        self, picture: Bool[np.ndarray, "i j"], points_world: Float[np.ndarray, "*n 3"]
    ) -> Bool[np.ndarray, "*n"]:
        """Return the picture's value where each point appears; False outside it."""
        pixels = np.nan_to_num(self.pixels(points_world), nan=-1.0).astype(int)
        h, w = picture.shape
        x, y = pixels[..., 0], pixels[..., 1]
        inside = (x >= 0) & (y >= 0) & (x < w) & (y < h)
        return inside & picture[np.clip(y, 0, h - 1), np.clip(x, 0, w - 1)]

    def drawn(self, mesh: trimesh.Trimesh, T_world_mesh: np.ndarray) -> Bool[np.ndarray, "i j"]:
        """Return the mesh's silhouette."""
        points = mesh.vertices @ T_world_mesh[:3, :3].T + T_world_mesh[:3, 3]
        pixels = self.pixels(points)
        picture = np.zeros(self.mask.shape, np.uint8)
        if not np.isfinite(pixels).all() or np.abs(pixels).max() > 8 * _CROP_PX:
            return picture > 0
        a, b, c = (pixels[mesh.faces[:, k]] for k in range(3))
        turn = (b - a)[:, 0] * (c - a)[:, 1] - (b - a)[:, 1] * (c - a)[:, 0]
        # Of a closed surface the faces that look this way cover all.
        for triangle in in_parts(np.stack([a, b, c], axis=1)[turn < 0]):
            fill(picture, triangle)
        return picture > 0

    def iou(self, drawn: Bool[np.ndarray, "i j"]) -> float:
        """Return the overlap with the mask, where the object could be seen."""
        seen = drawn & self.known
        return float((seen & self.mask).sum() / max(1, (seen | self.mask).sum()))

    def hidden_share(self, drawn: Bool[np.ndarray, "i j"]) -> float:
        """Return how much of a silhouette cannot be seen."""
        return float((drawn & ~self.known).sum() / max(1, drawn.sum()))


def middle_of(picture: Bool[np.ndarray, "i j"]) -> Float[np.ndarray, "2"]:
    """Return the middle of a silhouette's bounding box [px]."""
    x, y, w, h = bounding_box(picture)
    return np.array([x + w / 2, y + h / 2])

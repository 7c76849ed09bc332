"""The table as a smooth coat of colour: what differs from it may be an object."""

from dataclasses import dataclass

import cv2
import numpy as np
from jaxtyping import Bool, Float32, UInt8

from v2p_data.scene.frames.colour import lab_of

_LEAST_SEEN = 0.03
"""Share of the picture; from less bare table its colour cannot be told."""
_CHANNEL_WEIGHT = np.array([0.55, 1.2, 1.2], np.float32)
"""Shadows change lightness, objects change hue: lightness counts half."""


@dataclass(frozen=True, kw_only=True)
class Table:
    """Where the table is seen and which colour it has at every pixel."""

    seen: Bool[np.ndarray, "h w"]
    """Pixels of the bare table."""
    hull: Bool[np.ndarray, "h w"]
    """Convex hull of those: the table with the objects on it."""
    lab: Float32[np.ndarray, "h w 3"]
    """Colour the bare table has, or would have, at each pixel."""
    noise: float
    """Weighted Lab distance below which a pixel is table."""

    def stands_out(self, image: UInt8[np.ndarray, "h w 3"]) -> Bool[np.ndarray, "h w"]:
        """Return pixels within the hull that do not have the table's colour."""
        lab = cv2.GaussianBlur(lab_of(image), (0, 0), 0.8)
        return (_distance(lab, self.lab) > max(7.0, self.noise)) & self.hull


def find_table(image: UInt8[np.ndarray, "h w 3"], bare: Bool[np.ndarray, "h w"]) -> Table:
    """Return the table in a still by its bare part; by all of the picture where hardly any is bare.

    A quadratic in x and y follows the light across it.
    """
    h, w = image.shape[:2]
    seen = bare if bare.mean() > _LEAST_SEEN else np.ones_like(bare)
    y, x = np.mgrid[:h, :w].astype(np.float32)
    lab = np.asarray(cv2.GaussianBlur(lab_of(image), (0, 0), 1.5), np.float32)
    basis = np.stack(
        [np.ones_like(x), x / w, y / h, (x / w) ** 2, (y / h) ** 2, x * y / w / h], -1
    )
    coefficients = np.linalg.lstsq(basis[seen][::5], lab[seen][::5], rcond=None)[0]
    model = (basis @ coefficients).astype(np.float32)
    residual = np.linalg.norm((lab - model) * np.array([0.7, 1.2, 1.2]), axis=-1)
    noise = 3 * float(np.clip(1.5 * np.median(residual[seen]), 2.5, 6))
    return Table(seen=seen, hull=_hull_of(seen), lab=model, noise=noise)


def _hull_of(seen: Bool[np.ndarray, "h w"]) -> Bool[np.ndarray, "h w"]:
    closed = cv2.morphologyEx(seen.astype(np.uint8), cv2.MORPH_CLOSE, np.ones((9, 9)))
    outlines, _ = cv2.findContours(closed, cv2.RETR_EXTERNAL, cv2.CHAIN_APPROX_SIMPLE)
    hull = np.zeros(seen.shape, np.uint8)
    if outlines:
        cv2.fillConvexPoly(hull, cv2.convexHull(max(outlines, key=cv2.contourArea)), 1)
    return hull > 0


def _distance(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    return np.linalg.norm((a - b) * _CHANNEL_WEIGHT, axis=-1)

"""Polygons drawn to a sixteenth of a pixel; pixel centres lie at one half, OpenCV's at whole numbers."""

import cv2
import numpy as np
from jaxtyping import Float, Int32, UInt8

_BITS = 4
PARTS = 2**_BITS
"""Parts of a pixel to which corners are rounded."""


def in_parts(pixels: Float[np.ndarray, "*n 2"]) -> Int32[np.ndarray, "*n 2"]:
    """Return points [px] as OpenCV draws them: in sixteenths of a pixel, counted from the centre of the first one."""
    return ((pixels - 0.5) * PARTS).astype(np.int32)


def fill(picture: UInt8[np.ndarray, "h w"], polygon: Int32[np.ndarray, "*n 2"]) -> None:
    """Set the pixels in a convex polygon, given as by `in_parts`, to one."""
    cv2.fillConvexPoly(picture, polygon, 1, cv2.LINE_8, _BITS)

"""What the clips of `segmentation_of` are drawn of: rectangles in a picture of 120 x 90 px, and their colours."""

import numpy as np

H, W = 90, 120
RED, BLUE, GREEN, SKIN = (190, 40, 40), (40, 60, 190), (40, 150, 60), (224, 172, 140)


def square(x: int, y: int, wide: int = 14, tall: int | None = None) -> np.ndarray:
    """Return a rectangle's mask; a square where only one side is said."""
    mask = np.zeros((H, W), bool)
    mask[y : y + (tall or wide), x : x + wide] = True
    return mask


def large(mask: np.ndarray, shape: tuple[int, int]) -> np.ndarray:
    """Return a mask of the drawn frames at working size."""
    h, w = shape
    return mask[(np.arange(h) * H) // h][:, (np.arange(w) * W) // w]

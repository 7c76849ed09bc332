"""Dense optical flow between two frames, or the same part of them."""

import cv2
import numpy as np
from jaxtyping import Float32, UInt8

_LEAST_PX = 32
"""OpenCV's DIS flow ends the process by a segmentation fault on some wide pictures that are lower
than this (OpenCV 4.13)."""


def flow_to(
    here: UInt8[np.ndarray, "h w"], there: UInt8[np.ndarray, "h w"]
) -> Float32[np.ndarray, "h w 2"]:
    """Return how far from each pixel of a grey frame its point is in the other one (x, y) [px].

    It is DIS optical flow (Kroeger et al. 2016). Small pictures are continued beyond their border first.
    """
    h, w = here.shape
    below, right = max(0, _LEAST_PX - h), max(0, _LEAST_PX - w)
    padded = [
        cv2.copyMakeBorder(image, 0, below, 0, right, cv2.BORDER_REPLICATE)
        for image in (here, there)
    ]
    method = cv2.DISOpticalFlow.create(cv2.DISOPTICAL_FLOW_PRESET_FAST)
    flow = method.calc(*padded, None)  # type: ignore[call-overload]
    return np.asarray(flow[:h, :w], np.float32)

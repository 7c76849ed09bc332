"""A hand's landmarks as a ruler: they are known in metres, and where a fingertip touches a resting object its distance is known.

The hand is as far from the camera as the point above the object's foot that is seen where the hand is. So the pixels per metre that
the landmarks show give the camera's height.
"""

import numpy as np
from jaxtyping import Float

from v2p_data.geometry.camera import Camera
from v2p_data.geometry.pose import apply, inverse
from v2p_data.scene.data_types import RestingObject
from v2p_data.scene.frames.hand_track import HandTrack
from v2p_data.scene.frames.mask_ops import iou

_IN_PLACE = 0.4
"""Overlap of an object's outline with the one where it rests, from which on it rests there."""
_FEWEST = 3
"""Views of a touching hand, fewer of which say nothing."""
_DOUBT = 0.22
"""Standard deviation of the logarithm, beyond the spread of the views. On eight real clips the heights differ by 0.28 (root mean square) from
those by usual sizes, whose own spread is 0.13."""
_FARTHEST_M = 0.3
"""A hand so high above an object's foot does not touch the object."""


def height_from_landmarks(
    hands: HandTrack, resting: RestingObject, height_m: float
) -> tuple[float, float] | None:
    """Return the camera's height [m] by a hand's landmarks, and the standard deviation of its logarithm.

    Args:
        hands: of the clip.
        resting: the object that the hand touches.
        height_m: a guess of the camera's height, which only says what is too far to be a touch.

    Returns:
        None where too few views show a hand that touches the object at rest.
    """
    heights = []
    for outline, position in resting.rests:
        for k in _touching(hands, resting, outline):
            shown = px_per_m(hands.px[k], hands.metres[k])
            above = _point_above(resting.camera, position, hands.px[k].mean(0))
            if shown <= 0 or not 0 <= above[2] * height_m < _FARTHEST_M:
                continue
            depth = float(apply(inverse(resting.camera.T_world_cam), above[None])[0, 2])
            focal_px = float(resting.camera.K[0, 0])
            heights.append(focal_px / (shown * depth))
    if len(heights) < _FEWEST:
        return None
    logs = np.log(heights)
    middle = float(np.median(logs))
    spread = 1.4826 * float(np.median(np.abs(logs - middle)))
    return float(np.exp(middle)), float(np.hypot(spread, _DOUBT))


def px_per_m(px: Float[np.ndarray, "21 2"], metres: Float[np.ndarray, "21 3"]) -> float:
    """Return the scale of the weak perspective that brings landmarks to where the picture shows them [px/m].

    Both have axes to the right and down.
    """
    true = metres[:, :2] - metres[:, :2].mean(0)
    seen = px - px.mean(0)
    return float((true * seen).sum() / (true * true).sum())


def _touching(hands: HandTrack, resting: RestingObject, outline: np.ndarray) -> list[int]:
    """Return which hands touch the object while it rests where this outline shows it."""
    frames = {
        int(i)
        for i in np.unique(hands.at)
        if resting.masks[i].any() and iou(resting.masks[i], outline) >= _IN_PLACE
    }
    return [
        k
        for k, i in enumerate(hands.at)
        if int(i) in frames and hands.touches(k, resting.masks[i])
    ]


def _point_above(
    camera: Camera, position: Float[np.ndarray, "3"], pixel: Float[np.ndarray, "2"]
) -> Float[np.ndarray, "3"]:
    """Return the point above a position's foot that is seen in the pixel's row [camera heights]."""
    ray = camera.rays_world(pixel[None])[0]
    origin = camera.T_world_cam[:3, 3]
    along = np.linalg.norm(position[:2] - origin[:2]) / np.linalg.norm(ray[:2])
    return np.array([position[0], position[1], origin[2] + along * ray[2]])

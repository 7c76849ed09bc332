"""A clicked pixel, or a line drawn over an object, becomes the object's outline by colours alone."""

from dataclasses import dataclass

import cv2
import numpy as np
from jaxtyping import Bool, UInt8

from v2p_data.errors import V2PError
from v2p_data.scene.frames.colour import lab_of
from v2p_data.scene.frames.mask_ops import grow, largest, refine, tidy

SURROUNDINGS = 8
"""Colour clusters of the picture."""
BORDER_PX = 6
LIGHTNESS_WEIGHT = 0.5
"""Of lightness beside hue in colour distances: faces of one thing differ in lightness."""
SPECK_PX = 16
"""At 256 px: nothing smaller is an object."""


@dataclass(frozen=True, kw_only=True)
class ClickConfig:
    """How a clicked object is told from its surroundings."""

    least_contrast: float = 9.0
    """Lab distance from the surroundings' colours from which a clicked pixel is a thing."""
    largest_share: float = 0.25
    """Of the picture: a larger thing is the table, or the light."""


def clicked_mask(
    picture: UInt8[np.ndarray, "h w 3"],
    click_px: tuple[float, float],
    robot: Bool[np.ndarray, "h w"],
    cfg: ClickConfig,
) -> Bool[np.ndarray, "h w"]:
    """Return the outline of the thing at a pixel (u right, v down).

    Raises:
        V2PError: the pixel lies outside the picture, on the robot, on the table, or on something
            too small or too large.
    """
    h, w = picture.shape[:2]
    u, v = click_px
    where = f"the click at ({u:g}, {v:g})"
    if not (0 <= u < w and 0 <= v < h):
        raise V2PError(
            f"{where} lies outside the picture, which has {w} x {h} pixels; click on the object"
        )
    x, y = int(u), int(v)
    if robot[y, x]:
        raise V2PError(f"{where} is on the robot; click on the object that the task is about")
    apart = _apart_from_surroundings(picture, robot)
    noise = float(np.median(apart[~robot]))
    threshold = max(cfg.least_contrast, 4 * noise)
    around = apart[max(0, y - 1) : y + 2, max(0, x - 1) : x + 2]
    if np.median(around) < threshold:
        raise V2PError(
            f"{where} is on the table or the background: its colour is that of the surroundings; click on the"
            " middle of the object"
        )
    things = tidy((apart > threshold) & ~grow(robot, 1))
    things[max(0, y - 1) : y + 2, max(0, x - 1) : x + 2] = True
    _, parts = cv2.connectedComponents(things.astype(np.uint8), connectivity=4)
    blob = largest(parts == parts[y, x])
    if blob.sum() > cfg.largest_share * h * w:
        raise V2PError(
            f"{where} is on something that fills {blob.mean():.0%} of the picture: the table or the background; click"
            " on the object"
        )
    if blob.sum() < SPECK_PX * (h / 256) ** 2:
        raise V2PError(
            f"{where} is on a speck of {int(blob.sum())} pixels: no object is seen there; click on its middle"
        )
    mask = refine(picture, blob, never=robot)
    return mask if mask[y, x] else blob


def _apart_from_surroundings(picture: np.ndarray, robot: np.ndarray) -> np.ndarray:
    """Return each pixel's distance in Lab from the nearest colour that the surroundings have.

    Colours count as surroundings if much of the picture, or of its border, has them.
    """
    weights = np.array([LIGHTNESS_WEIGHT, 1.0, 1.0], np.float32)
    lab = cv2.GaussianBlur(lab_of(picture), (0, 0), 0.8) * weights
    usable = ~grow(robot, 3)
    border = np.ones_like(robot)
    border[BORDER_PX:-BORDER_PX, BORDER_PX:-BORDER_PX] = False
    samples = np.ascontiguousarray(lab[usable][::3])
    if len(samples) < 10 * SURROUNDINGS:
        raise V2PError(
            "the robot fills the picture: the camera sees no object; move the arm aside"
        )
    cv2.setRNGSeed(2)
    _, _, centres = cv2.kmeans(
        samples, SURROUNDINGS, np.empty(0), (3, 20, 1), 1, cv2.KMEANS_PP_CENTERS
    )
    distance = np.linalg.norm(lab[:, :, None] - centres[None, None], axis=-1)
    nearest = distance.argmin(-1)
    share = np.bincount(nearest[usable], minlength=SURROUNDINGS) / usable.sum()
    rim = border & usable
    at_rim = np.bincount(nearest[rim], minlength=SURROUNDINGS) / max(1, rim.sum())
    common = (share > 0.08) | (at_rim > 0.03)
    return distance[..., common].min(-1)

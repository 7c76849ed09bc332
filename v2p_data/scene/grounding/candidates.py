"""What may be the object that a phrase means: outlines, and what speaks for each."""

from dataclasses import dataclass, field

import cv2
import numpy as np
from jaxtyping import Bool, Float

from v2p_data.scene.frames.mask_ops import solidity

_WHOLE = 0.8
"""Solidity from which an outline is that of one object."""
_NECKS = (0.4, 0.6, 0.8)
"""Radii, as shares of a mask's greatest inner radius, at which a mask is cut at its necks."""


@dataclass(frozen=True, kw_only=True)
class Candidate:
    """A thing that may be the one that a phrase means."""

    mask: Bool[np.ndarray, "h w"]
    cues: dict[str, float]
    """What speaks for it."""
    outlined: bool = False
    """Whether a model that knows edges of objects drew it."""

    @property
    def area(self) -> int:
        return int(self.mask.sum())


@dataclass(frozen=True, kw_only=True)
class Moved:
    """The manipulated object's two outlines at working size."""

    first: Bool[np.ndarray, "h w"]
    last: Bool[np.ndarray, "h w"]
    score: float
    """Product of the cues, 0 to 1."""
    colour_hist: Float[np.ndarray, "l a b"] = field(repr=False)
    """Colour histogram of the object."""
    cues: dict[str, float] = field(default_factory=dict[str, float])
    outlined: tuple[int, ...] = ()
    """0 where a model that knows edges of objects drew the first outline, 1 where it drew the last: these are final."""


def connected_parts(
    pixels: Bool[np.ndarray, "h w"], least_px: float, most_px: float = np.inf
) -> list[Bool[np.ndarray, "h w"]]:
    """Return the connected parts of some pixels whose area lies between these."""
    count, parts, stats, _ = cv2.connectedComponentsWithStats(pixels.astype(np.uint8))
    return [
        parts == k for k in range(1, count) if least_px <= stats[k, cv2.CC_STAT_AREA] <= most_px
    ]


def pieces_of(mask: Bool[np.ndarray, "h w"], least_px: float) -> list[Bool[np.ndarray, "h w"]]:
    """Return the parts of a mask that only a neck joins, as openings with discs of its own width leave them."""
    if mask.sum() < least_px or solidity(mask) > _WHOLE:
        return []
    inner = cv2.distanceTransform(mask.astype(np.uint8), cv2.DIST_L2, 5)
    out: list[Bool[np.ndarray, "h w"]] = []
    for share in _NECKS:
        radius = share * float(inner.max())
        count, cores = cv2.connectedComponents((inner > radius).astype(np.uint8))
        for k in range(1, count):
            outside = (cores != k).astype(np.uint8)
            near = cv2.distanceTransform(outside, cv2.DIST_L2, 5) <= radius
            if (near & mask).sum() >= least_px:
                out.append(near & mask)
    return out

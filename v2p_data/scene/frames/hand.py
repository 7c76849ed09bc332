"""Where a hand ends in the picture: what is farthest from where its arm comes in."""

from dataclasses import dataclass

import cv2
import numpy as np
from jaxtyping import Bool

_EDGE_PX = 3
_LEAST_REACH = 0.08
"""Of the picture's width: a hand that comes in less far shows too little of itself."""


@dataclass(frozen=True, kw_only=True)
class HandEnd:
    """The end of a hand that is farthest from where its arm comes into the picture."""

    tip_px: tuple[float, float]
    entry_px: tuple[float, float]
    """Where the arm comes into the picture."""

    @property
    def way(self) -> tuple[float, float]:
        """Unit vector from there to where the arm comes in."""
        dx, dy = self.entry_px[0] - self.tip_px[0], self.entry_px[1] - self.tip_px[1]
        far = max(1e-6, float(np.hypot(dx, dy)))
        return dx / far, dy / far


def hand_end(hand: Bool[np.ndarray, "h w"]) -> HandEnd | None:
    """Return where a hand ends; None where no arm comes in from the picture's edge, or not far."""
    count, parts, stats, _ = cv2.connectedComponentsWithStats(hand.astype(np.uint8))
    if count < 2:
        return None
    h, w = hand.shape
    y, x = np.nonzero(parts == 1 + int(stats[1:, cv2.CC_STAT_AREA].argmax()))
    edge = (x < _EDGE_PX) | (x >= w - _EDGE_PX) | (y < _EDGE_PX) | (y >= h - _EDGE_PX)
    if edge.sum() < _EDGE_PX:
        return None
    spots = np.stack([x, y], 1) + 0.5
    entry = spots[edge].mean(0)
    far = np.linalg.norm(spots - entry, axis=1)
    if far.max() < _LEAST_REACH * w:
        return None
    tip = spots[far >= np.percentile(far, 98)].mean(0)
    return HandEnd(
        tip_px=(float(tip[0]), float(tip[1])), entry_px=(float(entry[0]), float(entry[1]))
    )


def gap_px(hand: Bool[np.ndarray, "h w"], mask: Bool[np.ndarray, "h w"]) -> float:
    """Return how far apart a hand and a thing's outline are in the picture."""
    away = cv2.distanceTransform((~mask).astype(np.uint8), cv2.DIST_L2, 5)
    return float(away[hand].min())

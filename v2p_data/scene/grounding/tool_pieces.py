"""What passes in a frame is cut into pieces, and each is rated by how much it looks like a tool in a hand."""

from collections.abc import Iterator
from dataclasses import dataclass

import cv2
import numpy as np
from jaxtyping import Bool, Float, Float32, UInt8

from v2p_data.scene.frames.colour import histogram, similarity
from v2p_data.scene.frames.mask_ops import bounding_box, grow, tidy

_HALF_WIDTHS_PX = (2, 3, 5, 8, 12)
"""Of what is cut off what passes, so that thinner things are left, at working size."""
_COLOURS = (2, 3, 4)
"""Into so many kinds of colour what passes is split."""
LEAST_PX = 40
"""Least area of a piece, in a picture 320 px wide."""


@dataclass(frozen=True, kw_only=True)
class ToolFrame:
    """What passes in one frame, and what is known there."""

    rgb: UInt8[np.ndarray, "h w 3"]
    lab: Float32[np.ndarray, "h w 3"]
    passing: Bool[np.ndarray, "h w"]
    shaded: Bool[np.ndarray, "h w"]
    hand: Float32[np.ndarray, "h w"]
    """Probability."""
    moved: Float32[np.ndarray, "h w"]
    pushed: Bool[np.ndarray, "h w"]
    away_px: Float32[np.ndarray, "h w"]
    """From what is pushed."""


@dataclass(frozen=True, kw_only=True)
class ToolPiece:
    mask: Bool[np.ndarray, "h w"]
    parts: dict[str, float]
    """What its rating is the product of, each 0 to 1."""
    hist: Float[np.ndarray, "l a b"]

    @property
    def rating(self) -> float:
        return float(np.prod(list(self.parts.values())))


def pieces_in(
    passing: Bool[np.ndarray, "h w"], frame: ToolFrame
) -> Iterator[Bool[np.ndarray, "h w"]]:
    """Yield what passes, its thin parts, what the network says is moved of it, and its parts of one colour."""
    yield from connected_pieces(passing)
    for half_width in _HALF_WIDTHS_PX:
        disc = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (2 * half_width + 1,) * 2)
        thick = cv2.morphologyEx(passing.astype(np.uint8), cv2.MORPH_OPEN, disc) > 0
        thin = passing & ~grow(thick, 1)
        yield from connected_pieces(tidy(thin) if half_width > 2 else thin)
    yield from connected_pieces(tidy((frame.moved > 0.5) & grow(passing, 1)))
    pixels = frame.lab[passing]
    if len(pixels) < LEAST_PX:
        return
    cv2.setRNGSeed(3)
    for count in _COLOURS:
        sample = np.ascontiguousarray(pixels[:: max(1, len(pixels) // 2000)])
        if len(sample) < count:
            return
        _, _, centres = cv2.kmeans(
            sample, count, np.empty(0), (3, 12, 1.0), 1, cv2.KMEANS_PP_CENTERS
        )
        nearest = np.linalg.norm(pixels[:, None] - centres[None], axis=-1).argmin(1)
        for k in range(count):
            alike = np.zeros_like(passing)
            alike[passing] = nearest == k
            yield from connected_pieces(tidy(alike, 5))


def connected_pieces(mask: Bool[np.ndarray, "h w"]) -> Iterator[Bool[np.ndarray, "h w"]]:
    count, parts, stats, _ = cv2.connectedComponentsWithStats(mask.astype(np.uint8))
    for k in range(1, count):
        if stats[k, cv2.CC_STAT_AREA] >= LEAST_PX:
            yield parts == k


def ratings_of(
    frame: ToolFrame,
    passing: Bool[np.ndarray, "h w"],
    mask: Bool[np.ndarray, "h w"],
    usual_px: tuple[float, ...],
) -> dict[str, float]:
    """Return what speaks for a piece being the tool, each 0 to 1."""
    area = float(mask.sum())
    y, x = np.nonzero(mask)
    sides = cv2.minAreaRect(np.stack([x, y], 1).astype(np.float32))[1]
    length, across = max(sides) + 1, min(sides) + 1
    width = area / length
    usual_length, usual_width = usual_px[0], max(usual_px[1], 2.0)
    # A spoon is as wide as its noun says at its bowl only.
    mean_width = usual_width if usual_length > 6 * usual_width else 0.45 * usual_width
    x0, y0, w, h = bounding_box(mask)
    inner = np.pad(mask[y0 : y0 + h, x0 : x0 + w].astype(np.uint8), 1)
    thickest = 2 * float(cv2.distanceTransform(inner, cv2.DIST_L2, 5).max()) - 1
    ring = grow(mask, 2) & ~mask & ~frame.pushed
    around = passing & ~mask & (frame.hand > 0.5)
    near = around & grow(mask, 20)
    hand = near if near.sum() > 100 else around
    unlike = 0.6
    if hand.sum() > 100:
        alike = similarity(histogram(frame.rgb[mask]), histogram(frame.rgb[hand]))
        unlike = float(np.clip(1.15 - alike, 0.15, 1))
    reach = 0.25 * np.sqrt(float(frame.pushed.sum())) + 3
    return {
        "long": float(np.clip((length / width - 1.5) / 4, 0.02, 1)),
        "straight": min(1.0, area / (length * across) / 0.5),
        "at the thing": float(np.exp(-max(0.0, float(frame.away_px[mask].min()) - 3) / reach)),
        "end on": float(np.clip(1.4 - 1.6 * (frame.away_px[mask] <= 5).mean(), 0.05, 1)),
        "usual width": _within(width / mean_width, 0.4, 0.4),
        "not thick": _within(max(1.0, thickest / usual_width), 0.4, 0.5),
        "usual length": _within(length / (0.7 * usual_length), 0.5, 0.5),
        "stands out": float(np.clip(1 - 1.2 * passing[ring].mean(), 0.1, 1))
        if ring.any()
        else 0.5,
        "no shadow": float(1 - 0.9 * frame.shaded[mask].mean()),
        "no hand": float(1 - 0.45 * frame.hand[mask].mean()),
        "unlike the hand": unlike,
    }


def _within(ratio: float, free: float, sd: float) -> float:
    """Return 1 for a ratio near one, less beyond exp(`free`) either way."""
    return float(np.exp(-0.5 * (max(0.0, abs(float(np.log(ratio))) - free) / sd) ** 2))

"""A click on an object, or a stroke over it, becomes the object's outline in that picture.

Candidates come from colours that the surroundings lack (`frames/one_click.py`), from what the
network sees as an object, from the colours at the marked pixels, and from GrabCut with several
sizes and proportions. The one counts that most looks like an object which somebody clicked near its
middle.
"""

from collections.abc import Iterator, Sequence
from itertools import pairwise

import cv2
import numpy as np
from jaxtyping import Bool, Float, UInt8

from v2p_data.errors import V2PError
from v2p_data.scene.frames.classes import HAND, MOVED, OTHER
from v2p_data.scene.frames.colour import lab_of
from v2p_data.scene.frames.mask_ops import (
    bounding_box,
    edge_contrast,
    ellipse_in,
    from_core,
    from_points,
    grow,
    is_cut,
    largest,
    refine,
    solidity,
    tidy,
)
from v2p_data.scene.frames.one_click import ClickConfig, clicked_mask
from v2p_data.scene.grounding.model_outlines import ModelOutline

_LIKELY, _SURE = 0.5, 0.8
_STEP_PX = 3.0
"""At working size: a stroke counts at every so many pixels."""
_CLICKS_OF_STROKE = 6
_ALIKE_LAB = (6.0, 9.0, 14.0)
_SIDES_PX, _PROPORTIONS = (14, 24, 40, 66), ((1.0, 1.0), (0.6, 1.3), (1.4, 0.6))
"""At working size, 320 px wide: ellipses around a click from which GrabCut starts."""
_CORE = 0.6
"""Share of an ellipse's axes within which all is taken to be object."""
_LEAST_PX = 12
_LARGEST_SHARE = 0.3
"""Of the picture: a larger outline is no object on a table."""
_LEAST_ON = 0.5
"""Share of the marked pixels that an outline must hold."""
_RING_PX = (1, 4)
_MOST_CONTRAST = 40.0
_WEIGHTS = np.array([-0.174, -0.028, 0.190, 0.141, 0.451, -1.014, -0.190])
"""Of what `_likeness` looks at: least squares on the overlap with boxes drawn by hand around 56
objects of 32 real clips."""

_WHOLE = 1.0
"""Weight on the logarithm of the overlap that a model expects of its outline."""
_LEAST_LIKENESS, _BARE = 0.40, 0.4
"""What looks less like an object, where the network sees an object with a lower probability, is
none. Of 112 clicks on bare table 94 % look so, of 112 on those objects 7 %."""


def mask_at_spots(
    picture: UInt8[np.ndarray, "h w 3"],
    spots: Sequence[tuple[float, float]],
    shares: Float[np.ndarray, "5 h w"],
    outlines: Sequence[ModelOutline] = (),
) -> Bool[np.ndarray, "h w"]:
    """Return the outline of the object at a clicked pixel, or along a stroke.

    Args:
        picture: at working size, 320 px wide.
        spots: (x, y) [px] of the picture; several are the corners of a stroke.
        shares: what the network sees in the picture, by class.
        outlines: of a model that was asked at these spots; they are preferred to all others.

    Raises:
        V2PError: no object is there.
    """
    marked = points_along(spots, picture.shape[:2])
    drawn = _pixels_of(marked, picture.shape[:2])
    hand = (shares[HAND] > _LIKELY) & ~grow(drawn, 1)
    thing = shares[MOVED] + shares[OTHER]
    drawn_by_model = [(one.mask, _WHOLE * float(np.log(min(1.0, one.iou)))) for one in outlines]
    others = ((mask, 0.0) for mask in _candidates(picture, marked, drawn, thing, hand))
    usable, preference = list[Bool[np.ndarray, "h w"]](), list[float]()
    for mask, bonus in drawn_by_model or others:
        if (
            _LEAST_PX <= mask.sum() <= _LARGEST_SHARE * mask.size
            and mask[drawn].mean() >= _LEAST_ON
        ):
            usable.append(mask)
            preference.append(bonus)
    if not usable:
        raise V2PError("no outline of an object is found there; draw a box around it")
    lab = lab_of(picture)
    likeness = [_likeness(mask, lab, thing, drawn) for mask in usable]
    best = int(np.argmax(np.add(likeness, preference)))
    if likeness[best] < _LEAST_LIKENESS and thing[drawn].mean() < _BARE:
        raise V2PError(
            "nothing stands out there from the table or the background; mark the middle of the "
            "object, or draw a box around it"
        )
    return usable[best]


def _candidates(
    picture: UInt8[np.ndarray, "h w 3"],
    marked: list[tuple[float, float]],
    drawn: Bool[np.ndarray, "h w"],
    thing: Float[np.ndarray, "h w"],
    hand: Bool[np.ndarray, "h w"],
) -> Iterator[Bool[np.ndarray, "h w"]]:
    yield from _by_contrast(picture, marked, hand)
    yield from _by_network(picture, thing, drawn, hand)
    for alike_lab in _ALIKE_LAB:
        yield from_points(picture, marked, alike_lab) & ~hand
    x, y, w, h = bounding_box(drawn)
    for side in _SIDES_PX:
        for wide, tall in _PROPORTIONS:
            far = (w - 1 + side * wide) / 2, (h - 1 + side * tall) / 2
            box, around = (_box_at((x + w / 2, y + h / 2), far, k) for k in (1, 2))
            inside = np.zeros(drawn.shape, bool)
            inside[max(0, around[1]) : around[3], max(0, around[0]) : around[2]] = True
            likely, core = (ellipse_in(box, drawn.shape, share) for share in (1.0, _CORE))
            core = drawn | (core & ~hand) if len(marked) == 1 else drawn
            mask = from_core(picture, core, likely & ~hand, inside & ~hand)
            if mask is not None:
                yield mask


def _by_contrast(
    picture: UInt8[np.ndarray, "h w 3"],
    marked: list[tuple[float, float]],
    hand: Bool[np.ndarray, "h w"],
) -> Iterator[Bool[np.ndarray, "h w"]]:
    """Yield what has other colours than the surroundings, where any marked pixel has."""
    parts = list[Bool[np.ndarray, "h w"]]()
    for spot in marked[:: max(1, len(marked) // _CLICKS_OF_STROKE)]:
        try:
            parts.append(clicked_mask(picture, spot, hand, ClickConfig()))
        except V2PError:
            continue  # other candidates may show it
    if parts:
        yield np.any(parts, axis=0)


def _by_network(
    picture: UInt8[np.ndarray, "h w 3"],
    thing: Float[np.ndarray, "h w"],
    drawn: Bool[np.ndarray, "h w"],
    hand: Bool[np.ndarray, "h w"],
) -> Iterator[Bool[np.ndarray, "h w"]]:
    """Yield what the network sees as one object, or as several that touch, as it is and with GrabCut's outline."""
    for least in (_LIKELY, _SURE):
        _, parts = cv2.connectedComponents(tidy(thing > least).astype(np.uint8), connectivity=4)
        wanted = np.unique(parts[drawn])
        blob = largest(np.isin(parts, wanted[wanted > 0]))
        if blob.any():
            yield blob & ~hand
            yield refine(picture, blob, never=hand)


def _likeness(
    mask: Bool[np.ndarray, "h w"],
    lab: Float[np.ndarray, "h w 3"],
    thing: Float[np.ndarray, "h w"],
    drawn: Bool[np.ndarray, "h w"],
) -> float:
    """Return how much a mask looks like an object that was marked near its middle: an expected overlap."""
    ring = grow(mask, _RING_PX[1]) & ~grow(mask, _RING_PX[0])
    x, y, w, h = bounding_box(mask)
    u, v, wide, high = bounding_box(drawn)
    off = max(abs(u + wide / 2 - x - w / 2) / w, abs(v + high / 2 - y - h / 2) / h)
    log_share = float(np.log(mask.mean()))
    values = [
        log_share,
        log_share**2,
        min(_MOST_CONTRAST, edge_contrast(lab, mask)) / _MOST_CONTRAST,
        solidity(mask),
        float(thing[mask].mean()) - (float(thing[ring].mean()) if ring.any() else 0.0),
        off,
        float(is_cut(mask)),
    ]
    return float(_WEIGHTS @ values)


def points_along(
    spots: Sequence[tuple[float, float]], shape: tuple[int, int]
) -> list[tuple[float, float]]:
    """Return points along the line through the spots, `_STEP_PX` apart, inside of a picture of this shape."""
    h, w = shape
    corners = [(min(max(x, 0.0), w - 1.0), min(max(y, 0.0), h - 1.0)) for x, y in spots]
    out = corners[:1]
    for (x0, y0), (x1, y1) in pairwise(corners):
        count = max(1, round(float(np.hypot(x1 - x0, y1 - y0)) / _STEP_PX))
        steps = (k / count for k in range(1, count + 1))
        out += [(x0 + (x1 - x0) * k, y0 + (y1 - y0) * k) for k in steps]
    return out


def _pixels_of(
    marked: list[tuple[float, float]], shape: tuple[int, int]
) -> Bool[np.ndarray, "h w"]:
    line = np.array(marked).round().astype(np.int32)
    drawn = np.zeros(shape, np.uint8)
    for start, end in pairwise([line[0], *line]):
        cv2.line(drawn, start.tolist(), end.tolist(), 1)
    return drawn > 0


def _box_at(
    centre: tuple[float, float], far: tuple[float, float], k: int
) -> tuple[int, int, int, int]:
    (x, y), (w, h) = centre, far
    return int(x - k * w), int(y - k * h), int(x + k * w), int(y + k * h)

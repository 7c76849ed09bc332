"""Split screens: which pictures a clip shows at once, beside or above each other, on a plain page, or one in another.

A seam between two pictures has a step along a whole column or row, in every frame. Lines of a scene may have one too. They are told by
three facts: a seam is exactly upright or level, no texture goes on behind it, and nothing moves across it. An inset has four such sides,
some of which may be the picture's border.
"""

from dataclasses import dataclass
from itertools import combinations
from typing import Literal

import cv2
import numpy as np
from jaxtyping import Bool, Float32, UInt8

from v2p_data.scene.frames.colour import lab_distance
from v2p_data.scene.frames.working_clip import WorkingClip

_Greys = Float32[np.ndarray, "sample h w"]
_Changes = Bool[np.ndarray, "moments rows columns"]
"""Whether each pixel of the working frames differs from the first one."""
PaneBox = tuple[int, int, int, int]
"""x0, y0, x1, y1 [px of the clip's frames]."""
_FRAMES = 9
_REACH = 3
"""Pixels between the two columns whose difference is a step: encoded seams are that wide."""
_STEP, _SHARE, _BESIDE_SHARE = 10.0, 0.72, 0.45
"""Luma step across a seam, the share of its length that has one, and the largest share 6 px beside it."""
_LEAST_PX = 40
"""Narrower pictures leave no room for strips beside a seam."""
_MARGIN = 1 / 5
"""Of the width or height: narrower parts are not looked for."""
_TILTS_PX = (4, 6, 8, 12)
"""Tilted lines deviate so far over their length, to either side: less is below `_REACH`."""
_CORRELATION = 0.35
"""Of the edges on both sides of a seam, at most."""
_CROSSING = 0.5
"""Association of the changes on both sides, over time and along the seam: 0 by chance, 1 where all of one side's are on the other as well."""
_STRIP_PX = (2, 6)
"""From a seam to the strip where changes are compared, of a picture 320 px wide."""
_CHANGE_LAB, _LEAST_MOVING = 15.0, 0.002
_PLAIN = 12.0
"""Luma: a line whose 2nd and 98th percentile, over all frames, are so near to the page is a strip of it."""
_USUAL_PAGES = (248.0, 8.0)
"""Luma of white and black ones; others show at the picture's corners."""
_LEAST_BLOCK, _LEAST_BLOCK_PX = 0.12, 40
"""Of the length that is cut, and pixels: narrower blocks are titles."""
_MOST_CUTS = 4
_INSET_AREA = (0.03, 0.6)
_LEAST_SIDE = 0.15
_INSET_SHARE, _LEAST_SIDE_SHARE = 0.85, 0.75
"""Shares of an inset's sides that show a step: their mean, and the least."""
_BESIDE_PX = 7
_LASTING = 0.75
"""Share of the frames in which an edge must be seen. A moving object may hide it at times, where its colour equals the background."""
_GAP_PX, _NEAR_PX = 9, 5
"""Gaps in a side that are closed, and how far an inset's corner may lie from its sides' ends."""
_MOST_LINES = 24


@dataclass(frozen=True, kw_only=True)
class Seam:
    """A straight seam between two pictures."""

    direction: Literal["upright", "level"]
    place: float
    """As a share of the picture's width, or of its height where the seam is level."""
    step_share: float
    """Share of its length that shows a step, in the frame that shows least."""
    moving: tuple[float, float]
    """Share of the picture that changes at some time: left and right, or above and below."""


def panes_of(frames: UInt8[np.ndarray, "time h w 3"], working: WorkingClip) -> list[PaneBox]:
    """Return the pictures in which something moves that a clip shows at once; none where it shows one.

    An inset comes first, and the picture that it lies in after it.
    """
    grey, changes = _seen(frames, working)
    corners = [np.median(grey[:, y, x]) for y in (1, -2) for x in (1, -2)]
    own = [float(np.median(corners))] if np.ptp(corners) <= _PLAIN else []
    panes = _split(
        grey, changes, (*own, *_USUAL_PAGES), (0, 0, grey.shape[2], grey.shape[1]), _MOST_CUTS
    )
    return panes if len(panes) > 1 else []


def seam_of(frames: UInt8[np.ndarray, "time h w 3"], working: WorkingClip) -> Seam | None:
    """Return the seam with the longest step, None where there is no seam."""
    return _longest_seam(*_seen(frames, working))


def _seen(
    frames: UInt8[np.ndarray, "time h w 3"], working: WorkingClip
) -> tuple[_Greys, _Changes]:
    """Return a few frames in grey, and what changes in the working frames."""
    pick = np.unique(
        np.linspace(0, len(frames) - 1, min(len(frames), _FRAMES)).round().astype(int)
    )
    grey = np.stack([cv2.cvtColor(frames[i], cv2.COLOR_RGB2GRAY) for i in pick]).astype(np.float32)
    first = working.lab[0]
    changes = np.stack([lab_distance(lab, first) > _CHANGE_LAB for lab in working.lab])
    return grey, changes


def _split(
    grey: _Greys, changes: _Changes, pages: tuple[float, ...], box: PaneBox, cuts: int
) -> list[PaneBox]:
    """Return the parts of a picture in which something moves, cut at strips of a page of one of these lumas, and at seams."""
    x0, y0, x1, y1 = box
    k = changes.shape[2] / grey.shape[2]
    here = grey[:, y0:y1, x0:x1]
    moves = changes[:, round(y0 * k) : round(y1 * k), round(x0 * k) : round(x1 * k)]
    if not moves.size or np.any(moves, axis=0).mean() < _LEAST_MOVING:
        return []
    cut = (parts for page in pages if (parts := _blocks(here, page, box)) != [box])
    parts = next(cut, [box])
    if parts == [box] and (seam := _longest_seam(here, moves)) is not None:
        across, down = x0 + round(seam.place * (x1 - x0)), y0 + round(seam.place * (y1 - y0))
        upright = seam.direction == "upright"
        parts = (
            [(x0, y0, across, y1), (across, y0, x1, y1)]
            if upright
            else [(x0, y0, x1, down), (x0, down, x1, y1)]
        )
    if parts != [box] and cuts:
        return [pane for part in parts for pane in _split(grey, changes, pages, part, cuts - 1)]
    inset = _inset(here, moves)
    if inset is None:
        return [box]
    a, b, c, d = inset
    return [(x0 + a, y0 + b, x0 + c, y0 + d), box]


def _blocks(grey: _Greys, page: float, box: PaneBox) -> list[PaneBox]:
    """Return the blocks between columns, else between rows, that have the page's luma from end to end in all frames."""
    x0, y0, x1, y1 = box
    for axis, (begin, end) in ((1, (x0, x1)), (2, (y0, y1))):
        spread = np.abs(np.percentile(grey, (2, 98), axis=(0, axis)) - page).max(0)
        least = max(_LEAST_BLOCK_PX, round(_LEAST_BLOCK * (end - begin)))
        inside = _runs(spread > _PLAIN, least)
        if len(inside) > 1 or (inside and inside[0] != (0, end - begin)):
            return [
                (x0 + a, y0, x0 + b, y1) if axis == 1 else (x0, y0 + a, x1, y0 + b)
                for a, b in inside
            ]
    return [box]


def _runs(there: Bool[np.ndarray, "n"], least: int) -> list[tuple[int, int]]:
    """Return where runs of a line begin and end, of those that are long enough."""
    edges = np.flatnonzero(np.diff(np.pad(there, 1).astype(np.int8)))
    return [(int(a), int(b)) for a, b in edges.reshape(-1, 2) if b - a >= least]


def _inset(grey: _Greys, changes: _Changes) -> PaneBox | None:
    """Return a small picture that lies in another one: two or more sides that stay, and the picture's border for the others."""
    h, w = grey.shape[1:]
    if min(changes.shape[1:]) < _LEAST_PX:
        return None
    moving = np.any(changes, axis=0)
    k = moving.shape[1] / w
    upright, level = _lasting(grey), _lasting(grey.swapaxes(1, 2)).T
    best, found = _INSET_SHARE, None
    for left, right in combinations(_lines(upright, h), 2):
        xa, xb = left[0], right[0]
        for top, bottom in {left[1:], right[1:]}:
            box = xa, _edge_near(level, top, xa, xb), xb, _edge_near(level, bottom, xa, xb)
            sides = _sides(upright, level, box)
            if len(sides) < 2 or min(sides) < _LEAST_SIDE_SHARE or np.mean(sides) <= best:
                continue
            y, x = (slice(round(box[i] * k), round(box[i + 2] * k)) for i in (1, 0))
            inside = float(moving[y, x].mean())
            outside = float(moving.sum() - moving[y, x].sum()) / moving.size
            if min(inside, outside) >= _LEAST_MOVING and _stays_inside(changes, box, k):
                best, found = float(np.mean(sides)), box
    return found


def _lasting(grey: _Greys) -> Bool[np.ndarray, "h w"]:
    """Return where a step from left to right is there in most frames, by the column at which it is."""
    steps = (np.abs(grey[:, :, _REACH:] - grey[:, :, :-_REACH]) > _STEP).mean(0) >= _LASTING
    return np.pad(steps, ((0, 0), (2, 1)))


def _lines(steps: Bool[np.ndarray, "h w"], h: int) -> list[tuple[int, int, int]]:
    """Return the upright lines that may bound an inset: column, first and last row; the picture's border among them."""
    w = steps.shape[1]
    closed = cv2.morphologyEx(steps.astype(np.uint8), cv2.MORPH_CLOSE, np.ones((_GAP_PX, 1))) > 0
    found = [(0, 0, h), (w, 0, h)]
    long = [
        (b - a, x, a, b) for x in range(w) for a, b in _runs(closed[:, x], round(_LEAST_SIDE * h))
    ]
    for _, x, a, b in sorted(long, reverse=True):
        if all(abs(x - other) > _REACH or max(a, c) >= min(b, d) for other, c, d in found):
            found.append((x, a, b))
    return sorted(found[: _MOST_LINES + 2])


def _edge_near(level: Bool[np.ndarray, "h w"], row: int, xa: int, xb: int) -> int:
    """Return the row near to one that bounds an inset; it may be the picture's border."""
    h = len(level)
    if xb <= xa or row <= _REACH or row >= h - _REACH:
        return 0 if row <= _REACH else h
    near = range(max(0, row - _NEAR_PX), min(h, row + _NEAR_PX + 1))
    return max(near, key=lambda y: float(level[y, xa:xb].mean()))


def _sides(
    upright: Bool[np.ndarray, "h w"], level: Bool[np.ndarray, "h w"], box: PaneBox
) -> list[float]:
    """Return the shares of an inset's sides that show a step; none where it is too small, too large, or edges lie beside them too.

    Sides at the picture's border are left out.
    """
    h, w = level.shape
    x0, y0, x1, y1 = box
    area = (x1 - x0) * (y1 - y0) / (w * h)
    if (
        min((y1 - y0) / h, (x1 - x0) / w) < _LEAST_SIDE
        or not _INSET_AREA[0] < area < _INSET_AREA[1]
    ):
        return []
    sides = [(upright[y0:y1], x) for x in (x0, x1) if 0 < x < w]
    sides += [(level[:, x0:x1].T, y) for y in (y0, y1) if 0 < y < h]
    for lines, at in sides:
        beside = (lines[:, max(0, i - 1) : i + 2] for i in (at - _BESIDE_PX, at + _BESIDE_PX))
        if max(steps.any(1).mean() for steps in beside if steps.size) > _BESIDE_SHARE:
            return []  # texture
    return [float(lines[:, at - 1 : at + 2].any(1).mean()) for lines, at in sides]


def _stays_inside(changes: _Changes, box: PaneBox, k: float) -> bool:
    """Return whether nothing moves across the sides of an inset."""
    x0, y0, x1, y1 = (round(v * k) for v in box)
    far = _STRIP_PX[1]
    rows, columns = changes[:, y0:y1], changes[:, :, x0:x1].swapaxes(1, 2)
    return all(
        _motion_across(one, at) < _CROSSING
        for one, ats in ((rows, (x0, x1)), (columns, (y0, y1)))
        for at in ats
        if far < at < one.shape[2] - far
    )


def _longest_seam(grey: _Greys, changes: _Changes) -> Seam | None:
    if not any(_peaks(_step_shares(one)) for one in (grey, grey.swapaxes(1, 2))):
        return None
    seams = [
        seam
        for seam in (
            _seam_along(grey, changes, "upright"),
            _seam_along(grey.swapaxes(1, 2), changes.swapaxes(1, 2), "level"),
        )
        if seam is not None
    ]
    return max(seams, key=lambda seam: seam.step_share, default=None)


def _seam_along(
    grey: _Greys, changes: _Changes, direction: Literal["upright", "level"]
) -> Seam | None:
    """Return the longest seam along the second axis."""
    w = grey.shape[2]
    if changes.shape[2] < _LEAST_PX:
        return None
    shares = _step_shares(grey)
    moving = np.any(changes, axis=0)
    for at in _peaks(shares):
        place = (at + _REACH / 2 + 0.5) / w
        cut = round(place * moving.shape[1])
        sides = float(moving[:, :cut].mean()), float(moving[:, cut:].mean())
        if (
            min(sides) >= _LEAST_MOVING
            and _is_straight(grey, at)
            and _texture_across(grey, at) < _CORRELATION
            and _motion_across(changes, cut) < _CROSSING
        ):
            share = float(shares[at])
            return Seam(direction=direction, place=place, step_share=share, moving=sides)
    return None


def _step_shares(grey: _Greys) -> Float32[np.ndarray, "columns"]:
    """Return per column the share of its length with a step, in the frame that shows least: edges of moving objects drop out."""
    steps = np.abs(grey[:, :, _REACH:] - grey[:, :, :-_REACH]) > _STEP
    return steps.mean(1, dtype=np.float32).min(0)


def _peaks(shares: Float32[np.ndarray, "columns"]) -> list[int]:
    """Return the columns that may be seams, those with the longest step first."""
    w = len(shares) + _REACH
    if w < _LEAST_PX:
        return []
    columns = np.arange(len(shares))
    inside = (columns >= _MARGIN * w) & (columns <= (1 - _MARGIN) * w)
    found = list[int]()
    while (rest := np.where(inside, shares, 0.0)).max(initial=0.0) >= _SHARE:
        top = int(rest.argmax())
        near = np.abs(columns - top) <= _REACH
        at = round(float(columns[near & (shares >= shares[top] - 0.01)].mean()))
        beside = (np.abs(columns - at) >= 6) & (np.abs(columns - at) <= 8)
        if shares[beside].max() <= _BESIDE_SHARE:
            found.append(at)
        inside &= ~near
    return found


def _is_straight(grey: _Greys, at: int) -> bool:
    """Return whether no tilted line nearby shows a longer step than the column.

    A scene's line is upright to the pixel only by chance.
    """
    upright = max(_line_share(grey, at + shift, 0) for shift in (-1, 0, 1))
    tilted = max(
        _line_share(grey, at + shift, sign * tilt_px)
        for tilt_px in _TILTS_PX
        for sign in (-1, 1)
        for shift in range(-_REACH, _REACH + 1)
    )
    return upright >= tilted


def _line_share(grey: _Greys, at: int, tilt_px: int) -> float:
    """Return the share of a line's length with a step, in the frame that shows least; the line crosses column `at` halfway."""
    _, h, w = grey.shape
    along = np.arange(h)
    column = at + np.round(tilt_px * (along / (h - 1) - 0.5)).astype(int)
    column = np.clip(column, 0, w - 1 - _REACH)
    steps = np.abs(grey[:, along, column + _REACH] - grey[:, along, column]) > _STEP
    return float(steps.mean(1).min())


def _texture_across(grey: _Greys, at: int) -> float:
    """Return how much edges on a column's left side go on along its right side: the largest correlation over slopes up to 45 degrees."""
    left = np.diff(grey[:, :, at - 2], axis=1)
    right = np.diff(grey[:, :, at + _REACH + 2], axis=1)
    steepest = _REACH + 4
    inner = left[:, steepest:-steepest].ravel()
    shifted = (
        right[:, i : i + inner.shape[0] // len(left)].ravel() for i in range(2 * steepest + 1)
    )
    pairs = [(inner, other) for other in shifted if min(inner.std(), other.std()) > 1e-3]
    return max((float(np.corrcoef(a, b)[0, 1]) for a, b in pairs), default=0.0)


def _motion_across(changes: _Changes, cut: int) -> float:
    """Return the association of what changes just left and just right of a column, over time and height; -1 to 1.

    An arm that reaches across a line of the scene is on both sides at one height. Two pictures move independently.
    The arm may be narrower on one side, and both sides may change a lot.

    Source: Cole 1949, The measurement of interspecific association, Ecology 30 (the coefficient C7).
    """
    near, far = _STRIP_PX
    left = changes[:, :, cut - far : cut - near].mean(-1) > 0.5
    right = changes[:, :, cut + near : cut + far].mean(-1) > 0.5
    chance = float(left.mean() * right.mean())
    possible = float(min(left.mean(), right.mean())) - chance
    return (float((left & right).mean()) - chance) / possible if possible > 0 else 0.0

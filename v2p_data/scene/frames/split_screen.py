"""Split screens: clips that show several pictures at once are rejected, with the command that keeps one of them.

A seam between two pictures has a step along a whole column or row, in every frame. Lines of a scene may have one too. They are told by
three facts: a seam is exactly upright or level, no texture goes on behind it, and nothing moves across it.
"""

from dataclasses import dataclass
from typing import Literal

import cv2
import numpy as np
from jaxtyping import Bool, Float32, UInt8

from v2p_data.errors import ItemRejectedError
from v2p_data.scene.frames.working_clip import WorkingClip
from v2p_data.video.clip import Clip

_Greys = Float32[np.ndarray, "time h w"]
_Changes = Bool[np.ndarray, "moments rows columns"]
"""Whether each pixel of the working frames differs from the first one."""
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


def check_split(clip: Clip, working: WorkingClip) -> None:
    """Reject a clip that shows several pictures at once.

    Raises:
        ItemRejectedError: `split_screen`, with the share of the seam's length that shows a step.
    """
    seam = seam_of(clip.frames, working)
    if seam is None:
        return
    x0, y0, x1, y1 = (round(v) for v in clip.in_file_px)
    upright = seam.direction == "upright"
    low, high = (x0, x1) if upright else (y0, y1)
    cut = round(low + seam.place * (high - low))
    begin, end = (low, cut) if seam.moving[0] >= seam.moving[1] else (cut, high)
    x, y, w, h = (
        (begin, y0, end - begin, y1 - y0) if upright else (x0, begin, x1 - x0, end - begin)
    )
    size_px = clip.source_size_px[0 if upright else 1]
    raise ItemRejectedError(
        "split_screen",
        f"the picture is put together of several: a straight seam runs {'down' if upright else 'across'} it at {cut} of {size_px} px, along "
        f"{seam.step_share:.0%} of its length; keep one of them: ffmpeg -i {clip.path.name} -vf "
        f"crop={w - w % 2}:{h - h % 2}:{x}:{y} one.mp4",
        round(seam.step_share, 3),
    )


def seam_of(frames: UInt8[np.ndarray, "time h w 3"], working: WorkingClip) -> Seam | None:
    """Return the seam with the longest step, None where there is no seam."""
    pick = np.unique(
        np.linspace(0, len(frames) - 1, min(len(frames), _FRAMES)).round().astype(int)
    )
    grey = np.stack([cv2.cvtColor(frames[i], cv2.COLOR_RGB2GRAY) for i in pick]).astype(np.float32)
    if not any(_peaks(_step_shares(one)) for one in (grey, grey.swapaxes(1, 2))):
        return None  # ordinary clips need no changes
    first = working.lab[0]
    changes = np.stack([np.linalg.norm(lab - first, axis=-1) > _CHANGE_LAB for lab in working.lab])
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

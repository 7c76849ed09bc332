"""Which outlines a hand can have taken an object from, or put it down at: by its fingertips in the order of time.

A hand handles objects only between taking one up and letting one go. An outline that the fingertips
never reach, or reach only after most of the handling, is not where the object was taken from. The
same holds backwards in time for its last outline.
"""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool

from v2p_data.scene.frames.classes import MOVED
from v2p_data.scene.frames.hand_track import HandTrack
from v2p_data.scene.frames.segmentation import Segmentation

_LIKELY = 0.5
_LATE, _TOO_LATE = 0.25, 0.5
"""Share of the handling before the first touch, or after the last one: up to the first it says
nothing, from the second on the outline is not the object's. On 32 real clips right outlines have
0.17 at most, and the four wrong ones of other places 0.6 or more."""
_LEAST = 0.3
"""Weight of an outline that is not where the hand takes or puts down."""
_REACH = 0.6
"""In palm lengths: a fingertip so near to an outline is at it. Fingers may be behind an object,
and outlines are off by pixels."""
_FEWEST = 5
"""Hands at moving objects, fewer of which say nothing."""


@dataclass(frozen=True, kw_only=True)
class Handling:
    """The hands that touch something the network sees as moving, in the order of time."""

    hands: HandTrack
    rows: tuple[int, ...]
    """Their numbers in the hand track."""

    def taken_from(self, outline: Bool[np.ndarray, "h w"]) -> float:
        """Return 1 where a hand may have taken the object from this outline, down to 0.3 where it did not."""
        return _weight(self._untouched(outline, self.rows))

    def put_at(self, outline: Bool[np.ndarray, "h w"]) -> float:
        """Return 1 where a hand may have put the object down at this outline, down to 0.3 where it did not."""
        return _weight(self._untouched(outline, self.rows[::-1]))

    def _untouched(self, outline: Bool[np.ndarray, "h w"], rows: tuple[int, ...]) -> float:
        touched = (n for n, k in enumerate(rows) if self.hands.touches(k, outline, _REACH))
        return next(touched, len(rows)) / len(rows)


def handling_in(hands: HandTrack | None, segmentation: Segmentation) -> Handling | None:
    """Return what the hands of a clip handle; None where no model found them in enough frames."""
    if hands is None or not hands.is_known:
        return None
    moving = {int(i): segmentation.at(int(i))[MOVED] > _LIKELY for i in np.unique(hands.at)}
    rows = tuple(
        k
        for k, i in enumerate(hands.at.tolist())
        if moving[i].any() and hands.touches(k, moving[i])
    )
    return Handling(hands=hands, rows=rows) if len(rows) >= _FEWEST else None


def _weight(untouched: float) -> float:
    return float(np.interp(untouched, [_LATE, _TOO_LATE], [1.0, _LEAST]))

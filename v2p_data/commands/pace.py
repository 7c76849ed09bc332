"""How long an item of a stage still takes: a range that what happened so far supports, or nothing.

Items of one stage take alike long, so finished ones say most. Without any, an item's own progress counts: its mean
rate and its rate of the last seconds, which differ where something was read or waited for first.
"""

import math
from collections import defaultdict

_EARLIEST = 0.25
"""Share that is done before an item's own rate says anything."""
_RECENT_S = 10.0
_SPREAD = 1.5
"""An item may take this much more or less than the rates say."""
_LAST_S = 5.0
"""What comes after the last share: judging, writing."""
_NEARLY = 0.9
"""From here on the last piece may be cheaper than the others."""
_WIDEST = 8.0
"""A range from once to this many times is still worth saying."""
_ENDS_EARLY = frozenset({"expert", "reward"})
"""Stages that stop when their policy no longer improves."""


class Pace:
    """What is known of the time that items take."""

    def __init__(self) -> None:
        self.finished: dict[str, list[float]] = defaultdict(list)
        """Seconds of each finished item, by stage."""
        self.seen: dict[str, list[tuple[float, float]]] = {}
        """Seconds since it began and share that was done, by item at work."""

    def left_s(
        self, stage: str, item: str, passed_s: float, share: float
    ) -> tuple[float, float] | None:
        """Return the least and the most seconds that an item still takes; None where nobody can say."""
        seen = self.seen.setdefault(item, [(0.0, 0.0)])
        seen.append((passed_s, share))
        done = self.finished[stage]
        if done and (most := _SPREAD * max(done) - passed_s) > 0:
            return max(0.0, min(done) / _SPREAD - passed_s), most
        if share < _EARLIEST:
            return None
        earlier = [(t, s) for t, s in seen if passed_s - t >= _RECENT_S][-1:] or seen[:1]
        rates = [(share - s) / max(passed_s - t, 1e-3) for t, s in (seen[0], *earlier)]
        if min(rates) <= 0 or max(rates) * _SPREAD**2 > _WIDEST * min(rates):
            return None
        least = (
            0.0 if stage in _ENDS_EARLY or share > _NEARLY else (1 - share) / max(rates) / _SPREAD
        )
        return least, (1 - share) / min(rates) * _SPREAD + _LAST_S


def said(left_s: tuple[float, float] | None) -> str:
    """Return a range in words, with the comma before it; empty for None."""
    if left_s is None:
        return ""
    unit, step, name = (60, 1, "min") if left_s[1] > 120 else (1, 5, "s")
    least, most = (
        step * rounded(s / unit / step)
        for rounded, s in zip((math.floor, math.ceil), left_s, strict=True)
    )
    return f", {least} to {most} {name} left" if least else f", up to {most} {name} left"

"""Videos that were stretched: frames that only repeat the one before are dropped where they come in an even pattern."""

from dataclasses import replace
from itertools import pairwise

import cv2
import numpy as np
from jaxtyping import Float, UInt8

from v2p_data.video.clip import Clip, Hint

_WIDTH_PX = 160
"""Frames are compared at this width."""
_LOCAL = 0.005
"""Share of the picture that changes most between two frames: its least change counts, so that a small moving object does."""
_MOVES = 4.0
"""Of 255: noise stays below."""
_CLEARLY = 0.25
"""Of a fast change in this clip (95th percentile): what changes so much shows motion."""
_NOTHING = (0.8, 0.1)
"""Of 255, and of a fast change in this clip: what changes less repeats the frame before."""
_MOST_TIMES = 8
_LEAST_MOVES, _LEAST_DUE = 6, 0.5
"""Changes that show motion; and their share of the moments at which the pattern has one, from the first to the last."""
_FEWEST_FRAMES = 8
_UNEVEN, _FEWEST_UNEVEN = 0.3, 3
"""Repeats within a motion, as a share of the changes that show it, and their number, from which it is told."""


def without_repeats(clip: Clip) -> Clip:
    """Return the clip with one of each `k` equal frames, where every frame is there `k` times; as it is where none repeats.

    Frame rate and hints go along, and durations stay. Frames that repeat in no even pattern stay as well, with a warning: without them
    the others would not be evenly spaced in time.
    """
    changes = changes_of(clip.frames)
    times = times_shown(changes)
    if times > 1 and len(clip.frames) >= _FEWEST_FRAMES * times:
        note = (
            f"every frame is there {times} times: one of each was kept; if the video was slowed down in this way, "
            f"motions are {times} times as fast as they seem"
        )
        kept = np.arange(0, len(clip.frames), times)
        return replace(
            clip,
            frames=np.ascontiguousarray(clip.frames[kept]),
            fps=clip.fps / times,
            source_frame=clip.source_frame[kept],
            times_s=clip.times_s[kept],
            hints={phrase: _hint(hint, times, len(kept)) for phrase, hint in clip.hints.items()},
            warnings=(*clip.warnings, note),
        )
    repeats, moves = uneven_repeats(changes)
    if repeats < max(_FEWEST_UNEVEN, _UNEVEN * moves):
        return clip
    note = (
        f"the video halts: during motion {repeats} frames repeat the one before, and {moves} do not; it was stretched or lost frames, so "
        "speeds and durations may be wrong"
    )
    return replace(clip, warnings=(*clip.warnings, note))


def changes_of(frames: UInt8[np.ndarray, "time h w 3"]) -> Float[np.ndarray, "gap"]:
    """Return how much each frame differs from the one before where it differs most, 0 to 255."""
    h, w = frames.shape[1:3]
    size = (_WIDTH_PX, max(8, round(h * _WIDTH_PX / w)))
    small = (
        cv2.resize(f, size, interpolation=cv2.INTER_AREA).astype(np.float32).mean(-1)
        for f in frames
    )
    return np.array([np.quantile(np.abs(b - a), 1 - _LOCAL) for a, b in pairwise(small)], float)


def times_shown(changes: Float[np.ndarray, "gap"]) -> int:
    """Return how many times every frame is there, in turn: 1 where frames do not repeat in an even pattern."""
    moves = np.flatnonzero(_shows_motion(changes)) + 1
    if len(moves) < _LEAST_MOVES:
        return 1
    for times in range(_MOST_TIMES, 1, -1):
        phase = moves[0] % times
        due = (moves[-1] - moves[0]) // times + 1
        if (moves % times == phase).all() and len(moves) > _LEAST_DUE * due:
            return times
    return 1


def uneven_repeats(changes: Float[np.ndarray, "gap"]) -> tuple[int, int]:
    """Return how many frames repeat the one before between two that show motion, and how many show motion."""
    moves = _shows_motion(changes)
    if not moves.any():
        return 0, 0
    least = max(_NOTHING[0], _NOTHING[1] * float(np.percentile(changes, 95)))
    alone = (changes[1:-1] < least) & moves[:-2] & moves[2:]
    return int(alone.sum()), int(moves.sum())


def _shows_motion(changes: Float[np.ndarray, "gap"]) -> np.ndarray:
    return changes > max(_MOVES, _CLEARLY * float(np.percentile(changes, 95)))


def _hint(hint: Hint, times: int, num_frames: int) -> Hint:
    out = hint.copy()
    if "frame" in hint:
        out["frame"] = min(hint["frame"] // times, num_frames - 1)
    return out

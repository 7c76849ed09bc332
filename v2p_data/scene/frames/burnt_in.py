"""Captions, titles and stickers that appear, change or vanish: where they are, and in which frames.

A hand moves objects, and a hand comes from the picture's edge. So what changes in place, at once, beside nothing that moves, and has
far more edges on one side of the change, was put over the clip by an editor (`changes_in_place`). Of a graphic beside a moving hand, the
number of pixels that jump at one moment tells (`sudden_changes`). Graphics that never change stand still, as the table does.
"""

from collections.abc import Iterator
from dataclasses import dataclass, replace
from itertools import pairwise
from typing import Literal

import cv2
import numpy as np
from jaxtyping import Bool, Float32, UInt8
from scipy.ndimage import find_objects, label

from v2p_data.scene.frames.mask_ops import bounding_box, grow

_Frames = UInt8[np.ndarray, "time h w 3"]
_Mask = Bool[np.ndarray, "h w"]

_FRAMES = (20, 300)
"""Shorter clips show no change in place, and changes of longer ones (`--video.max-frames`) take too much memory."""
_LEAST_FPS = 8.0
"""With fewer frames a second, what a hand moves jumps as well."""
_LAG_S = 0.1
"""Changes are looked at over this time, so that slow fades are seen."""
_ACTIVE, _CHANGED = 14, 20
"""Of 255, in one channel: a pixel changes within the lag, and from before an event to after it."""
_AT_ONCE_S, _FADE_S = 0.35, 0.9
"""Longest time in which a graphic changes, and in which letters fade."""
_LASTING = 0.9
"""Share of the changing pixels that stay changed: behind a passing hand most return."""
_FILLED = (0.75, 1.35)
"""Pixels that were seen changing, of those that stay changed."""
_LEAST_EDGES, _MORE_EDGES, _MORE_IN_FADE, _MANY_EDGES = 40.0, 2.5, 5.0, 230.0
"""Mean Sobel gradient within a graphic; its least ratio to that without the graphic, at once and in a fade; and what both sides have where one
text gives way to another. Of 32 real clips only one, whose camera moves, has a change in place with a ratio above 2.5: 3.0, over 0.6 s."""
_LEAST_PART_PX, _LEAST_PX = 16, 90
"""Of a picture 320 px wide: one letter, and everything that changes at one moment."""

_USUAL = 0.04
"""Share of a graphic's pixels that has a colour, from which that is one of its colours."""
_STEP, _STILL = 30, 16
"""Of 255: a pixel jumps by the first between two frames, and by less than the second in the frames beside them."""
_BESIDE = 3
"""Frames on each side of a jump."""
_SUDDEN_PX, _SUDDEN_RATIO = 300, 8.0
"""Pixels that jump at one moment, and their ratio to those in the frames beside it. A fast hand reaches 9 in 32 real clips, without more edges on one side."""
_NEAR_PX, _CLUSTER = 6, 0.2
"""Of a picture 320 px wide: pixels of one graphic lie so near to each other; the share of all in a cluster that counts."""
_SMOOTH = 0.1
"""Pixels that change in the frames beside a jump, of those that jump: in a film that halts, everything jumps."""

Side = Literal["appears", "vanishes", "changes"]


@dataclass(frozen=True, kw_only=True)
class Graphic:
    """What was put over a clip."""

    mask: Bool[np.ndarray, "h w"]
    """Pixels that change with it."""
    shown: Bool[np.ndarray, "time"]
    """Frames that show it, or that are not known to be without it."""


@dataclass(frozen=True, kw_only=True)
class _Event:
    """A graphic that appears, vanishes, or gives way to another."""

    start: int
    """First frame that may be in between."""
    stop: int
    """First frame after it."""
    mask: Bool[np.ndarray, "h w"]
    side: Side


def graphics_of(frames: UInt8[np.ndarray, "time h w 3"], fps: float) -> list[Graphic]:
    """Return what was put over a clip and appears, changes or vanishes in it.

    Args:
        frames: about 320 px wide; sizes in pixels are tuned there.
        fps: frames per second.
    """
    if not _FRAMES[0] <= len(frames) <= _FRAMES[1] or fps < _LEAST_FPS:
        return []
    in_place = [_whole(frames, events) for events in _by_moment(changes_in_place(frames, fps))]
    sudden = [
        event
        for event in sudden_changes(frames)
        if not any(other.start <= event.stop and event.start <= other.stop for other in in_place)
    ]
    return [_graphic(events, len(frames)) for events in _by_place([*in_place, *sudden])]


# --- changes in place ----------------------------------------------------------------------------------------


def changes_in_place(frames: UInt8[np.ndarray, "time h w 3"], fps: float) -> list[_Event]:
    """Return the changes that are brief, last, touch nothing else that changes, and bring or take edges."""
    h, w = frames.shape[1:3]
    lag = max(1, round(_LAG_S * fps))
    parts = np.empty(frames.shape[:3], np.int32)
    label(_active(frames, lag), np.ones((3, 3, 3)), output=parts)
    found = list[_Event]()
    for k, where in enumerate(find_objects(parts), 1):
        time, rows, columns = where
        longest = _FADE_S * fps + 2 * lag
        inside = (
            rows.start > 1 and columns.start > 1 and rows.stop < h - 1 and columns.stop < w - 1
        )
        if not inside or time.stop - time.start > longest:
            continue
        active = np.zeros((h, w), bool)
        active[rows, columns] = (parts[where] == k).any(0)
        if active.sum() < _LEAST_PART_PX:
            continue
        at_once = time.stop - time.start <= _AT_ONCE_S * fps + 2 * lag
        event = _event(frames, (time.start, time.stop), active, lag, at_once=at_once)
        found += [] if event is None else [event]
    return found


def _active(frames: _Frames, lag: int) -> Bool[np.ndarray, "time h w"]:
    active = np.zeros(frames.shape[:3], bool)
    for t in range(lag, len(frames)):
        active[t - lag + 1 : t + 1] |= cv2.absdiff(frames[t], frames[t - lag]).max(-1) > _ACTIVE
    return active


def _event(
    frames: _Frames, time: tuple[int, int], active: _Mask, lag: int, *, at_once: bool
) -> _Event | None:
    """Return the event of the pixels that are active in a time; None where they may be anything else."""
    n = len(frames)
    x, y, w, h = bounding_box(active)
    spot = (slice(max(0, y - 2), y + h + 2), slice(max(0, x - 2), x + w + 2))
    start, stop = time
    before = _still(frames[max(0, start - lag - 1) : max(1, start)][:, *spot])
    after = _still(frames[min(n - 1, stop) : stop + lag + 1][:, *spot])
    there = active[spot]
    lasting = (cv2.absdiff(before, after).max(-1) > _CHANGED) & grow(there, 1)
    if (lasting & there).sum() < _LASTING * there.sum():
        return None
    if not _FILLED[0] < there.sum() / lasting.sum() < _FILLED[1]:
        return None
    side = _side(before, after, lasting, _MORE_EDGES if at_once else _MORE_IN_FADE)
    if side is None or (side == "changes" and not at_once):
        return None
    mask = np.zeros_like(active)
    mask[spot] = lasting
    return _Event(start=start, stop=stop, mask=mask, side=side)


def _still(frames: _Frames) -> UInt8[np.ndarray, "h w 3"]:
    return np.median(frames, axis=0).astype(np.uint8)


def _side(
    before: UInt8[np.ndarray, "h w 3"],
    after: UInt8[np.ndarray, "h w 3"],
    mask: _Mask,
    ratio: float = _MORE_EDGES,
) -> Side | None:
    """Return whether a graphic appears, vanishes or changes in the mask; None where no graphic is seen."""
    was, now = (float(_gradient(image)[mask].mean()) for image in (before, after))
    if max(was, now) < _LEAST_EDGES:
        return None
    if now > ratio * was:
        return "appears"
    if was > ratio * now:
        return "vanishes"
    return "changes" if min(was, now) > _MANY_EDGES else None


def _gradient(image: UInt8[np.ndarray, "h w 3"]) -> Float32[np.ndarray, "h w"]:
    grey = cv2.cvtColor(image, cv2.COLOR_RGB2GRAY)
    return np.hypot(cv2.Sobel(grey, cv2.CV_32F, 1, 0), cv2.Sobel(grey, cv2.CV_32F, 0, 1))


def _by_moment(events: list[_Event]) -> Iterator[list[_Event]]:
    """Yield the events that belong together in time and are large enough together."""
    rest = sorted(events, key=lambda event: event.start)
    while rest:
        first = rest[0]
        group = [e for e in rest if abs(e.start - first.start) <= _BESIDE and e.side == first.side]
        rest = [e for e in rest if not any(e is other for other in group)]
        if sum(int(e.mask.sum()) for e in group) >= _LEAST_PX:
            yield group


def _whole(frames: _Frames, events: list[_Event]) -> _Event:
    """Return events of one moment as one, with what jumps beside them then: letters next to a hand."""
    mask = np.any([event.mask for event in events], axis=0)
    start, stop = min(e.start for e in events), max(e.stop for e in events)
    jumps = [
        float(cv2.absdiff(frames[t], frames[t - 1]).max(-1)[mask].mean())
        for t in range(max(1, start), min(stop + 1, len(frames)))
    ]
    at = max(1, start) + int(np.argmax(jumps))
    if max(jumps) > 2 * _STEP:
        _, y, _, high = bounding_box(mask)
        line = np.zeros_like(mask)
        line[max(0, y - high // 3) : y + high + high // 3] = True
        image = frames[at - 1 if events[0].side == "vanishes" else at]
        alike = _has_colours_of(image, mask)
        mask = mask | (line & alike & _jumping(frames, at, events[0].side))
    return replace(events[0], start=start, stop=stop, mask=mask)


def _has_colours_of(image: UInt8[np.ndarray, "h w 3"], mask: _Mask) -> _Mask:
    """Return the pixels whose colours are usual within the mask."""
    cells = (image // 32).astype(int) @ np.array([64, 8, 1])
    usual = np.bincount(cells[mask], minlength=512) > _USUAL * mask.sum()
    return usual[cells]


# --- sudden changes ------------------------------------------------------------------------------------------


def sudden_changes(frames: UInt8[np.ndarray, "time h w 3"]) -> list[_Event]:
    """Return the moments at which far more pixels jump, from one still colour to another, than in the frames beside them."""
    n = len(frames)
    change = [np.zeros(frames.shape[1:3], np.uint8)]
    change += [cv2.absdiff(b, a).max(-1) for a, b in pairwise(frames)]
    still = [moved < _STILL for moved in change]
    count, moving = np.zeros(n), np.array([(moved > _STEP).sum() for moved in change])
    for t in range(_BESIDE + 1, n - _BESIDE):
        if moving[t] >= _SUDDEN_PX:
            beside = [*range(t - _BESIDE, t), *range(t + 1, t + _BESIDE + 1)]
            count[t] = ((change[t] > _STEP) & np.all([still[i] for i in beside], axis=0)).sum()
    found = list[_Event]()
    for t in np.flatnonzero(count >= _SUDDEN_PX).tolist():
        beside = [i for i in range(t - _BESIDE, t + _BESIDE + 1) if i != t]
        smooth = min(moving[t - 1], moving[t + 1]) > _SMOOTH * (moving[t] - count[t])
        if count[t] < _SUDDEN_RATIO * max(1.0, count[beside].max()) or not smooth:
            continue
        pure = (change[t] > _STEP) & np.all([still[i] for i in beside], axis=0)
        side = _side(frames[t - 1], frames[t], pure)
        if side is not None:
            mask = grow(_dense(pure), _NEAR_PX) & _jumping(frames, t, side)
            found.append(_Event(start=t, stop=t, mask=mask, side=side))
    return found


def _dense(mask: _Mask) -> _Mask:
    """Return the mask without clusters that hold little of it: the edge of a hand that moves meanwhile."""
    count, clusters = cv2.connectedComponents(grow(mask, _NEAR_PX).astype(np.uint8))
    sizes = np.bincount(clusters[mask], minlength=count)
    return mask & np.isin(clusters, np.flatnonzero(sizes > _CLUSTER * mask.sum()))


def _jumping(frames: _Frames, t: int, side: Side) -> _Mask:
    """Return the pixels that jump at frame `t` and stand still in the frames that show the graphic."""
    n = len(frames)
    jump = cv2.absdiff(frames[t], frames[t - 1]).max(-1) > _STEP
    after = [cv2.absdiff(frames[i], frames[t]) for i in range(t + 1, min(n, t + _BESIDE + 1))]
    before = [cv2.absdiff(frames[i], frames[t - 1]) for i in range(max(0, t - 1 - _BESIDE), t - 1)]
    rests = [
        np.max([x.max(-1) for x in some], axis=0) < _STILL if some else np.zeros_like(jump)
        for some in (before, after)
    ]
    stands = {"vanishes": rests[0], "appears": rests[1], "changes": rests[0] | rests[1]}[side]
    return jump & stands


# --- over time -----------------------------------------------------------------------------------------------


def _by_place(events: list[_Event]) -> list[list[_Event]]:
    """Return the events of each place: those whose pixels overlap."""
    places = list[list[_Event]]()
    for event in events:
        same = [p for p in places if any((event.mask & other.mask).any() for other in p)]
        places = [p for p in places if not any(p is other for other in same)]
        places.append([event, *(other for p in same for other in p)])
    return places


def _graphic(events: list[_Event], n: int) -> Graphic:
    """Return what the events of one place say of all frames."""
    shown = np.zeros(n, bool)
    order = sorted(events, key=lambda event: event.start)
    for k, event in enumerate(order):
        begin = order[k - 1].stop if k else 0
        end = order[k + 1].start if k + 1 < len(order) else n
        shown[event.start : event.stop] = True
        if event.side != "appears":
            shown[begin : event.stop] = True
        if event.side != "vanishes":
            shown[event.start : end] = True
    return Graphic(mask=np.any([event.mask for event in events], axis=0), shown=shown)

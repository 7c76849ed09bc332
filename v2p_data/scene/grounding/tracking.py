"""The object's mask in the frames between the first and the last.

Optical flow carries the mask on; colour decides what of it is object. The decisive rule: a pixel outside the first mask
that still looks as in the first frame is not the object. A track that got lost says so by a low quality.
"""

from collections.abc import Callable
from dataclasses import dataclass

import cv2
import numpy as np
from jaxtyping import Bool, Float, Float32

from v2p_data.scene.frames.colour import histogram, lab_of, likelihood, similarity
from v2p_data.scene.frames.mask_ops import bounding_box, convex_hull, grow, iou, largest, tidy
from v2p_data.scene.frames.working_clip import WorkingClip
from v2p_data.scene.grounding.moved_by_change import Moved

_SAME_LAB = 6.0
_LOST = 0.4
"""Likeness below which what is followed from one frame alone is taken to be gone."""
_RESTS = 0.4
"""Of the first outline: while so much of it looks as before, and the table under it does not, the object has not left."""
_SHRUNK = 1.25
"""Of what was followed: what lies there still is taken as it was where that is larger, as less is an outline's own correction."""
_SURELY_BARE = 0.8
"""How surely the network sees bare table where a mask is: then the mask is none of an object that it knows."""
_MOVES, _UNSEEN = 0.5, 0.05
"""How surely the network sees something move where the object is at both ends, for it to be believed where it sees nothing."""
_NEAR = 0.3
"""Of an object's extent: what moves so near to a mask may be it, a frame before or after."""
_HAND_RATIO = 3.0
"""Logarithm of how much better the hand's colours explain a pixel of the last outline: more, and it is hand."""
_BARE, _UNLIKE = 0.4, 0.2
"""Of a mask: where so much of it shows what stands there for good, it is not the object; and of the object, how much at most may look
like the table under it for that to tell anything."""
_MOSTLY, _LITTLE = 0.4, 0.05
"""Of an outline: what must be left of it without the hand, and what is not worth cutting off."""


@dataclass(frozen=True, kw_only=True)
class Track:
    """Masks at working size, one per working frame, and how far to believe each (0 to 1)."""

    masks: Bool[np.ndarray, "time h w"]
    quality: Float[np.ndarray, "time"]
    agreement: float
    """Overlap of the mask carried forwards with the one found at the end, or backwards at the start; 0 to 1."""


Moving = Callable[[int], Float[np.ndarray, "h w"]]


@dataclass(frozen=True, kw_only=True)
class _MotionCheck:
    """The network, where it sees the object move at both ends."""

    moving: Moving
    ends: tuple[Bool[np.ndarray, "h w"], Bool[np.ndarray, "h w"]]

    def agrees(self, i: int, mask: Bool[np.ndarray, "h w"]) -> float:
        """Return how well a mask overlaps what it sees move."""
        return iou(mask, self.moving(i) > 0.5)

    def misses(self, i: int, mask: Bool[np.ndarray, "h w"]) -> bool:
        """Return whether it sees nothing move there, and the object does not lie there at either end."""
        area = float(mask.sum())
        lies = max(float((mask & place).sum()) for place in self.ends)
        around = grow(mask, round(_NEAR * np.sqrt(area)))  # not every frame was looked at
        return lies < 0.5 * area and float(self.moving(i)[around].sum()) < _UNSEEN * area


def _motion_check(
    moving: Moving | None,
    first: Bool[np.ndarray, "h w"],
    last: Bool[np.ndarray, "h w"],
    last_i: int,
) -> _MotionCheck | None:
    """Return the network as a witness; None where it was not asked, or does not see the object at one end."""
    if moving is None:
        return None
    seen = [float(moving(i)[m].mean()) for i, m in ((0, first), (last_i, last)) if m.any()]
    return (
        _MotionCheck(moving=moving, ends=(first, last))
        if min(seen, default=1.0) > _MOVES
        else None
    )


def track(
    working: WorkingClip,
    moved: Moved,
    *,
    every: int = 1,
    moving: Moving | None = None,
    bare: Moving | None = None,
) -> Track:
    """Return the object's mask over time: forwards from the first and backwards from the last outline.

    At each frame the direction is taken whose mask looks more like the object, and agrees better with `moving`. `every` skips frames for speed; the
    skipped ones repeat their neighbour with no quality. `moving` says how likely each pixel of a frame belongs to
    something that moves and is no hand, `bare` how likely it is bare table, if anyone knows.
    """
    n = len(working.rgb)
    steps = sorted({*range(0, n, every), n - 1})
    early, late = (_smooth(lab_of(still)) for still in (working.early, working.late))
    differs_from_table = _alike_share(working.lab[0], late, moved.first) < _UNLIKE
    forward = _follow(
        working, steps, moved.first, moved.colour_hist, 0, moving, may_rest=differs_from_table
    )
    area_first = float(moved.first.sum())
    found, carried = (
        _likeness(working, n - 1, mask, moved.colour_hist, area_first)
        for mask in (moved.last, forward[-1])
    )
    # The hand often breaks the object into pieces at the end; the mask carried there may be the better one.
    end = (
        forward[-1]
        if carried > found + 0.05 and iou(forward[-1], moved.last) > 0.05
        else moved.last
    )
    end = _less_hand(working, n - 1, end, moved.colour_hist)
    may_rest = _alike_share(working.lab[-1], early, end) < _UNLIKE
    backward = _follow(
        working, steps[::-1], end, moved.colour_hist, n - 1, moving, may_rest=may_rest
    )
    backward.reverse()
    area_last = float(end.sum())
    motion_check = _motion_check(moving, moved.first, end, n - 1)
    masks = np.zeros((n, *working.shape), bool)
    quality = np.zeros(n)
    for k, i in enumerate(steps):
        share = i / max(1, n - 1)
        area = float(area_first ** (1 - share) * area_last**share)
        both = (forward[k], backward[k])
        marks, votes = [], []
        for mask, away in zip(both, (share, 1 - share), strict=True):
            mark = _likeness(working, i, mask, moved.colour_hist, area) - 0.15 * away
            agreement = 0.0
            if motion_check is not None:
                mark -= motion_check.misses(i, mask)
                agreement = motion_check.agrees(i, mask)
            marks.append(mark)
            votes.append(mark + agreement)
        best = int(votes[1] > votes[0])
        masks[i], quality[i] = both[best], max(0.0, marks[best])
    masks[0], masks[-1] = moved.first, end
    # An outline at the end that does not look like the object is not it: it is hidden there.
    alike = _likeness(working, n - 1, end, moved.colour_hist, area_first)
    quality[0], quality[-1] = 1.0, 1.0 if alike > _LOST else alike
    # Nor is what stands there at both ends, where the object looks otherwise than the table under it.
    if differs_from_table:
        for i in steps[1:]:
            still, place = (early, moved.first) if i >= n / 2 else (late, end)
            if _alike_share(working.lab[i], still, masks[i], grow(place, 2)) > _BARE:
                quality[i] = 0.0
    # Nor is bare table, where the network knows the object at first and it is hidden at the end, as in a fist.
    known = moving is not None and moving(0)[moved.first].sum() > _MOVES * moved.first.sum()
    if bare is not None and known and motion_check is None:
        for i in steps[1:]:
            if masks[i].any() and float(bare(i)[masks[i]].mean()) > _SURELY_BARE:
                quality[i] = 0.0
    for i in range(1, n):
        if not masks[i].any():
            masks[i] = masks[i - 1]
    agreement = max(iou(forward[-1], moved.last), iou(backward[0], moved.first))
    return Track(masks=masks, quality=quality, agreement=agreement)


def carried(
    working: WorkingClip,
    mask: Bool[np.ndarray, "h w"],
    at: int,
    *,
    every: int = 1,
    moving: Moving | None = None,
) -> Track:
    """Return the mask over time of what is known in one frame only: carried forwards and backwards from there.

    Where the mask looks little like the object any more, it is taken to be out of the picture: the mask is empty.
    """
    n = len(working.rgb)
    colour_hist, area = histogram(working.rgb[at][mask]), float(mask.sum())
    masks, quality = np.zeros((n, *working.shape), bool), np.zeros(n)
    for steps in ([*range(at, n, every)], [*range(at, -1, -every)]):
        for i, found in zip(
            steps, _follow(working, steps, mask, colour_hist, at, moving), strict=True
        ):
            likeness = _likeness(working, i, found, colour_hist, area)
            if likeness < _LOST:
                break
            masks[i], quality[i] = found, likeness
    masks[at], quality[at] = mask, 1.0
    return Track(masks=masks, quality=quality, agreement=1.0)


def _follow(
    working: WorkingClip,
    steps: list[int],
    start: Bool[np.ndarray, "h w"],
    colour_hist: Float[np.ndarray, "l a b"],
    anchor: int,
    moving: Moving | None,
    *,
    may_rest: bool = False,
) -> list[Bool[np.ndarray, "h w"]]:
    """Return the mask in these frames, the first of them the `anchor`.

    With `may_rest`, what of the start looks as it did belongs to the mask while most of it does: the object lies there still.
    """
    h, w = working.shape
    flow_of = cv2.DISOpticalFlow.create(cv2.DISOPTICAL_FLOW_PRESET_FAST)
    grid_y, grid_x = np.mgrid[:h, :w].astype(np.float32)
    before = _smooth(working.lab[anchor])
    home, area = grow(start, 2), int(start.sum())
    x, y, bw, bh = bounding_box(grow(start, 4))
    there = slice(y, y + bh), slice(x, x + bw)
    mask, out = start, [start]
    grey = cv2.cvtColor(working.rgb[anchor], cv2.COLOR_RGB2GRAY)
    for i in steps[1:]:
        image = working.rgb[i]
        now = cv2.cvtColor(image, cv2.COLOR_RGB2GRAY)
        x, y, bw, bh = bounding_box(mask)
        reach = int(max(24, 0.8 * max(bw, bh)))
        rows = slice(max(0, y - reach), min(h, y + bh + reach))
        cols = slice(max(0, x - reach), min(w, x + bw + reach))
        crop_now, crop_old = (
            np.ascontiguousarray(now[rows, cols]),
            np.ascontiguousarray(grey[rows, cols]),
        )
        back = flow_of.calc(crop_now, crop_old, None)  # type: ignore[call-overload]
        ch, cw = crop_now.shape
        carried = cv2.remap(
            mask[rows, cols].astype(np.float32),
            grid_x[:ch, :cw] + back[..., 0],
            grid_y[:ch, :cw] + back[..., 1],
            cv2.INTER_LINEAR,
        )
        prior = cv2.GaussianBlur(carried, (0, 0), 2)
        part = image[rows, cols]
        around = part[prior < 0.05]
        local = histogram(around) if len(around) > 100 else working.rest_hist
        others = np.maximum(likelihood(local, part), likelihood(working.hand_hist, part))
        others = np.maximum(others, 0.7 * likelihood(working.rest_hist, part))
        ratio = np.log(likelihood(colour_hist, part) + 1e-6) - np.log(others + 1e-6)
        votes = ratio + 3 * (prior - 0.35)
        if moving is not None:
            votes = 0.35 * ratio + 2 * (prior - 0.35) + 5 * (moving(i)[rows, cols] - 0.5)
        vote = cv2.GaussianBlur(votes.astype(np.float32), (0, 0), 1)
        smooth = _smooth(working.lab[i][rows, cols])
        still = np.linalg.norm(smooth - before[rows, cols], axis=-1) < _SAME_LAB
        floor = 0.03 if mask.sum() < 1.3 * area else 0.3
        allowed = (prior > floor) & ~(still & ~home[rows, cols])
        found = tidy((vote > 0) & allowed, 2 * int(0.1 * np.sqrt(area)) + 1)
        # The shapes we fit are convex: a gap within the hull that the flow carried along is print, not background.
        found |= convex_hull(found) & (prior > 0.5) & allowed
        count, parts, stats, _ = cv2.connectedComponentsWithStats(found.astype(np.uint8))
        mask = np.zeros((h, w), bool)
        if count > 1:
            big = stats[1:, 4] > 0.15 * stats[1:, 4].max()
            mask[rows, cols] = np.isin(parts, 1 + np.flatnonzero(big))
        else:
            mask[rows, cols] = prior > 0.5
        if may_rest and _SHRUNK * mask.sum() < area:
            rests = np.zeros((h, w), bool)
            off = np.linalg.norm(_smooth(working.lab[i][there]) - before[there], axis=-1)
            rests[there] = start[there] & (off < _SAME_LAB)
            if rests.sum() > max(_RESTS * area, _SHRUNK * mask.sum()):
                mask = mask | rests
        if mask.sum() < 0.45 * area:
            mask = _find_again(working, i, colour_hist, before, home, area, mask)
        if mask.sum() < 15:
            mask = out[-1]
        out.append(mask)
        grey = now
    return out


def _find_again(
    working: WorkingClip,
    i: int,
    colour_hist: Float[np.ndarray, "l a b"],
    before: np.ndarray,
    home: Bool[np.ndarray, "h w"],
    area: int,
    mask: Bool[np.ndarray, "h w"],
) -> Bool[np.ndarray, "h w"]:
    """Return the changed region that looks most like the object, or the given mask where none is better."""
    image = working.rgb[i]
    others = np.maximum(
        likelihood(working.hand_hist, image), 0.7 * likelihood(working.rest_hist, image)
    )
    ratio = np.log(likelihood(colour_hist, image) + 1e-6) - np.log(others + 1e-6)
    changed = np.linalg.norm(_smooth(working.lab[i]) - before, axis=-1) > 7
    pixels = (cv2.GaussianBlur(ratio.astype(np.float32), (0, 0), 1.5) > 0.3) & (changed | home)
    count, parts = cv2.connectedComponents(tidy(pixels, 7).astype(np.uint8))
    best, value = mask, _likeness(working, i, mask, colour_hist, float(area)) + 0.05
    for c in range(1, min(count, 40)):
        part = parts == c
        likeness = _likeness(working, i, part, colour_hist, float(area))
        if likeness > value:
            best, value = part, likeness
    return best


def _less_hand(
    working: WorkingClip,
    i: int,
    mask: Bool[np.ndarray, "h w"],
    colour_hist: Float[np.ndarray, "l a b"],
) -> Bool[np.ndarray, "h w"]:
    """Return the mask without what has the colours of the hand rather than the object's, unless that is most of it."""
    image = working.rgb[i]
    ratio = np.log(likelihood(working.hand_hist, image) + 1e-6) - np.log(
        likelihood(colour_hist, image) + 1e-6
    )
    hand = mask & (cv2.GaussianBlur(ratio.astype(np.float32), (0, 0), 2) > _HAND_RATIO)
    rest, area = tidy(mask & ~hand), float(mask.sum())
    if hand.sum() < _LITTLE * area or rest.sum() < _MOSTLY * area:
        return mask
    return largest(rest)


def _smooth(lab: Float32[np.ndarray, "h w 3"]) -> Float32[np.ndarray, "h w 3"]:
    """Return a picture without the noise of single pixels."""
    return np.asarray(cv2.GaussianBlur(lab, (0, 0), 1))


def _alike_share(
    lab: Float32[np.ndarray, "h w 3"],
    still: Float32[np.ndarray, "h w 3"],
    mask: Bool[np.ndarray, "h w"],
    but_for: Bool[np.ndarray, "h w"] | None = None,
) -> float:
    """Return how much of a mask looks in a frame as in a smoothed still; `but_for` are pixels that do not count as alike."""
    alike = np.linalg.norm(_smooth(lab) - still, axis=-1) < _SAME_LAB
    if but_for is not None:
        alike &= ~but_for
    return float(alike[mask].mean()) if mask.any() else 0.0


def _likeness(
    working: WorkingClip,
    i: int,
    mask: Bool[np.ndarray, "h w"],
    colour_hist: np.ndarray,
    area: float,
) -> float:
    size = int(mask.sum())
    if size < 15:
        return 0.0
    alike = similarity(colour_hist, histogram(working.rgb[i][mask]))
    return alike * float(np.exp(-0.5 * np.log(size / area) ** 2))

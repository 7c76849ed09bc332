"""The object's mask in the frames between the first and the last.

The mask is carried forwards from the start and backwards from the end (`mask_follower`); in each
frame the better one counts. A pixel outside the first mask that still looks as in the first frame
is not the object. A lost track has a low quality.
"""

from dataclasses import dataclass

import cv2
import numpy as np
from jaxtyping import Bool, Float, Float32

from v2p_data.scene.frames.colour import histogram, lab_distance, lab_of, likelihood
from v2p_data.scene.frames.mask_ops import grow, iou, largest, tidy
from v2p_data.scene.frames.working_clip import WorkingClip
from v2p_data.scene.grounding.candidates import Moved
from v2p_data.scene.grounding.mask_follower import CONFIG, Moving, follow, likeness_of, smoothed


@dataclass(frozen=True, kw_only=True)
class MaskTrack:
    """Masks at working size, one per working frame, and how far to believe each (0 to 1)."""

    masks: Bool[np.ndarray, "time h w"]
    quality: Float[np.ndarray, "time"]
    agreement: float
    """Overlap of the mask carried forwards with the one found at the end, or backwards at the start; 0 to 1."""


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
        around = grow(mask, round(CONFIG.near * np.sqrt(area)))  # not every frame was looked at
        return lies < 0.5 * area and float(self.moving(i)[around].sum()) < CONFIG.unseen * area


def _motion_check(
    moving: Moving | None,
    first: Bool[np.ndarray, "h w"],
    last: Bool[np.ndarray, "h w"],
    last_i: int,
) -> _MotionCheck | None:
    """Return the check; None where the network was not asked, or does not see the object at one end."""
    if moving is None:
        return None
    seen = [float(moving(i)[m].mean()) for i, m in ((0, first), (last_i, last)) if m.any()]
    return (
        _MotionCheck(moving=moving, ends=(first, last))
        if min(seen, default=1.0) > CONFIG.moves
        else None
    )


def track(
    working: WorkingClip,
    moved: Moved,
    *,
    every: int = 1,
    moving: Moving | None = None,
    bare: Moving | None = None,
) -> MaskTrack:
    """Return the object's mask over time: forwards from the first and backwards from the last outline.

    At each frame the direction is taken whose mask looks more like the object, and agrees better with `moving`.

    Args:
        working: frames.
        moved: both outlines.
        every: only every such frame is tracked; those between repeat their neighbour with no quality.
        moving: per frame the probability, 0 to 1, that each pixel shows a moving object and no hand.
        bare: per frame the probability that each pixel shows bare table.
    """
    n = len(working.rgb)
    steps = sorted({*range(0, n, every), n - 1})
    early, late = (smoothed(lab_of(still)) for still in (working.early, working.late))
    differs = _alike_share(working.lab[0], late, moved.first) < CONFIG.differs
    hist = moved.colour_hist
    forward = follow(working, steps, moved.first, hist, 0, moving, may_rest=differs)
    end = _last_outline(working, moved, forward[-1])
    may_rest = _alike_share(working.lab[-1], early, end) < CONFIG.differs
    backward = follow(working, steps[::-1], end, hist, n - 1, moving, may_rest=may_rest)
    backward.reverse()
    motion_check = _motion_check(moving, moved.first, end, n - 1)
    masks, quality = _merged(
        working, steps, (forward, backward), hist, (moved.first, end), motion_check
    )
    masks[0], masks[-1] = moved.first, end
    # An outline at the end that does not look like the object is not it: it is hidden there.
    alike = likeness_of(working, n - 1, end, hist, float(moved.first.sum()))
    quality[0], quality[-1] = 1.0, 1.0 if alike > CONFIG.lost else alike
    # Nor is a mask that shows the background of both ends, where the object looks otherwise than the table under it.
    if differs:
        for i in steps[1:]:
            still, place = (early, moved.first) if i >= n / 2 else (late, end)
            if _alike_share(working.lab[i], still, masks[i], grow(place, 2)) > CONFIG.bare:
                quality[i] = 0.0
    # Nor is bare table, where the network knows the object at first and it is hidden at the end, as in a fist.
    known = moving is not None and moving(0)[moved.first].sum() > CONFIG.moves * moved.first.sum()
    if bare is not None and known and motion_check is None:
        for i in steps[1:]:
            if masks[i].any() and float(bare(i)[masks[i]].mean()) > CONFIG.surely_bare:
                quality[i] = 0.0
    for i in range(1, n):
        if not masks[i].any():
            masks[i] = masks[i - 1]
    agreement = max(iou(forward[-1], moved.last), iou(backward[0], moved.first))
    return MaskTrack(masks=masks, quality=quality, agreement=agreement)


def _last_outline(
    working: WorkingClip, moved: Moved, carried_on: Bool[np.ndarray, "h w"]
) -> Bool[np.ndarray, "h w"]:
    """Return the outline of the last frame without the hand: the one found there, or the one carried there.

    The hand often breaks the object into pieces at the end; the mask carried there may be the better one.
    """
    n, area = len(working.rgb), float(moved.first.sum())
    found, carried = (
        likeness_of(working, n - 1, mask, moved.colour_hist, area)
        for mask in (moved.last, carried_on)
    )
    better = carried > found + 0.05 and iou(carried_on, moved.last) > 0.05
    return _less_hand(working, n - 1, carried_on if better else moved.last, moved.colour_hist)


def _merged(
    working: WorkingClip,
    steps: list[int],
    both_ways: tuple[list[Bool[np.ndarray, "h w"]], list[Bool[np.ndarray, "h w"]]],
    colour_hist: Float[np.ndarray, "l a b"],
    ends: tuple[Bool[np.ndarray, "h w"], Bool[np.ndarray, "h w"]],
    motion_check: _MotionCheck | None,
) -> tuple[Bool[np.ndarray, "time h w"], Float[np.ndarray, "time"]]:
    """Return in each of these frames the better of two masks, carried forwards and backwards, with its quality."""
    n = len(working.rgb)
    area_first, area_last = (float(mask.sum()) for mask in ends)
    masks = np.zeros((n, *working.shape), bool)
    quality = np.zeros(n)
    for i, *both in zip(steps, *both_ways, strict=True):
        share = i / max(1, n - 1)
        area = float(area_first ** (1 - share) * area_last**share)
        marks, votes = [], []
        for mask, away in zip(both, (share, 1 - share), strict=True):
            mark = likeness_of(working, i, mask, colour_hist, area) - CONFIG.far_cost * away
            agreement = 0.0
            if motion_check is not None:
                mark -= motion_check.misses(i, mask)
                agreement = motion_check.agrees(i, mask)
            marks.append(mark)
            votes.append(mark + agreement)
        best = int(votes[1] > votes[0])
        masks[i], quality[i] = both[best], max(0.0, marks[best])
    return masks, quality


def carried(
    working: WorkingClip,
    mask: Bool[np.ndarray, "h w"],
    at: int,
    *,
    every: int = 1,
    moving: Moving | None = None,
) -> MaskTrack:
    """Return the mask over time of what is known in one frame only: carried forwards and backwards from there.

    Where the mask looks little like the object any more, it is taken to be out of the picture: the mask is empty.
    """
    n = len(working.rgb)
    colour_hist, area = histogram(working.rgb[at][mask]), float(mask.sum())
    masks, quality = np.zeros((n, *working.shape), bool), np.zeros(n)
    for steps in ([*range(at, n, every)], [*range(at, -1, -every)]):
        for i, found in zip(
            steps, follow(working, steps, mask, colour_hist, at, moving), strict=True
        ):
            likeness = likeness_of(working, i, found, colour_hist, area)
            if likeness < CONFIG.lost:
                break
            masks[i], quality[i] = found, likeness
    masks[at], quality[at] = mask, 1.0
    return MaskTrack(masks=masks, quality=quality, agreement=1.0)


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
    hand = mask & (cv2.GaussianBlur(ratio.astype(np.float32), (0, 0), 2) > CONFIG.hand_ratio)
    rest, area = tidy(mask & ~hand), float(mask.sum())
    if hand.sum() < CONFIG.little * area or rest.sum() < CONFIG.mostly * area:
        return mask
    return largest(rest)


def _alike_share(
    lab: Float32[np.ndarray, "h w 3"],
    still: Float32[np.ndarray, "h w 3"],
    mask: Bool[np.ndarray, "h w"],
    but_for: Bool[np.ndarray, "h w"] | None = None,
) -> float:
    """Return how much of a mask looks in a frame as in a smoothed still.

    `but_for` are pixels that do not count as alike.
    """
    alike = lab_distance(smoothed(lab), still) < CONFIG.same_lab
    if but_for is not None:
        alike &= ~but_for
    return float(alike[mask].mean()) if mask.any() else 0.0

"""Which static object the caption means, from colours and places alone: for when the scene network is not asked."""

from dataclasses import dataclass, replace

import cv2
import numpy as np
from jaxtyping import Bool, Float32, UInt8

from v2p_data.kinds import KINDS, Kind
from v2p_data.scene.frames.colour import colour_words, lab_of
from v2p_data.scene.frames.mask_ops import (
    bounding_box,
    edge_contrast,
    grow,
    refine,
    shrink,
    solidity,
    tidy,
)
from v2p_data.scene.frames.table import Table
from v2p_data.scene.frames.working_clip import WorkingClip
from v2p_data.scene.grounding.change_blobs import WHOLE, border_sides, connected_parts, has_colour
from v2p_data.scene.grounding.moved_by_change import Moved

_LARGE = 0.01
"""Share of the picture from which solidity counts: the outlines of smaller objects are ragged."""
_LEAST_STATIC = 0.0025
"""Least share of the picture that a static object covers."""
_MOST_STATIC = 0.2
"""Greatest share of the picture that a static object covers."""
_NECKS = (0.4, 0.6, 0.8)
"""Radii, as shares of a mask's greatest inner radius, at which a mask is cut at its necks."""
_RESTLESS_LAB = 12.0
"""Distance in Lab between frames, from which a pixel has changed."""
_RESTLESS_SHARE = 0.15
"""Share of frames in which a pixel changes, from which something passes there."""


@dataclass(frozen=True, kw_only=True)
class StaticCues:
    """What each cue for a static object counts: their sum is its score, and above about 2 it was nearly always right.

    All were set by hand on drawn clips of the tuning half.
    """

    border: float = 0.8
    """Loss for each side at which the picture cuts it, and a third of that for the lower one."""
    split: float = 0.6
    """Loss of a piece of an outline: light and print cut objects into pieces, too."""
    goal: float = 3.0
    """Gain for each share, up to 0.6, of the place where the moved object went that it covers."""
    foot: float = 2.5
    """Gain for each share above 0.6 of it that lies where a cover's foot was."""
    approach: float = 1.0
    """Gain where the moved object comes straight towards it, and the same loss where it goes away."""
    near_px: float = 20.0
    """Gap that costs 1, where the task ends near the other object; at most 4 in all."""
    far_px: float = 60.0
    """The same where the task may end anywhere."""
    colour: float = 1.6
    """Gain for each share of it that has the named colour."""
    fill: float = 0.8
    """Gain for each share of its bounding box that it fills."""
    solid: float = 2.0
    """Loss for each share of solidity below 0.8: touching objects, or pieces of one, are no object."""
    edge: float = 0.02
    """Gain for each Lab unit of contrast along its outline, up to 40."""
    small: float = 0.5
    """Loss for each factor e by which it covers less than 0.8 % of the picture."""


CUES = StaticCues()


@dataclass(frozen=True, kw_only=True)
class Found:
    """A static object, at working size."""

    mask: Bool[np.ndarray, "h w"]
    score: float
    """Above about 2 it was nearly always right."""


def find_static_by_change(
    working: WorkingClip,
    table: Table,
    phrase: str,
    kind: Kind,
    moved: Moved,
    taken: Bool[np.ndarray, "h w"] | None = None,
) -> Found | None:
    """Return the static object that the phrase means; None where the still shows no candidate.

    For what is uncovered the late still is searched, for all others the early one.
    """
    late = kind == "uncover"
    still = working.late if late else working.early
    h, w = working.shape
    words = colour_words(phrase)
    rating = _Rating(working, table, words, kind, moved)
    stack = working.lab[-rating.quarter :] if late else working.lab[: rating.quarter]
    steps = np.linalg.norm(np.diff(stack[:: max(1, rating.quarter // 8)], axis=0), axis=-1)
    restless = (steps > _RESTLESS_LAB).mean(0) > _RESTLESS_SHARE
    stands_out = table.stands_out(still) & shrink(table.hull, 1) & ~restless
    hand = working.hand(still) & ~rating.colour
    sets = [stands_out, stands_out & ~hand] + ([rating.colour & ~restless] if words else [])
    occupied = grow(moved.first, 3)
    best: Found | None = None
    for pixels in sets:
        free = pixels & ~grow(moved.last, 2) if late else pixels & ~occupied
        free = free if taken is None else free & ~taken
        wholes = connected_parts(tidy(free, 5), h * w, _LEAST_STATIC, _MOST_STATIC)
        pieces = [part for whole in wholes for part in pieces_of(whole, _LARGE * h * w)]
        for k, mask in enumerate([*wholes, *pieces]):
            score = rating.score(mask, is_piece=k >= len(wholes))
            if best is None or score > best.score:
                best = Found(mask=mask, score=score)
    if best is None:
        return None
    never = np.zeros((h, w), bool) if late else moved.first
    return replace(best, mask=_outlined(still, best.mask, never))


class _Rating:
    """What the cues of a candidate add up to, for one phrase in one clip."""

    def __init__(
        self, working: WorkingClip, table: Table, words: tuple[str, ...], kind: Kind, moved: Moved
    ) -> None:
        self._late = kind == "uncover"
        still = working.late if self._late else working.early
        goal = moved.first if self._late else moved.last
        self._kind, self._table, self._has_words = KINDS[kind], table, bool(words)
        self._goal_zone = grow(goal, 6)
        self._foot = self._goal_zone.copy()
        top, tall = bounding_box(goal)[1::2]
        self._foot[: top + tall // 2] = False
        self._to_goal = _distance_to(goal)
        self._to_first = _distance_to(moved.first)
        ends = [np.argwhere(mask).mean(0) for mask in (moved.first, moved.last) if mask.any()]
        self._way_px = float(np.linalg.norm(ends[-1] - ends[0])) if ends else 0.0
        self._lab = lab_of(still)
        self.colour = has_colour(still, words)
        self.quarter = max(3, len(working.lab) // 5)

    def score(self, mask: Bool[np.ndarray, "h w"], *, is_piece: bool) -> float:
        """Return the sum of a candidate's cues; `is_piece` says that it was cut out of a larger one."""
        h, w = mask.shape
        x, y, bw, bh = bounding_box(mask)
        area = int(mask.sum())
        score = -border_sides((x, y, bw, bh), w, h) * CUES.border
        score -= CUES.split if is_piece else 0.0
        if self._kind.touches or self._late:
            share = float((mask & self._goal_zone).sum() / self._goal_zone.sum())
            score += CUES.goal * min(0.6, share)
        if self._late:  # what was under the cover stands where its foot was
            score += CUES.foot * float((mask & self._foot).sum() / area - 0.6)
        gap = float(self._to_goal[mask].min())
        if self._kind.comes_near:
            nearer = float(self._to_first[mask].min()) - gap
            score += CUES.approach * float(np.clip(nearer / max(8.0, self._way_px), -1, 1))
        near = CUES.near_px if self._kind.ends_near or self._late else CUES.far_px
        score -= min(gap / near, 4.0)
        ring = grow(mask, 3) & ~mask
        score += float(self._table.seen[ring].mean()) if ring.any() else 0.0
        score += CUES.colour * float(self.colour[mask].mean()) if self._has_words else 0.0
        score += CUES.fill * area / (bw * bh)
        if area > _LARGE * h * w:
            score += CUES.solid * float(np.clip(solidity(mask) - WHOLE, -0.2, 0))
        score += CUES.edge * min(40.0, edge_contrast(self._lab, mask))
        score -= CUES.small * max(0.0, float(np.log(0.008 * h * w / area)))
        return score


def _distance_to(mask: Bool[np.ndarray, "h w"]) -> Float32[np.ndarray, "h w"]:
    """Return each pixel's distance from a mask [px]."""
    return np.asarray(cv2.distanceTransform((~mask).astype(np.uint8), cv2.DIST_L2, 5))


def _outlined(
    still: UInt8[np.ndarray, "h w 3"],
    blob: Bool[np.ndarray, "h w"],
    never: Bool[np.ndarray, "h w"],
) -> Bool[np.ndarray, "h w"]:
    """Return the outline around a static object, or the blob where there is no clear one."""
    mask = refine(still, blob, never)
    return mask if 0.5 <= mask.sum() / blob.sum() <= 1.8 else blob


def pieces_of(mask: Bool[np.ndarray, "h w"], least_px: float) -> list[Bool[np.ndarray, "h w"]]:
    """Return the parts of a mask that only a neck joins, as openings with discs of its own width leave them."""
    if mask.sum() < least_px or solidity(mask) > WHOLE:
        return []
    inner = cv2.distanceTransform(mask.astype(np.uint8), cv2.DIST_L2, 5)
    out: list[Bool[np.ndarray, "h w"]] = []
    for share in _NECKS:
        radius = share * float(inner.max())
        count, cores = cv2.connectedComponents((inner > radius).astype(np.uint8))
        for k in range(1, count):
            outside = (cores != k).astype(np.uint8)
            near = cv2.distanceTransform(outside, cv2.DIST_L2, 5) <= radius
            if (near & mask).sum() >= least_px:
                out.append(near & mask)
    return out

"""What speaks for a thing that stands still being the one that a phrase means.

What each cue counts was learned from drawn clips (`scripts/train_standing.py`); the weights are
`standing.json` beside this file.
"""

import json
from dataclasses import dataclass
from functools import cache, cached_property
from pathlib import Path

import cv2
import numpy as np
from jaxtyping import Bool, Float32

from v2p_data.kinds import KINDS, Kind
from v2p_data.scene.frames.classes import HAND, MOVED, OTHER
from v2p_data.scene.frames.colour import balance, colour_match, colour_words, lab_of
from v2p_data.scene.frames.mask_ops import (
    bounding_box,
    edge_contrast,
    grow,
    solidity,
)
from v2p_data.scene.frames.segmentation import Segmentation
from v2p_data.scene.frames.table import Table
from v2p_data.scene.frames.working_clip import WorkingClip
from v2p_data.scene.grounding.candidates import Candidate
from v2p_data.scene.scale.camera_height import SeenCamera, px_per_m
from v2p_data.scene.scale.nouns import Noun, noun_for

WEIGHTS = Path(__file__).with_name("standing.json")
MOST_SHARE = 0.2
"""Greatest share of the picture that a candidate covers, unless the network sees an object there."""
_TOO_LARGE = 0.3
"""Logarithm of size over usual size, above which a candidate beyond `MOST_SHARE` is the table and no object."""
_KINDS_VARY = 0.3
"""Logarithm of size over usual size up to which the moved object says nothing against the camera:
its kind varies that much."""
_FOOT = 0.8
"""Row of a candidate's foot, as a share of its height from the top: there its width is compared
with the table's scale."""
_LEAST_FREE = 2.0
"""Frames without anything passing in front of a pixel, from which the network's word on it counts in full."""
_MOST_GAP = 3.0
"""Distance from the moved object, in its extents, beyond which distance says nothing more."""


@dataclass(frozen=True, kw_only=True)
class StaticCandidate(Candidate):
    """What stands there and may be the one that is meant."""

    preference: float = 0.0
    """What its outline adds to its rating."""

    @property
    def rating(self) -> float:
        """Log odds, up to a constant, of being the object that is meant."""
        return weighted(learned()["choice"], self.cues) + self.preference


@dataclass(frozen=True, kw_only=True)
class StaticSearch:
    """What is looked for, and where."""

    working: WorkingClip
    table: Table
    segmentation: Segmentation
    phrase: str
    """What the caption calls it."""
    moved: Noun
    """What the manipulated object is."""
    kind: Kind
    """Of the task."""
    ends: tuple[Bool[np.ndarray, "h w"], Bool[np.ndarray, "h w"]]
    """The manipulated object's first and last outline."""
    taken: Bool[np.ndarray, "h w"]
    """What other phrases mean."""

    @property
    def late(self) -> bool:
        """Whether the named object is seen at the end only."""
        return KINDS[self.kind].starts_over

    @cached_property
    def static(self) -> Float32[np.ndarray, "h w"]:
        """How likely each pixel shows a thing that stands there."""
        return static_share(self.segmentation, self.kind)

    @cached_property
    def cues(self) -> "Cues":
        """What every candidate's cues are computed from."""
        return Cues.of(self)

    @cached_property
    def log_scale(self) -> float:
        """By how much all seems too large, as the moved object tells beyond what its kind varies (a logarithm)."""
        mask = self.ends[0]
        if not (self.moved.known and mask.any()):
            return 0.0
        off = larger_than_usual(self.moved, self.segmentation.camera, mask)
        return float(np.sign(off) * max(0.0, abs(off) - _KINDS_VARY))


def static_share(segmentation: Segmentation, kind: Kind) -> Float32[np.ndarray, "h w"]:
    """Return how likely each pixel shows a thing that stands there, over all frames in which nothing passes before it.

    What is uncovered is only seen at the end, and the network may say that it moved.
    """
    if kind == "uncover":
        return segmentation.late[OTHER] + segmentation.late[MOVED]
    free = 1 - segmentation.shares[:, HAND] - segmentation.shares[:, MOVED]
    return segmentation.shares[:, OTHER].sum(0) / np.maximum(free.sum(0), _LEAST_FREE)


def usual_area_px(noun: Noun, camera: SeenCamera, shape: tuple[int, int], row_px: float) -> float:
    """Return how many pixels a thing of the noun's usual size covers, its foot in that row of a picture of this shape.

    Its top seen from above and its side, the mean over all yaws (of a convex outline the mean
    width is its girth over pi).
    """
    per_m = px_per_m(camera, shape, row_px)
    below = (row_px - shape[0] / 2) / shape[1]
    down = max(0.05, camera.pitch_rad + float(np.arctan(below / camera.focal_widths)))
    length, width, height = noun.size_m
    if noun.form == "sphere":
        return per_m**2 * np.pi / 4 * length**2
    if noun.form == "cylinder":
        narrow = min(noun.taper, 1 / noun.taper)
        top, side = np.pi / 4 * length * width, length * height * (1 + narrow) / 2
    else:
        top, side = length * width, 2 / np.pi * (length + width) * height
    return per_m**2 * float(top * np.sin(down) + side * np.cos(down))


def larger_than_usual(noun: Noun, camera: SeenCamera, mask: Bool[np.ndarray, "h w"]) -> float:
    """Return the logarithm of how much larger a mask's object seems than its kind usually is."""
    y, tall = bounding_box(mask)[1::2]
    area, row_px = float(mask.sum()), y + _FOOT * tall
    return float(np.log(area / usual_area_px(noun, camera, mask.shape, row_px))) / 2


@dataclass(frozen=True, kw_only=True)
class Cues:
    """What the candidates' cues are computed from."""

    search: StaticSearch
    lab: Float32[np.ndarray, "h w 3"]
    """Colours of the still in which the object is searched."""
    colour: Float32[np.ndarray, "h w"] | None
    """How well each pixel has the colour that the phrase names."""
    usual: float
    """Its mean over the table."""
    off_table: Bool[np.ndarray, "h w"]
    """What stands out from the table, and is neither hand nor moving."""
    free: Bool[np.ndarray, "h w"]
    """What other objects do not take."""
    way: "_Approach"

    @classmethod
    def of(cls, search: StaticSearch) -> "Cues":
        working, table, segmentation = search.working, search.table, search.segmentation
        late = search.late
        still, here = (
            (working.late, segmentation.late) if late else (working.early, segmentation.early)
        )
        words = colour_words(search.phrase)
        colour = colour_match(balance(still), words) if words else None
        return cls(
            search=search,
            lab=lab_of(still),
            colour=colour,
            usual=float(colour[table.seen].mean())
            if colour is not None and table.seen.any()
            else 0.0,
            off_table=table.stands_out(still) & (here[HAND] + (0 if late else here[MOVED]) < 0.5),
            free=~search.taken & ~grow(search.ends[1], 2) if late else ~search.taken,
            way=_Approach.of(search),
        )

    def candidate(self, mask: Bool[np.ndarray, "h w"], *, is_part: bool) -> StaticCandidate | None:
        """Return a mask with its cues; None where it is as large as the table.

        Args:
            mask: its pixels.
            is_part: it was cut out of a larger one.
        """
        own = _own_cues(self.search, mask, self.lab, self.colour, self.usual)
        if mask.mean() > MOST_SHARE and own["larger than usual"] > _TOO_LARGE:
            return None
        cues = {"part": float(is_part), **own, **self.way.cues(mask, self.search.kind)}
        return StaticCandidate(mask=mask, cues=cues)


def _own_cues(
    search: StaticSearch,
    mask: Bool[np.ndarray, "h w"],
    lab: Float32[np.ndarray, "h w 3"],
    colour: Float32[np.ndarray, "h w"] | None,
    usual: float,
) -> dict[str, float]:
    """Return what a candidate looks like.

    `colour` is how well each pixel has the colour that the phrase names, `usual` the table's
    mean.
    """
    static, seen = search.static, search.table.seen
    h, w = mask.shape
    x, y, bw, bh = bounding_box(mask)
    area = float(mask.sum())
    ring = grow(mask, 4) & ~grow(mask, 1)
    noun = noun_for(search.phrase)
    off = larger_than_usual(noun, search.segmentation.camera, mask) - search.log_scale
    return {
        "seen": float(static[mask].mean()),
        "seen around": float(static[ring].mean()) if ring.any() else 0.0,
        "sides cut": float(sum((x <= 1, x + bw >= w - 1, y <= 1, y + bh >= h - 1))),
        "larger than usual": max(0.0, off),
        "smaller than usual": max(0.0, -off),
        "area": float(np.log(area / (h * w))),
        "solidity": solidity(mask),
        "fill": area / (bw * bh),
        "edge": min(40.0, edge_contrast(lab, mask)) / 40,
        "table around": float(seen[ring].mean()) if ring.any() else 0.0,
        "colour": 0.0 if colour is None else float(colour[mask].mean()) - usual,
    }


@dataclass(frozen=True, kw_only=True)
class _Approach:
    """From where to where something moved, as far as that tells which thing is meant."""

    own: Bool[np.ndarray, "h w"]
    """Where what moved is itself in the picture that is searched."""
    goal_zone: Bool[np.ndarray, "h w"]
    """Around where it went; what is uncovered is where it came from."""
    foot: Bool[np.ndarray, "h w"]
    """The lower half of that."""
    from_goal: Float32[np.ndarray, "h w"]
    """Distances [px]."""
    from_first: Float32[np.ndarray, "h w"]
    reach_px: float
    """The moved thing's extent."""
    length_px: float

    @classmethod
    def of(cls, search: StaticSearch) -> "_Approach":
        first, last = search.ends
        goal, own = (first, last) if search.late else (last, first)
        zone = grow(goal, 6)
        foot = zone.copy()
        top, tall = bounding_box(goal)[1::2]
        foot[: top + tall // 2] = False
        from_goal, from_first = (
            cv2.distanceTransform((~mask).astype(np.uint8), cv2.DIST_L2, 5)
            for mask in (goal, first)
        )
        spots = [np.argwhere(mask).mean(0) for mask in search.ends if mask.any()]
        return cls(
            own=own,
            goal_zone=zone,
            foot=foot,
            from_goal=from_goal,
            from_first=from_first,
            reach_px=float(np.sqrt(max(1, goal.sum()))),
            length_px=max(8.0, float(np.linalg.norm(spots[-1] - spots[0])) if spots else 0.0),
        )

    def cues(self, mask: Bool[np.ndarray, "h w"], kind: Kind) -> dict[str, float]:
        """Return how a candidate lies to it, under the names for the kind of task."""
        area = float(mask.sum())
        to_goal, to_first = (
            float(distance[mask].min()) for distance in (self.from_goal, self.from_first)
        )
        gap = min(_MOST_GAP, to_goal / self.reach_px)
        reached = min(float(self.goal_zone.sum()), area)
        there = {
            "gap": gap,
            "at the end": float((mask & self.goal_zone).sum() / max(1.0, reached)),
            "nearer": float(np.clip((to_first - to_goal) / self.length_px, -1, 1)),
        }
        under = {"gap": gap, "foot": float((mask & self.foot).sum() / area)}
        out = {"moved": float((mask & self.own).sum() / area), "gap": gap}
        of_kind = KINDS[kind]
        for name, counts, cues in (
            ("into", of_kind.touches, there),
            ("towards", of_kind.comes_near, there),
            ("under", of_kind.starts_over, under),
        ):
            out |= {f"{name}: {what}": cue * counts for what, cue in cues.items()}
        return out


@cache
def learned() -> dict[str, dict[str, float]]:
    """Return what a unit of each cue counts, for which candidate it is and for whether that is right."""
    return json.loads(WEIGHTS.read_text(encoding="utf-8"))


def weighted(weights: dict[str, float], cues: dict[str, float]) -> float:
    return sum(weights[cue] * value for cue, value in cues.items())

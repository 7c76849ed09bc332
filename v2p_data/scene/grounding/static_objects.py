"""Which static object the caption means, from what the scene network sees.

The network says of every pixel in every frame whether it shows an object that never moved. That is cut into candidates. Cues, such as
size, colour and place, say which candidate is meant. What each cue counts was learned from drawn clips
(`scripts/train_standing.py`); the weights are `standing.json` beside this file.
"""

import json
from collections.abc import Iterator
from dataclasses import dataclass, replace
from functools import cache, cached_property
from pathlib import Path

import cv2
import numpy as np
from jaxtyping import Bool, Float, Float32, UInt8
from scipy.special import softmax

from v2p_data.kinds import KINDS, Kind
from v2p_data.scene.frames.classes import HAND, MOVED, OTHER
from v2p_data.scene.frames.colour import balance, colour_match, colour_words, lab_of
from v2p_data.scene.frames.mask_ops import (
    bounding_box,
    edge_contrast,
    grow,
    iou,
    refine,
    solidity,
    tidy,
)
from v2p_data.scene.frames.segmentation import Segmentation
from v2p_data.scene.frames.table import Table
from v2p_data.scene.frames.working_clip import WorkingClip
from v2p_data.scene.grounding.model_outlines import outlines_around
from v2p_data.scene.grounding.static_by_change import Found, pieces_of
from v2p_data.scene.scale.camera_height import SeenCamera, px_per_m
from v2p_data.scene.scale.nouns import Noun, noun_for

WEIGHTS = Path(__file__).with_name("standing.json")
_LEVELS = (0.75, 0.5, 0.25, 0.12)
"""Probabilities at which what the network sees is cut into things."""
_LEAST_SHARE = 0.0005
"""Least share of the picture that a candidate covers: smaller ones are noise."""
_MOST_SHARE = 0.2
"""Greatest share of the picture that a candidate covers, unless the network sees an object there."""
_MOST_SEEN_SHARE = 0.45
"""Greatest share where the network sees an object: bowls and baskets are filmed from near."""
_TOO_LARGE = 0.3
"""Logarithm of size over usual size, above which a candidate beyond `_MOST_SHARE` is the table and no object."""
_KINDS_VARY = 0.3
"""Logarithm of size over usual size up to which the moved object says nothing against the camera: its kind varies that much."""
_FOOT = 0.8
"""Row of a candidate's foot, as a share of its height from the top: there its width is compared with the table's scale."""
_LEAST_FREE = 2.0
"""Frames without anything passing in front of a pixel, from which the network's word on it counts in full."""
_SAME = 0.9
"""IoU from which two candidates are one."""
_ALIKE = 0.5
"""IoU from which two candidates are the same object, cut out differently."""
_SOFTER = 0.7
"""Factor on the learned ratings for the expected overlap: the odds they were learned for are too sure. Measured on 88 drawn clips."""
_LEAST_CHANCE = 0.01
"""Least and, from 1 downwards, greatest probability of a candidate."""
_MOST_WITH_HANDLE = 1.5
"""Greatest area of a pan with its handle, over that of its body."""
_MOST_GAP = 3.0
"""Distance from the moved object, in its extents, beyond which distance says nothing more."""
_SEEN_AS_THING = 0.35
"""Mean probability over a candidate from which the network knows it as an object."""
_SURELY = 0.9
"""Probability from which a pixel belongs to the outline, whatever the edges say."""
_NO_THING = 0.08
"""Probability below which a pixel does not belong to the outline of an object that the network knows."""
_ASKED = 5
"""Of the best candidates, so many are outlined anew by a model, where one was asked for."""
_ASKED_APART = 0.7
"""IoU below which two candidates are asked for both."""
_WHOLE = 30.0
"""Weight on the logarithm of the overlap that such a model expects: 0.99 for most whole objects, 0.9 for their parts."""
_NOT_OUTLINED = -2.0
"""What other candidates' outlines add to their rating beside those."""
_MOST_TAKEN = 0.3
"""Share of an outline that other objects may hold."""
_LESS_HIDDEN = 0.1
"""Share of an object by which less must be hidden in the late still for its outline to be taken there."""


@dataclass(frozen=True, kw_only=True)
class StaticCandidate:
    """A thing that may be the one that is meant."""

    mask: Bool[np.ndarray, "h w"]
    cues: dict[str, float]
    preference: float = 0.0
    """What its outline adds to its rating."""
    outlined: bool = False
    """Whether a model that knows edges of objects drew it."""

    @property
    def rating(self) -> float:
        """Log odds, up to a constant, of being the object that is meant."""
        return _sum(_learned()["choice"], self.cues) + self.preference


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
    def cues(self) -> "_Cues":
        """What every candidate's cues are computed from."""
        return _Cues.of(self)

    @cached_property
    def log_scale(self) -> float:
        """By how much all seems larger than it is, as far as the moving object seems too large for its kind by more than kinds vary."""
        mask = self.ends[0]
        if not (self.moved.known and mask.any()):
            return 0.0
        off = larger_than_usual(self.moved, self.segmentation.camera, mask)
        return float(np.sign(off) * max(0.0, abs(off) - _KINDS_VARY))


def find_static_object(search: StaticSearch) -> Found | None:
    """Return the thing that the phrase means, its score being how likely it is the right one; None where nothing stands.

    It is the candidate from which most overlap with the named object can be expected: a whole rather than its likelier half.
    """
    found = _with_outlines(search, candidates(search))
    if not found:
        return None
    learned = _learned()
    rating = np.array([one.rating for one in found])
    likely = softmax(rating)
    overlaps = overlaps_of(found)
    k = int((overlaps @ softmax(_SOFTER * rating)).argmax())
    best = found[k]
    mask = best.mask
    said = {"offset": 1.0, "odds": odds_of(likely, overlaps[k])}
    if KINDS[search.kind].locates_other:
        odds = _sum(learned["sure"], {**said, **best.cues})
    else:
        odds = _sum(learned["aside"], said)
    if noun_for(search.phrase).handled:
        alike = [c.mask for c in found if c.outlined == best.outlined]
        mask = max((m for m in alike if _is_with_handle(m, mask)), key=np.sum)
    if not best.outlined:
        mask = _outlined(search, mask)
    return Found(mask=mask, score=float(1 / (1 + np.exp(-odds))))


def overlaps_of(found: list[StaticCandidate]) -> Float[np.ndarray, "n n"]:
    """Return how far each candidate overlaps each (IoU)."""
    masks = np.stack([one.mask.ravel() for one in found]).astype(np.float32)
    common, area = masks @ masks.T, masks.sum(1)
    return common / np.maximum(1, area[:, None] + area - common)


def odds_of(likely: Float[np.ndarray, "n"], alike: Float[np.ndarray, "n"]) -> float:
    """Return the log odds of the likeliest candidate and those like it among all; `alike` is how far each overlaps it."""
    share = float(np.clip(likely[alike > _ALIKE].sum(), _LEAST_CHANCE, 1 - _LEAST_CHANCE))
    return float(np.log(share / (1 - share)))


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

    Its top seen from above and its side, the mean over all yaws (of a convex outline the mean width is its girth over pi).
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
    """Return the logarithm of how much larger a mask's object seems than its kind usually is, of its forms the likelier."""
    y, tall = bounding_box(mask)[1::2]
    area, row_px = float(mask.sum()), y + _FOOT * tall
    forms = [one for one in (noun, noun.variant) if one is not None]
    offs = [
        float(np.log(area / usual_area_px(one, camera, mask.shape, row_px))) / 2 for one in forms
    ]
    return min(offs, key=abs)


def candidates(search: StaticSearch) -> list[StaticCandidate]:
    """Return all that may be meant by the phrase, with its cues."""
    cues = search.cues
    masks = _masks(search.static, cues.off_table, cues.free, cues.colour)
    rated = (cues.candidate(mask, is_part=is_part) for mask, is_part in masks)
    return [one for one in rated if one is not None]


def _with_outlines(search: StaticSearch, found: list[StaticCandidate]) -> list[StaticCandidate]:
    """Return the candidates with the outlines that a model draws at the best of them, where one was asked for."""
    if search.working.outliner is None:
        return found
    cues = search.cues
    best: list[StaticCandidate] = []
    for one in sorted(found, key=lambda one: -one.rating):
        if len(best) < _ASKED and all(iou(one.mask, other.mask) < _ASKED_APART for other in best):
            best.append(one)
    out: list[StaticCandidate] = []
    for one in best:
        for outline in outlines_around(search.working, -1 if search.late else 0, one.mask):
            mask = outline.mask
            is_free = (mask & cues.free).sum() >= (1 - _MOST_TAKEN) * mask.sum()
            is_known = any(iou(mask, other.mask) >= _SAME for other in out)
            seen = cues.candidate(mask, is_part=False) if is_free and not is_known else None
            if seen is not None:
                whole = _WHOLE * float(np.log(np.clip(outline.iou, 0.1, 1.0)))
                out.append(replace(seen, preference=whole, outlined=True))
    return [*out, *(replace(one, preference=_NOT_OUTLINED) for one in found)]


@dataclass(frozen=True, kw_only=True)
class _Cues:
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
    def of(cls, search: StaticSearch) -> "_Cues":
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
        if mask.mean() > _MOST_SHARE and own["larger than usual"] > _TOO_LARGE:
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
    """Return what a candidate looks like; `colour` is how well each pixel has the colour that the phrase names, `usual` the table's mean."""
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


def _is_with_handle(mask: Bool[np.ndarray, "h w"], body: Bool[np.ndarray, "h w"]) -> bool:
    """Return whether a mask is that body, alone or with no more beside it than a handle."""
    return (
        mask & body
    ).sum() >= _SAME * body.sum() and mask.sum() <= _MOST_WITH_HANDLE * body.sum()


@cache
def _learned() -> dict[str, dict[str, float]]:
    """Return what a unit of each cue counts, for which candidate it is and for whether that is right."""
    return json.loads(WEIGHTS.read_text())


def _sum(weights: dict[str, float], cues: dict[str, float]) -> float:
    return sum(weights[cue] * value for cue, value in cues.items())


def _masks(
    static: Float32[np.ndarray, "h w"],
    off_table: Bool[np.ndarray, "h w"],
    free: Bool[np.ndarray, "h w"],
    colour: Float32[np.ndarray, "h w"] | None,
) -> Iterator[tuple[Bool[np.ndarray, "h w"], bool]]:
    """Yield candidates, each with whether it is cut out of a larger one: by a neck, or by its colour."""
    sets = [(tidy((static > level) & free), False, _MOST_SEEN_SHARE) for level in _LEVELS]
    sets.append((tidy(off_table & free, 5), False, _MOST_SHARE))
    if colour is not None:
        named = free & (colour > 0.5)
        sets += [
            (tidy(pixels & named, 5), True, _MOST_SHARE)
            for pixels in (off_table, *(static > level for level in _LEVELS[1:]))
        ]
    known: list[Bool[np.ndarray, "h w"]] = []
    least = _LEAST_SHARE * free.size
    for pixels, is_part, most_share in sets:
        count, parts, stats, _ = cv2.connectedComponentsWithStats(pixels.astype(np.uint8))
        for k in range(1, count):
            if not least <= stats[k, cv2.CC_STAT_AREA] <= most_share * free.size:
                continue
            whole = parts == k
            for mask in (whole, *pieces_of(whole, least)):
                if all(iou(mask, other) < _SAME for other in known):
                    known.append(mask)
                    yield mask, is_part or mask is not whole


def _outlined(search: StaticSearch, mask: Bool[np.ndarray, "h w"]) -> Bool[np.ndarray, "h w"]:
    """Return the outline that follows the edges around a thing, as far as the network lets it."""
    working, segmentation, static = search.working, search.segmentation, search.static
    late, never = search.late, search.ends[1]
    if not late:
        passes = [
            shares[HAND] + shares[MOVED] for shares in (segmentation.early, segmentation.late)
        ]
        hidden = [float(plane[mask].mean()) for plane in passes]
        late = hidden[1] + _LESS_HIDDEN < hidden[0]
        never = passes[int(late)] > 0.5
    still: UInt8[np.ndarray, "h w 3"] = working.late if late else working.early
    tells = static[mask].mean() > _SEEN_AS_THING
    none = (static < _NO_THING) if tells else np.zeros_like(mask)
    fine = refine(still, mask, never | none)
    if not 0.5 <= fine.sum() / mask.sum() <= 1.8:
        fine = mask
    return (fine & ~none) | (mask & (static > _SURELY))

"""Which pixels are the moved object at the start and at the end, from what the scene network sees: the default way.

The network's class `moved` is cut into blobs at both ends. Pairs of blobs are rated by how well
they fit the caption and each other; the product of the cues, 0 to 1, is the score, and the weakest
cue is its reason.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import cv2
import numpy as np
from jaxtyping import Bool, Float, Float32, UInt8

from v2p_data.kinds import KINDS, Kind
from v2p_data.scene.frames.classes import HAND, MOVED
from v2p_data.scene.frames.colour import (
    balance,
    colour_match,
    colour_words,
    histogram,
    lab_of,
    likelihood,
    named_colours,
    similarity,
)
from v2p_data.scene.frames.mask_ops import (
    edge_contrast,
    grow,
    iou,
    is_cut,
    largest,
    refine,
    tidy,
)
from v2p_data.scene.frames.segmentation import LEAST_SHARE, Segmentation, hand_at
from v2p_data.scene.frames.working_clip import WorkingClip
from v2p_data.scene.grounding.candidates import Candidate, Moved, connected_parts
from v2p_data.scene.grounding.model_outlines import outlines_around

_LIKELY, _POSSIBLE = 0.5, 0.25
_GAP_PX = 7
"""Of a picture 320 px wide: parts of one thing lie as near as this."""
_SAME_THING = 0.5
"""Share of the smaller outline in the larger, from which both are the same thing."""
_PIECE = 0.85
"""What a piece of an outline counts: it must be clearly better than the whole."""
_MOSTLY_OTHER = 0.5
"""Share of an outline: with less of the named colour it is taken along with something else."""


_ASKED = 3
"""Of the best blobs, so many are outlined anew by a model, where one was asked for."""
_ONE_OUTLINE = 0.9
"""IoU from which two outlines are one."""
_WHOLE = 8.0
"""Exponent of the overlap that the model expects: 0.99 for most whole objects, 0.9 for their parts."""
_NOT_OUTLINED = 0.4
"""What a blob counts beside the model's outlines."""


@dataclass(frozen=True, kw_only=True)
class _Blob(Candidate):
    """What may be the moved object at one end of the clip; its cues are 0 to 1 each."""

    hist: np.ndarray
    preference: float = 1.0
    """What its outline adds to the rating, not to the confidence."""

    @property
    def rating(self) -> float:
        return self.preference * float(np.prod(list(self.cues.values())))

    def weighed(self, what: str, part: float) -> "_Blob":
        """Return the blob with one factor more in its rating."""
        return replace(self, cues={**self.cues, what: part})


@dataclass(frozen=True)
class _Pair:
    """One thing at both ends of the clip."""

    first: _Blob
    last: _Blob
    cues: dict[str, float]
    """What speaks for their being the same thing, each 0 to 1."""

    @property
    def rating(self) -> float:
        return self.first.rating * self.last.rating * float(np.prod(list(self.cues.values())))


@dataclass(frozen=True, kw_only=True)
class Given:
    """What a person marked, at working size."""

    first: Bool[np.ndarray, "h w"] | None = None
    """The moved object's first outline, which is taken as it is."""
    last: Bool[np.ndarray, "h w"] | None = None
    """Its last outline, which is taken as it is."""
    goal: Bool[np.ndarray, "h w"] | None = None
    """The object into, onto or over which it goes."""
    colour_hist: Float[np.ndarray, "l a b"] | None = None
    """Its colours, where it was marked on its way."""


def find_moved_by_network(
    working: WorkingClip,
    segmentation: Segmentation,
    phrase: str,
    kind: Kind,
    tool: str = "",
    marked: Given | None = None,
) -> tuple[Moved, Moved | None] | None:
    """Return the manipulated object and, where the caption names one that a hand holds, the tool.

    None where nothing that moved was seen.
    """
    given = marked or Given()
    starts = _ends(working, segmentation, phrase, 0, given.first)
    stops = _ends(working, segmentation, phrase, len(working.rgb) - 1, given.last)
    if given.colour_hist is not None:
        starts, stops = (
            [_alike(blob, given.colour_hist) for blob in ends] for ends in (starts, stops)
        )
    if starts and not stops and KINDS[kind].hides:
        stops = _last_seen(working, segmentation, phrase, starts[0].area)
    stops = [_hidden_end(blob, KINDS[kind].end_weight) for blob in stops]
    if given.goal is not None and KINDS[kind].touches:
        near = grow(given.goal, _GAP_PX)
        stops = [_at_goal(blob, near) for blob in stops]
    pairs = sorted(
        (_Pair(a, b, _pair_cues(a, b, kind, working.shape)) for a in starts for b in stops),
        key=lambda pair: -pair.rating,
    )
    if not pairs:
        return None
    if not tool:
        return _moved(pairs, pairs[0]), None
    # The tool is what the hand holds; the object is pushed by it and lies farther from the hand.
    best = pairs[0]
    rest = [pair for pair in pairs[1:] if _is_another(pair, best)]
    if not rest:
        return _moved(pairs, best), None
    second = rest[0]
    in_hand = [_share_in_hand(working, segmentation, pair.first.hist) for pair in (best, second)]
    words = [colour_words(text) for text in (phrase, tool)]
    by_colour = [
        _named(working.rgb[0], best.first.mask, words[0])
        * _named(working.rgb[0], second.first.mask, words[1]),
        _named(working.rgb[0], second.first.mask, words[0])
        * _named(working.rgb[0], best.first.mask, words[1]),
    ]
    if by_colour[1] * (0.3 + in_hand[0]) > by_colour[0] * (0.3 + in_hand[1]):
        best, second = second, best
    return _moved(pairs, best), _moved(pairs, second)


def find_brought_by_network(
    working: WorkingClip,
    segmentation: Segmentation,
    phrase: str,
    given: Bool[np.ndarray, "h w"] | None = None,
) -> Moved | None:
    """Return what a hand brought and left, by its last outline alone; None where nothing came to rest.

    Args:
        working: frames.
        segmentation: what the network sees.
        phrase: what the caption calls it.
        given: its last outline, where a person marked it.
    """
    stops = _ends(working, segmentation, phrase, len(working.rgb) - 1, given)
    if not stops:
        return None
    best = stops[0]
    rival = max((b.rating for b in stops if not (b.mask & best.mask).any()), default=0.0)
    cues = {
        **{f"last {k}": v for k, v in best.cues.items()},
        "no rival": float(1 / (1 + (rival / max(best.rating, 1e-6)) ** 2)),
    }
    return Moved(
        first=np.zeros_like(best.mask),
        last=best.mask,
        score=float(np.prod(list(cues.values()))),
        colour_hist=best.hist,
        cues=cues,
        outlined=(1,) if best.outlined else (),
    )


def mask_of_mover(
    working: WorkingClip, segmentation: Segmentation, i: int, blob: Bool[np.ndarray, "h w"]
) -> Bool[np.ndarray, "h w"]:
    """Return a blob's outline at working frame `i` at working size, the hand cut away."""
    never = grow(hand_at(segmentation, i) & ~blob, 1) & ~blob
    return refine(working.rgb[i], blob, never)


def _ends(
    working: WorkingClip,
    segmentation: Segmentation,
    phrase: str,
    i: int,
    given: Bool[np.ndarray, "h w"] | None,
) -> list[_Blob]:
    if given is not None:
        hist = histogram(working.rgb[i][given])
        return [_Blob(mask=given, hist=hist, cues={"given": 1.0})]
    moved = segmentation.at(i)[MOVED]
    h, w = working.shape
    cores: list[Bool[np.ndarray, "h w"]] = []
    masks: list[Bool[np.ndarray, "h w"]] = []
    hand = hand_at(segmentation, i)
    for level in (_LIKELY, _POSSIBLE):
        # Print on an object and its content break it up: gaps are closed, but not over the hand.
        whole = tidy(moved > level, _GAP_PX) & ~(hand & (moved < _POSSIBLE))
        for mask in connected_parts(whole, LEAST_SHARE * h * w):
            if any((mask & other).any() for other in masks):
                continue
            cores.append(mask)
            masks.append(mask_of_mover(working, segmentation, i, largest(_grown_to(mask, moved))))
    pieces = _of_named_colour(working.rgb[i], phrase, cores)
    blobs = _rated(working, segmentation, phrase, i, masks, cores)
    cut = [mask_of_mover(working, segmentation, i, piece) for piece in pieces]
    blobs += [
        blob.weighed("cut by colour", _PIECE)
        for blob in _rated(working, segmentation, phrase, i, cut, pieces)
    ]
    if working.outliner is not None:
        blobs = _with_outlines(working, segmentation, phrase, i, blobs)
    return sorted(blobs, key=lambda blob: -blob.rating)[:8]


def _with_outlines(
    working: WorkingClip, segmentation: Segmentation, phrase: str, i: int, blobs: list[_Blob]
) -> list[_Blob]:
    """Return the blobs with the outlines that a model draws at the best of them.

    A blob may hold an arm or the screen behind the object; the model draws each by itself. It is
    surer of whole objects than of parts.
    """
    moved, hand = segmentation.at(i)[MOVED], hand_at(segmentation, i)
    best = sorted(blobs, key=lambda blob: -blob.rating)[:_ASKED]
    found: list[_Blob] = []
    for blob in best:
        outlines = [
            one
            for one in outlines_around(working, i, blob.mask, hand)
            if (one.mask & blob.mask).sum() > _SAME_THING * min(one.mask.sum(), blob.area)
            and all(iou(one.mask, other.mask) < _ONE_OUTLINE for other in found)
        ]
        masks = [one.mask for one in outlines]
        held = float(moved[blob.mask].sum())
        for one, rated in zip(
            outlines, _rated(working, segmentation, phrase, i, masks, masks), strict=True
        ):
            share = float(np.clip(moved[one.mask & blob.mask].sum() / held, 0.0, 1.0))
            whole = float(np.clip(one.iou, 0.0, 1.0)) ** _WHOLE
            found.append(replace(rated, preference=whole * share**0.5, outlined=True))
    return [*found, *(replace(blob, preference=_NOT_OUTLINED) for blob in blobs)]


def _of_named_colour(
    image: UInt8[np.ndarray, "h w 3"], phrase: str, wholes: Sequence[Bool[np.ndarray, "h w"]]
) -> list[Bool[np.ndarray, "h w"]]:
    """Return what of each whole has the colour that the phrase names, where an arm may have been taken along.

    An arm reaches the picture's edge, and most of such a whole has another colour.
    """
    if not named_colours(phrase):
        return []
    match = colour_match(balance(image), colour_words(phrase)) > _LIKELY
    out = []
    for whole in wholes:
        if is_cut(whole) and (whole & match).any():
            piece = largest(tidy(whole & match, _GAP_PX))
            if LEAST_SHARE * piece.size <= piece.sum() < _MOSTLY_OTHER * whole.sum():
                out.append(piece)
    return out


def _rated(
    working: WorkingClip,
    segmentation: Segmentation,
    phrase: str,
    i: int,
    masks: Sequence[Bool[np.ndarray, "h w"]],
    cores: Sequence[Bool[np.ndarray, "h w"]],
) -> list[_Blob]:
    """Return the masks with their cues, at working frame `i`: the first one or one near the end.

    `cores` are what the network saw of each before its outline was refined: noise is small there.
    """
    image, moved = working.rgb[i], segmentation.at(i)[MOVED]
    words = colour_words(phrase)
    match = colour_match(balance(image), words) if words else None
    lab, gone = lab_of(image), lab_of(working.late if i == 0 else working.early)
    return [
        _Blob(
            mask=mask,
            hist=histogram(image[mask]),
            cues={
                "moved": min(1.0, 0.4 + 0.75 * float(moved[mask].mean())),
                "size": float(1 - np.exp(-core.mean() / 0.002)),
                "colour": _named_by(match, mask) ** (1.0 if named_colours(phrase) else 0.3),
                "whole": 0.75 if is_cut(mask) else 1.0,
                "vanishing": _vanishing(lab, gone, mask),
            },
        )
        for mask, core in zip(masks, cores, strict=True)
    ]


def _last_seen(
    working: WorkingClip, segmentation: Segmentation, phrase: str, area: int
) -> list[_Blob]:
    """Return the blobs of the last frame that shows half of something this large, before all is hidden."""
    quick = replace(working, outliner=None)
    for i in segmentation.idx[: len(segmentation.idx) // 3 : -1].tolist():
        if any(blob.area > area / 2 for blob in _ends(quick, segmentation, phrase, i, None)):
            return _ends(working, segmentation, phrase, i, None)
    return []


def _hidden_end(blob: _Blob, weight: float) -> _Blob:
    """Return a blob of the last frame with ratings that count by this exponent."""
    return replace(blob, cues={name: cue**weight for name, cue in blob.cues.items()})


def _alike(blob: _Blob, colour_hist: Float[np.ndarray, "l a b"]) -> _Blob:
    """Return a blob that counts little where it has other colours than what the user marked."""
    return blob.weighed("alike what is marked", 0.2 + 0.8 * similarity(blob.hist, colour_hist))


def _at_goal(blob: _Blob, goal: Bool[np.ndarray, "h w"]) -> _Blob:
    """Return a blob of the last frame that counts little where it is not at the goal: hands uncover other things."""
    share = float((blob.mask & goal).sum()) / blob.area
    return blob.weighed("at the goal", min(1.0, 0.2 + 2 * share))


def _grown_to(
    core: Bool[np.ndarray, "h w"], moved: Float32[np.ndarray, "h w"]
) -> Bool[np.ndarray, "h w"]:
    """Return the core with what adjoins it and may be part of it, unless that would more than double it."""
    _, parts = cv2.connectedComponents(((moved > 0.35) | core).astype(np.uint8))
    labels = np.unique(parts[core])
    wider = tidy(np.isin(parts, labels[labels > 0])) | core
    return wider if wider.sum() < 2 * core.sum() else core


def _vanishing(
    lab: Float32[np.ndarray, "h w 3"],
    gone: Float32[np.ndarray, "h w 3"],
    mask: Bool[np.ndarray, "h w"],
) -> float:
    """Return whether the mask's outline is an edge here and none once the thing is gone: 0.2 to 1.

    Both where a thing was and where it goes the picture changes; only where it is there is an edge.
    """
    here, after = edge_contrast(lab, mask), edge_contrast(gone, mask)
    return float(np.clip(0.6 + 0.6 * (here - after) / (here + after + 4), 0.2, 1))


def _pair_cues(a: _Blob, b: _Blob, kind: Kind, shape: tuple[int, int]) -> dict[str, float]:
    ratio = abs(float(np.log(a.area / b.area)))
    weight = KINDS[kind].end_weight
    cues = {
        "alike": (0.3 + 0.7 * similarity(a.hist, b.hist)) ** weight,
        "same size": float(np.exp(-0.5 * (max(0.0, ratio - 0.4) / 0.7) ** 2)) ** weight,
    }
    spots = [np.argwhere(blob.mask).mean(0) for blob in (a, b)]
    (rise, across) = (spots[0] - spots[1]) / shape[1]
    if kind in ("push_left", "push_right"):
        along = -across if kind == "push_right" else across
        cues["direction"] = float(np.clip(0.5 + along / 0.06, 0.1, 1))
    elif kind == "lift_up":
        # What is lifted may be put down again before the clip ends.
        cues["direction"] = float(np.clip(0.8 + rise / 0.08, 0.6, 1))
    return cues


def _moved(pairs: list[_Pair], chosen: _Pair) -> Moved:
    a, b = chosen.first, chosen.last
    rival = max((pair.rating for pair in pairs if _is_another(pair, chosen)), default=0.0)
    cues = {
        **{f"first {k}": v for k, v in a.cues.items()},
        **{f"last {k}": v for k, v in b.cues.items()},
        **chosen.cues,
        "no rival": float(1 / (1 + (rival / max(chosen.rating, 1e-6)) ** 2)),
    }
    score = float(np.prod(list(cues.values())))
    outlined = tuple(end for end, blob in enumerate((a, b)) if blob.outlined)
    return Moved(
        first=a.mask, last=b.mask, score=score, colour_hist=a.hist, cues=cues, outlined=outlined
    )


def _is_another(pair: _Pair, chosen: _Pair) -> bool:
    """Return whether a pair is another thing than the chosen one, and no part of it, at both ends."""
    ends = ((pair.first, chosen.first), (pair.last, chosen.last))
    return all((a.mask & b.mask).sum() < _SAME_THING * min(a.area, b.area) for a, b in ends)


def _share_in_hand(working: WorkingClip, segmentation: Segmentation, hist: np.ndarray) -> float:
    """Return how much of the time a hand adjoins what looks like this (0 to 1)."""
    touches = []
    for i in segmentation.idx[len(segmentation.idx) // 4 : -(len(segmentation.idx) // 4) or None]:
        shares = segmentation.at(int(i))
        hand = shares[HAND] > _LIKELY
        if hand.sum() < 30:
            continue
        alike = (shares[MOVED] > _LIKELY) & (likelihood(hist, working.rgb[i]) > 2e-4)
        near = grow(hand, 5) & alike
        touches.append(min(1.0, near.sum() / max(1.0, 0.25 * alike.sum())))
    return float(np.mean(touches)) if touches else 0.0


def _named(
    image: UInt8[np.ndarray, "h w 3"], mask: Bool[np.ndarray, "h w"], words: tuple[str, ...]
) -> float:
    return _named_by(colour_match(balance(image), words) if words else None, mask)


def _named_by(match: Float32[np.ndarray, "h w"] | None, mask: Bool[np.ndarray, "h w"]) -> float:
    """Return 1 for a mask of the colour its phrase names, down to 0.4; 1 where it names none."""
    if match is None or not mask.any():
        return 1.0
    return 0.4 + 0.6 * min(1.0, float(match[mask].mean()) / 0.4)

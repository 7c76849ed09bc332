"""Which static object the caption means, from what the scene network sees.

The network says of every pixel in every frame whether it shows an object that never moved. That is
cut into candidates. Cues, such as size, colour and place, say which candidate is meant
(`static_cues.py`).
"""

from collections.abc import Iterator
from dataclasses import replace

import numpy as np
from jaxtyping import Bool, Float, Float32, UInt8
from scipy.special import softmax

from v2p_data.kinds import KINDS
from v2p_data.scene.frames.classes import HAND, MOVED
from v2p_data.scene.frames.mask_ops import (
    iou,
    refine,
    tidy,
)
from v2p_data.scene.grounding.candidates import connected_parts, pieces_of
from v2p_data.scene.grounding.model_outlines import outlines_around
from v2p_data.scene.grounding.static_cues import (
    MOST_SHARE,
    StaticCandidate,
    StaticSearch,
    learned,
    weighted,
)
from v2p_data.scene.scale.nouns import noun_for

_LEVELS = (0.75, 0.5, 0.25, 0.12)
"""Probabilities at which what the network sees is cut into things."""
_LEAST_SHARE = 0.0005
"""Least share of the picture that a candidate covers: smaller ones are noise."""
_MOST_SEEN_SHARE = 0.45
"""Greatest share where the network sees an object: bowls and baskets are filmed from near."""
_SAME = 0.9
"""IoU from which two candidates are one."""
_ALIKE = 0.5
"""IoU from which two candidates are the same object, cut out differently."""
_SOFTER = 0.7
"""Factor on the learned ratings for the expected overlap: the odds they were learned for are too
sure. Measured on 88 drawn clips."""
_LEAST_CHANCE = 0.01
"""Least and, from 1 downwards, greatest probability of a candidate."""
_MOST_WITH_HANDLE = 1.5
"""Greatest area of a pan with its handle, over that of its body."""
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
"""Weight on the logarithm of the overlap that such a model expects: 0.99 for most whole objects,
0.9 for their parts."""
_NOT_OUTLINED = -2.0
"""What other candidates' outlines add to their rating beside those."""
_MOST_TAKEN = 0.3
"""Share of an outline that other objects may hold."""
_LESS_HIDDEN = 0.1
"""Share of an object by which less must be hidden in the late still for its outline to be taken there."""


def find_static_object(search: StaticSearch) -> tuple[Bool[np.ndarray, "h w"], float] | None:
    """Return the thing that the phrase means, and how likely it is the right one; None where nothing stands.

    It is the candidate from which most overlap with the named object can be expected: a whole
    rather than its likelier half.
    """
    found = _with_outlines(search, candidates(search))
    if not found:
        return None
    weights = learned()
    rating = np.array([one.rating for one in found])
    likely = softmax(rating)
    overlaps = overlaps_of(found)
    k = int((overlaps @ softmax(_SOFTER * rating)).argmax())
    best = found[k]
    mask = best.mask
    said = {"offset": 1.0, "odds": odds_of(likely, overlaps[k])}
    if KINDS[search.kind].locates_other:
        odds = weighted(weights["sure"], {**said, **best.cues})
    else:
        odds = weighted(weights["aside"], said)
    if noun_for(search.phrase).handled:
        alike = [c.mask for c in found if c.outlined == best.outlined]
        mask = max((m for m in alike if _is_with_handle(m, mask)), key=np.sum)
    if not best.outlined:
        mask = _outlined(search, mask)
    return mask, float(1 / (1 + np.exp(-odds)))


def overlaps_of(found: list[StaticCandidate]) -> Float[np.ndarray, "n n"]:
    """Return how far each candidate overlaps each (IoU)."""
    masks = np.stack([one.mask.ravel() for one in found]).astype(np.float32)
    common, area = masks @ masks.T, masks.sum(1)
    return common / np.maximum(1, area[:, None] + area - common)


def odds_of(likely: Float[np.ndarray, "n"], alike: Float[np.ndarray, "n"]) -> float:
    """Return the log odds of the likeliest candidate and those like it among all.

    `alike` is how far each overlaps it.
    """
    share = float(np.clip(likely[alike > _ALIKE].sum(), _LEAST_CHANCE, 1 - _LEAST_CHANCE))
    return float(np.log(share / (1 - share)))


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


def _is_with_handle(mask: Bool[np.ndarray, "h w"], body: Bool[np.ndarray, "h w"]) -> bool:
    """Return whether a mask is that body, alone or with no more beside it than a handle."""
    return (
        mask & body
    ).sum() >= _SAME * body.sum() and mask.sum() <= _MOST_WITH_HANDLE * body.sum()


def _masks(
    static: Float32[np.ndarray, "h w"],
    off_table: Bool[np.ndarray, "h w"],
    free: Bool[np.ndarray, "h w"],
    colour: Float32[np.ndarray, "h w"] | None,
) -> Iterator[tuple[Bool[np.ndarray, "h w"], bool]]:
    """Yield candidates, each with whether it is cut out of a larger one: by a neck, or by its colour."""
    sets = [(tidy((static > level) & free), False, _MOST_SEEN_SHARE) for level in _LEVELS]
    sets.append((tidy(off_table & free, 5), False, MOST_SHARE))
    if colour is not None:
        named = free & (colour > 0.5)
        sets += [
            (tidy(pixels & named, 5), True, MOST_SHARE)
            for pixels in (off_table, *(static > level for level in _LEVELS[1:]))
        ]
    known: list[Bool[np.ndarray, "h w"]] = []
    least = _LEAST_SHARE * free.size
    for pixels, is_part, most_share in sets:
        for whole in connected_parts(pixels, least, most_share * free.size):
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

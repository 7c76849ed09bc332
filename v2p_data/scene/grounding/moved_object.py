"""The manipulated object: found by the network, by change, or where a person marked it, then tracked from end to end."""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from v2p_data.errors import ItemRejectedError
from v2p_data.scene.data_types import ObjectTrack
from v2p_data.scene.frames.classes import MOVED, TABLE
from v2p_data.scene.frames.colour import histogram
from v2p_data.scene.frames.mask_ops import grow, largest
from v2p_data.scene.frames.segmentation import LEAST_SHARE, Segmentation, share_at_first
from v2p_data.scene.frames.table import Table
from v2p_data.scene.frames.working_clip import WorkingClip
from v2p_data.scene.grounding.brought import find_brought, tracked_back
from v2p_data.scene.grounding.hint_masks import HintMask
from v2p_data.scene.grounding.moved_by_change import Moved, find_moved_by_change
from v2p_data.scene.grounding.moved_by_network import Marked, find_moved_by_network, rated
from v2p_data.scene.grounding.outlines import disjoint_ends, without_shadow
from v2p_data.scene.grounding.tracking import track
from v2p_data.video.clip import Clip
from v2p_data.video.meaning import Meaning

_CHANGE_TELLS = 4.0
"""Score from which the heuristics (`moved_by_change`) count as a second opinion; below about 4.5 most findings were wrong."""
_CLEARLY_BETTER = 1.6
"""Ratio of ratings by the network's own cues, from which the heuristics' finding is preferred to the network's."""
_LIES_WITHIN = 0.8
"""Share of one outline in the other, from which both show the same object, one of them with something beside it."""
_AS_A_PART = 0.5
"""Least overlap that counts where the network's outline lies within the heuristics' one."""
_AS_A_PIECE = 0.35
"""Least overlap that counts where the heuristics' outline lies within the network's: it is the most colourful piece."""
_NO_OPINION = 0.75
"""Factor on the network's score where the heuristics have no opinion."""
_NO_OPINION_OF_WHOLE = 0.85
"""The same where a model that knows edges of objects drew both outlines: nothing else was taken along."""
_SURE_OF_WHOLE = 0.35
"""Exponent of the rating where a model drew both outlines, 0.5 otherwise: then what else lowers the rating says less about them."""
_LITTLE = 0.2
"""Share of an object's first outline; when no more than this is seen, the object is hidden."""
_TOUCH_PX = 6
"""Distance in a picture 320 px wide, within which an object reaches the one it goes into."""


def find_moved_object(
    clip: Clip,
    working: WorkingClip,
    table: Table,
    segmentation: Segmentation | None,
    meaning: Meaning,
    tool: str,
    marked: dict[str, HintMask],
) -> tuple[Moved, Moved | None]:
    mark = marked.get(meaning.manipulated)
    at_end = mark is not None and mark.at_end(working)
    first = mark.mask if mark and not at_end else None
    last = mark.mask if mark and at_end else None
    colour_hist = None
    if mark is not None and segmentation is not None and mark.on_its_way(working):
        first, last, colour_hist = None, None, histogram(working.rgb[mark.frame][mark.mask])
    moved, tool_moved = None, None
    if segmentation is not None:
        goal = next(
            (marked[phrase].mask for phrase, _ in meaning.others if phrase in marked), None
        )
        found = find_moved_by_network(
            working,
            segmentation,
            meaning.manipulated,
            meaning.kind,
            tool,
            Marked(first=first, last=last, goal=goal, colour_hist=colour_hist),
        )
        moved, tool_moved = found or (None, None)
    if moved is None or (mark is None and not tool):
        by_change = find_moved_by_change(
            working, table, meaning.manipulated, meaning.kind, first=first, last=last
        )
        moved = (
            by_change
            if moved is None or segmentation is None
            else _agreed(working, segmentation, meaning, moved, by_change)
        )
    if moved is None:
        check_there_at_first(clip, meaning.manipulated, segmentation)
        raise ItemRejectedError(
            "object_not_found", f"nothing that moved looks like '{meaning.manipulated}'", None
        )
    given = [
        end for end, mask in enumerate((first, last)) if mask is not None or end in moved.outlined
    ]
    if segmentation is not None:
        moved = _without_shadows(working, segmentation, moved, given)
    return disjoint_ends(working, moved, given), tool_moved


def _without_shadows(
    working: WorkingClip, segmentation: Segmentation, moved: Moved, keep: Sequence[int]
) -> Moved:
    """Return both outlines without what the network surely sees as table; those in `keep` are taken as they are."""
    first, last = (
        mask if end in keep else without_shadow(mask, segmentation.at(i))
        for end, (mask, i) in enumerate(
            ((moved.first, 0), (moved.last, int(segmentation.idx[-1])))
        )
    )
    return replace(moved, first=first, last=last, colour_hist=histogram(working.rgb[0][first]))


def _agreed(
    working: WorkingClip,
    segmentation: Segmentation,
    meaning: Meaning,
    moved: Moved,
    by_change: Moved | None,
) -> Moved:
    """Return what the network found, weighed by what colours and vanishing edges say.

    The two ways err differently: the network takes people who move for things; the other takes shadows and hands along.
    What the other found is preferred where it is clearly better by the network's own cues.
    """
    whole = moved.outlined == (0, 1)
    if by_change is None or by_change.score < _CHANGE_TELLS:
        opinion = _NO_OPINION_OF_WHOLE if whole else _NO_OPINION
        return _with_opinion(moved, opinion)
    if by_change.first.any() and by_change.last.any():
        other = rated(working, segmentation, meaning.manipulated, meaning.kind, by_change)
        if other.score > _CLEARLY_BETTER * moved.score:
            rivalry = float(1 / (1 + (moved.score / other.score) ** 2))
            cues = {**other.cues, "no rival": rivalry}
            return replace(other, score=other.score * rivalry, cues=cues)
    overlaps = []
    for own, other in ((moved.first, by_change.first), (moved.last, by_change.last)):
        common = float((own & other).sum())
        overlap = common / max(1.0, float((own | other).sum()))
        if common > _LIES_WITHIN * own.sum():
            overlap = max(overlap, _AS_A_PART)
        elif common > _LIES_WITHIN * other.sum():  # its most colourful piece
            overlap = max(overlap, _AS_A_PIECE)
        overlaps.append(overlap)
    opinion = float(np.clip(0.55 + 0.75 * max(0.0, overlaps[0]), 0, 1)) * float(
        np.clip(0.75 + 0.5 * overlaps[1], 0, 1)
    )
    if whole:
        opinion = max(opinion, _NO_OPINION)
    return _with_opinion(moved, opinion)


def _with_opinion(moved: Moved, opinion: float) -> Moved:
    """Return what was found with a second opinion."""
    cues = {**moved.cues, "second opinion": opinion}
    return replace(moved, score=moved.score * opinion, cues=cues)


def brought_object(
    thing: ObjectTrack, working: WorkingClip, segmentation: Segmentation, mark: HintMask | None
) -> tuple[ObjectTrack, Moved]:
    """Return what a hand brings and leaves, with its outlines.

    Raises:
        ItemRejectedError: `object_not_found`, where nothing in the clip does that.
    """
    moved = find_brought(working, segmentation, thing.phrase, mark)
    if mark is None:
        moved = _with_opinion(moved, _NO_OPINION)
        shares = segmentation.at(len(working.rgb) - 1)
        last = moved.last if moved.outlined else without_shadow(moved.last, shares)
        moved = replace(moved, last=last)
    sure, why = sureness_of(moved, segmentation, mark)
    thing = replace(thing, sure=sure, why=why, hinted=mark is not None)
    return tracked_back(thing, working, segmentation, moved, every_nth(working)), moved


def sureness_of(
    moved: Moved, segmentation: Segmentation | None, mark: HintMask | None
) -> tuple[float, str]:
    if mark is not None:
        return mark.sure, ""
    if segmentation is None or "no rival" not in moved.cues:
        return rise(moved.score, 3.6, 0.8), f"its cues add up to {moved.score:.1f}"
    weakest = min(moved.cues, key=lambda cue: moved.cues[cue])
    sure = moved.score ** (_SURE_OF_WHOLE if moved.outlined == (0, 1) else 0.5)
    return sure, f"weakest is '{weakest}' with {moved.cues[weakest]:.2f}"


def tracked_mover(
    thing: ObjectTrack,
    working: WorkingClip,
    segmentation: Segmentation | None,
    moved: Moved,
    mark: HintMask | None,
) -> ObjectTrack:
    """Return a thing that moves, followed from its first outline to its last."""
    sure, why = sureness_of(moved, segmentation, mark)
    tracked = track(
        working,
        moved,
        every=every_nth(working),
        moving=None if segmentation is None else lambda i: segmentation.at(i)[MOVED],
        bare=None if segmentation is None else lambda i: segmentation.at(i)[TABLE],
    )
    if mark is not None and mark.on_its_way(working):
        tracked.masks[mark.frame], tracked.quality[mark.frame] = mark.mask, 1.0
    return replace(
        thing,
        masks=tracked.masks,
        quality=tracked.quality,
        agreement=tracked.agreement,
        moves=True,
        sure=sure,
        why=why,
        hinted=mark is not None,
    )


def every_nth(working: WorkingClip) -> int:
    """Return every how-manieth frame is tracked."""
    return 1 if len(working.rgb) < 80 else 2


def hidden_in_container(
    segmentation: Segmentation, thing: ObjectTrack, other: ObjectTrack
) -> ObjectTrack:
    """Return the thing as last seen, where it goes into the other and nothing that moved is seen at the end: bins are deep.

    Where the user marked the other, only what is seen there counts: hands and legs uncover things elsewhere.
    """
    little = _LITTLE * float(thing.first.sum())
    goal = grow(other.first, _TOUCH_PX)
    left = segmentation.at(len(thing.masks) - 1)[MOVED] > 0.5
    if not other.noun.hollow or (left & goal if other.hinted else left).sum() > little:
        return thing
    entering = [
        (int(i), mask)
        for i in segmentation.idx[len(segmentation.idx) // 3 :]
        if (mask := (segmentation.at(int(i))[MOVED] > 0.5) & goal).sum() > little
    ]
    if not entering:
        return thing
    i, mask = entering[-1]
    masks, quality = thing.masks.copy(), thing.quality.copy()
    masks[i:], quality[i + 1 :] = largest(mask), 0.0
    return replace(thing, masks=masks, quality=quality, hidden_in_container=True)


def check_there_at_first(clip: Clip, phrase: str, segmentation: Segmentation | None) -> None:
    seen = None if segmentation is None else share_at_first(segmentation)
    if seen is not None:
        raise ItemRejectedError(
            "not_there_at_first",
            f"the moving object of {clip.item} is not in the picture when it begins (it covers {seen:.2%} of it, at least {LEAST_SHARE:.2%} "
            f"needed): let the clip begin where '{phrase}' lies on the table",
            round(seen, 5),
        )


def rise(x: float, middle: float, width: float) -> float:
    return float(1 / (1 + np.exp(-(x - middle) / width)))

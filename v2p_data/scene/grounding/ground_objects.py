"""Which pixels are which object of the caption, in every frame: grounding, then segmentation, by the chosen backends.

A user's box, points or a detector's box say where an object is in one frame; without them what moved and what stands
there decides. Everything works at working size.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Bool

from v2p_data.errors import ItemRejectedError
from v2p_data.kinds import KINDS
from v2p_data.scene.data_types import GroundedObjects, ObjectTrack
from v2p_data.scene.frames.classes import HAND, MOVED, TABLE
from v2p_data.scene.frames.colour import histogram
from v2p_data.scene.frames.mask_ops import bounding_box, grow, largest
from v2p_data.scene.frames.segmentation import (
    LEAST_SHARE,
    Segmentation,
    hand_at,
    share_at_first,
    table_seen,
)
from v2p_data.scene.frames.table import Table, find_table
from v2p_data.scene.frames.working_clip import WorkingClip
from v2p_data.scene.grounding.held_tool import HeldTool, find_tool
from v2p_data.scene.grounding.hint_masks import Box, HintMask, hint_masks_of
from v2p_data.scene.grounding.moved_by_change import (
    Moved,
    find_moved_by_change,
    find_static_by_change,
)
from v2p_data.scene.grounding.moved_by_network import find_moved_by_network, rated
from v2p_data.scene.grounding.outlines import disjoint_ends, without_shadow
from v2p_data.scene.grounding.static_objects import StaticSearch, find_static_object
from v2p_data.scene.grounding.tracking import carried, track
from v2p_data.scene.scale.nouns import noun_for
from v2p_data.scene.schema import Role
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
_LEAST_HAND = 0.002
"""Least share of the picture that a hand covers in the frame that shows most of it."""
_LITTLE = 0.2
"""Share of an object's first outline; when no more than this is seen, the object is hidden."""
_TOUCH_PX = 6
"""Distance in a picture 320 px wide, within which an object reaches the one it goes into."""
_BELOW_PX = 5
"""Depth of the strip below an object in which the network must see table."""
_SEEN_BELOW = 0.5
"""Mean probability of table in that strip, from which the object stands on the table."""
_SETS_OUT = 0.05
"""Share of its way that a pushed object has gone when it moves."""
_WELL_SEEN = 0.6
"""Share of a tool's largest area, from which a frame shows the tool well."""


def ground_objects(
    clip: Clip,
    working: WorkingClip,
    meaning: Meaning,
    segmentation: Segmentation | None,
    min_found: float,
    boxes: Mapping[str, Box] | None = None,
) -> GroundedObjects:
    """Return the masks of all objects that the caption names.

    `segmentation` is what the network sees, where it was asked; `boxes` are what a detector says, by phrase: a user's hint
    for the phrase goes before it.

    Raises:
        ItemRejectedError: `no_hand`, `not_there_at_first`, `object_not_found` or `reference_not_found`, with the number that decided.
    """
    if segmentation is not None:
        _check_hand(clip, segmentation)
        working = _knowing_hand(working, segmentation)
    table = find_table(working.always, table_seen(segmentation) if segmentation else None)
    marked = hint_masks_of(clip, working, segmentation, boxes or {})
    tool = next((phrase for phrase, role in meaning.others if role == "tool"), "")
    own = marked.get(meaning.manipulated)
    if own is not None and own.at_end(working):
        _check_there_at_first(clip, meaning.manipulated, segmentation)
    moved, tool_moved = _find_moved(clip, working, table, segmentation, meaning, tool, marked)
    sure, why = _sureness(moved, segmentation, own)
    if sure < min_found:
        _check_there_at_first(clip, meaning.manipulated, segmentation)
        raise ItemRejectedError(
            "object_not_found",
            f"the best match for '{meaning.manipulated}' in {clip.item} is sure to {sure:.3f}, below {min_found:g} "
            f"({why}); mark it, and each other object of the caption, with a box in captions.json",
            round(sure, 3),
        )
    if segmentation is None:
        working = working.knowing(moved.colour_hist)
    thing = _moved_object(
        _unseen_object(clip, meaning.manipulated, "manipulated"), working, segmentation, moved, own
    )
    moved = replace(moved, last=thing.masks[-1])
    scene = _Scene(clip, working, table, segmentation, meaning, moved, thing, min_found)
    objects, warnings = [thing], list[str]()
    taken = np.zeros(working.shape, bool)
    for phrase, role in meaning.others:
        thing, mark = _unseen_object(clip, phrase, role), marked.get(phrase)
        if role == "tool" and (segmentation is not None or mark is not None):
            seen = _tool(scene, thing, mark, tool_moved)
        else:
            seen = _static_object(scene, thing, mark, taken)
        if seen is None:
            warnings.append(f"the '{phrase}' was not found and is left out")
            continue
        if not seen.moves:
            taken |= grow(seen.first, 2)
        objects.append(seen)
    may_be_hidden = own is None or not own.at_end(working)
    if segmentation is not None and KINDS[meaning.kind].hides and may_be_hidden and objects[1:]:
        objects[0] = hidden_in_container(segmentation, objects[0], objects[1])
    return GroundedObjects(
        objects=tuple(objects),
        working=working,
        table=table,
        segmentation=segmentation,
        warnings=tuple(warnings),
    )


def without_asides(
    grounded: GroundedObjects, meaning: Meaning, clip: Clip
) -> tuple[list[int], tuple[str, ...]]:
    """Return the numbers of the objects without those of which the caption does not speak, and a warning for each of these.

    What is only listed beside the caption of a lift, push or tip is no part of the task: such a scene makes sense without it.
    """
    left_out = [
        k
        for k, s in enumerate(grounded.objects)
        if k
        and KINDS[meaning.kind].other == "ignored"
        and not (s.hinted or _is_said(s.phrase, clip))
    ]
    return [k for k in range(len(grounded.objects)) if k not in left_out], tuple(
        f"the '{grounded.objects[k].phrase}', of which the caption does not speak, was not found surely enough and is left out"
        for k in left_out
    )


def _is_said(phrase: str, clip: Clip) -> bool:
    return phrase.lower() in clip.caption.lower()


@dataclass(frozen=True)
class _Scene:
    """What the search for the other objects goes by."""

    clip: Clip
    working: WorkingClip
    table: Table
    segmentation: Segmentation | None
    meaning: Meaning
    moved: Moved
    mover: ObjectTrack
    """The manipulated object."""
    min_found: float


def _moved_object(
    thing: ObjectTrack,
    working: WorkingClip,
    segmentation: Segmentation | None,
    moved: Moved,
    mark: HintMask | None,
) -> ObjectTrack:
    """Return a thing that moves, followed from its first outline to its last."""
    sure, why = _sureness(moved, segmentation, mark)
    tracked = track(
        working,
        moved,
        every=_every(working),
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


def _every(working: WorkingClip) -> int:
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


def _tool(
    scene: _Scene, thing: ObjectTrack, mark: HintMask | None, tool_moved: Moved | None
) -> ObjectTrack | None:
    """Return a tool: in a hand that brings it, else what moves as well, or what is marked, followed.

    None where it is not found and the caption can do without.

    Raises:
        ItemRejectedError: `reference_not_found`.
    """
    found, sure = None, 0.0
    if scene.segmentation is not None:
        box = None if mark is None else (mark.frame, mark.box)
        found = find_tool(scene.working, scene.segmentation, scene.mover.masks, thing.noun, box)
    if found is not None:
        sure = found.sure if mark is None else mark.sure
    if found is not None and sure >= scene.min_found:
        return replace(
            thing,
            masks=found.masks,
            quality=found.quality,
            moves=True,
            at=_first_pushing(found, scene.mover),
            sure=sure,
            why=found.why,
            hinted=mark is not None,
            in_hand=True,
        )
    seen = None
    if mark is not None:
        seen = _marked_tool(scene, thing, mark)
    elif tool_moved is not None:
        seen = _moved_object(thing, scene.working, scene.segmentation, tool_moved, mark)
    if seen is None:
        _check_needed(scene, thing.phrase, sure)
    return seen


def _first_pushing(tool: HeldTool, pushed: ObjectTrack) -> int:
    """Return the working frame that shows a tool first and well while what it pushes moves, or shortly before or after."""
    spots = {i: np.argwhere(m).mean(0) for i, m in enumerate(pushed.masks) if m.any()}
    start = np.argwhere(pushed.first).mean(0)
    way = np.argwhere(pushed.last).mean(0) - start
    gone = {i: float((spot - start) @ way) / max(1e-6, way @ way) for i, spot in spots.items()}
    moves = [i for i, share in gone.items() if _SETS_OUT < share < 1 - _SETS_OUT]
    if not moves:
        return tool.at
    area = tool.masks.sum((1, 2)) * (tool.quality > 0)
    around = range(max(0, moves[0] - 1), min(len(area), moves[-1] + 2))
    seen = [i for i in around if area[i]]
    return next((i for i in seen if area[i] > _WELL_SEEN * area[seen].max()), tool.at)


def _marked_tool(scene: _Scene, thing: ObjectTrack, mark: HintMask) -> ObjectTrack | None:
    """Return a marked tool, followed from that frame on; None where the mark is empty."""
    if not mark.mask.any():
        return None
    working, segmentation = scene.working, scene.segmentation
    tracked = carried(
        working,
        mark.mask,
        mark.frame,
        every=_every(working),
        moving=None
        if segmentation is None
        else lambda i: segmentation.at(i)[MOVED] + 0.5 * segmentation.at(i)[HAND],
    )
    return replace(
        thing,
        masks=tracked.masks,
        quality=tracked.quality,
        moves=True,
        at=mark.frame,
        sure=mark.sure,
        hinted=True,
        in_hand=True,
    )


def _static_object(
    scene: _Scene, thing: ObjectTrack, mark: HintMask | None, taken: Bool[np.ndarray, "h w"]
) -> ObjectTrack | None:
    """Return a thing that stands still; None where it is not found and the caption can do without.

    Raises:
        ItemRejectedError: `reference_not_found`.
    """
    phrase, kind, segmentation = thing.phrase, scene.meaning.kind, scene.segmentation
    late = kind == "uncover" if mark is None else mark.frame > 0
    if mark is not None:
        mask, sure = mark.mask, mark.sure
    else:
        if segmentation is not None:
            search = StaticSearch(
                working=scene.working,
                table=scene.table,
                segmentation=segmentation,
                phrase=phrase,
                moved=scene.mover.noun,
                kind=kind,
                ends=(scene.moved.first, scene.moved.last),
                taken=taken,
            )
            found = find_static_object(search)
            sure = found.score if found else 0.0
        else:
            found = find_static_by_change(
                scene.working, scene.table, phrase, kind, scene.moved, taken
            )
            sure = _rise(found.score, 1.0, 0.5) if found else 0.0
        mask = found.mask if found else np.zeros_like(taken)
    if sure < scene.min_found or not mask.any():
        _check_needed(scene, phrase, sure)
        return None
    masks = _less_what_passes(scene, mask)
    at = len(masks) - 1 if late else 0
    masks[at] = mask
    return replace(
        thing,
        masks=masks,
        quality=masks.sum((1, 2)) / max(1, mask.sum()),
        at=at,
        sure=sure,
        why="" if mark else "what stands there fits the words only so far",
        hinted=mark is not None,
    )


def _check_needed(scene: _Scene, phrase: str, sure: float) -> None:
    """Turn away a clip whose task makes no sense without an object that was not found."""
    clip = scene.clip
    if _is_said(phrase, clip) and KINDS[scene.meaning.kind].other != "ignored":
        raise ItemRejectedError(
            "reference_not_found",
            f"the '{phrase}' was not found in {clip.item} (sure to {sure:.3f}, below {scene.min_found:g}); mark it with a box in captions.json",
            round(sure, 3),
        )


def _unseen_object(clip: Clip, phrase: str, role: Role) -> ObjectTrack:
    """Return an object of which nothing is seen yet."""
    hint = clip.hints.get(phrase, {})
    size = hint.get("size_m")
    return ObjectTrack(
        phrase=phrase,
        role=role,
        noun=noun_for(hint.get("name") or phrase),
        masks=np.zeros((0, 0, 0), bool),
        quality=np.zeros(0),
        moves=False,
        at=0,
        known_m=(size[0], size[1], size[2]) if size else None,
        sure=0.0,
        why="",
    )


def _check_hand(clip: Clip, segmentation: Segmentation) -> None:
    most = float((segmentation.shares[:, HAND] > 0.5).mean((1, 2)).max())
    if most < _LEAST_HAND:
        raise ItemRejectedError(
            "no_hand",
            f"no hand is seen in {clip.item}: it covers {most:.2%} of the picture at most; what moves by itself shows no "
            "manipulation",
            round(most, 5),
        )


def _check_there_at_first(clip: Clip, phrase: str, segmentation: Segmentation | None) -> None:
    seen = None if segmentation is None else share_at_first(segmentation)
    if seen is not None:
        raise ItemRejectedError(
            "not_there_at_first",
            f"what moves in {clip.item} is not in the picture when it begins (it covers {seen:.2%} of it, at least {LEAST_SHARE:.2%} "
            f"needed): let the clip begin where '{phrase}' lies on the table",
            round(seen, 5),
        )


def _knowing_hand(working: WorkingClip, segmentation: Segmentation) -> WorkingClip:
    """Return the working clip with the colours of the hand that the network saw."""
    pixels = [working.rgb[i][hand_at(segmentation, int(i))] for i in segmentation.idx]
    hand = np.concatenate(pixels)
    if len(hand) < 300:
        return working
    return replace(
        working, hand_hist=histogram(hand[:: max(1, len(hand) // 60000)]), skin_only=False
    )


def _find_moved(
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
            first,
            last,
            goal,
            colour_hist,
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
        _check_there_at_first(clip, meaning.manipulated, segmentation)
        raise ItemRejectedError(
            "object_not_found", f"nothing that moved looks like '{meaning.manipulated}'", None
        )
    given = [end for end, mask in enumerate((first, last)) if mask is not None]
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
    if by_change is None or by_change.score < _CHANGE_TELLS:
        return replace(
            moved,
            cues={**moved.cues, "second opinion": _NO_OPINION},
            score=_NO_OPINION * moved.score,
        )
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
    cues = {**moved.cues, "second opinion": opinion}
    return replace(moved, score=moved.score * opinion, cues=cues)


def _sureness(
    moved: Moved, segmentation: Segmentation | None, mark: HintMask | None
) -> tuple[float, str]:
    if mark is not None:
        return mark.sure, ""
    if segmentation is None or "no rival" not in moved.cues:
        return _rise(moved.score, 3.6, 0.8), f"its cues add up to {moved.score:.1f}"
    weakest = min(moved.cues, key=lambda cue: moved.cues[cue])
    sure = moved.score**0.5
    return sure, f"weakest is '{weakest}' with {moved.cues[weakest]:.2f}"


def _less_what_passes(
    scene: _Scene, mask: Bool[np.ndarray, "h w"]
) -> Bool[np.ndarray, "time h w"]:
    """Return a standing thing's mask over time, less what passes in front of it."""
    out = np.repeat(mask[None], len(scene.mover.masks), axis=0)
    for i, hidden in enumerate(scene.mover.masks):
        if scene.segmentation is not None:
            shares = scene.segmentation.at(i)
            hidden = hidden | (shares[HAND] + shares[MOVED] > 0.5)
        out[i] &= ~hidden
    return out


def rests_on_table(
    table: Table, mask: Bool[np.ndarray, "h w"], segmentation: Segmentation | None = None
) -> bool:
    """Return whether the mask's foot lies on the table's part of the picture, or the network sees table beneath it."""
    x, y, w, h = bounding_box(mask)
    foot = np.zeros_like(mask)
    foot[y + int(0.75 * h) : y + h, x : x + w] = True
    foot &= mask
    if float((foot & grow(table.hull, 6)).sum()) > 0.3 * float(foot.sum()):
        return True
    if segmentation is None:
        return False
    below = grow(foot, _BELOW_PX) & ~grow(mask, 1)
    below[: y + int(0.75 * h)] = False
    return bool(below.any()) and float(segmentation.early[TABLE][below].mean()) > _SEEN_BELOW


def _rise(x: float, middle: float, width: float) -> float:
    return float(1 / (1 + np.exp(-(x - middle) / width)))

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
from v2p_data.scene.frames.mask_ops import bounding_box, grow
from v2p_data.scene.frames.segmentation import Segmentation, hand_at, table_seen
from v2p_data.scene.frames.table import Table, find_table
from v2p_data.scene.frames.working_clip import WorkingClip
from v2p_data.scene.grounding.brought import seen_backwards
from v2p_data.scene.grounding.candidates import Moved
from v2p_data.scene.grounding.marked_table import with_marked_table
from v2p_data.scene.grounding.methods.base import Mark, Method, Seen
from v2p_data.scene.grounding.methods.hint import Hints
from v2p_data.scene.grounding.moved_object import (
    brought_object,
    check_there_at_first,
    every_nth,
    find_moved_object,
    hidden_in_container,
    sureness_of,
    tracked_mover,
)
from v2p_data.scene.grounding.static_cues import StaticSearch
from v2p_data.scene.grounding.static_objects import find_static_object
from v2p_data.scene.grounding.tracking import carried
from v2p_data.scene.scale.nouns import noun_for
from v2p_data.scene.schema import Role
from v2p_data.video.clip import Clip
from v2p_data.video.meaning import Meaning

_LEAST_HAND = 0.002
"""Least share of the picture that a hand covers in the frame that shows most of it."""
_BELOW_PX, _GAP_PX, EXACT_GAP_PX = 5, 1, 3
"""Depth of the strip below an object in which the network must see table, and where it begins;
below a model's exact outline later."""
_SEEN_BELOW, _FOOT_ON_TABLE = 0.5, 0.3
"""Mean probability of table in that strip, and share of the foot within the table's part, from
which the object rests on the table."""


@dataclass(frozen=True)
class _Scene:
    """What the search for the other objects goes by."""

    clip: Clip
    working: WorkingClip
    table: Table
    segmentation: Segmentation
    meaning: Meaning
    moved: Moved
    mover: ObjectTrack
    """The manipulated object."""
    min_found: float


def ground_objects(
    clip: Clip,
    working: WorkingClip,
    meaning: Meaning,
    segmentation: Segmentation,
    min_found: float,
    methods: Sequence[Method] = (Hints(),),
) -> GroundedObjects:
    """Return the masks of all objects that the caption names.

    `segmentation` is what the network sees; `methods` mark objects before it is asked, the later
    ones before the earlier ones.

    Raises:
        ItemRejectedError: `no_hand`, `not_there_at_first`, `bad_hint`, `object_not_found` or
            `reference_not_found`, with the number that
            decided.
    """
    check_hand(clip, working, segmentation)
    segmentation = with_marked_table(clip, working, segmentation)
    working = _knowing_hand(working, segmentation)
    table = find_table(working.always, table_seen(segmentation))
    marked = dict[str, Mark]()
    for method in methods:
        marked |= method.marks(
            Seen(clip=clip, working=working, segmentation=segmentation), meaning.phrases
        )
    tool = next((phrase for phrase, role in meaning.others if role == "tool"), "")
    own = marked.get(meaning.manipulated)
    if own is not None and own.at_end(working):
        check_there_at_first(clip, meaning.manipulated, segmentation)
    moved, tool_moved = find_moved_object(clip, working, segmentation, meaning, tool, marked)
    sure, why = sureness_of(moved, own)
    if sure < min_found:
        check_there_at_first(clip, meaning.manipulated, segmentation)
        raise ItemRejectedError(
            "object_not_found",
            f"the best match for '{meaning.manipulated}' in {clip.item} is sure to {sure:.3f}, below {min_found:g} "
            f"({why}); mark it, and each other object of the caption, with a box in captions.json",
            round(sure, 3),
        )
    thing = tracked_mover(
        _unseen_object(clip, meaning.manipulated, "manipulated"), working, segmentation, moved, own
    )
    moved = replace(moved, last=thing.masks[-1])
    scene = _Scene(clip, working, table, segmentation, meaning, moved, thing, min_found)
    others, warnings = _others(scene, marked, tool_moved)
    objects = [thing, *others]
    may_be_hidden = own is None or not own.at_end(working)
    if KINDS[meaning.kind].hides and may_be_hidden and objects[1:]:
        objects[0] = hidden_in_container(segmentation, objects[0], objects[1])
    return GroundedObjects(
        objects=tuple(objects),
        working=working,
        table=table,
        segmentation=segmentation,
        warnings=warnings,
    )


def ground_brought(
    clip: Clip,
    working: WorkingClip,
    meaning: Meaning,
    min_found: float,
) -> GroundedObjects:
    """Return the masks of all objects of a clip in which a hand brings the manipulated one.

    Raises:
        ItemRejectedError: `bad_hint`, `object_not_found` or `reference_not_found`.
    """
    segmentation = with_marked_table(clip, working, seen_backwards(clip, working))
    working = _knowing_hand(working, segmentation)
    marked = Hints().marks(Seen(clip=clip, working=working, segmentation=segmentation))
    thing = _unseen_object(clip, meaning.manipulated, "manipulated")
    own = marked.get(meaning.manipulated)
    thing, moved = brought_object(thing, working, segmentation, own)
    if thing.sure < min_found:
        raise ItemRejectedError(
            "object_not_found", f"no hand surely brings '{thing.phrase}'", round(thing.sure, 3)
        )
    table = find_table(working.always, table_seen(segmentation))
    scene = _Scene(clip, working, table, segmentation, meaning, moved, thing, min_found)
    others, warnings = _others(scene, marked, None)
    return GroundedObjects(
        objects=(thing, *others),
        working=working,
        table=table,
        segmentation=segmentation,
        warnings=warnings,
    )


def _others(
    scene: _Scene, marked: Mapping[str, Mark], tool_moved: Moved | None
) -> tuple[list[ObjectTrack], tuple[str, ...]]:
    """Return the caption's other objects, and a warning for each that is left out.

    Raises:
        ItemRejectedError: `reference_not_found`.
    """
    found, warnings = list[ObjectTrack](), list[str]()
    taken = np.zeros(scene.working.shape, bool)
    for phrase, role in scene.meaning.others:
        thing, mark = _unseen_object(scene.clip, phrase, role), marked.get(phrase)
        if role == "tool":
            seen = _tool(scene, thing, mark, tool_moved)
        else:
            seen = _static_object(scene, thing, mark, taken)
        if seen is None:
            warnings.append(f"the '{phrase}' was not found and is left out")
            continue
        if not seen.moves:
            taken |= grow(seen.first, 2)
        found.append(seen)
    return found, tuple(warnings)


def without_asides(
    grounded: GroundedObjects, meaning: Meaning, clip: Clip
) -> tuple[list[int], tuple[str, ...]]:
    """Return the numbers of the objects that the caption names, and a warning for each other one.

    What is only listed beside the caption of a lift, push or tip is no part of the task: such a
    scene makes sense without it.
    """
    left_out = [
        k
        for k, s in enumerate(grounded.objects)
        if k
        and KINDS[meaning.kind].other == "ignored"
        and not (s.hinted or _is_said(s.phrase, clip))
    ]
    return [k for k in range(len(grounded.objects)) if k not in left_out], tuple(
        f"the '{grounded.objects[k].phrase}', of which the caption does not speak, was not found "
        "surely enough and is left out"
        for k in left_out
    )


def _is_said(phrase: str, clip: Clip) -> bool:
    return phrase.lower() in clip.caption.lower()


def _tool(
    scene: _Scene, thing: ObjectTrack, mark: Mark | None, tool_moved: Moved | None
) -> ObjectTrack | None:
    """Return a tool: the marked one, or the second moving object.

    None where it is not found and the caption can do without.

    Raises:
        ItemRejectedError: `reference_not_found`.
    """
    if mark is not None and mark.mask.any():
        return _marked_tool(scene, thing, mark)
    if mark is None and tool_moved is not None:
        return tracked_mover(thing, scene.working, scene.segmentation, tool_moved, mark)
    _check_needed(scene, thing.phrase, 0.0)
    return None


def _marked_tool(scene: _Scene, thing: ObjectTrack, mark: Mark) -> ObjectTrack:
    """Return a marked tool, followed from that frame on."""
    working, segmentation = scene.working, scene.segmentation
    tracked = carried(
        working,
        mark.mask,
        mark.frame,
        every=every_nth(working),
        moving=lambda i: segmentation.at(i)[MOVED] + 0.5 * segmentation.at(i)[HAND],
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
    scene: _Scene, thing: ObjectTrack, mark: Mark | None, taken: Bool[np.ndarray, "h w"]
) -> ObjectTrack | None:
    """Return a thing that stands still; None where it is not found and the caption can do without.

    Raises:
        ItemRejectedError: `reference_not_found`.
    """
    phrase, kind = thing.phrase, scene.meaning.kind
    late = kind == "uncover" if mark is None else mark.frame > 0
    if mark is not None:
        mask, sure = mark.mask, mark.sure
    else:
        search = StaticSearch(
            working=scene.working,
            table=scene.table,
            segmentation=scene.segmentation,
            phrase=phrase,
            moved=scene.mover.noun,
            kind=kind,
            ends=(scene.moved.first, scene.moved.last),
            taken=taken,
        )
        mask, sure = find_static_object(search) or (np.zeros_like(taken), 0.0)
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
        why="" if mark else "the object there fits the words only so far",
        hinted=mark is not None,
    )


def _check_needed(scene: _Scene, phrase: str, sure: float) -> None:
    """Turn away a clip whose task makes no sense without an object that was not found."""
    clip = scene.clip
    if _is_said(phrase, clip) and KINDS[scene.meaning.kind].other != "ignored":
        raise ItemRejectedError(
            "reference_not_found",
            f"the '{phrase}' was not found in {clip.item} (sure to {sure:.3f}, below "
            f"{scene.min_found:g}); mark it with a box in captions.json",
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


def check_hand(clip: Clip, working: WorkingClip, segmentation: Segmentation) -> None:
    """Turn away a clip in which our network sees no hand.

    Raises:
        ItemRejectedError: `no_hand`, with the share of the picture that a hand covers at most.
    """
    most = float((segmentation.shares[:, HAND] > 0.5).mean((1, 2)).max())
    if most < _LEAST_HAND:
        where = clip.item if clip.crop is None else f"the part of {clip.item} that was taken"
        raise ItemRejectedError(
            "no_hand",
            f"no hand is seen in {where}: it covers {most:.2%} of the picture at most; motion without a hand shows no "
            "manipulation",
            round(most, 5),
        )


def _knowing_hand(working: WorkingClip, segmentation: Segmentation) -> WorkingClip:
    """Return the working clip with the colours of the hand that the network saw."""
    pixels = [working.rgb[i][hand_at(segmentation, int(i))] for i in segmentation.idx]
    hand = np.concatenate(pixels)
    if len(hand) < 300:
        return working
    return replace(working, hand_hist=histogram(hand[:: max(1, len(hand) // 60000)]))


def _less_what_passes(
    scene: _Scene, mask: Bool[np.ndarray, "h w"]
) -> Bool[np.ndarray, "time h w"]:
    """Return a standing thing's mask over time, less what passes in front of it."""
    out = np.repeat(mask[None], len(scene.mover.masks), axis=0)
    for i, hidden in enumerate(scene.mover.masks):
        shares = scene.segmentation.at(i)
        out[i] &= ~(hidden | (shares[HAND] + shares[MOVED] > 0.5))
    return out


def seen_on_table(
    table: Table,
    mask: Bool[np.ndarray, "h w"],
    segmentation: Segmentation,
    gap_px: int = _GAP_PX,
) -> float:
    """Return how far an object is seen to rest on the table, 0 to 1: by its foot, or by the table beneath it.

    Args:
        table: the table's part of the picture.
        mask: the object at the beginning.
        segmentation: what the network sees.
        gap_px: between the mask and the strip beneath it; what the network sees as object goes on
            a little beside an exact outline.
    """
    x, y, w, h = bounding_box(mask)
    foot = np.zeros_like(mask)
    foot[y + int(0.75 * h) : y + h, x : x + w] = True
    foot &= mask
    on_table = float((foot & grow(table.hull, 6)).sum() / max(1, foot.sum())) / _FOOT_ON_TABLE
    below = grow(foot, gap_px + _BELOW_PX - _GAP_PX) & ~grow(mask, gap_px)
    below[: y + int(0.75 * h)] = False
    beneath = float(segmentation.early[TABLE][below].mean()) if below.any() else 0.0
    return min(1.0, max(on_table, beneath / _SEEN_BELOW))

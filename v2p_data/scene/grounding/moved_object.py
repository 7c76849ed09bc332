"""The manipulated object: found by the network or where a person marked it, then tracked from end to end."""

from collections.abc import Sequence
from dataclasses import replace

from v2p_data.errors import ItemRejectedError
from v2p_data.scene.data_types import ObjectTrack
from v2p_data.scene.frames.classes import MOVED, TABLE
from v2p_data.scene.frames.colour import histogram
from v2p_data.scene.frames.mask_ops import grow, largest
from v2p_data.scene.frames.segmentation import LEAST_SHARE, Segmentation, share_at_first
from v2p_data.scene.frames.working_clip import WorkingClip
from v2p_data.scene.grounding.brought import find_brought, tracked_back
from v2p_data.scene.grounding.candidates import Moved
from v2p_data.scene.grounding.methods.base import Mark
from v2p_data.scene.grounding.moved_by_network import Given, find_moved_by_network
from v2p_data.scene.grounding.outlines import disjoint_ends, without_shadow
from v2p_data.scene.grounding.tracking import track
from v2p_data.video.clip import Clip
from v2p_data.video.meaning import Meaning

_ONE_END = 0.75
"""Factor on the score of what is seen at rest at the end alone."""
_SURE_OF_WHOLE = 0.35
"""Exponent of the rating where a model drew both outlines, 0.5 otherwise: then what else lowers
the rating says less about them."""
_LITTLE = 0.2
"""Share of an object's first outline; when no more than this is seen, the object is hidden."""
_TOUCH_PX = 6
"""Distance in a picture 320 px wide, within which an object reaches the one it goes into."""


def find_moved_object(
    clip: Clip,
    working: WorkingClip,
    segmentation: Segmentation,
    meaning: Meaning,
    tool: str,
    marked: dict[str, Mark],
) -> tuple[Moved, Moved | None]:
    """Return the manipulated object and, where the caption names one that a hand holds, the tool.

    Raises:
        ItemRejectedError: `not_there_at_first` or `object_not_found`.
    """
    mark = marked.get(meaning.manipulated)
    at_end = mark is not None and mark.at_end(working)
    first = mark.mask if mark and not at_end else None
    last = mark.mask if mark and at_end else None
    colour_hist = None
    if mark is not None and mark.on_its_way(working):
        first, last, colour_hist = None, None, histogram(working.rgb[mark.frame][mark.mask])
    goal = next((marked[phrase].mask for phrase, _ in meaning.others if phrase in marked), None)
    found = find_moved_by_network(
        working,
        segmentation,
        meaning.manipulated,
        meaning.kind,
        tool,
        Given(first=first, last=last, goal=goal, colour_hist=colour_hist),
    )
    if found is None:
        check_there_at_first(clip, meaning.manipulated, segmentation)
        raise ItemRejectedError(
            "object_not_found", f"nothing that moved looks like '{meaning.manipulated}'", None
        )
    moved, tool_moved = found
    given = [
        end for end, mask in enumerate((first, last)) if mask is not None or end in moved.outlined
    ]
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


def brought_object(
    thing: ObjectTrack, working: WorkingClip, segmentation: Segmentation, mark: Mark | None
) -> tuple[ObjectTrack, Moved]:
    """Return what a hand brings and leaves, with its outlines.

    Raises:
        ItemRejectedError: `object_not_found`, where nothing in the clip does that.
    """
    moved = find_brought(working, segmentation, thing.phrase, mark)
    if mark is None:
        cues = {**moved.cues, "seen at one end": _ONE_END}
        moved = replace(moved, score=moved.score * _ONE_END, cues=cues)
        shares = segmentation.at(len(working.rgb) - 1)
        last = moved.last if moved.outlined else without_shadow(moved.last, shares)
        moved = replace(moved, last=last)
    sure, why = sureness_of(moved, mark)
    thing = replace(thing, sure=sure, why=why, hinted=mark is not None)
    return tracked_back(thing, working, segmentation, moved, every_nth(working)), moved


def sureness_of(moved: Moved, mark: Mark | None) -> tuple[float, str]:
    """Return how sure a finding is, 0 to 1, and what speaks most against it."""
    if mark is not None:
        return mark.sure, ""
    weakest = min(moved.cues, key=lambda cue: moved.cues[cue])
    sure = moved.score ** (_SURE_OF_WHOLE if moved.outlined == (0, 1) else 0.5)
    return sure, f"weakest is '{weakest}' with {moved.cues[weakest]:.2f}"


def tracked_mover(
    thing: ObjectTrack,
    working: WorkingClip,
    segmentation: Segmentation,
    moved: Moved,
    mark: Mark | None,
) -> ObjectTrack:
    """Return a thing that moves, followed from its first outline to its last."""
    sure, why = sureness_of(moved, mark)
    tracked = track(
        working,
        moved,
        every=every_nth(working),
        moving=lambda i: segmentation.at(i)[MOVED],
        bare=lambda i: segmentation.at(i)[TABLE],
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
    """Return the step between the frames that are tracked."""
    return 1 if len(working.rgb) < 80 else 2


def hidden_in_container(
    segmentation: Segmentation, thing: ObjectTrack, other: ObjectTrack
) -> ObjectTrack:
    """Return the thing as last seen, where it goes into the other and is out of sight at the end.

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


def check_there_at_first(clip: Clip, phrase: str, segmentation: Segmentation) -> None:
    """Turn away a clip whose moving object comes into the picture only later.

    Raises:
        ItemRejectedError: `not_there_at_first`, with the share of the picture that it covers at first.
    """
    seen = share_at_first(segmentation)
    if seen is not None:
        raise ItemRejectedError(
            "not_there_at_first",
            f"the moving object of {clip.item} is not in the picture when it begins (it covers "
            f"{seen:.2%} of it, at least {LEAST_SHARE:.2%} "
            f"needed): let the clip begin where '{phrase}' lies on the table",
            round(seen, 5),
        )

"""An object as its tracks show it at both ends, and what may hide it there."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float, UInt8

from v2p_data.scene.data_types import ObjectTrack
from v2p_data.scene.fitting.plans import STATIC, FitPlan
from v2p_data.scene.fitting.shape_fit import orientations
from v2p_data.scene.fitting.trajectory import peak
from v2p_data.scene.frames.colour import lab_of
from v2p_data.scene.frames.mask_ops import bounding_box, grow, handle_of, tidy
from v2p_data.scene.frames.working_clip import WorkingClip
from v2p_data.scene.scale.nouns import Noun

MOUTH_DOWN = np.diag([1.0, -1.0, -1.0])
"""Half a turn about x: how a cover rests."""
_MOUTH_UP_COST = 0.03
"""IoU by which an outline must fit a cover better with its mouth up than with its mouth down."""
_PASSING_LAB = 12
"""Distance in Lab from the still of the other end, from which something passes in front of a pixel."""
type Rests = list[tuple[Float[np.ndarray, "3 3"], float]]
"""Resting orientations, each with its cost in units of IoU."""


@dataclass(frozen=True, kw_only=True)
class ObjectView:
    """An object as it is seen at both ends, and what may hide it there."""

    s: ObjectTrack
    image: UInt8[np.ndarray, "h w 3"]
    """The working frame of its first pose."""
    rests: Rests
    """How it may rest at first."""
    hidden: Bool[np.ndarray, "h w"]
    """Pixels that say nothing at the first pose."""
    last_i: int
    """Working frame of its last pose."""
    last_image: UInt8[np.ndarray, "h w 3"]
    last_mask: Bool[np.ndarray, "h w"]
    last_hidden: Bool[np.ndarray, "h w"]


def object_view(
    working: WorkingClip, objects: tuple[ObjectTrack, ...], s: ObjectTrack, plan: FitPlan
) -> ObjectView:
    """Return one of the objects as it is seen at both ends.

    The first of them is the manipulated one, which has the plan.
    """
    thing = objects[0]
    hidden = hidden_around(working, objects, s.first, s.at) | other_objects(objects, s, s.at)
    last_i, last_mask = end_of(s, plan)
    last_hidden = hidden
    if s.moves:
        last_hidden = hidden_around(working, objects, last_mask, last_i) | other_objects(
            objects, s, last_i
        )
    return ObjectView(
        s=s,
        image=working.rgb[s.at],
        rests=rests_of(s, plan if s is thing else STATIC),
        hidden=hidden,
        last_i=last_i,
        last_image=working.rgb[last_i],
        last_mask=last_mask,
        last_hidden=last_hidden,
    )


def rests_of(s: ObjectTrack, plan: FitPlan) -> Rests:
    """Return the ways an object may rest at first, each with what it costs: a cover lies with its mouth down."""
    if s.noun.hollow and plan.mouth_first == "down":
        return [(MOUTH_DOWN, 0.0)]
    if s.noun.hollow and plan.mouth_first == "down_or_up":
        return [(MOUTH_DOWN, 0.0), (np.eye(3), _MOUTH_UP_COST)]
    return orientations(s.noun)


def end_of(s: ObjectTrack, plan: FitPlan) -> tuple[int, Bool[np.ndarray, "h w"]]:
    """Return the working frame of an object's last pose, and its mask there."""
    if s.role == "manipulated" and plan.end == "in_air":
        i = peak(s)
        return i, s.masks[i]
    if s.at > 0 and s.moves:  # a tool may be gone again before the clip ends
        i = int(np.flatnonzero(s.masks.any((1, 2)))[-1])
        return i, s.masks[i]
    return len(s.masks) - 1, s.last


def round_body(
    mask: Bool[np.ndarray, "h w"], hidden: Bool[np.ndarray, "h w"], noun: Noun
) -> tuple[Bool[np.ndarray, "h w"], Bool[np.ndarray, "h w"]]:
    """Return the outline that a noun's round shape is fitted to, and what says nothing: a handle is neither."""
    if not noun.handled:
        return mask, hidden
    handle = handle_of(mask)
    return mask & ~handle, hidden | handle


def hidden_around(
    working: WorkingClip, objects: tuple[ObjectTrack, ...], mask: Bool[np.ndarray, "h w"], i: int
) -> Bool[np.ndarray, "h w"]:
    """Return pixels near a mask of frame `i` where the hand or a shadow may hide the object.

    What passes differs from the still of the other end, except where that shows what has moved.
    """
    early = i < len(working.rgb) / 2
    background = working.late if early else working.early
    passing = np.linalg.norm(working.lab[i] - lab_of(background), axis=-1) > _PASSING_LAB
    hidden = tidy(passing) & ~mask
    for s in objects:
        if s.moves and not s.in_hand:
            hidden &= ~grow(s.last if early else s.first, 2)
    x, y, w, h = bounding_box(mask)
    near = np.zeros_like(mask)
    pad = max(4, int(0.3 * max(w, h)))
    near[max(0, y - pad) : y + h + pad, max(0, x - pad) : x + w + pad] = True
    return hidden & near


def other_objects(
    objects: tuple[ObjectTrack, ...], s: ObjectTrack, i: int
) -> Bool[np.ndarray, "h w"]:
    """Return where other objects are seen at working frame `i`: this one may go on behind them."""
    shown = [other.masks[i] for other in objects if other is not s]
    return np.any(shown, axis=0) & ~s.masks[i] if shown else np.zeros_like(s.first)


def unknown_around(
    working: WorkingClip, thing: ObjectTrack, s: ObjectTrack, i: int
) -> Bool[np.ndarray, "h w"]:
    """Return what may hide a tool in a frame: the hand, and what it pushes."""
    return hidden_around(working, (thing, s), s.masks[i], i) | other_objects((thing, s), s, i)

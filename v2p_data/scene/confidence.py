"""How sure each step of a reconstruction is and why, and whether the motion found is the one that the caption tells of.

A scene's confidence is the product of its cues; each cue belongs to one stage, whose confidence is
the product of its own.
"""

from collections.abc import Iterator
from dataclasses import replace

import numpy as np
from jaxtyping import Float

from v2p_data.errors import ItemRejectedError
from v2p_data.kinds import KINDS, Kind
from v2p_data.scene.data_types import Cue, GroundedObjects, ObjectTrack, PlacedObject, Placement
from v2p_data.scene.fitting.placement import vote_of
from v2p_data.scene.frames.colour import balance, colour_match, named_colours
from v2p_data.scene.frames.mask_ops import attainable_iou, grow
from v2p_data.scene.grounding.ground_objects import EXACT_GAP_PX, seen_on_table
from v2p_data.scene.scale.camera_height import disagreement, height_plausibility
from v2p_data.scene.scale.nouns import is_clear

_COLOURED = 0.25
"""Share of a thing's pixels that need its colour: few things are one colour all over."""
_OUT_OF_SIGHT = 0.8
"""Confidence in an object that nobody sees at one end: in a bin, in a fist, or on the table before a hand brings it."""
_IN_THE_AIR = 0.6
"""Confidence in an object that does not rest on the table at first; it falls from 1 where half of
what that needs is seen."""
_GOOD, _LEAST_CUE = 0.95, 0.01
"""A cue above the first needs no help; the second keeps a ratio finite."""


def cues_of(grounded: GroundedObjects, placement: Placement, kind: Kind) -> tuple[Cue, ...]:
    """Return everything that the scene's confidence is the product of."""
    pairs = zip(grounded.objects, placement.objects, strict=True)
    of_objects = [
        cue for s, placed in pairs for cue in _object_cues(grounded, placement, kind, s, placed)
    ]
    return (*of_objects, *_scene_cues(grounded, placement, kind))


def _cue(stage: str, what: str, value: float, advice: str = "") -> Cue:
    return Cue(stage=stage, what=what, value=float(np.clip(value, 0, 1)), advice=advice)


def _object_cues(
    grounded: GroundedObjects,
    placement: Placement,
    kind: Kind,
    s: ObjectTrack,
    placed: PlacedObject,
) -> Iterator[Cue]:
    """Yield the cues of one object: found, outlined, sized, placed at the start and the end."""
    which = f"'{s.phrase}'"
    box = "" if s.hinted else f"mark {which} with a box"
    yield _cue("grounding", f"finding {which}" + (f" ({s.why})" if s.why else ""), s.sure, box)
    if not s.hinted and (words := named_colours(s.phrase)):
        image = grounded.working.rgb[s.at]
        match = float(colour_match(balance(image), words)[s.first].mean())
        value = 0.4 + 0.6 * (match / _COLOURED)
        yield _cue("grounding", f"colour of {which}", value, f"{box}, or correct its colour word")
    if s.moves:
        track = f"track of {which} from start to end"
        yield _cue("segmentation", track, 0.8 + 0.7 * s.agreement, box)
    off = abs(disagreement(vote_of(s, placed.first), placement.height_m))
    value = np.exp(-0.5 * (max(0.0, off - 2.0) / 2.0) ** 2)
    advice = "" if s.known_m else f"measure {which} and give its size_m"
    yield _cue("size", f"size of {which}", value, advice)
    covers = placed.first.iou / attainable_iou(s.first)
    yield _cue("shape", f"outline of {which}", max(0.1, 0.5 + (covers - 0.6) / 0.6), box)
    if not s.moves:
        return
    if s.hidden_in_container or placed.hidden_in_hand:
        yield _cue("pose", f"{which} is out of sight at the end", _OUT_OF_SIGHT)
        return
    if s.brought:
        yield _cue("pose", f"{which} is brought, and seen at rest at the end alone", _OUT_OF_SIGHT)
    covers = placed.last.iou / attainable_iou(placed.last_mask)
    value = max(0.1, 0.6 + (covers - 0.45) / 0.875)
    yield _cue("pose", f"outline of {which} at the end", value, box)
    seen = placed.last.visible / max(0.2, placed.first.visible)
    # Of what is put into something only the upper part is left to see.
    least = 0.8 if KINDS[kind].hides else 0.5
    advice = f"end the clip while {which} is in full view"
    yield _cue("pose", f"{which} seen at the end", max(0.1, least + seen), advice)


def _scene_cues(grounded: GroundedObjects, placement: Placement, kind: Kind) -> Iterator[Cue]:
    """Yield the cues of the camera, the start on the table and the caption."""
    thing = grounded.objects[0]
    yield _cue(
        "camera",
        "camera height",
        height_plausibility(placement.height_m),
        "measure the camera's height and give --scene.camera-height-m",
    )
    # What is brought may come to rest on something else than the table.
    on_table = 1.0 if thing.brought and KINDS[kind].touches else _seen_on_table(grounded)
    if on_table < 1:
        on_table = max(0.0, 2 * on_table - 1)
        yield _cue(
            "grounding",
            f"standing on the table at {'the end' if thing.brought else 'first'}",
            _IN_THE_AIR + (1 - _IN_THE_AIR) * on_table,
            f"begin the clip while '{thing.phrase}' stands on the table, or mark the table",
        )
    if not (thing.noun.known or thing.known_m):
        what = f"knowing what '{thing.phrase}' is"
        yield _cue("size", what, 0.9, f"give '{thing.phrase}' a name of the table of nouns")
    matter = "clear" if is_clear(thing.phrase) else thing.noun.matter
    if matter != "rigid":
        yield _cue("shape", f"'{thing.phrase}' is {matter}", {"soft": 0.8, "clear": 0.7}[matter])
    if kind == "generic":
        advice = "say what happens with a verb of a known kind of task"
        yield _cue("grounding", "understanding the caption", 0.85, advice)


def _seen_on_table(grounded: GroundedObjects) -> float:
    """Return how far the object is seen to rest on the table at first, or at the end if a hand brings it."""
    gap_px = {} if grounded.working.outliner is None else {"gap_px": EXACT_GAP_PX}
    thing, seen = grounded.objects[0], grounded.segmentation
    if thing.brought:
        seen = replace(seen, early=seen.late)
    return seen_on_table(grounded.table, thing.first, seen, **gap_px)


def by_stage(cues: tuple[Cue, ...]) -> dict[str, tuple[float, str]]:
    """Return each stage's confidence, and in words its weakest cue where that is below 0.9."""
    out: dict[str, tuple[float, str]] = {}
    for stage in dict.fromkeys(cue.stage for cue in cues):
        own = [cue for cue in cues if cue.stage == stage]
        weakest = min(own, key=lambda cue: cue.value)
        reason = f"{weakest.what}: {weakest.value:.2f}" if weakest.value < 0.9 else ""
        out[stage] = round(float(np.prod([cue.value for cue in own])), 4), reason
    return out


def confidence_of(cues: tuple[Cue, ...]) -> float:
    """Return the scene's confidence, 0 to 1."""
    return float(np.prod([cue.value for cue in cues]))


def check_confidence(cues: tuple[Cue, ...], least: float) -> float:
    """Return the scene's confidence.

    Raises:
        ItemRejectedError: `low_confidence`, where it is below `least`.
    """
    confidence = confidence_of(cues)
    if confidence < least:
        weakest = min(cues, key=lambda cue: cue.value)
        raise ItemRejectedError(
            "low_confidence",
            f"the scene is sure to {confidence:.3f}, below {least:g}; weakest is {weakest.what} with "
            f"{weakest.value:.2f}; {_what_helps(cues, least)}",
            round(confidence, 3),
        )
    return confidence


def _what_helps(cues: tuple[Cue, ...], least: float) -> str:
    """Return what a person can do, by the weakest cues first, until the scene would be sure enough."""
    left, steps = confidence_of(cues), list[str]()
    for cue in sorted((cue for cue in cues if cue.advice), key=lambda cue: cue.value):
        if left >= least or cue.value > _GOOD:
            break
        left /= max(cue.value, _LEAST_CUE)
        steps += [cue.advice] if cue.advice not in steps else []
    if not steps:
        return "no mark or measure would change that: film it again, nearer and in full view"
    return f"what helps: {'; '.join(steps)}" + (
        "" if left >= least else "; even so it may stay too unsure"
    )


def check_motion(
    kind: Kind,
    grounded: GroundedObjects,
    placement: Placement,
    T_world_objs: list[Float[np.ndarray, "_ 4 4"]],
    size_m: tuple[float, float, float],
) -> None:
    """Turn away what does not do what its caption says: then something else was followed.

    Raises:
        ItemRejectedError: `motion_contradicts_caption`.
    """
    own, said = T_world_objs[0], ""
    move = own[-1][:3, 3] - own[0][:3, 3]
    several = len(T_world_objs) > 1
    if kind == "lift_up":
        value, least, said = float(move[2]), 0.05, "rises"
    elif kind in ("push_left", "push_right"):
        value = float(move[1] if kind == "push_left" else -move[1])
        least = max(0.04, 0.25 * max(size_m))
        said = "moves to the left" if kind == "push_left" else "moves to the right"
    elif kind == "tip_over":
        value, least = placement.upright_cost - placement.objects[0].last.cost, -0.03
        said = "fits the picture better tipped than upright"
    elif KINDS[kind].comes_near and several and grounded.objects[0].brought:
        # Where it starts was chosen, and proves nothing.
        last, other = grounded.objects[0].last, grounded.objects[1].first
        value = float(grow(other, round(float(np.sqrt(last.sum()))))[last].mean())
        least, said = 0.5, "ends beside the other"
    elif KINDS[kind].comes_near and several and not grounded.objects[1].moves:
        gaps = [
            float(np.linalg.norm((T[:3, 3] - T_world_objs[1][0][:3, 3])[:2]))
            for T in (own[0], own[-1])
        ]
        value, least, said = gaps[0] - gaps[1], 0.02, "comes nearer to the other"
    elif KINDS[kind].touches and several:
        goal, last = grow(grounded.objects[1].first, 6), grounded.objects[0].last
        # What is covered may be far smaller than what covers it.
        value, least = float((goal & last).sum() / max(1, min(last.sum(), goal.sum()))), 0.25
        said = "ends at the other"
    else:
        value, least, said = float(np.linalg.norm(move)), 0.02, "moves"
    if value < least:
        raise ItemRejectedError(
            "motion_contradicts_caption",
            f"what was followed as '{grounded.objects[0].phrase}' hardly {said} ({value:.2f}, at "
            f"least {least:.2f} needed), "
            "so it is probably something else; mark it with a box in captions.json",
            round(value, 3),
        )

"""How far a reconstruction is from the truth of a rendered clip, and which stage failed.

Both sides are in the scene frame (origin under the manipulated object's first position, +x away, +y left, +z up) and in
metres, so numbers compare directly. A stage fails as in table 4 of the Video2Policy paper: what it gives is broken, or
it is the wrong object. A clip fails where one of its named objects does.

What is compared is what can be seen or used, not how somebody named the axes: the own frame of a reconstructed object
is arbitrary, so boxes compare with their sides in the most favourable order and round things by their axis alone.
"""

import numpy as np
from jaxtyping import Bool, Float

from drawn_clips.score_types import (
    MAX_SIZE_RATIO,
    MIN_SEEN_PX,
    MIN_SEEN_SHARE,
    SIZE_SLACK_M,
    ClipScore,
    FoundClip,
    FoundThing,
    ThingScore,
    TrueClip,
    TrueThing,
)
from drawn_clips.shape_overlap import fitting_turns, iou, opening, shape_ious
from v2p_data.geometry.pose import angle_between, apply, inverse
from v2p_data.kinds import KINDS
from v2p_data.scene.data_types import Reconstruction

_AT_REST_M = 0.002
FRAME_SLACK = 2
"""File frames between two masks that still show the same moment, for clips thinned out while decoding."""


def found_of(reconstruction: Reconstruction) -> FoundClip:
    """Return what is compared of a reconstruction; frames become those of the file."""
    file_frame = reconstruction.clip.source_frame
    things = []
    for thing in reconstruction.objects:
        masks = {int(file_frame[f]): mask for f, mask in thing.masks.items()}
        noun = thing.noun
        mesh = thing.mesh
        # What arches is no vessel: a spoon has room under its handle.
        hollow = noun.hollow and opening(mesh) is not None
        things.append(
            FoundThing(
                phrase=thing.label,
                size_m=thing.size_m,
                hollow=hollow,
                is_round=noun.form == "cylinder",
                is_ball=noun.form == "sphere",
                mesh=mesh,
                T_world_first=thing.T_world_objs[0],
                T_world_last=thing.T_world_objs[-1],
                first_frame=int(file_frame[thing.frames[0]]),
                last_frame=int(file_frame[thing.frames[-1]]),
                first_depth_seen=not thing.observed or thing.observed[0] == "full",
                last_depth_seen=not thing.observed or thing.observed[-1] == "full",
                masks=masks,
            )
        )
    return FoundClip(
        kind=reconstruction.kind,
        things=tuple(things),
        T_world_cam=reconstruction.camera.T_world_cam,
    )


def rejected(true: TrueClip, slug: str) -> ClipScore:
    """Return the score of a clip of which nothing was made."""
    things = tuple(ThingScore(phrase=thing.phrase) for thing in true.things)
    return ClipScore(kind_true=true.kind, kind_found=None, slug=slug, things=things)


def score_clip(true: TrueClip, found: FoundClip) -> ClipScore:
    """Compare a reconstruction with the truth.

    Objects are compared by phrase; where a phrase was understood differently, the manipulated one with the manipulated
    one and the others in their order.
    """
    pairs = zip(true.things, _matched(true, found), strict=True)
    things = tuple(
        ThingScore(phrase=t.phrase) if f is None else _score_thing(t, f, true, found)
        for t, f in pairs
    )
    return ClipScore(kind_true=true.kind, kind_found=found.kind, slug=None, things=things)


def turn_between(
    true: TrueThing,
    found: FoundThing,
    R_true: Float[np.ndarray, "3 3"],
    R_found: Float[np.ndarray, "3 3"],
) -> float:
    """Return the angle between two posed objects [rad], up to what cannot be told apart.

    A ball has no orientation; where one was found for an egg, that shows in its shape. Of a round
    thing only the axis counts, and which way it points only where it is open on one side. A box,
    and anything without symmetry, is compared as a posed box: the found one's axes are renamed so
    that its sides fit the true ones, the six ways of equal sides and turns by 180 degrees
    included; what is open on one side keeps the side. Where a solid of revolution was found for
    it, that one's axis counts alone.
    """
    if true.symmetry == "sphere" or found.is_ball:
        return 0.0
    open_true = opening(true.mesh) if true.hollow else None
    open_found = opening(found.mesh) if found.hollow else None
    if true.symmetry == "round":
        if open_true is not None and open_found is not None:
            cosine = float((R_true @ open_true) @ (R_found @ open_found))
        else:
            cosine = abs(float(R_true[:, 2] @ R_found[:, _round_axis(true, found)]))
        return float(np.arccos(np.clip(cosine, -1, 1)))
    if found.is_round and open_true is not None and open_found is not None:
        # A mug with its handle is longer than high, the round one found for it is not: sides do not tell the axis.
        cosine = float((R_true @ open_true) @ (R_found @ open_found))
        return float(np.arccos(np.clip(cosine, -1, 1)))
    angles: list[float] = []
    for order, signs in fitting_turns(true.size_m, found.size_m):
        rename = np.zeros((3, 3))  # true axis i is the found axis order[i], with its sign
        rename[list(order), range(3)] = signs
        if (
            open_true is not None
            and open_found is not None
            and float(open_found @ rename @ open_true) < 0.5
        ):
            continue
        if found.is_round:  # nobody says how it is turned about its own axis
            i = order.index(2)
            cosine = float(R_true[:, i] @ (R_found @ rename)[:, i])
            angles.append(float(np.arccos(np.clip(cosine, -1, 1))))
        else:
            angles.append(angle_between(R_true, R_found @ rename))
    return min(angles) if angles else float(np.pi)


def size_sides(
    true: TrueThing, found: FoundThing
) -> tuple[Float[np.ndarray, "side"], Float[np.ndarray, "side"]]:
    """Return the true and the found lengths that belong together [m]: diameter and height, or sorted sides."""
    if true.symmetry == "round":
        sides = np.array(true.size_m)
        k = _round_axis(true, found)
        across = float(np.mean(np.delete(np.array(found.size_m), k)))
        return np.array([sides[:2].mean(), sides[2]]), np.array([across, found.size_m[k]])
    return np.sort(true.size_m), np.sort(found.size_m)


def _matched(true: TrueClip, found: FoundClip) -> list[FoundThing | None]:
    left = list(found.things)
    pairs: dict[str, FoundThing] = {}
    for thing in true.things:
        same = next((f for f in left if f.phrase == thing.phrase), None)
        if same is not None:
            pairs[thing.phrase] = same
            left = [f for f in left if f is not same]
    for thing in true.things:
        # what is left has another name than in the truth: the manipulated object comes first, the others follow
        spare = [f for f in left if (f is found.things[0]) == thing.manipulated]
        if thing.phrase not in pairs and spare:
            pairs[thing.phrase] = spare[0]
            left = [f for f in left if f is not spare[0]]
    return [pairs.get(thing.phrase) for thing in true.things]


def _score_thing(
    true: TrueThing, found: FoundThing, clip: TrueClip, understood: FoundClip
) -> ThingScore:
    last = min(found.last_frame, len(true.T_world_objs) - 1)
    begins = 0 if _seen_at_first(true) else min(found.first_frame, last)
    T_first, T_last = true.T_world_objs[begins], true.T_world_objs[last]
    sides, ours = size_sides(true, found)
    ratio = np.maximum(sides / ours, ours / sides)
    hollow_matters = true.hollow and KINDS[clip.kind].needs_hollow
    volume_iou, shape_iou = shape_ious(
        true.mesh,
        found.mesh,
        hollow=(true.hollow, found.hollow),
        cavity_matters=true.hollow and (found.hollow or hollow_matters),
    )
    centre_true, centre_found = (m.bounds.mean(axis=0)[None] for m in (true.mesh, found.mesh))
    ends = []
    for T, T_found, depth_seen in (
        (T_first, found.T_world_first, found.first_depth_seen),
        (T_last, found.T_world_last, found.last_depth_seen),
    ):
        here, there = apply(T, centre_true), apply(T_found, centre_found)
        away, along = float(np.linalg.norm(here - there)), None
        if not depth_seen:
            away, along = _by_sight(here[0], there[0], clip.T_world_cam[:3, 3])
        in_camera = apply(inverse(clip.T_world_cam), here)
        in_camera_found = apply(inverse(understood.T_world_cam), there)
        ends.append(
            (
                away,
                along,
                float(np.linalg.norm(in_camera - in_camera_found)),
                turn_between(true, found, T[:3, :3], T_found[:3, :3]),
            )
        )
    ious = _mask_ious(true, found)
    return ThingScore(
        phrase=true.phrase,
        box_iou=_grounding_iou(true, found),
        iou_first=ious[0] if ious else None,
        iou_last=ious[-1] if ious else None,
        iou_mean=float(np.mean(ious)) if ious else None,
        size_error_m=float(np.abs(sides - ours).mean()),
        size_error_share=float((np.abs(sides - ours) / sides).mean()),
        size_right=bool(
            ((ratio <= MAX_SIZE_RATIO) | (np.abs(sides - ours) <= SIZE_SLACK_M)).all()
        ),
        position_first_m=ends[0][0],
        position_last_m=ends[1][0],
        position_first_depth_m=ends[0][1],
        position_last_depth_m=ends[1][1],
        position_first_cam_m=ends[0][2],
        position_last_cam_m=ends[1][2],
        turn_first_rad=ends[0][3],
        turn_last_rad=ends[1][3],
        travel_share=_travel_share(true, last, clip.things[0]),
        watertight=bool(found.mesh.is_watertight),
        hollow_agrees=true.hollow == found.hollow,
        hollow_matters=hollow_matters,
        volume_iou=volume_iou,
        shape_iou=shape_iou,
    )


def _by_sight(
    true: Float[np.ndarray, "3"], found: Float[np.ndarray, "3"], eye: Float[np.ndarray, "3"]
) -> tuple[float, float]:
    """Return how far two points are apart across and along the line of sight to the true one."""
    sight = (true - eye) / np.linalg.norm(true - eye)
    along = float((found - true) @ sight)
    return float(np.linalg.norm(found - true - along * sight)), abs(along)


def _travel_share(true: TrueThing, last: int, manipulated: TrueThing) -> float | None:
    """Return how much of its way it had gone by that frame; None for what stays. A way may lead out and back.

    A tool's way ends where what it moves comes to rest: then it is taken away, out of the picture.
    """
    places = true.T_world_objs[:, :3, 3]
    if not true.manipulated:
        goal = manipulated.T_world_objs[-1, :3, 3]
        ahead_m = np.linalg.norm(manipulated.T_world_objs[:, :3, 3] - goal, axis=1)
        under_way = np.flatnonzero(ahead_m > _AT_REST_M)
        places = places[: under_way[-1] + 2] if len(under_way) else places
    if np.linalg.norm(places - places[0], axis=1).max() < 0.02:
        return None
    way = np.concatenate([[0.0], np.linalg.norm(np.diff(places, axis=0), axis=1).cumsum()])
    return float(way[min(last, len(way) - 1)] / way[-1])


def _seen_frames(true: TrueThing) -> list[int]:
    areas = {frame: int(mask.sum()) for frame, mask in true.masks.items()}
    least = max(MIN_SEEN_PX, MIN_SEEN_SHARE * max(areas.values(), default=0))
    return sorted(frame for frame, area in areas.items() if area >= least)


def _seen_at_first(true: TrueThing) -> bool:
    """Return whether it is in the picture when the clip begins.

    A tool comes later, or is hidden by what it lies under.
    """
    frames = _seen_frames(true)
    return not frames or frames[0] == min(true.masks)


def _mask_ious(true: TrueThing, found: FoundThing) -> list[float]:
    out = []
    for frame in _seen_frames(true):
        near = _nearest(found, frame)
        if near is not None and abs(near - frame) <= FRAME_SLACK:
            out.append(iou(true.masks[frame], found.masks[near]))
    return out


def shown_at(true: TrueThing) -> int | None:
    """Return the frame in which a person would point at it: the first, or the one that shows most of it.

    None where it is never seen. Of equals the latest: what is uncovered lies free at the end.
    """
    if not _seen_frames(true):
        return None
    if _seen_at_first(true):
        return min(true.masks)
    return max(true.masks, key=lambda frame: (int(true.masks[frame].sum()), frame))


def _grounding_iou(true: TrueThing, found: FoundThing) -> float:
    frame = shown_at(true)
    if frame is None or not found.masks:
        return 0.0
    near = _nearest(found, frame)
    assert near is not None
    return _box_iou(true.masks[frame], found.masks[near])


def _nearest(found: FoundThing, frame: int) -> int | None:
    return min(found.masks, key=lambda other: abs(other - frame), default=None)


def _box_iou(a: Bool[np.ndarray, "h w"], b: Bool[np.ndarray, "h w"]) -> float:
    if not a.any() or not b.any():
        return 0.0
    (a0, a1), (b0, b1) = ((p.min(0), p.max(0) + 1) for p in (np.argwhere(a), np.argwhere(b)))
    both = float(np.prod(np.clip(np.minimum(a1, b1) - np.maximum(a0, b0), 0, None)))
    return both / (float(np.prod(a1 - a0) + np.prod(b1 - b0)) - both)


def _round_axis(true: TrueThing, found: FoundThing) -> int:
    """Return which of the found object's axes stands for a round thing's axis of revolution."""
    if found.is_round:
        return 2
    across, along = np.mean(true.size_m[:2]), true.size_m[2]
    size = np.array(found.size_m)
    costs = [
        np.abs(np.log(np.array([np.delete(size, k).mean() / across, size[k] / along]))).sum()
        for k in range(3)
    ]
    return int(np.argmin(costs))

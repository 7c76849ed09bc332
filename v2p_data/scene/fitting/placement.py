"""Masks become a camera, shapes and poses: everything here is in camera heights, until `height_m` turns it into metres.

The camera stands at (0, 0, 1), level, and looks along +x. Objects rest on the table unless something shows that they
are held; how far away something in mid-air is cannot be seen from one side and is taken over from where it stood.
"""

from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Bool, Float, UInt8
from scipy.spatial.transform import Rotation

from v2p_data.geometry.camera import Camera
from v2p_data.geometry.pose import transform
from v2p_data.kinds import KINDS, Kind
from v2p_data.scene.data_types import CameraGuess, Fit, ObjectTrack, PlacedObject, Placement
from v2p_data.scene.fitting.silhouette import (
    Silhouette,
    Within,
    camera_above,
    fit_lifted,
    fit_pose,
    fit_shape,
    orientations,
    three,
    yaw_of,
)
from v2p_data.scene.fitting.tool_pose import fit_tool_pose, push_motion
from v2p_data.scene.fitting.trajectory import (
    Trajectory,
    carried_by_hand,
    peak,
    trajectory_between,
    trajectory_in_hand,
)
from v2p_data.scene.frames.colour import lab_of
from v2p_data.scene.frames.mask_ops import bounding_box, grow, handle_of, tidy
from v2p_data.scene.frames.segmentation import Segmentation
from v2p_data.scene.frames.working_clip import WorkingClip
from v2p_data.scene.scale.camera_height import SizeVote, camera_height_m
from v2p_data.scene.scale.nouns import Noun

UNSEEN_IOU = 0.35
"""An outline at the end that fits the object no better shows something else."""
_HAS_ITS_SHAPE = 0.8
"""IoU: an outline that is covered no better tells no size."""
_TURN_COST = 0.007
"""Of a pitch one standard deviation off the expected one, in units of IoU of all outlines together."""
_NO_SPREAD = 0.01
"""Of the logarithm of a length that is known."""
_MOST_VIEWS = 5
"""Frames in which the outline of a tool is compared."""
_LATE = 0.6
"""Share of the way of what a tool pushes, from which on an outline shows how the tool ends."""
_LEAST_QUALITY, _UNSEEN_SURE = 0.4, 0.4
"""Of a tool's masks that are compared; and how sure a pose is where there is none."""
_OTHER_FORM_COST = 0.02
"""By so much a noun's second form must cover an outline better where it alone is a box: that has a side and a turn more to choose than a cylinder."""
_LYING_TELLS = 0.1
"""A lid that is taken off lies on the table at first if that fits so much better, in units of IoU."""
_SIZE_TELLS, _MOST_OFF = 0.01, 3.0
"""Of a form whose size is one standard deviation off, in units of IoU, and from where on it counts no more."""
_COVERED_TELLS = 0.02
"""The same of a lid that is not as wide as what it covers: no jar's lid lies on a pot."""
_PITCH_RANGE_RAD = (0.15, 1.4)
"""From nearly level to nearly straight down: beyond, outlines on the table say nothing of places on it."""
_MOUTH_DOWN = np.diag([1.0, -1.0, -1.0])
type _Rests = list[tuple[Float[np.ndarray, "3 3"], float]]


@dataclass(frozen=True, kw_only=True)
class _ObjectView:
    """An object as it is seen at both ends, and what may hide it there."""

    s: ObjectTrack
    image: UInt8[np.ndarray, "h w 3"]
    rests: _Rests
    """How it may rest at first."""
    hidden: Bool[np.ndarray, "h w"]
    last_i: int
    last_image: UInt8[np.ndarray, "h w 3"]
    last_mask: Bool[np.ndarray, "h w"]
    last_hidden: Bool[np.ndarray, "h w"]


@dataclass(frozen=True, kw_only=True)
class _EndPoses:
    """An object at both ends."""

    first: Fit
    last: Fit
    rival: float | None = None
    as_before: float = 0.0
    """What standing as at first would have cost at the end."""
    unseen: bool = False
    log_growth: float = 0.0
    lifted_off: bool = False


def place(
    working: WorkingClip,
    objects: tuple[ObjectTrack, ...],
    kind: Kind,
    guess: CameraGuess,
    max_poses: int,
    segmentation: Segmentation | None = None,
) -> Placement:
    """Return camera, shapes and poses such that all outlines fit their masks, the manipulated object's at both ends.

    `segmentation` is what the network sees, where it was asked: then the hand helps to tell the scale.
    """
    thing = objects[0]
    shown = [_shown(working, objects, s, kind) for s in objects]
    resting = [k for k, s in enumerate(objects) if not s.in_hand]
    pitch_rad, firsts = _best_pitch([shown[k] for k in resting], guess)
    camera = camera_above(working.shape, pitch_rad, guess.fov_rad)
    carried = (
        carried_by_hand(thing, segmentation)
        if kind == "lift_up" and segmentation is not None
        else []
    )
    fits = {k: _EndPoses(first=fit, last=fit) for k, fit in zip(resting, firsts, strict=True)}
    for k in resting:
        if objects[k].moves and not (k == 0 and carried):
            role = kind if k == 0 else "push_with"
            support, within = 0.0, None
            if k == 0 and 1 in fits:
                support, within = _goal(kind, objects, fits[0].first, fits[1].first)
            fits[k] = _fit_both_ends(shown[k], role, camera, support, within)
            if k == 0 and kind == "uncover" and 1 in fits and _is_lid(thing.noun):
                fits[0] = _fit_lifted_off(shown[0], fits[0], fits[1].first, camera)
            if k == 0 and KINDS[kind].end not in ("in_air", "on_side") and not fits[k].unseen:
                fits[k] = replace(fits[k], log_growth=_log_growth(shown[k], fits[k], camera))
    votes = [vote_of(objects[k], fits[k].first) for k in resting]
    known = guess.heights(pitch_rad)
    height_m, spread = camera_height_m(votes, known)
    if segmentation is not None and len(resting) == len(objects):
        guessed = (pitch_rad, height_m)
        by_hand = _height_from_hand(
            working, segmentation, shown[0], fits[0], kind, camera, guessed
        )
        if by_hand is not None:
            height_m, spread = camera_height_m(votes, [*known, by_hand])
    placed: list[PlacedObject] = []
    for k, see in enumerate(shown):
        if k == 0 and carried:
            placed.append(_hidden_in_hand(see, fits[k], carried, camera))
        elif see.s.in_hand:
            placed.append(
                _pushing(see, thing, placed[0], camera, height_m, working, segmentation, max_poses)
            )
        else:
            trajectory = _course(see, fits[k], kind, camera, max_poses)
            placed.append(_placed(see, fits[k], trajectory))
    return Placement(
        camera=camera,
        pitch_rad=pitch_rad,
        objects=tuple(placed),
        height_m=height_m,
        scale_spread=spread,
        upright_cost=fits[0].as_before,
    )


def _shown(
    working: WorkingClip, objects: tuple[ObjectTrack, ...], s: ObjectTrack, kind: Kind
) -> _ObjectView:
    thing = objects[0]
    hidden = _hidden(working, objects, s.first, s.at) | _others(objects, s, s.at)
    last_i, last_mask = _end_of(s, kind)
    last_hidden = hidden
    if s.moves:
        last_hidden = _hidden(working, objects, last_mask, last_i) | _others(objects, s, last_i)
    return _ObjectView(
        s=s,
        image=working.rgb[s.at],
        rests=_rests(s, kind if s is thing else "generic"),
        hidden=hidden,
        last_i=last_i,
        last_image=working.rgb[last_i],
        last_mask=last_mask,
        last_hidden=last_hidden,
    )


def _fit_both_ends(
    see: _ObjectView, kind: Kind, camera: Camera, support: float, within: Within | None
) -> _EndPoses:
    """Return the pair of poses that costs least: one outline often fits a standing and a lying box alike, both ends seldom do.

    The last pose is `support` above the table [camera heights], over the disc `within`.
    """
    options = _options(see, camera)
    body = _body(see.last_mask, see.last_hidden, see.s.noun)
    silhouette = Silhouette(*body, camera, see.last_image)
    found = [_fit_last(silhouette, see.s, kind, first, support, within) for first in options]
    costs = [a.cost + b.cost for a, (b, _) in zip(options, found, strict=True)]
    best = int(np.argmin(costs))
    last, as_before = found[best]
    unseen = KINDS[kind].hides and (see.s.hidden_in_container or last.iou < UNSEEN_IOU)
    if unseen and within is not None:
        last = _inside(last, support, within)
    return _EndPoses(
        first=options[best],
        last=last,
        rival=float(np.partition(costs, 1)[1] - min(costs)) if len(costs) > 1 else None,
        as_before=as_before,
        unseen=unseen and within is not None,
    )


def _is_lid(noun: Noun) -> bool:
    """Return whether what covers something lies on top of it: cups and bowls stand around it, cloths hang down."""
    return not noun.hollow and noun.matter == "rigid"


def _fit_lifted_off(
    see: _ObjectView, lying: _EndPoses, other_fit: Fit, camera: Camera
) -> _EndPoses:
    """Return the poses of a lid that lies on the other thing at first and on the table at the end.

    `lying` are its poses if it lay on the table at both ends: they stay where they fit much better.
    """
    noun = see.s.noun
    start = Silhouette(see.s.first, see.hidden, camera, see.image)
    stop = Silhouette(see.last_mask, see.last_hidden, camera, see.last_image)
    last = fit_shape(stop, noun, np.eye(3))
    support, within = _top_of(np.array(last.size), other_fit)
    first = fit_pose(start, noun, last.size, np.eye(3), support=support, within=within)
    if first.cost + last.cost > lying.first.cost + lying.last.cost + _LYING_TELLS:
        return lying
    return replace(lying, first=first, last=last, lifted_off=True)


def _log_growth(see: _ObjectView, fits: _EndPoses, camera: Camera) -> float:
    """Return the logarithm of how much larger an object is at first than its last outline says by itself, as far as that has its shape."""
    rest = _rest_of(fits.last.T_world_obj[:3, :3])
    silhouette = Silhouette(*_body(see.last_mask, see.last_hidden, see.s.noun), camera)
    alone = fit_shape(silhouette, see.s.noun, rest, thorough=False)
    if alone.iou < _HAS_ITS_SHAPE:
        return 0.0
    return float(np.log(np.array(fits.first.size) / np.array(alone.size)).mean())


def _height_from_hand(
    working: WorkingClip,
    segmentation: Segmentation,
    see: _ObjectView,
    fits: _EndPoses,
    kind: Kind,
    camera: Camera,
    known: tuple[float, float],
) -> tuple[float, float] | None:
    """Return the camera's height by the hand that moves the object, as `hand_scale.height_from_hand` does; `known` is pitch and height."""
    from v2p_data.scene.fitting.hand_scale import (
        height_from_hand,  # torch takes a second to import
    )

    stands = [(see.s.first, fits.first.T_world_obj[:3, 3])]
    if kind != "lift_up":  # it ends in mid-air
        stands.append((see.last_mask, fits.last.T_world_obj[:3, 3]))
    return height_from_hand(working, segmentation, see.s.masks, stands, camera, *known)


def _course(
    see: _ObjectView, fits: _EndPoses, kind: Kind, camera: Camera, max_poses: int
) -> Trajectory:
    if see.s.moves:
        end = (see.last_i, see.last_mask)
        return trajectory_between(see.s, kind, fits.first, fits.last, end, camera, max_poses)
    pose, iou = fits.first.T_world_obj, fits.first.iou
    return Trajectory([0], [pose], [iou], ["full"]).append(len(see.s.masks) - 1, pose, iou, "full")


def _hidden_in_hand(
    see: _ObjectView,
    fits: _EndPoses,
    carried: list[tuple[int, Float[np.ndarray, "2"]]],
    camera: Camera,
) -> PlacedObject:
    """Return what a hand hides and carries as far in the picture."""
    start = Trajectory([0], [fits.first.T_world_obj], [fits.first.iou], ["full"])
    trajectory = trajectory_in_hand(start, carried, camera)
    last = replace(fits.first, T_world_obj=trajectory.poses[-1], iou=0.0, visible=0.0)
    see = replace(see, last_i=carried[-1][0], last_mask=np.zeros_like(see.last_mask))
    return replace(_placed(see, replace(fits, last=last), trajectory), hidden_in_hand=True)


def _placed(see: _ObjectView, fits: _EndPoses, trajectory: Trajectory) -> PlacedObject:
    return PlacedObject(
        first=fits.first,
        last=fits.last,
        last_i=see.last_i,
        last_mask=see.last_mask,
        hidden=see.hidden,
        last_hidden=see.last_hidden,
        frames=tuple(trajectory.frames),
        T_world_objs=np.stack(trajectory.poses),
        confidences=tuple(trajectory.sure),
        observed=tuple(trajectory.observed),
        rival=fits.rival,
        unseen=fits.unseen,
        log_growth=fits.log_growth,
        lifted_off=fits.lifted_off,
    )


def with_noun_variants(
    working: WorkingClip, objects: tuple[ObjectTrack, ...], guess: CameraGuess, kind: Kind
) -> tuple[ObjectTrack, ...]:
    """Return the object tracks with their nouns in the form that their outlines fit, where a noun has two; a lid is about as wide as what it covers."""
    beneath = objects[1].noun if kind in ("cover", "uncover") and len(objects) > 1 else None
    camera = camera_above(working.shape, guess.pitch_rad, guess.fov_rad)
    out = []
    for k, s in enumerate(objects):
        if s.noun.variant is not None:
            unknown = _others(objects, s, s.at)
            silhouette = Silhouette(s.first, unknown, camera)
            under = beneath if k == 0 and _is_lid(s.noun) else None
            usual, other = (
                _cost_of(fit_shape(silhouette, noun, np.eye(3)), noun, guess, under)
                for noun in (s.noun, s.noun.variant)
            )
            freer = _OTHER_FORM_COST if s.noun.variant.form == "box" != s.noun.form else 0.0
            s = replace(s, noun=s.noun.variant if other + freer < usual else s.noun)
        out.append(s)
    return tuple(out)


def _cost_of(fit: Fit, noun: Noun, guess: CameraGuess, beneath: Noun | None) -> float:
    """Return what a fit costs as one of a noun's two forms: jar lids and pot lids are alike but for their size.

    `beneath` is the round thing that a lid covers.
    """
    sizes = np.log(np.array(fit.size) / np.array(noun.size_m)).mean()
    offs = [
        (sizes + np.log(height_m)) / np.hypot(noun.spread, sd)
        for height_m, sd in guess.heights(guess.pitch_rad)
    ]
    size_cost = _SIZE_TELLS * float(np.square(np.clip(offs, -_MOST_OFF, _MOST_OFF)).sum())
    if beneath is not None and beneath.form == "cylinder":
        wider = np.log(noun.size_m[0] / beneath.size_m[0]) / np.hypot(noun.spread, beneath.spread)
        size_cost += _COVERED_TELLS * float(np.clip(wider, -_MOST_OFF, _MOST_OFF)) ** 2
    return fit.cost + size_cost


def _best_pitch(shown: list[_ObjectView], guess: CameraGuess) -> tuple[float, list[Fit]]:
    """Try pitches around the guess; the silhouettes decide, as far as the guess lets them."""
    best: tuple[float, float, list[Fit]] | None = None
    tried: list[float] = []

    def fits_at(pitch: float, *, thorough: bool) -> list[Fit]:
        camera = camera_above(shown[0].hidden.shape, pitch, guess.fov_rad)
        out = []
        for k, see in enumerate(shown):
            usual = see if thorough or k == 0 else replace(see, rests=see.rests[:1])
            options = _options(usual, camera, thorough=thorough)
            out.append(min(options, key=lambda fit: fit.cost))
        return out

    sd = guess.pitch_sd_rad
    for offsets in ((-1.8 * sd, -0.9 * sd, 0.0, 0.9 * sd, 1.8 * sd), (-0.4 * sd, 0.4 * sd)):
        centre = guess.pitch_rad if best is None else best[1]
        for offset in offsets:
            pitch = float(np.clip(centre + offset, *_PITCH_RANGE_RAD))
            if any(abs(pitch - other) < 0.01 for other in tried):
                continue
            tried.append(pitch)
            fits = fits_at(pitch, thorough=False)
            off = (pitch - guess.pitch_rad) / sd
            cost = sum(fit.cost for fit in fits) + _TURN_COST * off**2
            if best is None or cost < best[0]:
                best = cost, pitch, fits
    assert best is not None
    return best[1], fits_at(best[1], thorough=len(shown) > 1)


def _rests(s: ObjectTrack, kind: Kind) -> _Rests:
    """Return the ways an object may rest at first, each with what it costs: a cover lies with its mouth down."""
    if s.noun.hollow and kind == "uncover":
        return [(_MOUTH_DOWN, 0.0)]
    if s.noun.hollow and kind == "cover":
        return [(_MOUTH_DOWN, 0.0), (np.eye(3), 0.03)]
    return orientations(s.noun)


def _options(see: _ObjectView, camera: Camera, *, thorough: bool = True) -> list[Fit]:
    """Return the best fit for every way in which the object may rest."""
    noun = see.s.noun
    silhouette = Silhouette(*_body(see.s.first, see.hidden, noun), camera, see.image)
    fits = []
    for rest, extra in see.rests:
        fit = fit_shape(silhouette, noun, rest, thorough=thorough)
        fit = replace(fit, cost=fit.cost + extra)
        upright = noun.form == "box" and rest is not _MOUTH_DOWN
        fits.append(_upright_axes(fit) if upright else fit)
    return fits


def _body(
    mask: Bool[np.ndarray, "h w"], hidden: Bool[np.ndarray, "h w"], noun: Noun
) -> tuple[Bool[np.ndarray, "h w"], Bool[np.ndarray, "h w"]]:
    """Return the outline that a noun's round shape is fitted to, and what says nothing: a handle is neither."""
    if not noun.handled:
        return mask, hidden
    handle = handle_of(mask)
    return mask & ~handle, hidden | handle


def _end_of(s: ObjectTrack, kind: Kind) -> tuple[int, Bool[np.ndarray, "h w"]]:
    """Return the working frame of an object's last pose, and its mask there."""
    if s.role == "manipulated" and kind == "lift_up":
        i = peak(s)
        return i, s.masks[i]
    if s.at > 0 and s.moves:  # a tool may be gone again before the clip ends
        i = int(np.flatnonzero(s.masks.any((1, 2)))[-1])
        return i, s.masks[i]
    return len(s.masks) - 1, s.last


def _fit_last(
    silhouette: Silhouette,
    s: ObjectTrack,
    kind: Kind,
    first: Fit,
    support: float,
    within: Within | None,
) -> tuple[Fit, float]:
    """Return an object's pose at the end, and what standing as at first would have cost."""
    noun = s.noun
    if kind == "lift_up":
        return fit_lifted(silhouette, noun, first.size, first.T_world_obj), 0.0
    rest = _rest_of(first.T_world_obj[:3, :3])
    yaw = yaw_of(first.T_world_obj[:3, :3], rest)
    if kind == "cover" and noun.hollow:
        rest = _MOUTH_DOWN
    same = fit_pose(
        silhouette, noun, first.size, rest, yaw_near=yaw, support=support, within=within
    )
    if kind == "uncover" and noun.hollow:  # put down either way
        upright = fit_pose(silhouette, noun, first.size, np.eye(3), yaw_near=yaw)
        same = upright if upright.cost + 0.1 < same.cost else same
    if KINDS[kind].may_end_held:
        held = fit_lifted(silhouette, noun, first.size, first.T_world_obj)
        if held.cost + 0.1 < same.cost:  # the clip ends before it is put down
            return held, same.cost
    if kind != "tip_over" or noun.form == "sphere":
        return same, same.cost
    turned = []
    for axis in ("y", "x"):
        tipped = Rotation.from_euler(axis, 90, degrees=True).as_matrix() @ rest
        fit = fit_pose(silhouette, noun, first.size, tipped)
        turned.append(_tipped_along(fit, first.T_world_obj))
    return min(turned, key=lambda fit: fit.cost), same.cost


def _pushing(
    see: _ObjectView,
    thing: ObjectTrack,
    pushed: PlacedObject,
    camera: Camera,
    height_m: float,
    working: WorkingClip,
    segmentation: Segmentation | None,
    max_poses: int,
) -> PlacedObject:
    """Return the poses of a tool in a hand, from when what it pushes sets out until that has come to rest."""
    s = see.s
    ground = camera.on_plane(np.argwhere(s.first).mean(0)[None, ::-1])[0][:2]
    push = push_motion(
        Trajectory(list(pushed.frames), list(pushed.T_world_objs), [], []),
        pushed.first,
        thing.noun.form,
        len(s.masks),
        ground if np.isfinite(ground).all() else np.zeros(2),
        camera,
        height_m,
        segmentation,
    )
    begins, ends = push.frames
    seen = [
        i
        for i in range(max(s.at, begins), ends + 1)
        if s.masks[i].any() and s.quality[i] > _LEAST_QUALITY
    ] or [s.at]
    few = np.unique(np.linspace(0, len(seen) - 1, _MOST_VIEWS).round().astype(int))
    views = []
    for i in (seen[k] for k in few):
        views.append((i, Silhouette(s.masks[i], _unknown(working, thing, s, i), camera)))
    size, spread = (s.known_m, _NO_SPREAD) if s.known_m else (s.noun.size_m, s.noun.spread)
    held = fit_tool_pose(views, push, s.noun, three(np.array(size) / height_m), spread)
    fit = held.fit
    gone = np.linalg.norm(push.spots - push.spots[0], axis=1)
    late = begins <= seen[-1] <= ends and gone[seen[-1]] >= _LATE * gone[-1]
    last_i = seen[-1] if late else ends

    def pose(i: int) -> Float[np.ndarray, "4 4"]:
        T = fit.T_world_obj.copy()
        T[:2, 3] += push.spots[i] - push.spots[0]
        return T

    def sure(i: int) -> float:
        return float(np.clip(fit.iou, 0, 1)) if i in seen else _UNSEEN_SURE

    trajectory = Trajectory([begins], [pose(begins)], [sure(begins)], ["no_depth"])
    count = min(max_poses, last_i - begins + 1)
    for i in np.unique(np.linspace(begins, last_i, count).round().astype(int)).tolist():
        trajectory.append(i, pose(i), sure(i), "no_depth")
    mask = s.masks[last_i] if late else np.zeros_like(s.first)
    unknown = _unknown(working, thing, s, last_i) if late else mask
    see = replace(see, last_i=last_i, last_mask=mask, last_hidden=unknown)
    first, last = (replace(fit, T_world_obj=trajectory.poses[k]) for k in (0, -1))
    placed = _placed(see, _EndPoses(first=first, last=last), trajectory)
    return replace(placed, hidden_in_hand=not late, T_world_seen=held.T_world_seen)


def _unknown(
    working: WorkingClip, thing: ObjectTrack, s: ObjectTrack, i: int
) -> Bool[np.ndarray, "h w"]:
    """Return what may hide a tool in a frame: the hand, and what it pushes."""
    return _hidden(working, (thing, s), s.masks[i], i) | _others((thing, s), s, i)


def _goal(
    kind: Kind, objects: tuple[ObjectTrack, ...], own_fit: Fit, goal_fit: Fit
) -> tuple[float, Within | None]:
    """Return how high above the table the manipulated object comes to rest, and over which disc [camera heights]."""
    if not KINDS[kind].touches or len(objects) < 2:
        return 0.0, None
    thing, other = objects[0].noun, objects[1].noun
    own, there = np.array(own_fit.size), np.array(goal_fit.size)
    if kind == "cover":
        support, within = _top_of(own, goal_fit)
        return (0.0 if thing.hollow else support), within
    reach = there[:2].max() / 2
    room = max(0.2 * reach, reach - own.min() / 2)
    support = _floor(there) if other.hollow else float(there[2])
    return support, Within(xy=goal_fit.T_world_obj[:2, 3], radius=float(room))


def _top_of(own: Float[np.ndarray, "3"], other_fit: Fit) -> tuple[float, Within]:
    """Return how high above the table a lid of a size lies on another thing, and over which disc [camera heights]."""
    there = np.array(other_fit.size)
    room = max(0.1 * there[:2].max(), (own[:2].max() - there[:2].max()) / 2)
    return float(there[2]), Within(xy=other_fit.T_world_obj[:2, 3], radius=float(room))


def _inside(fit: Fit, support: float, within: Within) -> Fit:
    """Return a pose in the middle of what swallowed it: deep bins hide what lies in them."""
    rest = _rest_of(fit.T_world_obj[:3, :3])
    height = support + float(np.abs(rest[2]) @ np.array(fit.size) / 2)
    return replace(fit, T_world_obj=transform(rest, np.array([*within.xy, height])))


def _floor(size: Float[np.ndarray, "3"]) -> float:
    """Return how high the floor of a hollow thing lies above the table, in units of its size."""
    return float(min(0.06 * size.min(), 0.15 * size[2]))


def _hidden(
    working: WorkingClip, objects: tuple[ObjectTrack, ...], mask: Bool[np.ndarray, "h w"], i: int
) -> Bool[np.ndarray, "h w"]:
    """Return pixels near a mask of frame `i` that say nothing: what passes there (the hand, a shadow) may hide the object.

    What passes differs from the still of the other end, except where that shows what has moved.
    """
    early = i < len(working.rgb) / 2
    background = working.late if early else working.early
    passing = np.linalg.norm(working.lab[i] - lab_of(background), axis=-1) > 12
    hidden = tidy(passing) & ~mask
    for s in objects:
        if s.moves and not s.in_hand:
            hidden &= ~grow(s.last if early else s.first, 2)
    x, y, w, h = bounding_box(mask)
    near = np.zeros_like(mask)
    pad = max(4, int(0.3 * max(w, h)))
    near[max(0, y - pad) : y + h + pad, max(0, x - pad) : x + w + pad] = True
    return hidden & near


def _others(objects: tuple[ObjectTrack, ...], s: ObjectTrack, i: int) -> Bool[np.ndarray, "h w"]:
    """Return where other objects are seen at working frame `i`: this one may go on behind them."""
    shown = [other.masks[i] for other in objects if other is not s]
    return np.any(shown, axis=0) & ~s.masks[i] if shown else np.zeros_like(s.first)


def _upright_axes(fit: Fit) -> Fit:
    """Return the same box with its own axes such that at first its z points up."""
    rest = _rest_of(fit.T_world_obj[:3, :3])
    size = np.abs(rest) @ np.array(fit.size)
    yawed = fit.T_world_obj[:3, :3] @ rest.T
    T = transform(yawed, fit.T_world_obj[:3, 3])
    return replace(fit, size=three(size), T_world_obj=T)


def _rest_of(rotation: Float[np.ndarray, "3 3"]) -> Float[np.ndarray, "3 3"]:
    """Return the resting orientation of a pose without its yaw: identity for upright things."""
    if rotation[2, 2] > 0.7:
        return np.eye(3)
    if rotation[2, 2] < -0.7:
        return np.diag([1.0, -1.0, -1.0])
    axis = "y" if abs(rotation[2, 0]) > 0.7 else "x"
    return Rotation.from_euler(axis, 90, degrees=True).as_matrix()


def _tipped_along(fit: Fit, T_first: Float[np.ndarray, "4 4"]) -> Fit:
    """Return the lying pose whose top points the way the object went: silhouettes do not tell top from bottom."""
    top = fit.T_world_obj[:3, 2]
    way = fit.T_world_obj[:3, 3] - T_first[:3, 3]
    if float(top[:2] @ way[:2]) >= 0:
        return fit
    T = fit.T_world_obj.copy()
    T[:3, :3] = np.diag([-1.0, -1.0, 1.0]) @ T[:3, :3]
    return replace(fit, T_world_obj=T)


def vote_of(s: ObjectTrack, fit: Fit) -> SizeVote:
    """Return what a fitted object says about the scale."""
    trust = max(0.1, fit.iou) * max(0.1, s.sure)
    return SizeVote(size=fit.size, noun=s.noun, trust=trust, known_m=s.known_m)

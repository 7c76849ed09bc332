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
from v2p_data.scene.classes import MOVED
from v2p_data.scene.colour import lab_of
from v2p_data.scene.find import SWALLOWING_KINDS, Watched, hand_at
from v2p_data.scene.footage import Footage
from v2p_data.scene.hand import hand_end
from v2p_data.scene.pose import (
    Fit,
    Silhouette,
    Within,
    camera_above,
    fit_held,
    fit_lifted,
    fit_pose,
    fit_shape,
    on_wall,
    orientations,
    three,
    yaw_of,
)
from v2p_data.scene.scale import SizeVote, camera_height_m, table_width_m
from v2p_data.scene.scene import Observed
from v2p_data.scene.segment import bounding_box, grow, tidy
from v2p_data.scene.sight import Sighting

_INSIDE_KINDS = (*SWALLOWING_KINDS, "place_onto")
UNSEEN_IOU = 0.35
"""An outline at the end that fits the object no better shows something else."""
_CARRY_KINDS = ("uncover", "generic", "drop_in_front_of")
_SLIDING_KINDS = ("push_left", "push_right", "push_next_to", "slide_to", "push_with")
_TURN_COST = 0.007
"""Of a pitch one standard deviation off the expected one, in units of IoU of all outlines together."""
_TOUCH_PX = 5
"""A tool is at work as long as it is so near to what it pushes; then it is in the air."""
_SEEN_RISING = 0.5
"""Of its height in the picture: a thing that is seen to rise less than this is hidden by the hand that lifts it."""
_LEFT_IN_SIGHT = 0.3
"""Of its area: where so much that moved is in sight, no hand hides it."""
_GOES_WITH_HAND = 0.5
"""How sure a pose is of what a hand hides."""
_NO_SPREAD = 0.01
"""Of the logarithm of a length that is known."""
_GRIP_HEIGHT_M = 0.08
"""Over the table, of a hand that pushes with something: the fist must clear the table."""
_OTHER_FORM_COST = 0.02
"""By so much a noun's second form must cover an outline better: a box has a side and a turn more to choose than a cylinder."""
_PITCH_RANGE_RAD = (0.15, 1.4)
"""From nearly level to nearly straight down: beyond, outlines on the table say nothing of places on it."""
_MOUTH_DOWN = np.diag([1.0, -1.0, -1.0])
type _Rests = list[tuple[Float[np.ndarray, "3 3"], float]]


@dataclass(frozen=True, kw_only=True)
class CameraGuess:
    """What is known of the camera before the outlines are looked at."""

    pitch_rad: float
    pitch_sd_rad: float
    fov_rad: float
    """Horizontal field of view."""
    height_m: float | None = None
    """Over the table, where something measured it."""
    height_sd: float = 0.12
    """Standard deviation of its logarithm."""
    table_width_m: float | None = None
    """How much of the table the picture shows from left to right at its middle, where something saw it."""
    table_width_sd: float = 0.2
    """Standard deviation of its logarithm."""

    def heights(self, pitch_rad: float) -> list[tuple[float, float]]:
        """Return what this says of the height [m], with the logarithm's standard deviation, at a fitted pitch."""
        out = []
        if self.height_m is not None:
            out.append((self.height_m, self.height_sd))
        if self.table_width_m is not None:
            focal_widths = 0.5 / np.tan(self.fov_rad / 2)
            shown = table_width_m(pitch_rad, focal_widths, 1.0)
            out.append((self.table_width_m / shown, self.table_width_sd))
        return out


@dataclass(frozen=True, kw_only=True)
class Placed:
    """One object in camera heights."""

    first: Fit
    last: Fit
    last_i: int
    """Footage frame of the last pose."""
    last_mask: Bool[np.ndarray, "h w"]
    hidden: Bool[np.ndarray, "h w"]
    """Where something may stand in front of it at first."""
    last_hidden: Bool[np.ndarray, "h w"]
    """The same at the last pose."""
    frames: tuple[int, ...]
    """Footage frames with a pose, the first and the last among them."""
    T_world_objs: Float[np.ndarray, "pose 4 4"]
    confidences: tuple[float, ...]
    observed: tuple[Observed, ...]
    rival: float | None
    """By how much the next best way of lying covers the outlines worse; None where there is no other."""
    in_fist: bool = False
    """Whether the hand that lifts it hides it from the camera: then its poses go with the hand."""


@dataclass(frozen=True, kw_only=True)
class Placement:
    """Camera and objects, in the order of the sightings."""

    camera: Camera
    """At working size, one camera height above the table."""
    pitch_rad: float
    objects: tuple[Placed, ...]
    height_m: float
    """Metres per camera height."""
    scale_spread: float
    """Standard deviation of the logarithm of `height_m`."""
    upright_cost: float
    """What standing as at first would have cost the manipulated object at the end."""


def place(
    footage: Footage,
    objects: tuple[Sighting, ...],
    kind: str,
    guess: CameraGuess,
    max_poses: int,
    watched: Watched | None = None,
) -> Placement:
    """Return camera, shapes and poses such that all outlines fit their masks, the manipulated object's at both ends.

    `watched` is what the network sees, where it was asked: then the hand helps to tell the scale.
    """
    thing = objects[0]
    unknown = [
        _hidden(footage, s.at, s.first, s.last if s.moves else None) | _others(objects, s, s.at)
        for s in objects
    ]
    images = [footage.rgb[s.at] for s in objects]
    rests = [_rests(s, kind if s is thing else "generic") for s in objects]
    ends = [_end_of(s, kind, thing) for s in objects]
    last_unknown = [
        _hidden(footage, last_i, last_mask, s.first) | _others(objects, s, last_i)
        if s.moves
        else hidden
        for s, (last_i, last_mask), hidden in zip(objects, ends, unknown, strict=True)
    ]
    resting = [k for k, s in enumerate(objects) if not s.in_hand]
    pitch_rad, fits = _best_pitch(
        [images[k] for k in resting],
        tuple(objects[k] for k in resting),
        [unknown[k] for k in resting],
        [rests[k] for k in resting],
        guess,
    )
    firsts = dict(zip(resting, fits, strict=True))
    camera = camera_above(footage.shape, pitch_rad, guess.fov_rad)
    carried = _carried(thing, watched) if kind == "lift_up" and watched is not None else ()
    upright_cost, lasts = 0.0, dict(firsts)
    rivals: list[float | None] = [None] * len(objects)
    for k in resting:
        s = objects[k]
        if not s.moves or (s is thing and carried):
            continue
        last_i, last_mask = ends[k]
        silhouette = Silhouette(last_mask, last_unknown[k], camera, footage.rgb[last_i])
        # One outline often fits a standing and a lying box alike; both ends together seldom do.
        options = _options(s, unknown[k], camera, rests[k], images[k])
        role = kind if s is thing else "push_with"
        goal = firsts.get(1) if s is thing else None
        support, within = _goal(kind, objects, firsts[0], goal) if goal else (0.0, None)
        found = [_fit_last(silhouette, s, role, first, support, within) for first in options]
        costs = [a.cost + b.cost for a, (b, _) in zip(options, found, strict=True)]
        best = int(np.argmin(costs))
        if len(costs) > 1:
            rivals[k] = float(np.partition(costs, 1)[1] - min(costs))
        firsts[k], (lasts[k], cost) = options[best], found[best]
        unseen = kind in SWALLOWING_KINDS and (s.swallowed or lasts[k].iou < UNSEEN_IOU)
        if unseen and within is not None:
            lasts[k] = _inside(lasts[k], support, within)
        upright_cost = cost if s is thing else upright_cost
    votes = [vote_of(objects[k], firsts[k]) for k in resting]
    known = guess.heights(pitch_rad)
    height_m, spread = camera_height_m(votes, known)
    if watched is not None and not any(s.in_hand for s in objects):
        stands = [(thing.first, firsts[0].T_world_obj[:3, 3])]
        if kind != "lift_up":  # it ends in mid-air
            stands.append((ends[0][1], lasts[0].T_world_obj[:3, 3]))
        from v2p_data.scene.ruler import height_by_hand  # torch takes a second to import

        by_hand = height_by_hand(
            footage, watched, thing.masks, stands, camera, pitch_rad, height_m
        )
        if by_hand is not None:
            height_m, spread = camera_height_m(votes, [*known, by_hand])
    for k, s in enumerate(objects):
        if s.in_hand:
            firsts[k], lasts[k] = _fit_in_hand(
                [
                    (Silhouette(mask, hidden, camera), thing.masks[i])
                    for i, mask, hidden in (
                        (s.at, s.first, unknown[k]),
                        (*ends[k], last_unknown[k]),
                    )
                ],
                s,
                height_m,
            )
    placed = []
    for k, s in enumerate(objects):
        last_i, last_mask = ends[k]
        course = _Course([0], [firsts[k].T_world_obj], [firsts[k].iou], ["full"])
        if s is thing and carried:
            last_i, last_mask = carried[-1][0], np.zeros_like(s.last)
            course = _course_in_hand(course, carried, camera)
            lasts[k] = replace(firsts[k], T_world_obj=course.poses[-1], iou=0.0, visible=0.0)
        elif s.moves:
            course = _course(s, kind, firsts[k], lasts[k], ends[k], camera, max_poses)
        else:
            course = course.then(len(s.masks) - 1, firsts[k].T_world_obj, firsts[k].iou, "full")
        placed.append(
            Placed(
                first=firsts[k],
                last=lasts[k],
                last_i=last_i,
                last_mask=last_mask,
                hidden=unknown[k],
                last_hidden=last_unknown[k],
                frames=tuple(course.frames),
                T_world_objs=np.stack(course.poses),
                confidences=tuple(course.sure),
                observed=tuple(course.observed),
                rival=rivals[k],
                in_fist=s is thing and bool(carried),
            )
        )
    return Placement(
        camera=camera,
        pitch_rad=pitch_rad,
        objects=tuple(placed),
        height_m=height_m,
        scale_spread=spread,
        upright_cost=upright_cost,
    )


def with_forms(
    footage: Footage, objects: tuple[Sighting, ...], guess: CameraGuess
) -> tuple[Sighting, ...]:
    """Return the sightings with their nouns in the form that their outlines fit, where a noun has two."""
    camera = camera_above(footage.shape, guess.pitch_rad, guess.fov_rad)
    out = []
    for s in objects:
        if s.noun.other is not None:
            unknown = _others(objects, s, s.at)
            silhouette = Silhouette(s.first, unknown, camera)
            usual, other = (
                fit_shape(silhouette, noun, np.eye(3)).cost for noun in (s.noun, s.noun.other)
            )
            s = replace(s, noun=s.noun.other if other + _OTHER_FORM_COST < usual else s.noun)
        out.append(s)
    return tuple(out)


def _best_pitch(
    images: list[UInt8[np.ndarray, "h w 3"]],
    objects: tuple[Sighting, ...],
    unknown: list[Bool[np.ndarray, "h w"]],
    rests: list[_Rests],
    guess: CameraGuess,
) -> tuple[float, list[Fit]]:
    """Try pitches around the guess; the silhouettes decide, as far as the guess lets them."""
    best: tuple[float, float, list[Fit]] | None = None
    tried: list[float] = []

    def fits_at(pitch: float, *, thorough: bool) -> list[Fit]:
        camera = camera_above(images[0].shape[:2], pitch, guess.fov_rad)
        return [
            min(
                _options(
                    s,
                    unknown[k],
                    camera,
                    rests[k][: None if thorough or k == 0 else 1],
                    images[k],
                    thorough=thorough,
                ),
                key=lambda fit: fit.cost,
            )
            for k, s in enumerate(objects)
        ]

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
    return best[1], fits_at(best[1], thorough=len(objects) > 1)


def _rests(s: Sighting, kind: str) -> _Rests:
    """Return the ways an object may rest at first, each with what it costs: a cover lies with its mouth down."""
    if s.noun.hollow and kind == "uncover":
        return [(_MOUTH_DOWN, 0.0)]
    if s.noun.hollow and kind == "cover":
        return [(_MOUTH_DOWN, 0.0), (np.eye(3), 0.03)]
    return orientations(s.noun)


def _options(
    s: Sighting,
    unknown: Bool[np.ndarray, "h w"],
    camera: Camera,
    rests: _Rests,
    image: UInt8[np.ndarray, "h w 3"],
    *,
    thorough: bool = True,
) -> list[Fit]:
    """Return the best fit for every way in which the object may rest."""
    silhouette = Silhouette(s.first, unknown, camera, image)
    fits = []
    for rest, extra in rests:
        fit = fit_shape(silhouette, s.noun, rest, thorough=thorough)
        fit = replace(fit, cost=fit.cost + extra)
        upright = s.noun.form == "box" and rest is not _MOUTH_DOWN
        fits.append(_upright_axes(fit) if upright else fit)
    return fits


def _end_of(s: Sighting, kind: str, thing: Sighting) -> tuple[int, Bool[np.ndarray, "h w"]]:
    """Return the footage frame of an object's last pose, and its mask there; `thing` is what is manipulated."""
    if s.role == "manipulated" and kind == "lift_up":
        i = _peak(s)
        return i, s.masks[i]
    if s.in_hand or (s.at > 0 and s.moves):  # a tool may be gone again before the clip ends
        seen = np.flatnonzero(s.masks.any((1, 2)))
        touching = [
            i for i in seen[seen > s.at] if (grow(s.masks[i], _TOUCH_PX) & thing.masks[i]).any()
        ]
        i = int(touching[-1] if s.in_hand and touching else seen[-1])
        return i, s.masks[i]
    return len(s.masks) - 1, s.last


def _fit_last(
    silhouette: Silhouette,
    s: Sighting,
    kind: str,
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
    if kind in _CARRY_KINDS:
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


def _fit_in_hand(
    seen: list[tuple[Silhouette, Bool[np.ndarray, "h w"]]], s: Sighting, height_m: float
) -> list[Fit]:
    """Return the poses of a tool in a hand, whose outline is seen beside that of what it pushes."""
    grip = _GRIP_HEIGHT_M / height_m

    def fits(size: tuple[float, float, float], spread: float) -> list[Fit]:
        return [fit_held(mask, s.noun, size, spread, pushed, grip) for mask, pushed in seen]

    if s.known_m:
        return fits(three(np.array(s.known_m) / height_m), _NO_SPREAD)
    free = fits(three(np.array(s.noun.size_m) / height_m), s.noun.spread)
    # It has one length: as long as it is seen.
    return fits(max((fit.size for fit in free), key=max), _NO_SPREAD)


def _goal(
    kind: str, objects: tuple[Sighting, ...], own_fit: Fit, goal_fit: Fit
) -> tuple[float, Within | None]:
    """Return how high above the table the manipulated object comes to rest, and over which disc [camera heights]."""
    if kind not in (*_INSIDE_KINDS, "cover") or len(objects) < 2:
        return 0.0, None
    thing, other = objects[0].noun, objects[1].noun
    own, there = np.array(own_fit.size), np.array(goal_fit.size)
    reach = there[:2].max() / 2
    if kind == "cover":
        room = max(0.2 * reach, (own[:2].max() - there[:2].max()) / 2)
        support = 0.0 if thing.hollow else float(there[2])
    else:
        room = max(0.2 * reach, reach - own.min() / 2)
        support = _floor(there) if other.hollow else float(there[2])
    return support, Within(xy=goal_fit.T_world_obj[:2, 3], radius=float(room))


def _inside(fit: Fit, support: float, within: Within) -> Fit:
    """Return a pose in the middle of what swallowed it: deep bins hide what lies in them."""
    rest = _rest_of(fit.T_world_obj[:3, :3])
    height = support + float(np.abs(rest[2]) @ np.array(fit.size) / 2)
    return replace(fit, T_world_obj=transform(rest, np.array([*within.xy, height])))


def _floor(size: Float[np.ndarray, "3"]) -> float:
    """Return how high the floor of a hollow thing lies above the table, in units of its size."""
    return float(min(0.06 * size.min(), 0.15 * size[2]))


@dataclass
class _Course:
    frames: list[int]
    poses: list[Float[np.ndarray, "4 4"]]
    sure: list[float]
    observed: list[Observed]

    def then(
        self, frame: int, pose: Float[np.ndarray, "4 4"], sure: float, observed: Observed
    ) -> "_Course":
        """Return the course with one pose more, unless it has one at that frame."""
        if frame > self.frames[-1]:
            self.frames.append(frame)
            self.poses.append(pose)
            self.sure.append(float(np.clip(sure, 0, 1)))
            self.observed.append(observed)
        return self


def _course(
    s: Sighting,
    kind: str,
    first_fit: Fit,
    last_fit: Fit,
    end: tuple[int, Bool[np.ndarray, "h w"]],
    camera: Camera,
    max_poses: int,
) -> _Course:
    """Return poses at well-tracked frames: position from the mask's centre, rotation blended."""
    first, last = first_fit.T_world_obj, last_fit.T_world_obj
    last_i, last_mask = end
    depth: Observed = "no_depth" if s.in_hand else "full"
    # What a hand brings has no pose before it comes.
    course = _Course([s.at], [first], [float(np.clip(first_fit.iou, 0, 1))], [depth])
    count = min(max_poses, last_i - s.at + 1)
    spots = np.unique(np.linspace(s.at, last_i, count).round().astype(int))
    on_table = kind in _SLIDING_KINDS
    turn = Rotation.from_matrix(last[:3, :3] @ first[:3, :3].T).as_rotvec()
    ends = [_centre(s.first), _centre(last_mask)]
    bias = [
        centre - camera.project(T[None, :3, 3])[0]
        for centre, T in zip(ends, (first, last), strict=True)
    ]
    travel = ends[1] - ends[0]
    for i in spots.tolist()[1:-1]:
        if s.quality[i] < 0.5 or not s.masks[i].any():
            continue
        centre = _centre(s.masks[i])
        share = float(np.clip((centre - ends[0]) @ travel / max(1.0, travel @ travel), 0, 1))
        pixel = centre - (1 - share) * bias[0] - share * bias[1]
        if on_table:
            position = camera.on_plane(pixel[None], float(first[2, 3]))[0]
        else:
            position = on_wall(
                camera, pixel, float((1 - share) * first[0, 3] + share * last[0, 3])
            )
            position[2] = max(position[2], min(first[2, 3], last[2, 3]))
        if not np.isfinite(position).all():
            continue
        rotation = Rotation.from_rotvec(share * turn).as_matrix() @ first[:3, :3]
        free = position[2] > max(first[2, 3], last[2, 3]) + 0.02
        course.then(
            i,
            transform(rotation, position),
            0.7 * float(s.quality[i]),
            "no_depth" if free else depth,
        )
    in_air = kind == "lift_up" or s.in_hand
    return course.then(last_i, last, last_fit.iou, "no_depth" if in_air else "full")


def _peak(s: Sighting) -> int:
    """Return the footage frame at which a lift is highest in the picture, among the believable ones.

    Where it is never higher than at first, that is the last believable one: a sleeve hides it from then on.
    """
    n = len(s.masks)
    heights = np.full(n, -np.inf)
    start = _centre(s.first)[1]
    for i in range(n):
        if s.quality[i] >= 0.5 and s.masks[i].any():
            heights[i] = start - _centre(s.masks[i])[1]
    top = heights.max()
    # The end of the clip counts as the peak when it is nearly as high: a hand that holds still trembles.
    near = heights >= 0.93 * top if top > 0 else np.isfinite(heights)
    return int(np.flatnonzero(near)[-1]) if near.any() else n - 1


def _carried(s: Sighting, watched: Watched) -> list[tuple[int, Float[np.ndarray, "2"]]]:
    """Return by how far the hand has moved in the picture since it took hold of a thing that it hides, in the frames since.

    It takes hold where its end stays longest, low and beside the thing. Nothing where the thing itself is seen going up, where
    no hand comes to it, where that hand does not rise, or where in the end something that moved is in sight.
    """
    i, (_, _, _, tall) = _peak(s), bounding_box(s.first)
    if _centre(s.first)[1] - _centre(s.masks[i])[1] > _SEEN_RISING * tall:
        return []
    home = grow(s.first, _TOUCH_PX)
    tips, holding = {}, []
    for at in watched.idx.tolist():
        hand = hand_at(watched, at)
        end = hand_end(hand)
        if end is not None:
            tips[at] = np.array(end.tip_px)
            holding += [at] if (hand & home).any() else []
    if not holding:
        return []
    middle = np.mean([max(tips[at][1] for at in holding), min(tip[1] for tip in tips.values())])
    order = list(tips)

    def haste(at: int) -> float:
        k = order.index(at)
        beside = [tips[other] for other in order[max(0, k - 1) : k + 2]]
        return float(np.linalg.norm(np.ptp(beside, axis=0)))

    grip = min((at for at in holding if tips[at][1] >= middle), key=haste)
    since = [(at, tip - tips[grip]) for at, tip in tips.items() if at > grip]
    risen = [k for k, (_, by) in enumerate(since) if -by[1] > _SEEN_RISING * tall]
    if not risen:
        return []
    since = since[: risen[-1] + 1]
    ending = since[-max(1, len(since) // 3) :]
    in_sight = np.median([(watched.at(at)[MOVED] > 0.5).sum() for at, _ in ending])
    return [] if in_sight > _LEFT_IN_SIGHT * s.first.sum() else since


def _course_in_hand(
    course: "_Course", carried: list[tuple[int, Float[np.ndarray, "2"]]], camera: Camera
) -> "_Course":
    """Return the course of what goes with a hand, as far away as it stood."""
    T_first = course.poses[0]
    start = camera.project(T_first[None, :3, 3])[0]
    for i, by in carried:
        position = on_wall(camera, start + by, float(T_first[0, 3]))
        position[2] = max(position[2], T_first[2, 3])
        course.then(i, transform(T_first[:3, :3], position), _GOES_WITH_HAND, "no_depth")
    return course


def _hidden(
    footage: Footage,
    i: int,
    mask: Bool[np.ndarray, "h w"],
    other_end: Bool[np.ndarray, "h w"] | None = None,
) -> Bool[np.ndarray, "h w"]:
    """Return pixels near the mask that say nothing: what passes there (the hand, a shadow) may hide the object."""
    background = footage.late if i < len(footage.rgb) / 2 else footage.early
    passing = np.linalg.norm(footage.lab[i] - lab_of(background), axis=-1) > 12
    hidden = tidy(passing) & ~mask
    if other_end is not None:
        hidden &= ~grow(other_end, 2)
    x, y, w, h = bounding_box(mask)
    near = np.zeros_like(mask)
    pad = max(4, int(0.3 * max(w, h)))
    near[max(0, y - pad) : y + h + pad, max(0, x - pad) : x + w + pad] = True
    return hidden & near


def _others(objects: tuple[Sighting, ...], s: Sighting, i: int) -> Bool[np.ndarray, "h w"]:
    """Return where other objects are seen at footage frame `i`: this one may go on behind them."""
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


def _centre(mask: Bool[np.ndarray, "h w"]) -> Float[np.ndarray, "2"]:
    y, x = np.nonzero(mask)
    return np.array([x.mean() + 0.5, y.mean() + 0.5]) if len(x) else np.array([np.nan, np.nan])


def vote_of(s: Sighting, fit: Fit) -> SizeVote:
    """Return what a fitted object says about the scale."""
    trust = max(0.1, fit.iou) * max(0.1, s.sure)
    return SizeVote(size=fit.size, noun=s.noun, trust=trust, known_m=s.known_m)

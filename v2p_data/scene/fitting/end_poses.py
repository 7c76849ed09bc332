"""One object at both ends: its size is the same, and the pair of poses that covers both outlines best is taken."""

from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Float
from scipy.spatial.transform import Rotation

from v2p_data.geometry.camera import Camera
from v2p_data.geometry.pose import transform
from v2p_data.scene.data_types import Fit, ObjectTrack, PlacedObject
from v2p_data.scene.fitting.object_view import MOUTH_DOWN, ObjectView, round_body
from v2p_data.scene.fitting.plans import FitPlan
from v2p_data.scene.fitting.shape_fit import Within, fit_lifted, fit_pose, fit_shape, three, yaw_of
from v2p_data.scene.fitting.silhouette import Silhouette
from v2p_data.scene.fitting.trajectory import Trajectory
from v2p_data.scene.scale.nouns import Noun

UNSEEN_IOU = 0.35
"""IoU: an outline at the end that the object covers no better shows something else."""
_LYING_TELLS = 0.1
"""IoU by which lying on the table at first must fit a lid better than lying on what it covered."""
_HELD_TELLS = 0.1
"""IoU by which a pose in the air must fit better than one on the table, where the clip may end
before it is put down."""
_UPRIGHT_TELLS = 0.1
"""IoU by which a cover must fit better with its mouth up, once it is put down."""


@dataclass(frozen=True, kw_only=True)
class EndPoses:
    """An object at both ends."""

    first: Fit
    last: Fit
    rival: float | None = None
    """Cost by which the next best way of resting is worse, in units of IoU; None where there is no other."""
    as_before: float = 0.0
    """What standing as at first would have cost at the end."""
    unseen: bool = False
    """Whether the goal hides where it ends."""
    lifted_off: bool = False
    """Whether it lies on the other object at first."""


def fit_both_ends(
    see: ObjectView, plan: FitPlan, camera: Camera, support: float, within: Within | None
) -> EndPoses:
    """Return the pair of poses that costs least; both ends together seldom fit a wrong pose.

    The last pose is `support` above the table [camera heights], over the disc `within`. Of what is
    brought there is the last outline alone.
    """
    options = fits_at_first(see, camera)
    if see.s.brought:
        options = [raised(fit, support, camera) for fit in options]
    body = round_body(see.last_mask, see.last_hidden, see.s.noun)
    silhouette = Silhouette(*body, camera, see.last_image)
    found = [_fit_last(silhouette, see.s, plan, first, support, within) for first in options]
    costs = [a.cost + b.cost for a, (b, _) in zip(options, found, strict=True)]
    best = int(np.argmin(costs))
    last, as_before = found[best]
    unseen = plan.may_be_hidden and (see.s.hidden_in_container or last.iou < UNSEEN_IOU)
    if unseen and within is not None:
        last = _inside(last, support, within)
    return EndPoses(
        first=options[best],
        last=last,
        rival=float(np.partition(costs, 1)[1] - min(costs)) if len(costs) > 1 else None,
        as_before=as_before,
        unseen=unseen and within is not None,
    )


def placed_along(see: ObjectView, fits: EndPoses, trajectory: Trajectory) -> PlacedObject:
    """Return an object with its poses."""
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
        lifted_off=fits.lifted_off,
    )


def raised(fit: Fit, support: float, camera: Camera) -> Fit:
    """Return what covers the same pixels `support` above the table: smaller, and nearer to the camera."""
    nearer = 1 - support
    eye = camera.T_world_cam[:3, 3]
    T = transform(fit.T_world_obj[:3, :3], eye + nearer * (fit.T_world_obj[:3, 3] - eye))
    return replace(fit, size=three(nearer * np.array(fit.size)), T_world_obj=T)


def fits_at_first(see: ObjectView, camera: Camera, *, thorough: bool = True) -> list[Fit]:
    """Return the best fit for every way in which the object may rest."""
    noun = see.s.noun
    silhouette = Silhouette(*round_body(see.s.first, see.hidden, noun), camera, see.image)
    fits = []
    for rest, extra in see.rests:
        fit = fit_shape(silhouette, noun, rest, thorough=thorough)
        fit = replace(fit, cost=fit.cost + extra)
        upright = noun.form == "box" and rest is not MOUTH_DOWN
        fits.append(_upright_axes(fit) if upright else fit)
    return fits


def _fit_last(
    silhouette: Silhouette,
    s: ObjectTrack,
    plan: FitPlan,
    first: Fit,
    support: float,
    within: Within | None,
) -> tuple[Fit, float]:
    """Return an object's pose at the end, and what standing as at first would have cost."""
    noun = s.noun
    if plan.end == "in_air":
        return fit_lifted(silhouette, noun, first.size, first.T_world_obj), 0.0
    rest = rest_of(first.T_world_obj[:3, :3])
    yaw = yaw_of(first.T_world_obj[:3, :3], rest)
    if plan.mouth_last == "down" and noun.hollow:
        rest = MOUTH_DOWN
    same = fit_pose(
        silhouette, noun, first.size, rest, yaw_near=yaw, support=support, within=within
    )
    if plan.mouth_last == "down_or_up" and noun.hollow:  # put down either way
        upright = fit_pose(silhouette, noun, first.size, np.eye(3), yaw_near=yaw)
        same = upright if upright.cost + _UPRIGHT_TELLS < same.cost else same
    if plan.may_end_held:
        held = fit_lifted(silhouette, noun, first.size, first.T_world_obj)
        if held.cost + _HELD_TELLS < same.cost:  # the clip ends before it is put down
            return held, same.cost
    if plan.end != "tipped" or noun.form == "sphere":
        return same, same.cost
    turned = []
    for axis in ("y", "x"):
        tipped = Rotation.from_euler(axis, 90, degrees=True).as_matrix() @ rest
        fit = fit_pose(silhouette, noun, first.size, tipped)
        turned.append(_tipped_along(fit, first.T_world_obj))
    return min(turned, key=lambda fit: fit.cost), same.cost


def is_lid(noun: Noun) -> bool:
    """Return whether what covers something lies on top of it: cups and bowls stand around it, cloths hang down."""
    return not noun.hollow and noun.matter == "rigid"


def fit_lifted_off(see: ObjectView, lying: EndPoses, other_fit: Fit, camera: Camera) -> EndPoses:
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


def goal_of(
    plan: FitPlan, objects: tuple[ObjectTrack, ...], own_fit: Fit, goal_fit: Fit
) -> tuple[float, Within | None]:
    """Return how high above the table the manipulated object comes to rest, and over which disc [camera heights]."""
    if plan.goal == "anywhere" or len(objects) < 2:
        return 0.0, None
    thing, other = objects[0].noun, objects[1].noun
    own, there = np.array(own_fit.size), np.array(goal_fit.size)
    if plan.goal == "on_top":
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
    """Return a pose in the middle of the container: deep bins hide their content."""
    rest = rest_of(fit.T_world_obj[:3, :3])
    height = support + float(np.abs(rest[2]) @ np.array(fit.size) / 2)
    return replace(fit, T_world_obj=transform(rest, np.array([*within.xy, height])))


def _floor(size: Float[np.ndarray, "3"]) -> float:
    """Return how high the floor of a hollow thing lies above the table, in units of its size."""
    return float(min(0.06 * size.min(), 0.15 * size[2]))


def _upright_axes(fit: Fit) -> Fit:
    """Return the same box with its own axes such that at first its z points up."""
    rest = rest_of(fit.T_world_obj[:3, :3])
    size = np.abs(rest) @ np.array(fit.size)
    yawed = fit.T_world_obj[:3, :3] @ rest.T
    T = transform(yawed, fit.T_world_obj[:3, 3])
    return replace(fit, size=three(size), T_world_obj=T)


def rest_of(rotation: Float[np.ndarray, "3 3"]) -> Float[np.ndarray, "3 3"]:
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

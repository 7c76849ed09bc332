"""Masks become a camera, shapes and poses: everything here is in camera heights, until `height_m` turns it into metres.

The camera stands at (0, 0, 1), level, and looks along +x. Objects rest on the table unless something shows that they
are held; how far away something in mid-air is cannot be seen from one side and is taken over from where it stood.
"""

from dataclasses import replace

import numpy as np
from jaxtyping import Float

from v2p_data.geometry.camera import Camera
from v2p_data.kinds import Kind
from v2p_data.scene.data_types import (
    CameraGuess,
    Fit,
    ObjectTrack,
    PlacedObject,
    Placement,
    RestingObject,
)
from v2p_data.scene.fitting.end_poses import (
    EndPoses,
    fit_both_ends,
    fit_lifted_off,
    goal_of,
    is_lid,
    placed_along,
)
from v2p_data.scene.fitting.object_view import ObjectView, object_view
from v2p_data.scene.fitting.pitch import best_pitch
from v2p_data.scene.fitting.plans import TOOL, FitPlan, plan_of
from v2p_data.scene.fitting.silhouette import camera_above
from v2p_data.scene.fitting.tool_pose import place_tool
from v2p_data.scene.fitting.trajectory import (
    Trajectory,
    carried_by_hand,
    trajectory_between,
    trajectory_in_hand,
)
from v2p_data.scene.frames.segmentation import Segmentation
from v2p_data.scene.frames.working_clip import WorkingClip
from v2p_data.scene.scale.camera_height import SizeVote, camera_height_m


def place(
    working: WorkingClip,
    objects: tuple[ObjectTrack, ...],
    kind: Kind,
    guess: CameraGuess,
    max_poses: int,
    segmentation: Segmentation,
) -> Placement:
    """Return camera, shapes and poses such that all outlines fit their masks, the manipulated object's at both ends.

    `segmentation` is what the network sees: the hand helps to tell the scale.
    """
    thing, plan = objects[0], plan_of(kind)
    views = [object_view(working, objects, s, plan) for s in objects]
    resting = [k for k, s in enumerate(objects) if not s.in_hand]
    pitch_rad, firsts = best_pitch([views[k] for k in resting], guess)
    camera = camera_above(working.shape, pitch_rad, guess.fov_rad)
    carried = []
    if plan.end == "in_air":
        carried = carried_by_hand(thing, segmentation)
    fits = {k: EndPoses(first=fit, last=fit) for k, fit in zip(resting, firsts, strict=True)}
    if thing.moves and 0 in fits and not carried:
        fits[0] = _manipulated(views[0], objects, fits, plan, camera)
    for k in resting:
        if k and objects[k].moves:
            fits[k] = fit_both_ends(views[k], TOOL, camera, 0.0, None)
    votes = [vote_of(objects[k], fits[k].first) for k in resting]
    known = guess.heights(pitch_rad)
    height_m, spread = camera_height_m(votes, known)
    if len(resting) == len(objects):
        resting_object = _resting_object(views[0], fits[0], plan, camera, pitch_rad)
        from v2p_data.scene.fitting.hand_scale import height_from_hand  # imports torch

        if by_hand := height_from_hand(working, segmentation, resting_object, height_m):
            height_m, spread = camera_height_m(votes, [*known, by_hand])
    placed: list[PlacedObject] = []
    for k, see in enumerate(views):
        if k == 0 and carried:
            placed.append(_hidden_in_hand(see, fits[k], carried, camera))
        elif see.s.in_hand:
            tool = place_tool(see, thing, placed[0], camera, height_m, working, segmentation)
            placed.append(tool)
        else:
            trajectory = _trajectory(see, fits[k], plan, camera, max_poses)
            placed.append(placed_along(see, fits[k], trajectory))
    return Placement(
        camera=camera,
        pitch_rad=pitch_rad,
        objects=tuple(placed),
        height_m=height_m,
        scale_spread=spread,
        upright_cost=fits[0].as_before,
    )


def _manipulated(
    see: ObjectView,
    objects: tuple[ObjectTrack, ...],
    fits: dict[int, EndPoses],
    plan: FitPlan,
    camera: Camera,
) -> EndPoses:
    """Return the manipulated object at both ends, as its kind of task says."""
    support, within = 0.0, None
    if 1 in fits:
        support, within = goal_of(plan, objects, fits[0].first, fits[1].first)
    out = fit_both_ends(see, plan, camera, support, within)
    if plan.starts_on_other and 1 in fits and is_lid(see.s.noun):
        out = fit_lifted_off(see, out, fits[1].first, camera)
    return out


def _resting_object(
    see: ObjectView, fits: EndPoses, plan: FitPlan, camera: Camera, pitch_rad: float
) -> RestingObject:
    """Return the object where the hand takes it and, unless that is in mid-air, where the hand leaves it."""
    rests = [(see.s.first, fits.first.T_world_obj[:3, 3])]
    if plan.end != "in_air":
        rests.append((see.last_mask, fits.last.T_world_obj[:3, 3]))
    return RestingObject(masks=see.s.masks, rests=rests, camera=camera, pitch_rad=pitch_rad)


def _trajectory(
    see: ObjectView, fits: EndPoses, plan: FitPlan, camera: Camera, max_poses: int
) -> Trajectory:
    if see.s.moves:
        end = (see.last_i, see.last_mask)
        return trajectory_between(see.s, plan, fits.first, fits.last, end, camera, max_poses)
    pose, iou = fits.first.T_world_obj, fits.first.iou
    return Trajectory([0], [pose], [iou], ["full"]).append(len(see.s.masks) - 1, pose, iou, "full")


def _hidden_in_hand(
    see: ObjectView,
    fits: EndPoses,
    carried: list[tuple[int, Float[np.ndarray, "2"]]],
    camera: Camera,
) -> PlacedObject:
    """Return what a hand hides and carries as far in the picture."""
    start = Trajectory([0], [fits.first.T_world_obj], [fits.first.iou], ["full"])
    trajectory = trajectory_in_hand(start, carried, camera)
    last = replace(fits.first, T_world_obj=trajectory.poses[-1], iou=0.0, visible=0.0)
    see = replace(see, last_i=carried[-1][0], last_mask=np.zeros_like(see.last_mask))
    return replace(placed_along(see, replace(fits, last=last), trajectory), hidden_in_hand=True)


def vote_of(s: ObjectTrack, fit: Fit) -> SizeVote:
    """Return what a fitted object says about the scale."""
    trust = max(0.1, fit.iou) * max(0.1, s.sure)
    return SizeVote(size=fit.size, noun=s.noun, trust=trust, known_m=s.known_m)

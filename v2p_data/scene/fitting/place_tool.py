"""A tool in a hand gets a pose in every frame in which it pushes."""

from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Float

from v2p_data.geometry.camera import Camera
from v2p_data.scene.data_types import ObjectTrack, PlacedObject
from v2p_data.scene.fitting.end_poses import EndPoses
from v2p_data.scene.fitting.object_view import ObjectView, unknown_around
from v2p_data.scene.fitting.shape_fit import three
from v2p_data.scene.fitting.silhouette import Silhouette
from v2p_data.scene.fitting.tool_pose import Pushed, fit_tool_pose, push_motion
from v2p_data.scene.fitting.trajectory import Trajectory
from v2p_data.scene.frames.segmentation import Segmentation
from v2p_data.scene.frames.working_clip import WorkingClip

_NO_SPREAD = 0.01
"""Standard deviation of the logarithm of a length that the user gave."""
_MOST_VIEWS = 5
"""Frames in which a tool's outline is compared with its pose: more take longer and fit no better."""
_LATE = 0.6
"""Share of the pushed object's way, 0 to 1, from which on an outline shows how the tool ends."""
_LEAST_QUALITY = 0.4
"""Quality, 0 to 1, of a mask that is compared."""
_UNSEEN_SURE = 0.4
"""Confidence, 0 to 1, of a tool's pose in a frame without a mask."""


@dataclass(frozen=True, kw_only=True)
class SeenIn:
    """The frames, and what the network sees in them, where it was asked."""

    working: WorkingClip
    segmentation: Segmentation | None


def place_tool(
    see: ObjectView,
    thing: ObjectTrack,
    pushed: PlacedObject,
    camera: Camera,
    height_m: float,
    seen_in: SeenIn,
    max_poses: int,
) -> PlacedObject:
    """Return the poses of a tool in a hand while the pushed object moves."""
    s = see.s
    ground = camera.on_plane(np.argwhere(s.first).mean(0)[None, ::-1])[0][:2]
    push = push_motion(
        Pushed(
            trajectory=Trajectory(list(pushed.frames), list(pushed.T_world_objs), [], []),
            fit=pushed.first,
            form=thing.noun.form,
        ),
        len(s.masks),
        ground if np.isfinite(ground).all() else np.zeros(2),
        camera,
        height_m,
        seen_in.segmentation,
    )
    begins, ends = push.frames
    seen = [
        i
        for i in range(max(s.at, begins), ends + 1)
        if s.masks[i].any() and s.quality[i] > _LEAST_QUALITY
    ] or [s.at]
    few = np.unique(np.linspace(0, len(seen) - 1, _MOST_VIEWS).round().astype(int))
    views = [
        (i, Silhouette(s.masks[i], unknown_around(seen_in.working, thing, s, i), camera))
        for i in (seen[k] for k in few)
    ]
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
    unknown = unknown_around(seen_in.working, thing, s, last_i) if late else mask
    see = replace(see, last_i=last_i, last_mask=mask, last_hidden=unknown)
    first, last = (replace(fit, T_world_obj=trajectory.poses[k]) for k in (0, -1))
    placed = placed_along(see, EndPoses(first=first, last=last), trajectory)
    return replace(placed, hidden_in_hand=not late, T_world_seen=held.T_world_seen)


def placed_along(see: ObjectView, fits: EndPoses, trajectory: Trajectory) -> PlacedObject:
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

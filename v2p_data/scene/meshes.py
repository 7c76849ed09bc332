"""Every object gets its mesh, and the last pose is fitted once more with it."""

from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Float

from v2p_data.geometry.pose import transform
from v2p_data.scene.data_types import GroundedObjects, Placement
from v2p_data.scene.fitting.end_poses import UNSEEN_IOU
from v2p_data.scene.fitting.metric import metric_camera, scene_origin
from v2p_data.scene.fitting.refine_pose import refine_pose, warped_trajectory
from v2p_data.scene.shapes.shape import ShapeChoice, best_shape
from v2p_data.scene.shapes.silhouette_view import SilhouetteView


@dataclass(frozen=True, kw_only=True)
class MeshedObject:
    """An object's mesh, and its poses in the scene frame [m]."""

    shape: ShapeChoice
    T_world_objs: Float[np.ndarray, "pose 4 4"]


def with_meshes(
    grounded: GroundedObjects, placement: Placement
) -> tuple[Placement, list[MeshedObject]]:
    """Return the objects' meshes and poses, and the placement knowing how well the meshes cover the last outlines."""
    origin, height = scene_origin(placement), placement.height_m
    work = metric_camera(placement.camera, origin, height)
    objects, out = list(placement.objects), []
    for k, (s, placed) in enumerate(zip(grounded.objects, placement.objects, strict=True)):
        length, width, tall = (float(v) * height for v in placed.first.size)
        seen = placed.T_world_objs[0] if placed.T_world_seen is None else placed.T_world_seen
        at_first, *rest = (
            transform(T[:3, :3], (T[:3, 3] - origin) * height)
            for T in (seen, *placed.T_world_objs)
        )
        poses = np.stack(rest)
        first = SilhouetteView(mask=s.first, T_world_obj=at_first, hidden=placed.hidden)
        last = SilhouetteView(
            mask=placed.last_mask, T_world_obj=poses[-1], hidden=placed.last_hidden
        )
        shape = best_shape(
            last if placed.lifted_off else first,
            work,
            (length, width, tall),
            s.noun,
            handles=s.known_m is None,
        )
        poses = poses @ shape.T_obj_shape
        shows_it = (
            s.moves
            and not s.hidden_in_container
            and placed.last.iou > UNSEEN_IOU
            and not s.in_hand
        )
        if shows_it and shape.kind != "primitive" and not placed.lifted_off:
            in_air = placed.observed[-1] == "no_depth"
            view = replace(last, T_world_obj=poses[-1])
            found = refine_pose(view, poses[0], shape.mesh, work, in_air=in_air)
            if found is not None:
                poses = warped_trajectory(poses, found.T_world_mesh)
                covered = replace(placed.last, iou=max(placed.last.iou, found.iou))
                objects[k] = replace(placed, last=covered)
        out.append(MeshedObject(shape=shape, T_world_objs=poses))
    return replace(placement, objects=tuple(objects)), out

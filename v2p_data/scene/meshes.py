"""Every object gets its mesh, and its poses in the scene frame."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

from v2p_data.geometry.pose import transform
from v2p_data.scene.data_types import GroundedObjects, Placement
from v2p_data.scene.fitting.metric import metric_camera, scene_origin
from v2p_data.scene.shapes.shape import ShapeChoice, best_shape
from v2p_data.scene.shapes.silhouette_view import SilhouetteView


@dataclass(frozen=True, kw_only=True)
class MeshedObject:
    """An object's mesh, and its poses in the scene frame [m]."""

    shape: ShapeChoice
    T_world_objs: Float[np.ndarray, "pose 4 4"]


def with_meshes(grounded: GroundedObjects, placement: Placement) -> list[MeshedObject]:
    """Return the objects' meshes and poses."""
    origin, height = scene_origin(placement), placement.height_m
    work = metric_camera(placement.camera, origin, height)
    out = []
    for s, placed in zip(grounded.objects, placement.objects, strict=True):
        length, width, tall = (float(v) * height for v in placed.first.size)
        seen = placed.T_world_objs[0] if placed.T_world_seen is None else placed.T_world_seen
        at_first, *rest = (
            transform(T[:3, :3], (T[:3, 3] - origin) * height)
            for T in (seen, *placed.T_world_objs)
        )
        poses = np.stack(rest)
        view = SilhouetteView(mask=s.first, T_world_obj=at_first, hidden=placed.hidden)
        if placed.lifted_off:
            view = SilhouetteView(
                mask=placed.last_mask, T_world_obj=poses[-1], hidden=placed.last_hidden
            )
        shape = best_shape(view, work, (length, width, tall), s.noun)
        out.append(MeshedObject(shape=shape, T_world_objs=poses @ shape.T_obj_shape))
    return out

"""Can an episode start like this? Looks at the poses that task code put its objects into, before anything is trained.

`Randomizer.place` never gives such poses; task code of its own making may. Poses that are no finite unit poses are
refused at every reset (`task.guarded`).
"""

# pyright: reportAttributeAccessIssue=false
# mujoco's classes come from a compiled module that declares none of them.

import copy
from collections.abc import Mapping

import mujoco
import numpy as np
from jaxtyping import Float

from v2p_data.errors import ItemRejectedError
from v2p_data.sim.world import World

OVERLAP_M = 0.003
"""Deeper is no contact but one thing inside another, which the first step would throw apart."""
TABLE_REACH_M = 1.4
"""The table ends here, from the robot's base."""


def check_start(
    world: World, fields: Mapping[str, np.ndarray], qpos: Float[np.ndarray, "env q"], task: str
) -> None:
    """Demand that objects stand on the table and not in each other.

    Args:
        world: the model.
        fields: model fields that differ between worlds (`Randomizer.fields`).
        qpos: the worlds' states after a reset.
        task: its title, for messages.

    Raises:
        ItemRejectedError: `starts_off_the_table`, `starts_in_the_table` or `objects_start_in_each_other`.
    """
    advice = "correct its reset_objects_states, or return super().reset_objects_states(env_ids)"
    for obj in world.objects:
        pose = qpos[:, obj.qpos_adr : obj.qpos_adr + 7]
        distance = float(np.linalg.norm(pose[:, :2], axis=1).max())
        if distance > TABLE_REACH_M:
            raise ItemRejectedError(
                "starts_off_the_table",
                f"task '{task}' starts '{obj.name}' up to {distance:.2f} m from the robot, where the table ends at "
                f"{TABLE_REACH_M} m: {advice}",
                distance,
            )
    model, names = copy.copy(world.model), {o.body_id: o.name for o in world.objects}
    data = mujoco.MjData(model)
    for env in range(len(qpos)):
        for name, value in fields.items():
            own = getattr(model, name)
            rows = value[env].reshape(-1, *own.shape[1:])
            own[: len(rows)] = rows  # of bvh_aabb, the bodies' come before the meshes'
        data.qpos[:] = qpos[env]
        mujoco.mj_fwdPosition(model, data)
        for contact in data.contact:
            if contact.dist > -OVERLAP_M:
                continue
            one, other = (names.get(int(model.geom_bodyid[g])) for g in contact.geom)
            depth = f"{-contact.dist * 1000:.0f} mm"
            if one and other:
                raise ItemRejectedError(
                    "objects_start_in_each_other",
                    f"task '{task}' starts '{one}' {depth} inside '{other}'; objects must start apart: {advice}",
                    float(-contact.dist),
                )
            if (one or other) and 0 in model.geom_bodyid[contact.geom]:
                raise ItemRejectedError(
                    "starts_in_the_table",
                    f"task '{task}' starts '{one or other}' {depth} inside the table; objects must stand on it: "
                    f"{advice}",
                    float(-contact.dist),
                )

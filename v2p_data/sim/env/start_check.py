"""Can an episode start like this? Looks at the poses that task code put its objects into.

`Randomizer.place` never gives such poses; task code of its own making may, and may count its
resets. So every world is looked at whenever it starts: by arithmetic (`check_poses`), and where the
poses are the task's own, by MuJoCo's collisions (`check_start`). Poses that are no finite unit poses
are refused at every reset (`task.guarded`).
"""

# pyright: reportAttributeAccessIssue=false
# mujoco's classes come from a compiled module that declares none of them.

import copy
from collections.abc import Mapping

import mujoco
import numpy as np
from jaxtyping import Float, Int

from v2p_data.errors import ItemRejectedError
from v2p_data.geometry.rotation import matrices
from v2p_data.sim.model.world import ObjectModel, World

OVERLAP_M = 0.003
"""Deeper is no contact but one thing inside another, which the first step would throw apart."""
TABLE_REACH_M = 1.4
"""The table ends here, from the robot's base."""
IN_THE_AIR_M = 0.01
"""A thing whose lowest point is this far above all that could carry it starts by falling."""
SOLVED_AT_MOST = 0.1
"""Share of starts in success: some layouts of some tasks are so by chance. Their episodes never count."""
SOLVED_BY_CHANCE = 3
"""So many solved starts say nothing of a share."""
ADVICE = "correct its reset_objects_states, or return super().reset_objects_states(env_ids)"


def check_poses(
    world: World,
    size_m: Float[np.ndarray, "n object 3"],
    poses: Float[np.ndarray, "n object 7"],
    task: str,
) -> None:
    """Demand that objects lie on the table or on each other, not in the air, in the table or in each other.

    Args:
        world: the model.
        size_m: the objects' sizes in these worlds.
        poses: where task code starts them.
        task: its title, for messages.

    Raises:
        ItemRejectedError: `starts_off_the_table`, `starts_in_the_table`, `starts_in_the_air` or
            `objects_start_in_each_other`.
    """
    objects = world.objects
    distance = np.sqrt((poses[:, :, :2] ** 2).sum(2)).max(0)
    for k, obj in enumerate(objects):
        if distance[k] > TABLE_REACH_M:
            raise ItemRejectedError(
                "starts_off_the_table",
                f"task '{task}' starts '{obj.name}' up to {distance[k]:.2f} m from the robot, where the table ends at "
                f"{TABLE_REACH_M} m: {ADVICE}",
                float(distance[k]),
            )
    extents = [_extent(obj, size_m[:, k], poses[:, k]) for k, obj in enumerate(objects)]
    low = np.array([lowest for lowest, _ in extents])
    for k, obj in enumerate(objects):
        depth = float(-low[k].min())
        if depth > OVERLAP_M:
            raise ItemRejectedError(
                "starts_in_the_table",
                f"task '{task}' starts '{obj.name}' {depth * 1000:.0f} mm inside the table; objects must stand on it: "
                f"{ADVICE}",
                depth,
            )
    for a, b in _solid_pairs(objects):
        room = (size_m[:, a].min(1) + size_m[:, b].min(1)) / 2
        apart = np.linalg.norm(poses[:, a, :3] - poses[:, b, :3], axis=1)
        depth = float((room - apart).max())
        if depth > OVERLAP_M:
            raise ItemRejectedError(
                "objects_start_in_each_other",
                f"task '{task}' starts '{objects[a].name}' {depth * 1000:.0f} mm or more inside '{objects[b].name}'; "
                f"objects must start apart: {ADVICE}",
                depth,
            )
    if not (low <= IN_THE_AIR_M).all():
        _check_carried(objects, size_m, poses, extents, task)


def _check_carried(
    objects: tuple[ObjectModel, ...],
    size_m: Float[np.ndarray, "n object 3"],
    poses: Float[np.ndarray, "n object 7"],
    extents: list[tuple[Float[np.ndarray, "n"], Float[np.ndarray, "n"]]],
    task: str,
) -> None:
    """Demand that what is not on the table lies on another object; `extents` are lowest and highest points."""
    low = np.array([lowest for lowest, _ in extents])
    fall = low.copy()
    reach = np.linalg.norm(size_m, axis=2).T / 2
    for a in range(len(objects)):
        for b in range(len(objects)):
            if a != b:
                apart = np.linalg.norm(poses[:, a, :2] - poses[:, b, :2], axis=1)
                above = low[a] - extents[b][1]
                fall[a] = np.where(
                    apart < reach[a] + reach[b], np.minimum(fall[a], above), fall[a]
                )
        if fall[a].max() > IN_THE_AIR_M:
            raise ItemRejectedError(
                "starts_in_the_air",
                f"task '{task}' starts '{objects[a].name}' {fall[a].max() * 1000:.0f} mm above what could carry it; "
                f"objects must lie on the table or on each other: {ADVICE}",
                float(fall[a].max()),
            )


def check_solved(solved: int, starts: int, task: str) -> None:
    """Demand that no more episodes begin in success than chance explains.

    Raises:
        ItemRejectedError: `starts_solved`.
    """
    allowed = SOLVED_AT_MOST * starts
    if solved > max(SOLVED_BY_CHANCE, allowed + 3 * allowed**0.5):
        raise ItemRejectedError(
            "starts_solved",
            f"task '{task}' starts solved: its success is true at {solved} of {starts} starts, before the robot has "
            f"done anything; {ADVICE}",
            solved / starts,
        )


def _extent(
    obj: ObjectModel, size_m: Float[np.ndarray, "n 3"], pose: Float[np.ndarray, "n 7"]
) -> tuple[Float[np.ndarray, "n"], Float[np.ndarray, "n"]]:
    """Return the heights of an object's lowest and highest points [m]."""
    if obj.kind == "sphere":
        return pose[:, 2] - size_m[:, 0] / 2, pose[:, 2] + size_m[:, 0] / 2
    up = matrices(pose[:, 3:].T)[2].T * (size_m / np.asarray(obj.size_m))
    heights = up @ obj.hull.T
    return pose[:, 2] + heights.min(1), pose[:, 2] + heights.max(1)


def _solid_pairs(objects: tuple[ObjectModel, ...]) -> list[tuple[int, int]]:
    """Return the pairs of objects whose inscribed balls may not overlap: neither is hollow or a mesh."""
    solid = [k for k, obj in enumerate(objects) if obj.kind in ("box", "cylinder", "sphere")]
    return [(a, b) for a in solid for b in solid if a < b]


def check_start(
    world: World,
    fields: Mapping[str, np.ndarray],
    qpos: Float[np.ndarray, "env q"],
    ids: Int[np.ndarray, "n"],
    task: str,
) -> None:
    """Demand of some worlds, by MuJoCo's collisions, that objects are in nothing and the arm touches none.

    Args:
        world: the model.
        fields: model fields that differ between worlds (`Randomizer.fields`).
        qpos: the worlds' states after a reset.
        ids: the worlds to look at.
        task: its title, for messages.

    Raises:
        ItemRejectedError: `starts_in_the_table`, `objects_start_in_each_other` or `arm_starts_at_an_object`.
    """
    if not len(ids):
        return
    model, names = copy.copy(world.model), {o.body_id: o.name for o in world.objects}
    data = mujoco.MjData(model)
    for env in ids:
        for name, value in fields.items():
            own = getattr(model, name)
            rows = value[env].reshape(-1, *own.shape[1:])
            own[: len(rows)] = rows  # of bvh_aabb, the bodies' come before the meshes'
        data.qpos[:] = qpos[env]
        mujoco.mj_fwdPosition(model, data)
        for contact in data.contact:
            one, other = (names.get(int(model.geom_bodyid[g])) for g in contact.geom)
            is_table = 0 in model.geom_bodyid[contact.geom]
            depth = f"{-contact.dist * 1000:.0f} mm"
            if (one is None) != (other is None) and not is_table:
                raise ItemRejectedError(
                    "arm_starts_at_an_object",
                    f"task '{task}' starts '{one or other}' where the arm is; objects must start apart from it: "
                    f"{ADVICE}",
                    float(-contact.dist),
                )
            if contact.dist > -OVERLAP_M:
                continue
            if one and other:
                raise ItemRejectedError(
                    "objects_start_in_each_other",
                    f"task '{task}' starts '{one}' {depth} inside '{other}'; objects must start apart: {ADVICE}",
                    float(-contact.dist),
                )
            if (one or other) and is_table:
                raise ItemRejectedError(
                    "starts_in_the_table",
                    f"task '{task}' starts '{one or other}' {depth} inside the table; objects must stand on it: "
                    f"{ADVICE}",
                    float(-contact.dist),
                )

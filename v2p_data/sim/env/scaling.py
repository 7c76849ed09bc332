"""How an object of another size, mass and friction is written into the model fields of each world."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Int
from scipy.spatial.transform import Rotation

from v2p_data.sim.model.world import ObjectModel, World


@dataclass(frozen=True, kw_only=True)
class Draw:
    """What was drawn for one object."""

    scale: Float[np.ndarray, "n 3"]
    """Of its size, along its own axes."""
    mass: Float[np.ndarray, "n"]
    friction: Float[np.ndarray, "n"]
    mesh_idx: Int[np.ndarray, "n"]
    """Which of the ready-made sizes of a mesh."""


class FieldWriter:
    """Writes draws into model fields, and what follows from them beside those.

    Args:
        world: the model.
        base: its fields as they were compiled.
    """

    def __init__(self, world: World, base: dict[str, np.ndarray]) -> None:
        self.world, self.base = world, base
        self.rest = [
            Rotation.from_quat(o.rest_quat, scalar_first=True).as_matrix() for o in world.objects
        ]

    def write(self, into: dict[str, np.ndarray], ids: np.ndarray, k: int, draw: Draw) -> None:
        """Write one object's draw for the worlds `ids`.

        Args:
            into: fields with a leading axis of worlds, and the arrays of `Randomizer.per_world_arrays`.
            ids: rows to be written.
            k: number of the object.
            draw: a row for each of them.
        """
        obj, scale = self.world.objects[k], draw.scale
        f, base, model = into, self.base, self.world.model
        geoms = np.asarray(obj.geom_ids)
        rows = ids[:, None]
        g = scale[
            :, None, :
        ]  # also along turned geoms' own axes: those belong to round things, where x = y
        f["geom_size"][rows, geoms] = base["geom_size"][geoms] * _size_scale(obj, scale)
        f["geom_pos"][rows, geoms] = base["geom_pos"][geoms] * g
        f["geom_aabb"][rows, geoms] = base["geom_aabb"][geoms] * np.tile(g, (1, 1, 2))
        if obj.kind == "sphere":
            f["geom_rbound"][rows, geoms] = base["geom_rbound"][geoms] * scale[:, :1]
        else:
            # The radius about the geom's centre of the box that bounds it.
            aabb = f["geom_aabb"][rows, geoms]
            f["geom_rbound"][rows, geoms] = np.linalg.norm(
                np.abs(aabb[..., :3]) + aabb[..., 3:], axis=2
            )
        f["geom_friction"][rows, geoms, 0] = draw.friction[:, None]
        if obj.kind == "mesh":
            f["geom_dataid"][rows, geoms] = np.asarray(obj.mesh_ids).T[draw.mesh_idx]
        start, count = model.body_bvhadr[obj.body_id], model.body_bvhnum[obj.body_id]
        nodes = np.arange(start, start + count)
        f["bvh_aabb"][rows, nodes] = base["bvh_aabb"][nodes] * np.tile(g, (1, 1, 2))
        self._write_mass(into, ids, obj, draw)
        f["size_m"][ids, k] = np.asarray(obj.size_m) * scale
        f["mass_kg"][ids, k] = draw.mass
        f["friction"][ids, k] = draw.friction
        corners = obj.hull * g @ self.rest[k].T
        f["height_above_table"][ids, k] = -corners[:, :, 2].min(1)
        f["radius"][ids, k] = np.linalg.norm(corners[:, :, :2], axis=2).max(1)

    def _write_mass(
        self, into: dict[str, np.ndarray], ids: np.ndarray, obj: ObjectModel, draw: Draw
    ) -> None:
        """Write mass and inertia, and what MuJoCo derives from them when it compiles."""
        f, base, model = into, self.base, self.world.model
        rows, scale, mass = ids[:, None], draw.scale, draw.mass
        body, dofs = obj.body_id, np.arange(obj.dof_adr, obj.dof_adr + 6)
        ratio = mass / base["body_mass"][body]
        second = base["body_inertia"][body].sum() / 2 - base["body_inertia"][body]  # of x, y, z
        if obj.kind == "mesh":  # its inertia has axes of its own, but is scaled uniformly
            inertia = base["body_inertia"][body] * scale[:, :1] ** 2
        else:
            stretched = second * scale**2
            inertia = stretched.sum(1, keepdims=True) - stretched
        inertia = inertia * ratio[:, None]
        f["body_mass"][ids, body] = mass
        f["body_subtreemass"][ids, body] = mass
        f["body_inertia"][ids, body] = inertia
        f["body_ipos"][ids, body] = base["body_ipos"][body] * scale
        turn = (1 / inertia).mean(1) / (1 / base["body_inertia"][body]).mean()
        f["body_invweight0"][ids, body, 0] = base["body_invweight0"][body, 0] / ratio
        f["body_invweight0"][ids, body, 1] = base["body_invweight0"][body, 1] * turn
        f["dof_invweight0"][rows, dofs[:3]] = base["dof_invweight0"][dofs[:3]] / ratio[:, None]
        f["dof_invweight0"][rows, dofs[3:]] = base["dof_invweight0"][dofs[3:]] * turn[:, None]
        if model.body_simple[body]:
            # MuJoCo takes a simple body's inertia from here; else a heavier one would fall faster.
            f["dof_M0"][rows, dofs[:3]] = mass[:, None]
            f["dof_M0"][rows, dofs[3:]] = inertia


def _size_scale(obj: ObjectModel, scale: np.ndarray) -> np.ndarray:
    """Return factors of `geom_size`, whose meaning depends on the geom's type."""
    if obj.kind == "cylinder":
        return scale[:, None, [0, 2, 2]]
    if obj.kind == "round_hollow":  # first the floor, a cylinder (radius, half height); then boxes
        factors = np.repeat(scale[:, None, :], len(obj.geom_ids), axis=1)
        factors[:, 0] = scale[:, [0, 2, 2]]
        return factors
    return scale[:, None, :]

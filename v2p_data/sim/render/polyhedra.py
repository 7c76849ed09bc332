"""The triangles of each kind of geom, at unit size, as MuJoCo's renderer draws them.

A vertex has a fourth number: how far it moves with its end of a capsule (-1, 0 or 1). Faces are counter-clockwise seen
from outside. MuJoCo draws round things with `visual/quality` `numslices` and `numstacks`; so do
we, because a disc of 28 corners covers 0.8 % less than a circle, and both pictures shall agree.
"""

# pyright: reportAttributeAccessIssue=false
# mujoco's classes come from a compiled module that declares none of them.

from dataclasses import dataclass

import mujoco
import numpy as np
from jaxtyping import Float, Int

_TYPE = mujoco.mjtGeom
Solid = tuple[Float[np.ndarray, "v 4"], Int[np.ndarray, "f 3"]]


@dataclass(frozen=True, kw_only=True)
class Polyhedra:
    """All shapes of a model, one behind the other."""

    vertices: Float[np.ndarray, "vertex 4"]
    faces: Int[np.ndarray, "face 3"]
    """Vertices, counted from the shape's first."""
    spans: Int[np.ndarray, "shape 4"]
    """First vertex, number of vertices, first face, number of faces."""
    of_type: dict[int, int]
    """Shape of each geom type but meshes."""
    of_mesh: Int[np.ndarray, "mesh"]
    """Shape of each mesh."""

    @property
    def arrays(self) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        return self.vertices, self.faces, self.spans


def polyhedra(model: mujoco.MjModel) -> Polyhedra:
    """Return the shapes that geoms of this model can have."""
    slices, stacks = int(model.vis.quality.numslices), int(model.vis.quality.numstacks)
    ball = _ball(slices, stacks // 2, apart=False)
    solids = {
        _TYPE.mjGEOM_PLANE: _square(),
        _TYPE.mjGEOM_SPHERE: ball,
        _TYPE.mjGEOM_ELLIPSOID: ball,
        _TYPE.mjGEOM_CAPSULE: _ball(slices, stacks // 2, apart=True),
        _TYPE.mjGEOM_CYLINDER: _cylinder(slices),
        _TYPE.mjGEOM_BOX: _box(),
    }
    meshes = [_mesh(model, k) for k in range(model.nmesh)]
    vertices, faces = zip(*solids.values(), *meshes, strict=True)
    num_vertices = [len(v) for v in vertices]
    num_faces = [len(f) for f in faces]
    spans = np.stack([_starts(num_vertices), num_vertices, _starts(num_faces), num_faces], axis=1)
    return Polyhedra(
        vertices=np.concatenate(vertices).astype(float),
        faces=np.concatenate(faces).astype(np.int32),
        spans=spans.astype(np.int32),
        of_type={int(kind): k for k, kind in enumerate(solids)},
        of_mesh=np.arange(len(solids), len(solids) + model.nmesh, dtype=np.int32),
    )


def _starts(counts: list[int]) -> np.ndarray:
    return np.concatenate([[0], np.cumsum(counts)[:-1]])


def _mesh(model: mujoco.MjModel, k: int) -> Solid:
    first, count = model.mesh_vertadr[k], model.mesh_vertnum[k]
    face, num_faces = model.mesh_faceadr[k], model.mesh_facenum[k]
    return _still(model.mesh_vert[first : first + count]), model.mesh_face[face : face + num_faces]


def _square() -> Solid:
    return _still([(-1, -1, 0), (1, -1, 0), (1, 1, 0), (-1, 1, 0)]), np.array(
        [(0, 1, 2), (0, 2, 3)]
    )


def _box() -> Solid:
    corners = [(x, y, z) for x in (-1, 1) for y in (-1, 1) for z in (-1, 1)]  # x y z are its bits
    sides = [(0, 1, 3, 2), (4, 6, 7, 5), (0, 4, 5, 1), (2, 3, 7, 6), (0, 2, 6, 4), (1, 5, 7, 3)]
    return _still(corners), _halves(sides)


def _cylinder(slices: int) -> Solid:
    ring = _ring(slices)
    low, high = (np.c_[ring, np.full(slices, z)] for z in (-1.0, 1.0))
    k, after = _neighbours(slices)
    below, above = np.full(slices, 2 * slices), np.full(slices, 2 * slices + 1)
    faces = [
        _halves(np.stack([k, after, after + slices, k + slices], axis=1)),
        np.stack([below, after, k], axis=1),
        np.stack([above, k + slices, after + slices], axis=1),
    ]
    return _still(np.concatenate([low, high, [(0, 0, -1), (0, 0, 1)]])), np.concatenate(faces)


def _ball(slices: int, half_stacks: int, *, apart: bool) -> Solid:
    """Return a sphere with a ring of vertices at its equator; of a capsule there are two, which move apart."""
    ring = _ring(slices)
    rise = np.pi / 2 * np.arange(half_stacks) / half_stacks
    rows = [(angle, 1.0) for angle in rise] if apart else [(angle, 1.0) for angle in rise[1:]]
    rows = [(-angle, -1.0) for angle, _ in rows[::-1]] + ([] if apart else [(0.0, 0.0)]) + rows
    vertices = [
        np.c_[ring * np.cos(angle), np.full(slices, np.sin(angle)), np.full(slices, end * apart)]
        for angle, end in rows
    ]
    poles = np.array([(0, 0, -1, -1.0 * apart), (0, 0, 1, 1.0 * apart)])
    south, north = slices * len(rows), slices * len(rows) + 1
    k, after = _neighbours(slices)
    faces = [
        _halves(np.stack([k, after, after + slices, k + slices], axis=1) + row * slices)
        for row in range(len(rows) - 1)
    ]
    top = (len(rows) - 1) * slices
    faces.append(np.stack([np.full(slices, south), after, k], axis=1))
    faces.append(np.stack([np.full(slices, north), k + top, after + top], axis=1))
    return np.concatenate([*vertices, poles]), np.concatenate(faces)


def _ring(slices: int) -> np.ndarray:
    turn = 2 * np.pi * np.arange(slices) / slices
    return np.stack([np.cos(turn), np.sin(turn)], axis=1)


def _neighbours(slices: int) -> tuple[np.ndarray, np.ndarray]:
    k = np.arange(slices)
    return k, (k + 1) % slices


def _halves(quads: np.ndarray | list[tuple[int, int, int, int]]) -> np.ndarray:
    quads = np.asarray(quads)
    return np.concatenate([quads[:, [0, 1, 2]], quads[:, [0, 2, 3]]])


def _still(points: np.ndarray | list[tuple[int, int, int]]) -> np.ndarray:
    return np.c_[np.asarray(points, float), np.zeros(len(points))]

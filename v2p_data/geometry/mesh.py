"""Meshes of simple things, in metres, centred on their bounding box, +z up. Writes OBJ through trimesh."""

from pathlib import Path

import numpy as np
import trimesh
from jaxtyping import Float
from trimesh.exchange.obj import export_obj

Size = tuple[float, float, float]
_AROUND = 40
_MIN_WALL_M = 0.0025


def box(size_m: Size, *, hollow: bool = False) -> trimesh.Trimesh:
    """Return a box of full extents `size_m`; a hollow one is open at the top."""
    if not hollow:
        return trimesh.creation.box(extents=size_m)
    length, width, height = size_m
    wall = _wall(min(size_m))
    slabs = [
        ((length, width, wall), (0.0, 0.0, (wall - height) / 2)),
        ((wall, width, height - wall), ((length - wall) / 2, 0.0, wall / 2)),
        ((wall, width, height - wall), ((wall - length) / 2, 0.0, wall / 2)),
        ((length - 2 * wall, wall, height - wall), (0.0, (width - wall) / 2, wall / 2)),
        ((length - 2 * wall, wall, height - wall), (0.0, (wall - width) / 2, wall / 2)),
    ]
    parts = []
    for extents, centre in slabs:
        part = trimesh.creation.box(extents=extents)
        part.apply_translation(centre)
        parts.append(part)
    return trimesh.Trimesh(*_joined(parts), process=False)


def sphere(diameter_m: float) -> trimesh.Trimesh:
    """Return a ball whose bounding box has exactly the diameter."""
    mesh = trimesh.creation.icosphere(subdivisions=3, radius=diameter_m / 2)
    mesh.vertices *= diameter_m / mesh.extents
    return mesh


def revolution(
    diameter_m: float, height_m: float, *, taper: float = 1.0, hollow: bool = False
) -> trimesh.Trimesh:
    """Return a solid of revolution about z: a cylinder, or a cone frustum with base `taper` times the top.

    A hollow one is open at the top, with a wall and a bottom: a cup, a bowl, a plate.
    """
    wide, narrow = (1.0, taper) if taper <= 1 else (1 / taper, 1.0)
    top, base = wide * diameter_m / 2, narrow * diameter_m / 2
    z0, z1 = -height_m / 2, height_m / 2
    outline = [(0.0, z0), (base, z0), (top, z1)]
    if hollow:
        wall = min(_wall(min(diameter_m, 2 * height_m)), 0.4 * height_m)
        outline += [(top - wall, z1), (max(base - wall, 0.3 * base), z0 + wall), (0.0, z0 + wall)]
    else:
        outline += [(0.0, z1)]
    mesh = trimesh.creation.revolve(np.array(outline), sections=_AROUND)
    mesh.apply_translation(-mesh.bounds.mean(axis=0))
    return mesh


def mesh_for(
    form: str, size_m: Size, *, hollow: bool = False, taper: float = 1.0
) -> trimesh.Trimesh:
    """Return the mesh of a `box`, `cylinder` (any solid of revolution) or `sphere` with these full extents."""
    if form == "box":
        return box(size_m, hollow=hollow)
    if form == "sphere":
        return sphere(size_m[0])
    return revolution(size_m[0], size_m[2], taper=taper, hollow=hollow)


def outline_points(form: str, size_m: Size, taper: float = 1.0) -> Float[np.ndarray, "n 3"]:
    """Return few points whose convex hull is the shape: what a silhouette needs."""
    length, width, height = size_m
    if form == "box":
        signs = np.array(
            [(i, j, k) for i in (-0.5, 0.5) for j in (-0.5, 0.5) for k in (-0.5, 0.5)]
        )
        return signs * np.array([length, width, height])
    around = np.linspace(0, 2 * np.pi, 20, endpoint=False)
    ring = np.stack([np.cos(around), np.sin(around), np.zeros_like(around)], axis=1) * length / 2
    if form == "sphere":
        up = np.linspace(-1.4, 1.4, 7)
        return np.concatenate(
            [ring * [np.cos(a), np.cos(a), 0] + [0, 0, length / 2 * np.sin(a)] for a in up]
        )
    top, base = (1.0, taper) if taper <= 1 else (1 / taper, 1.0)
    return np.concatenate([ring * top + [0, 0, height / 2], ring * base - [0, 0, height / 2]])


def write_obj(mesh: trimesh.Trimesh, path: Path) -> None:
    """Write the mesh as OBJ without materials."""
    text = export_obj(mesh, include_texture=False, include_color=False, include_normals=False)
    path.write_text(text)


def _joined(parts: list[trimesh.Trimesh]) -> tuple[np.ndarray, np.ndarray]:
    counts = np.cumsum([0, *(len(part.vertices) for part in parts)])
    faces = [part.faces + start for part, start in zip(parts, counts[:-1], strict=True)]
    return np.concatenate([part.vertices for part in parts]), np.concatenate(faces)


def _wall(smallest_m: float) -> float:
    return float(np.clip(0.06 * smallest_m, _MIN_WALL_M, 0.006))

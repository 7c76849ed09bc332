"""Meshes of simple things and the convex solids that collide for them, in metres, +z up.

Every mesh is one closed surface turned outwards; a hollow one is open at the top, so that its
volume is that of its walls. Primitives are centred on their bounding box.
"""

from collections.abc import Sequence
from itertools import pairwise
from pathlib import Path

import cv2
import numpy as np
import trimesh
from jaxtyping import Float
from trimesh.exchange.obj import export_obj
from trimesh.exchange.ply import export_ply

Size = tuple[float, float, float]
_AROUND = 40
_PART_SECTIONS = 20
_PART_WALLS = 10
_MIN_WALL_M = 0.0025


def box(size_m: Size, *, hollow: bool = False) -> trimesh.Trimesh:
    """Return a box of full extents `size_m`; a hollow one is open at the top."""
    if not hollow:
        return trimesh.creation.box(extents=size_m)
    half, wall = np.array(size_m) / 2, wall_m(size_m)
    ring = np.array([(-1.0, -1.0), (1.0, -1.0), (1.0, 1.0), (-1.0, 1.0)])
    levels = [
        (ring * half[:2], -half[2]),
        (ring * half[:2], half[2]),
        (ring * (half[:2] - wall), half[2]),
        (ring * (half[:2] - wall), wall - half[2]),
    ]
    vertices = np.concatenate([np.c_[xy, np.full(4, z)] for xy, z in levels])
    faces = [(0, 2, 1), (0, 3, 2), (12, 13, 14), (12, 14, 15)]  # underside, and the floor inside
    for level in range(3):
        for k in range(4):
            a, b = 4 * level + k, 4 * level + (k + 1) % 4
            faces += [(a, b, b + 4), (a, b + 4, a + 4)]
    return trimesh.Trimesh(vertices, faces, process=False)


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
    profile = _frustum(diameter_m, height_m, taper)
    return lathe(profile, wall_m((diameter_m, diameter_m, 2 * height_m)) if hollow else 0.0)


def lathe(profile: Float[np.ndarray, "k 2"], wall: float = 0.0) -> trimesh.Trimesh:
    """Return what a profile encloses when it turns about z.

    Args:
        profile: (radius, z) of the outside [m], from the bottom up, z increasing.
        wall: thickness of the wall and the floor [m]; 0 for a solid thing.
    """
    r, z = profile.T
    outline = [np.array([(0.0, z[0])]), profile]
    if wall > 0:
        outline.append(_inside(profile, wall)[::-1])
    outline.append(np.array([(0.0, outline[-1][-1, 1])]))
    return _turned(np.concatenate(outline), 2 * float(r.max()))


def lathe_parts(
    profile: Float[np.ndarray, "k 2"], wall: float = 0.0
) -> tuple[trimesh.Trimesh, ...]:
    """Return convex solids that together are `lathe(profile, wall)`, its inside left free.

    A solid thing is cut across where its profile is re-entrant; a hollow one becomes a floor and sectors of its wall.
    """
    coarse = _simplified(profile, 0.015 * float(profile[:, 0].max() + np.ptp(profile[:, 1])))
    if wall <= 0:
        way = np.diff(coarse, axis=0)
        turn = way[:-1, 0] * way[1:, 1] - way[:-1, 1] * way[1:, 0]
        cuts = [0, *(np.flatnonzero(turn < -1e-12) + 1).tolist(), len(coarse) - 1]
        return tuple(
            trimesh.convex.convex_hull(_rings(coarse[a : b + 1], 0.0, 2 * np.pi, _PART_SECTIONS))
            for a, b in pairwise(cuts)
        )
    inside = _inside(profile, wall)
    floor = float(inside[0, 1])
    under = np.concatenate([profile[profile[:, 1] < floor], [_at(profile, floor)]])
    parts = [trimesh.convex.convex_hull(_rings(under, 0.0, 2 * np.pi, _PART_SECTIONS))]
    levels = [floor, *coarse[coarse[:, 1] > floor + 1e-9, 1].tolist()]
    step = 2 * np.pi / _PART_WALLS
    # Straight chords cannot follow the inner circle: half of what they miss is left open, half juts in.
    reach = (1 + 1 / np.cos(step / 2)) / 2
    for low, high in pairwise(levels):
        outer = np.array([_at(profile, low), _at(profile, high)])
        inner = np.array([_at(inside, low), _at(inside, high)]) * [reach, 1.0]
        inner[:, 0] = np.minimum(inner[:, 0], outer[:, 0] - 0.2 * wall)
        parts += _sectors(inner, outer)
    return tuple(parts)


def ring(diameter_m: float, height_m: float, bore: float) -> trimesh.Trimesh:
    """Return a cylinder with a hole along its axis, whose diameter is the share `bore` of its own."""
    r, half = diameter_m / 2, height_m / 2
    outline = [(bore * r, -half), (r, -half), (r, half), (bore * r, half), (bore * r, -half)]
    return _turned(np.array(outline), diameter_m)


def ring_parts(diameter_m: float, height_m: float, bore: float) -> tuple[trimesh.Trimesh, ...]:
    """Return convex sectors that together are `ring` of the same arguments, the hole left free."""
    step, half = 2 * np.pi / _PART_WALLS, height_m / 2
    inner, outer = (
        np.array([(share * diameter_m / 2, -half), (share * diameter_m / 2, half)])
        for share in (bore / np.cos(step / 2), 1.0)
    )
    return tuple(_sectors(inner, outer))


def mesh_for(
    form: str, size_m: Size, *, hollow: bool = False, taper: float = 1.0, bore: float = 0.0
) -> trimesh.Trimesh:
    """Return the mesh of a `box`, `cylinder` (any solid of revolution) or `sphere` with these full extents.

    A cylinder with a `bore` is a `ring`.
    """
    if bore:
        return ring(size_m[0], size_m[2], bore)
    if form == "box":
        return box(size_m, hollow=hollow)
    if form == "sphere":
        return sphere(size_m[0])
    return revolution(size_m[0], size_m[2], taper=taper, hollow=hollow)


def parts_for(
    form: str, size_m: Size, *, hollow: bool = False, taper: float = 1.0, bore: float = 0.0
) -> tuple[trimesh.Trimesh, ...]:
    """Return convex solids that together are `mesh_for` of the same arguments, its inside left free."""
    if bore:
        return ring_parts(size_m[0], size_m[2], bore)
    if not hollow or form == "sphere":
        return (mesh_for(form, size_m, taper=taper),)
    if form == "cylinder":
        wall = wall_m((size_m[0], size_m[0], 2 * size_m[2]))
        return lathe_parts(_frustum(size_m[0], size_m[2], taper), wall)
    length, width, height = size_m
    wall = wall_m(size_m)
    slabs = [
        ((length, width, wall), (0.0, 0.0, (wall - height) / 2)),
        ((wall, width, height - wall), ((length - wall) / 2, 0.0, wall / 2)),
        ((wall, width, height - wall), ((wall - length) / 2, 0.0, wall / 2)),
        ((length - 2 * wall, wall, height - wall), (0.0, (width - wall) / 2, wall / 2)),
        ((length - 2 * wall, wall, height - wall), (0.0, (wall - width) / 2, wall / 2)),
    ]
    return tuple(
        trimesh.creation.box(
            extents=extents, transform=trimesh.transformations.translation_matrix(at)
        )
        for extents, at in slabs
    )


def wall_m(size_m: Size) -> float:
    """Return how thick the wall of a hollow thing of this size is drawn [m]."""
    return float(min(np.clip(0.06 * min(size_m), _MIN_WALL_M, 0.006), 0.2 * min(size_m)))


def mass_properties(
    mesh: trimesh.Trimesh, mass_kg: float
) -> tuple[Float[np.ndarray, "3"], Float[np.ndarray, "3 3"]]:
    """Return the centre of mass [m] and the inertia about it [kg m2] of a closed mesh of one density."""
    found = trimesh.triangles.mass_properties(mesh.triangles, density=mass_kg / mesh.volume)
    return np.asarray(found.center_mass), np.asarray(found.inertia)


def welded(mesh: trimesh.Trimesh, max_faces: int = 50_000, **kept: bool) -> trimesh.Trimesh:
    """Return the mesh with equal vertices merged; closed pieces that touch keep vertices of their own.

    Where two closed pieces share an edge it has four faces, so that the whole would pass for open.

    Args:
        mesh: vertices and faces.
        max_faces: larger meshes are not searched for pieces.
        kept: of trimesh's `merge_vertices`.
    """
    whole = mesh.copy()
    whole.merge_vertices(**kept)
    if whole.is_watertight or len(mesh.faces) > max_faces:
        return whole
    connected = trimesh.graph.connected_component_labels
    by_vertex = connected(mesh.edges, len(mesh.vertices))[mesh.faces[:, 0]]
    by_edge = connected(whole.face_adjacency, len(mesh.faces))
    for labels in (by_vertex, by_edge):
        if len(counts := np.bincount(labels)) < 2 or counts[counts > 0].min() < 4:
            continue
        pieces = [
            trimesh.Trimesh(mesh.vertices, mesh.faces[labels == k], process=False)
            for k in np.unique(labels)
        ]
        for piece in pieces:
            piece.merge_vertices(**kept)
            piece.remove_unreferenced_vertices()
        if all(piece.is_watertight for piece in pieces):
            return joined(pieces)
    return whole


def joined(pieces: Sequence[trimesh.Trimesh]) -> trimesh.Trimesh:
    """Return several meshes as one; no vertices are merged."""
    faces = trimesh.util.append_faces([p.vertices for p in pieces], [p.faces for p in pieces])
    return trimesh.Trimesh(*faces, process=False)


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
    path.write_text(text, encoding="utf-8")


def write_ply(mesh: trimesh.Trimesh, path: Path) -> None:
    """Write the mesh as binary PLY: vertices and faces only."""
    plain = trimesh.Trimesh(mesh.vertices, mesh.faces, process=False)
    path.write_bytes(export_ply(plain, vertex_normal=False, include_attributes=False))


def _frustum(diameter_m: float, height_m: float, taper: float) -> Float[np.ndarray, "2 2"]:
    wide, narrow = (1.0, taper) if taper <= 1 else (1 / taper, 1.0)
    half = height_m / 2
    return np.array([(narrow * diameter_m / 2, -half), (wide * diameter_m / 2, half)])


def _inside(profile: Float[np.ndarray, "k 2"], wall: float) -> Float[np.ndarray, "j 2"]:
    """Return the profile one wall further in, from the floor up: what a ball of that radius leaves of it."""
    r, z = profile.T
    wall = min(wall, 0.4 * float(np.ptp(z)))
    floor = z[0] + wall
    # Rings that all but touch would be merged into one, and leave a gap.
    heights = np.concatenate([[floor], z[z > floor + 1e-3 * np.ptp(z)]])
    if len(heights) == 2:  # straight sides: the ends say all
        heights = np.linspace(floor, z[-1], 2)
    angles = np.linspace(-np.pi / 2, np.pi / 2, 13)
    lower = np.maximum(heights[:, None] - wall * np.sin(angles), z[0])
    radii = (np.interp(lower, z, r) - wall * np.cos(angles)).min(axis=1)
    return np.c_[np.maximum(radii, 0.2 * np.interp(heights, z, r)), heights]


def _at(profile: Float[np.ndarray, "k 2"], height: float) -> Float[np.ndarray, "2"]:
    return np.array([np.interp(height, profile[:, 1], profile[:, 0]), height])


def _turned(outline: Float[np.ndarray, "k 2"], diameter_m: float) -> trimesh.Trimesh:
    """Return what a closed outline (radius, z) encloses when it turns about z, turned outwards, of that diameter."""
    # trimesh leaves out triangles below a fixed area: in metres these may be a small thing's.
    mesh = trimesh.creation.revolve(outline / diameter_m, sections=_AROUND)
    mesh.vertices *= diameter_m
    if mesh.volume < 0:
        mesh.invert()
    mesh.vertices[:, :2] *= diameter_m / mesh.extents[:2]
    return mesh


def _sectors(
    inner: Float[np.ndarray, "2 2"], outer: Float[np.ndarray, "2 2"]
) -> list[trimesh.Trimesh]:
    """Return the wall between two profiles, cut into convex sectors."""
    step = 2 * np.pi / _PART_WALLS
    return [
        trimesh.convex.convex_hull(
            np.concatenate(
                [
                    _rings(inner, k * step, (k + 1) * step, 1),
                    _rings(outer, k * step, (k + 1) * step, 3),
                ]
            )
        )
        for k in range(_PART_WALLS)
    ]


def _rings(
    profile: Float[np.ndarray, "k 2"], start: float, end: float, count: int
) -> Float[np.ndarray, "n 3"]:
    """Return the profile's points turned to `count` + 1 angles from start to end."""
    angles = np.linspace(start, end, count + 1)
    r, z = profile[:, :1], profile[:, 1:]
    ring = (r * np.cos(angles), r * np.sin(angles), np.broadcast_to(z, (len(r), len(angles))))
    return np.stack(ring, axis=-1).reshape(-1, 3)


def _simplified(profile: Float[np.ndarray, "k 2"], tolerance: float) -> Float[np.ndarray, "j 2"]:
    unit = 1000 / max(float(np.abs(profile).max()), 1e-9)  # OpenCV computes in single precision
    line = (profile * unit).astype(np.float32)[:, None]
    return cv2.approxPolyDP(line, tolerance * unit, closed=False)[:, 0].astype(float) / unit

"""An object's mesh file becomes convex solids: read, mended, brought to size, split where it is concave.

MuJoCo collides convex shapes only. What is nearly convex becomes one hull; a concave mesh becomes
a few parts: those that its scene brings along, else some that are found once (`convex`) and then
lie in a cache. A mesh that cannot be mended is refused in one sentence.
"""

import logging
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import trimesh
from jaxtyping import Float, Int

from v2p_data.errors import ItemRejectedError
from v2p_data.geometry.mesh import joined, welded
from v2p_data.sim.model.convex import ConvexConfig, convex_parts

MAX_MESH_MB = 200
"""Larger files are refused: reading them takes several times their size in memory."""
MAX_FACES = 2_000_000
MESH_KINDS = ("obj", "stl", "ply")
FINE_FACES = 50_000
"""Meshes with more faces are thinned before they are split, and not mended."""
FINE_VERTICES = 20_000
HULL_DIRECTIONS = 1_000
MAX_COORDINATE = 1e9
"""In the file's unit; squares of more overflow on the way."""
_CONVEX_WITHIN = 1.02
"""A hull of no more than this many times the volume is the thing itself."""
FLAT_RATIO = 1e-3
"""Thinnest over widest extent, along the mesh's own principal axes, below which it has no volume."""

logger = logging.getLogger(__name__)


@dataclass(frozen=True, kw_only=True)
class Solids:
    """An object's convex solids, in its own frame and of its true size."""

    parts: tuple[trimesh.Trimesh, ...]
    """Convex; one for whatever is nearly convex itself."""
    body: trimesh.Trimesh
    """What is weighed: the mesh itself where it was split, else its hull."""
    hull: Float[np.ndarray, "h 3"]
    """Corner points of all parts' common hull."""

    def mass_properties(
        self, mass_kg: float
    ) -> tuple[Float[np.ndarray, "3"], Float[np.ndarray, "3 3"]]:
        """Return the centre of mass, and the inertia about it, at one density."""
        return (
            np.asarray(self.body.center_mass),
            np.asarray(self.body.moment_inertia) * mass_kg / self.body.mass,
        )


def solids_of(
    path: Path,
    name: str,
    size_m: tuple[float, float, float],
    cfg: ConvexConfig | None = None,
    *,
    ready: Sequence[Path] = (),
) -> Solids:
    """Return the mesh in `path` as convex solids that fill a box of `size_m` about the origin.

    Args:
        path: the mesh file; its units do not matter, because it is brought to `size_m`.
        name: of the object, for messages.
        size_m: full extents.
        cfg: how concave meshes are split.
        ready: mesh files of convex parts in the mesh's frame that together are the mesh. They save a concave mesh the
            splitting, and are taken for one with holes; a single one can only be its hull and does neither.

    Raises:
        ItemRejectedError: there is no such file, or no solid in it.
    """
    cfg = cfg or ConvexConfig()
    mesh = read_mesh(path, name)
    is_closed = _is_closed(mesh, path, name)
    low, high = mesh.bounds
    _tell_scale(path, name, high - low, np.asarray(size_m))
    outer = np.asarray(mesh.vertices, float)
    outer = outer[_extreme(outer)] if len(outer) > FINE_VERTICES else outer
    found = [_hull(outer, cfg.hull_vertices)]
    filled = _volume(mesh) if is_closed else 0.0
    if cfg.concave_above * filled < trimesh.convex.convex_hull(outer).volume:
        parts = []
        if len(ready) > 1:
            parts = [np.asarray(read_mesh(file, name).vertices, float) for file in ready]
        elif is_closed:
            parts = _convex_pieces(mesh, filled, cfg.max_parts)
            parts = parts or convex_parts(path, *_thinned(mesh), cfg, name)
        found = [_hull(p, cfg.part_vertices) for p in parts] or found
    parts = _brought_to_size(found, size_m)
    if len(parts) == 1:
        return Solids(parts=parts, body=parts[0], hull=np.asarray(parts[0].vertices))
    common = trimesh.convex.convex_hull(np.concatenate([p.vertices for p in parts]))
    body = _brought_to_size([mesh], size_m)[0] if is_closed else joined(parts)
    return Solids(parts=parts, body=body, hull=np.asarray(common.vertices))


def read_mesh(path: Path, name: str) -> trimesh.Trimesh:
    """Return the mesh in `path`, with equal vertices merged.

    Raises:
        ItemRejectedError: `mesh_missing`, `mesh_too_large`, `mesh_unreadable`, `mesh_not_finite` or `flat_mesh`.
    """
    where = f"mesh of '{name}' in {path}"
    mesh = _demand_solid(_loaded(path, name, where), where)
    mesh = welded(mesh, FINE_FACES)
    mesh.remove_unreferenced_vertices()
    return mesh


def _loaded(path: Path, name: str, where: str) -> trimesh.Geometry:
    """Return what a mesh file holds, which may be no mesh of triangles."""
    if not path.is_file():
        raise ItemRejectedError("mesh_missing", f"mesh of '{name}' is missing: {path}")
    kind = path.suffix.lower().removeprefix(".")
    if kind not in MESH_KINDS:
        raise ItemRejectedError(
            "mesh_unreadable",
            f"{where} is none of the kinds {', '.join(MESH_KINDS)}; export it again as OBJ",
        )
    megabytes = path.stat().st_size / 1e6
    if megabytes > MAX_MESH_MB:
        raise ItemRejectedError(
            "mesh_too_large",
            f"{where} has {megabytes:.0f} MB; at most {MAX_MESH_MB} MB are read: decimate it to {FINE_FACES} faces",
            megabytes,
        )
    try:
        with path.open(
            "rb"
        ) as stream:  # a stream has no folder: materials and pictures that it names are not read
            mesh = trimesh.load(
                stream, file_type=kind, force="mesh", process=False, skip_materials=True
            )
    except Exception as error:
        raise ItemRejectedError(
            "mesh_unreadable",
            f"{where} cannot be read ({type(error).__name__}: {error}); export it again as OBJ with triangles",
        ) from error
    return mesh


def _demand_solid(mesh: trimesh.Geometry, where: str) -> trimesh.Trimesh:
    """Return the mesh; refuse one without faces, with too many, with bad numbers or without thickness."""
    faces = np.asarray(getattr(mesh, "faces", ()))
    if len(faces) > MAX_FACES:
        raise ItemRejectedError(
            "mesh_too_large",
            f"{where} has {len(faces)} triangles; at most {MAX_FACES} are taken: decimate it to {FINE_FACES}",
            float(len(faces)),
        )
    if not isinstance(mesh, trimesh.Trimesh) or not len(faces):
        raise ItemRejectedError(
            "mesh_unreadable",
            f"{where} holds no faces; export it again as OBJ with triangles",
            0.0,
        )
    vertices = np.asarray(mesh.vertices, float)
    if faces.min() < 0 or faces.max() >= len(vertices):
        raise ItemRejectedError(
            "mesh_unreadable",
            f"{where} has faces of vertex {faces.max() + 1}, but only {len(vertices)} vertices; export it again",
            float(faces.max() + 1),
        )
    bad = int((~(np.abs(vertices) < MAX_COORDINATE)).any(1).sum())
    if bad:
        raise ItemRejectedError(
            "mesh_not_finite",
            f"{bad} of {len(vertices)} vertices of the {where} are no numbers below "
            f"{MAX_COORDINATE:g}; export it again",
            float(bad),
        )
    widths = _principal_widths(vertices[np.unique(faces)])
    if widths[2] <= FLAT_RATIO * widths[0]:
        raise ItemRejectedError(
            "flat_mesh",
            f"{where} is flat: {widths[2]:.2g} thick where it is {widths[0]:.2g} wide, so it encloses nothing; "
            "give the object the shape 'box' instead, or a mesh with a thickness",
            float(widths[2]),
        )
    return mesh


def _is_closed(mesh: trimesh.Trimesh, path: Path, name: str) -> bool:
    """Mend holes and normals in place where that is simple, and return whether the mesh encloses a volume."""
    where = f"mesh of '{name}' in {path}"
    is_fine = len(mesh.faces) > FINE_FACES
    if not mesh.is_watertight and not is_fine:
        a, b, c = mesh.faces.T
        mesh.update_faces(mesh.unique_faces() & (a != b) & (b != c) & (c != a))
    if not mesh.is_watertight:
        open_edges = len(trimesh.grouping.group_rows(mesh.edges_sorted, require_count=1))
        if not is_fine:
            mesh.fill_holes()
        if not mesh.is_watertight:
            logger.warning(
                "%s has holes (%d open edges): its hull, or the parts it brings, are used",
                where,
                open_edges,
            )
            return False
        logger.warning("%s had small holes (%d open edges), which are closed", where, open_edges)
    if not mesh.is_winding_consistent and not is_fine:
        trimesh.repair.fix_normals(mesh, multibody=True)
        logger.warning("%s had faces turned inwards, which are turned around", where)
    if mesh.is_winding_consistent and not is_fine:
        _mend_components(mesh, where)
    elif _volume(mesh) < 0:
        mesh.invert()
        logger.warning("%s is inside out and is turned around", where)
    return bool(mesh.is_winding_consistent and _volume(mesh) > 0)


def _mend_components(mesh: trimesh.Trimesh, where: str) -> None:
    """Drop closed surfaces that enclose nothing, and turn outwards those that are inside out.

    A surface within another one is its cavity, or a solid in it, and is turned with it.
    """
    labels = trimesh.graph.connected_component_labels(mesh.face_adjacency, len(mesh.faces))
    corners = np.asarray(mesh.vertices, float)[mesh.faces]
    corners = corners - corners.mean((0, 1))
    a, b, c = corners.swapaxes(0, 1)
    volumes = np.bincount(labels, np.einsum("nk,nk->n", a, np.cross(b, c)) / 6)
    order = np.argsort(-np.abs(volumes), kind="stable")
    boxes = {
        k: (corners[labels == k].min((0, 1)), corners[labels == k].max((0, 1))) for k in order
    }
    is_turned = np.zeros(len(volumes), bool)
    for at, k in enumerate(order):
        low, high = boxes[k]
        around = [
            j for j in order[:at] if (boxes[j][0] <= low).all() and (high <= boxes[j][1]).all()
        ]
        is_turned[k] = is_turned[around[-1]] if around else volumes[k] < 0
    is_empty = np.abs(volumes) <= FLAT_RATIO**2 * np.abs(volumes).max()
    if (is_turned & ~is_empty).any():
        mesh.faces = np.where(is_turned[labels][:, None], mesh.faces[:, ::-1], mesh.faces)
        logger.warning("%s is inside out and is turned around", where)
    if is_empty.any():
        mesh.update_faces(~is_empty[labels])
        mesh.remove_unreferenced_vertices()
        logger.warning("%s has %d flat pieces, which are left out", where, is_empty.sum())


def _tell_scale(
    path: Path, name: str, extents: Float[np.ndarray, "3"], size_m: Float[np.ndarray, "3"]
) -> None:
    """Warn where the mesh's units, or its proportions, are not those of the object."""
    factors = extents / size_m
    factor = float(np.median(factors))
    if not 0.2 < factor < 5:
        units = {100: "centimetres", 1000: "millimetres"}
        near = [word for times, word in units.items() if 0.5 < factor / times < 2]
        logger.warning(
            "mesh of '%s' in %s is %.3g m large and the object %.3g m%s; it is brought to size",
            name,
            path,
            extents.max(),
            size_m.max(),
            f": taken to be in {near[0]}" if near else "",
        )
    stretch = float(factors.max() / factors.min())
    if stretch > 1.5:
        logger.warning(
            "mesh of '%s' in %s is stretched %.1f times along one axis to the object's size",
            name,
            path,
            stretch,
        )


def _brought_to_size(
    meshes: list[trimesh.Trimesh], size_m: tuple[float, float, float]
) -> tuple[trimesh.Trimesh, ...]:
    """Return the meshes moved and stretched together so that they fill a box of this size about the origin."""
    bounds = np.array([m.bounds for m in meshes])
    low, high = bounds[:, 0].min(0), bounds[:, 1].max(0)
    factor = np.asarray(size_m) / (high - low)
    return tuple(
        trimesh.Trimesh((m.vertices - (low + high) / 2) * factor, m.faces, process=False)
        for m in meshes
    )


def _convex_pieces(
    mesh: trimesh.Trimesh, volume: float, most: int
) -> list[Float[np.ndarray, "n 3"]]:
    """Return the corners of a closed mesh's pieces, at most `most`; none where a piece is not convex."""
    pieces = (
        [np.asarray(p.vertices, float) for p in mesh.split()]
        if len(mesh.faces) < FINE_FACES
        else []
    )
    if not 1 < len(pieces) <= most:
        return []
    filled = sum(trimesh.convex.convex_hull(piece).volume for piece in pieces)
    return pieces if filled < _CONVEX_WITHIN * volume else []


def _hull(points: Float[np.ndarray, "n 3"], count: int) -> trimesh.Trimesh:
    """Return the convex hull, of at most `count` vertices."""
    hull = trimesh.convex.convex_hull(points)
    if len(hull.vertices) > count:
        hull = trimesh.convex.convex_hull(_spread(np.asarray(hull.vertices), count))
    return hull


def _extreme(points: Float[np.ndarray, "n 3"]) -> Int[np.ndarray, "k"]:
    """Return which points are farthest along any of many directions, the axes among them."""
    k = np.arange(HULL_DIRECTIONS) + 0.5
    polar, around = np.arccos(1 - 2 * k / HULL_DIRECTIONS), np.pi * (1 + 5**0.5) * k
    sphere = np.stack(
        [np.cos(around) * np.sin(polar), np.sin(around) * np.sin(polar), np.cos(polar)]
    )
    directions = np.concatenate([sphere, np.eye(3), -np.eye(3)], axis=1)
    best = np.full(directions.shape[1], -np.inf)
    index = np.zeros(directions.shape[1], np.int64)
    for start in range(0, len(points), 8192):
        reach = directions.T @ points[start : start + 8192].T
        rows = reach.argmax(1)
        values = reach[np.arange(len(rows)), rows]
        better = values > best
        best[better], index[better] = values[better], start + rows[better]
    return np.unique(index)


def _spread(points: Float[np.ndarray, "n 3"], count: int) -> Float[np.ndarray, "m 3"]:
    """Return the extreme points along the axes, then those farthest from the ones chosen already."""
    chosen = sorted({int(f(points[:, k])) for f in (np.argmin, np.argmax) for k in range(3)})
    distance = np.min([np.linalg.norm(points - points[i], axis=1) for i in chosen], axis=0)
    while len(chosen) < count:
        far = int(np.argmax(distance))
        chosen.append(far)
        distance = np.minimum(distance, np.linalg.norm(points - points[far], axis=1))
    return points[chosen]


def _principal_widths(points: Float[np.ndarray, "n 3"]) -> Float[np.ndarray, "3"]:
    """Return the extents along the principal axes, widest first."""
    centred = points - points.mean(0)
    _, axes = np.linalg.eigh(centred.T @ centred)
    return np.sort(np.ptp(centred @ axes, axis=0))[::-1]


def _volume(mesh: trimesh.Trimesh) -> float:
    """Return what a closed mesh encloses, negative where it is inside out; trimesh's own takes ten times as long."""
    a, b, c = np.asarray(mesh.vertices, float)[mesh.faces.T]
    return float(np.einsum("nk,nk->", a, np.cross(b, c)) / 6)


def _thinned(
    mesh: trimesh.Trimesh,
) -> tuple[Float[np.ndarray, "k 3"], Int[np.ndarray, "l 3"]]:
    """Return vertices and faces; of a fine mesh, all vertices in one cell of a grid are drawn together.

    The grid has 64 cells along the widest side. What is lost is less than CoACD's own resolution.
    """
    vertices, faces = np.asarray(mesh.vertices, float), np.asarray(mesh.faces)
    if len(faces) <= FINE_FACES:
        return vertices, faces
    low = vertices.min(0)
    cell = np.minimum(((vertices - low) / (np.ptp(vertices, axis=0).max() / 64)).astype(int), 63)
    code = (cell[:, 0] * 64 + cell[:, 1]) * 64 + cell[:, 2]
    _, owner = np.unique(code, return_inverse=True)
    count = np.bincount(owner)
    centre = np.stack([np.bincount(owner, vertices[:, k]) / count for k in range(3)], axis=1)
    kept = owner[faces]
    kept = kept[
        (kept[:, 0] != kept[:, 1]) & (kept[:, 1] != kept[:, 2]) & (kept[:, 2] != kept[:, 0])
    ]
    _, first = np.unique(np.sort(kept, axis=1), axis=0, return_index=True)
    return centre, kept[np.sort(first)]

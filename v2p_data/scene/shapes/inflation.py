"""An outline inflated like a pillow: what has no simple shape.

One view does not show the back: it is taken to be like the front.
"""

import cv2
import numpy as np
import trimesh
from jaxtyping import Bool, Float

from v2p_data.geometry.pillow import inflated, pillow
from v2p_data.geometry.pose import inverse, transform
from v2p_data.scene.frames.mask_ops import bounding_box
from v2p_data.scene.shapes.mesh_hypothesis import MeshHypothesis, Size, turned
from v2p_data.scene.shapes.silhouette_view import SilhouetteCrop, SilhouetteView, middle_of

_FLAT = 0.45
"""Things lower than this share of their length lie, and are seen in the plane of the table; others stand."""
_PLANE_PX = 200
"""Side of the square picture in which an outline is inflated."""
_CORRECTIONS = 4
_STANDS = 0.99
"""Cosine of the angle between a standing fit's z axis and upright."""
_UPRIGHT = np.array([[1.0, 0, 0], [0, 0, 1], [0, -1, 0]])
"""Turns (right, towards the back, up) to an upright plane's (right, up, towards the camera)."""


def inflation(view: SilhouetteView, crop: SilhouetteCrop, size_m: Size) -> MeshHypothesis | None:
    """Return the outline, seen in a plane through the object and inflated to the fit's thickness.

    A lying object is seen in a plane along the table, a standing one in the upright plane that faces the camera.
    """
    T = view.T_world_obj
    extents = np.abs(T[:3, :3]) @ np.array(size_m)
    tall = float(extents[2])
    lengths = [s for s, up in zip(size_m, np.abs(T[2, :3]), strict=True) if up < 0.7]
    lies = tall < _FLAT * max(lengths, default=tall)
    thin = tall if lies else min([*lengths, tall])
    tilt, forward = _line_of_sight(crop, T[:3, 3])
    if not 0.1 < tilt < 1.45:
        lies = lies or tilt >= 1.45
    slant = 1 / np.tan(max(tilt, 0.1)) if lies else np.tan(min(tilt, 1.45))
    up = np.array([0.0, 0.0, 1.0])
    right = np.cross(forward, up)
    axes = np.stack([right, forward, up] if lies else [right, up, -forward], axis=1)
    cap, px = thin / 2, 1.6 * float(np.linalg.norm(size_m)) / _PLANE_PX
    origin = np.array([T[0, 3], T[1, 3], cap if lies else 0.0])
    plane = _plane_points(origin, axes, px)
    outline = cv2.morphologyEx(
        crop.looked_up(crop.mask, plane).astype(np.uint8), cv2.MORPH_OPEN, np.ones((3, 3))
    )
    field = _signed(_unsmeared(outline > 0, slant, cap / px))
    mesh, parts, T_world_plane = trimesh.Trimesh(), (), np.eye(4)
    goal = _signed(crop.mask)
    for step in range(_CORRECTIONS + 1):
        made = _blown(field > 0, px, cap, stands=not lies)
        if made is None:
            return None
        mesh, parts = made
        if lies:  # how thick it comes out says at which height its outline is seen
            origin[2] = float(mesh.extents[2]) / 2
        plane = _plane_points(origin, axes, px)
        T_world_plane = transform(axes, plane[0, 0] - 0.5 * px * (axes[:, 0] + axes[:, 1]))
        drawn = crop.drawn(mesh, T_world_plane)
        if step == _CORRECTIONS or not drawn.any():
            break
        if not lies:
            origin += _ground_shift(crop, drawn, forward) * forward
        field = field + _correction(crop, drawn, goal, plane)
    turn = _along(mesh) if lies else _UPRIGHT
    T_world_mesh = T_world_plane @ transform(turn, np.zeros(3))
    solids = [turned(solid, turn.T) for solid in (mesh, *parts)]
    middle = _centred(solids)
    T_world_mesh = T_world_mesh @ transform(np.eye(3), middle)
    grown, T_world_mesh = _without_shadows(crop, solids[0], T_world_mesh)
    for solid in solids:
        solid.vertices *= grown
    if not lies and abs(T[2, 2]) > _STANDS:
        solids, T_world_mesh = _along_fit(solids, T_world_mesh, T)
    return MeshHypothesis(
        kind="inflated",
        mesh=solids[0],
        parts=tuple(solids[1:]),
        T_obj_shape=inverse(T) @ T_world_mesh,
    )


def _correction(
    crop: SilhouetteCrop,
    drawn: Bool[np.ndarray, "i j"],
    goal: Float[np.ndarray, "i j"],
    plane: Float[np.ndarray, "p q 3"],
) -> Float[np.ndarray, "p q"]:
    """Return by how much the outline in the plane grows or shrinks, where the silhouette is too small or too large."""
    spots = np.nan_to_num(crop.pixels(plane), nan=0.0).astype(np.float32) - 0.5
    wrong = cv2.remap(
        goal - _signed(drawn),
        spots[..., 0],
        spots[..., 1],
        cv2.INTER_LINEAR,
        borderMode=cv2.BORDER_REPLICATE,
    )
    scale = float(np.abs(np.diff(spots[_PLANE_PX // 2, :, 0])).mean())
    return 0.8 * np.clip(wrong / max(scale, 0.2), -8, 8)


def _line_of_sight(
    crop: SilhouetteCrop, spot: Float[np.ndarray, "3"]
) -> tuple[float, Float[np.ndarray, "3"]]:
    """Return how far below the horizon the camera sees a place [rad], and the level direction there."""
    ahead = spot - crop.camera.T_world_cam[:3, 3]
    tilt = float(np.arctan2(-ahead[2], np.hypot(ahead[0], ahead[1])))
    return tilt, np.array([ahead[0], ahead[1], 0.0]) / max(float(np.hypot(*ahead[:2])), 1e-9)


def _along_fit(
    solids: list[trimesh.Trimesh],
    T_world_mesh: Float[np.ndarray, "4 4"],
    T_world_fit: Float[np.ndarray, "4 4"],
) -> tuple[list[trimesh.Trimesh], Float[np.ndarray, "4 4"]]:
    """Return the same solids and pose with the axes of the fit instead of the picture's plane."""
    turn = T_world_mesh[:3, :3].T @ T_world_fit[:3, :3]
    solids = [turned(solid, turn.T) for solid in solids]
    middle = _centred(solids)
    return solids, T_world_mesh @ transform(turn, turn @ middle)


def _centred(solids: list[trimesh.Trimesh]) -> Float[np.ndarray, "3"]:
    """Move the solids together so that the first one's bounding box is centred, and return where its middle was."""
    middle = solids[0].bounds.mean(axis=0)
    for solid in solids:
        solid.vertices -= middle
    return middle


def _without_shadows(
    crop: SilhouetteCrop, mesh: trimesh.Trimesh, T_world_mesh: Float[np.ndarray, "4 4"]
) -> tuple[float, Float[np.ndarray, "4 4"]]:
    """Return by how much to scale the mesh, and its pose on the table, so that its outline lies over the mask."""
    grown, T = 1.0, T_world_mesh.copy()
    for _ in range(3):
        solid = trimesh.Trimesh(mesh.vertices * grown, mesh.faces, process=False)
        T[2, 3] = float(solid.extents[2]) / 2
        drawn = crop.drawn(solid, T)
        if not drawn.any():
            break
        height = T[2, 3]
        onto = crop.matrix[:, [0, 1, 3]] + np.outer(crop.matrix[:, 2], [0.0, 0.0, height])
        ends = [np.append(middle_of(picture), 1.0) for picture in (drawn, crop.mask)]
        here, there = (spot[:2] / spot[2] for spot in np.linalg.solve(onto, np.stack(ends).T).T)
        T[:2, 3] += there - here
        grown *= float(np.clip(np.sqrt(crop.mask.sum() / drawn.sum()), 0.85, 1.18))
    grown = float(np.clip(grown, 0.75, 1.33))
    T[2, 3] = grown * float(mesh.extents[2]) / 2
    return grown, T


def _plane_points(
    origin: Float[np.ndarray, "3"], axes: Float[np.ndarray, "3 3"], px: float
) -> Float[np.ndarray, "h w 3"]:
    """Return world points of a square picture's pixels in the plane of the first two axes about `origin`."""
    line = (np.arange(_PLANE_PX) - _PLANE_PX / 2 + 0.5) * px
    u, v = np.meshgrid(line, line)
    return origin + u[..., None] * axes[:, 0] + v[..., None] * axes[:, 1]


def _ground_shift(
    crop: SilhouetteCrop, drawn: Bool[np.ndarray, "i j"], forward: Float[np.ndarray, "3"]
) -> float:
    """Return how much further away a thing stands whose foot is drawn too high or too low [m]."""
    onto = crop.matrix[:, [0, 1, 3]]
    feet = []
    for picture in (drawn, crop.mask):
        x, y, w, h = bounding_box(picture)
        spot = np.linalg.solve(onto, np.array([x + w / 2, y + h, 1.0]))
        feet.append(spot[:2] / spot[2])
    return float((feet[1] - feet[0]) @ forward[:2])


def _signed(picture: Bool[np.ndarray, "h w"]) -> Float[np.ndarray, "h w"]:
    """Return the distance to the outline, positive inside [px]."""
    inner, outer = (
        cv2.distanceTransform(side.astype(np.uint8), cv2.DIST_L2, 5)
        for side in (picture, ~picture)
    )
    return np.asarray(inner - outer, np.float32)


def _blown(
    outline: Bool[np.ndarray, "h w"], px: float, cap: float, *, stands: bool
) -> tuple[trimesh.Trimesh, tuple[trimesh.Trimesh, ...]] | None:
    """Return the inflated outline; a standing object ends at the picture's middle row, where the table is."""
    if outline.sum() < 60:
        return None
    if stands:
        outline = _standing(outline, _PLANE_PX // 2)
    half = inflated(outline, px, cap)
    if stands:
        outline = outline & (np.arange(_PLANE_PX) >= _PLANE_PX // 2)[:, None]
    try:
        mesh, parts = pillow(outline, half, px)
    except ValueError:
        return None
    if not stands:  # it rests on a face, not on a line
        floor = 0.85 * float(mesh.vertices[:, 2].min())
        for solid in (mesh, *parts):
            solid.vertices[:, 2] = np.maximum(solid.vertices[:, 2], floor)
        parts = tuple(trimesh.convex.convex_hull(part.vertices) for part in parts)
    return mesh, parts


def _unsmeared(
    outline: Bool[np.ndarray, "h w"], slant: float, cap_px: float
) -> Bool[np.ndarray, "h w"]:
    """Return the outline without what its thickness adds to it when seen aslant.

    A run of half length s along the view, of a thing half b thick, shows an ellipse of half length
    a with s² = a² + (b slant)², and a = b where the thickness is not capped.
    """
    reach = cv2.distanceTransform(np.pad(outline, 1).astype(np.uint8), cv2.DIST_L2, 5)[1:-1, 1:-1]
    out = np.zeros_like(outline)
    step = np.diff(np.pad(outline, ((1, 1), (0, 0))).astype(np.int8), axis=0)
    for column in np.flatnonzero(outline.any(axis=0)).tolist():
        starts = np.flatnonzero(step[:, column] == 1)
        ends = np.flatnonzero(step[:, column] == -1)
        for start, end in zip(starts.tolist(), ends.tolist(), strict=True):
            s = (end - start) / 2
            b = min(cap_px, float(reach[start:end, column].max()))
            a = max(s / np.hypot(1, slant), float(np.sqrt(max(0.0, s * s - (b * slant) ** 2))))
            middle = (start + end) / 2
            out[round(middle - a) : max(round(middle - a) + 1, round(middle + a)), column] = True
    return out


def _standing(outline: Bool[np.ndarray, "h w"], table: int) -> Bool[np.ndarray, "h w"]:
    """Return the outline going straight down below row `table`, so that its base has a thickness.

    It is cut off later.
    """
    rows = np.flatnonzero(outline.any(axis=1))
    tall = int(rows[-1]) - table
    if tall < 4:
        return outline
    base = min(max(table, int(rows[0])) + max(1, int(0.08 * tall)), int(rows[-1]))
    out = outline.copy()
    out[max(0, table - int(0.3 * tall)) : base] = outline[base]
    return out


def _along(mesh: trimesh.Trimesh) -> Float[np.ndarray, "3 3"]:
    """Return the rotation about z whose x axis lies along the mesh."""
    flat = mesh.vertices[:, :2] - mesh.vertices[:, :2].mean(axis=0)
    _, ways = np.linalg.eigh(flat.T @ flat)
    x, y = ways[:, 1]
    return np.array([[x, -y, 0.0], [y, x, 0.0], [0.0, 0.0, 1.0]])

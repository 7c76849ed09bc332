"""The mesh of an object: the primitive that was fitted, a solid of revolution, or the inflated silhouette, by outline.

The fit says where the object is and how large; here its outline says more: the neck of a bottle, the bulge of a bowl, a
banana's bend. The primitive stays unless another shape covers the outline clearly better, because a hand, a shadow or a
handle deforms outlines too. One view does not show the back: it is taken to be like the front.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Literal

import cv2
import numpy as np
import trimesh
from jaxtyping import Bool, Float
from scipy.ndimage import gaussian_filter1d

from v2p_data.geometry.camera import Camera
from v2p_data.geometry.mesh import (
    lathe,
    lathe_parts,
    mesh_for,
    parts_for,
    wall_m,
)
from v2p_data.geometry.pillow import inflated, pillow
from v2p_data.geometry.pose import inverse, transform
from v2p_data.scene.crop import Crop, View, middle_of
from v2p_data.scene.nouns import Form, Noun
from v2p_data.scene.segment import bounding_box, handle_of, largest

Kind = Literal["primitive", "revolution", "inflated"]
Size = tuple[float, float, float]
_RINGS, _RADII, _AROUND = 48, 44, 30
_MAX_RADIUS = 0.8
"""Of the fitted diameter: rings are tried up to here."""
_BEYOND = 0.35
"""Of the fitted height: a profile may go on that far beyond the primitive."""
_RING_INSIDE = 0.94
"""Of a ring's points must lie in the mask: a disc half a percent too large has 6 % outside."""
_FLAT = 0.45
"""Things lower than this share of their length lie, and are seen in the plane of the table; others stand."""
_PLANE_PX = 200
"""Side of the square picture in which an outline is inflated."""
_CORRECTIONS = 4
_OTHER_SIDES = 1.8
"""An inflated silhouette's sides are at most by this factor others than the fitted primitive's."""
_LOW = 0.6
"""Of its diameter: a lower vessel is a pan, with a stick for a handle; a higher one a mug."""
_HANDLE_AREA = 0.03
"""Of the body's outline: what sticks out must be so large, or it is a shadow."""
_UPRIGHT = np.array([[1.0, 0, 0], [0, 0, 1], [0, -1, 0]])
"""Turns (right, towards the back, up) to an upright plane's (right, up, towards the camera)."""


@dataclass(frozen=True, kw_only=True)
class ShapeConfig:
    """By how much another shape must cover the outline better than the primitive, in units of IoU."""

    revolution_margin: float = 0.025
    ball_margin: float = 0.06
    """For round fruit: a pear is no ball, but most outlines of balls are dented by noise."""
    irregular_margin: float = 0.015
    """For an inflated silhouette of what is known to have no simple shape."""
    regular_margin: float = 0.15
    """For an inflated silhouette of anything else."""
    min_px: int = 80
    """Of the mask, below which an outline has no form."""
    handles: bool = True
    """Whether vessels get the handle that their outline shows."""
    max_hidden: float = 0.25
    """Where more of the primitive than this is hidden, its outline is not trusted to say more."""

    def __post_init__(self) -> None:
        if not 0 < self.max_hidden <= 1:
            raise ValueError(f"max_hidden must lie in 0..1, got {self.max_hidden}")


@dataclass(frozen=True, kw_only=True)
class ShapeChoice:
    """The mesh that covers the outline best for what it costs."""

    kind: Kind
    form: Form
    """The primitive that is nearest, which other modules compute with."""
    mesh: trimesh.Trimesh
    """Closed, turned outwards, centred on its bounding box, in its own frame [m]."""
    parts: tuple[trimesh.Trimesh, ...]
    """Convex solids that together are the mesh; what is hollow stays free."""
    size_m: Size
    """The mesh's full extents."""
    T_obj_shape: Float[np.ndarray, "4 4"]
    """From the mesh's frame to the fitted primitive's: poses become `T_world_obj @ T_obj_shape`."""
    iou: float
    """Of the mesh's silhouette with the mask where it can be seen, averaged over the views."""
    confidence: float
    """0 to 1."""
    reason: str
    """Why this shape, with the numbers."""


@dataclass(frozen=True, kw_only=True)
class _Candidate:
    kind: Kind
    mesh: trimesh.Trimesh
    parts: tuple[trimesh.Trimesh, ...]
    T_obj_shape: Float[np.ndarray, "4 4"]


@dataclass(frozen=True)
class _Handle:
    """How a kind of handle is told from a dent of the body's."""

    shortest: float
    longest: float
    """Of the body's diameter."""
    gain: float
    """In units of IoU: what sticks out far need not cover much more."""
    heights: tuple[float, ...]
    """At which it may stick out, over the middle, in units of the body's height."""


_STICK = _Handle(0.3, 1.1, 0.015, (0.2, 0.35, 0.5, 0.7))
_PLATE = _Handle(0.12, 0.6, 0.03, (0.0,))
"""Of a low vessel, and of a high one."""


def best_shape(
    views: Sequence[View],
    camera: Camera,
    size_m: Size,
    noun: Noun,
    cfg: ShapeConfig | None = None,
) -> ShapeChoice:
    """Return the mesh of an object that was fitted with its noun's primitive.

    Args:
        views: the first is the one from which shapes are made, resting on the table; all are compared with.
        camera: of the masks, in the world frame, the table's top at z = 0 [m].
        size_m: of the fitted primitive, along its own axes.
        noun: which primitive, whether hollow, whether irregular.
        cfg: how clearly the primitive must be beaten.
    """
    cfg = cfg or ShapeConfig()
    crops = [Crop(view, camera) for view in views]
    primitive = _primitive(size_m, noun)
    plain = _iou(primitive, views, crops)
    hidden = crops[0].hidden_share(crops[0].drawn(primitive.mesh, views[0].T_world_obj))
    best, best_iou, best_gain = primitive, plain, 0.0
    reason = f"the {_word(noun)} covers the outline to {plain:.2f}"
    pixels = int(views[0].mask.sum())
    if pixels < cfg.min_px:
        reason += f"; with {pixels} pixels it is too small in the picture for anything finer"
    elif hidden > cfg.max_hidden:
        reason += f"; {hidden:.0%} of it is hidden, so nothing finer was tried"
    else:
        for candidate, margin in _others(views[0], crops[0], size_m, noun, cfg):
            if candidate.kind == "inflated" and not _as_large(candidate, size_m):
                continue
            iou = _iou(candidate, views, crops)
            if iou - margin - plain > best_gain:
                best, best_iou, best_gain = candidate, iou, iou - margin - plain
        if best is not primitive:
            what = {"revolution": "a solid of revolution", "inflated": "the inflated silhouette"}
            reason = f"{what[best.kind]} covers the outline to {best_iou:.2f}, the {_word(noun)} to {plain:.2f}"
        if cfg.handles and noun.handled:
            handle = _STICK if _is_low(best) else _PLATE
            handled = _handled(best, handle, views[0], crops[0])
            iou = -1.0 if handled is None else _iou(handled, views, crops)
            if handled is not None and iou > best_iou + handle.gain:
                best, best_iou = handled, iou
                reason += f"; with a handle to {iou:.2f}"
    confidence = float(np.clip((best_iou - 0.4) / 0.5, 0.05, 1) * (1 - 0.6 * hidden))
    x, y, z = (float(v) for v in best.mesh.extents)
    return ShapeChoice(
        kind=best.kind,
        form=noun.form,
        mesh=best.mesh,
        parts=best.parts,
        size_m=(x, y, z) if best is not primitive else size_m,
        T_obj_shape=best.T_obj_shape,
        iou=best_iou,
        confidence=round(confidence, 3),
        reason=reason,
    )


def _primitive(size_m: Size, noun: Noun) -> _Candidate:
    return _Candidate(
        kind="primitive",
        mesh=mesh_for(noun.form, size_m, hollow=noun.hollow, taper=noun.taper, bore=noun.bore),
        parts=parts_for(noun.form, size_m, hollow=noun.hollow, taper=noun.taper, bore=noun.bore),
        T_obj_shape=np.eye(4),
    )


def _others(
    view: View, crop: Crop, size_m: Size, noun: Noun, cfg: ShapeConfig
) -> list[tuple[_Candidate, float]]:
    """Return what else the object may be, with the margin by which each must win."""
    if noun.bore:
        return []
    found: list[tuple[_Candidate | None, float]] = []
    if noun.form != "box":
        margin = cfg.revolution_margin if noun.form == "cylinder" else cfg.ball_margin
        body = crop
        if noun.handled:
            handle = handle_of(view.mask)
            unknown = handle if view.hidden is None else view.hidden | handle
            body = Crop(replace(view, mask=view.mask & ~handle, hidden=unknown), crop.camera)
        found.append((_revolution(view, body, size_m, noun), margin))
    if not noun.hollow and noun.symmetry != "sphere" and not crop.at_border:
        irregular = noun.form == "box" and noun.symmetry == "none"
        margin = cfg.irregular_margin if irregular else cfg.regular_margin
        found.append((_inflation(view, crop, size_m), margin))
    return [(candidate, margin) for candidate, margin in found if candidate is not None]


def _handled(body: _Candidate, kind: _Handle, view: View, crop: Crop) -> _Candidate | None:
    """Return the vessel with the handle that its outline shows; None where it shows none, or does not stand upright.

    Low vessels have a stick near the rim, tall ones a plate at half height, whose own height hides how far back it reaches:
    there directions and lengths are tried.
    """
    T = view.T_world_obj @ body.T_obj_shape
    if T[2, 2] < 0.9:
        return None
    diameter, height = float(body.mesh.extents[:2].mean()), float(body.mesh.extents[2])
    drawn = crop.drawn(body.mesh, T)
    around = cv2.dilate(drawn.astype(np.uint8), np.ones((5, 5), np.uint8)) > 0
    spare = largest(crop.mask & ~around)
    if spare.sum() < _HANDLE_AREA * drawn.sum():
        return None
    made = []
    for z in (share * height for share in kind.heights):
        inner = _radius_at(body.mesh, z)
        made += [
            _with_handle(body, way, inner, extents, z)
            for way, extents in _tries(_spots(spare, crop.matrix @ T, z), kind, body, inner)
            if kind.shortest * diameter < extents[0] < kind.longest * diameter
        ]
    return max(made, key=lambda one: _iou(one, [view], [crop]), default=None)


def _tries(
    spots: Float[np.ndarray, "n 2"], kind: _Handle, body: _Candidate, inner: float
) -> list[tuple[Float[np.ndarray, "2"], Size]]:
    """Return directions and extents of handles that may be what is seen at these spots beside the axis."""
    diameter, height = float(body.mesh.extents[:2].mean()), float(body.mesh.extents[2])
    way = spots.mean(0) / np.linalg.norm(spots.mean(0))
    if kind is _STICK:
        along, across = spots @ way, spots @ np.array([-way[1], way[0]])
        length = float(np.percentile(along, 97)) - inner
        seen = 2 * np.sqrt(3) * across.std()
        widths = np.clip([0.7 * seen, seen], 0.06 * diameter, 0.25 * diameter).tolist()
        return [(way, (length, wide, min(wide, 0.4 * height))) for wide in widths]
    facing = np.arctan2(way[1], way[0]) + np.radians(np.arange(-75, 76, 15))
    return [
        (np.array([np.cos(a), np.sin(a)]), (share * diameter, 0.15 * diameter, 0.6 * height))
        for a in facing
        for share in (0.2, 0.3, 0.4, 0.5)
    ]


def _spots(
    picture: Bool[np.ndarray, "i j"], matrix: Float[np.ndarray, "3 4"], z: float
) -> Float[np.ndarray, "n 2"]:
    """Return where the pixels of a picture lie at height `z`; `matrix` takes points to pixels."""
    onto = matrix @ np.array([[1, 0, 0], [0, 1, 0], [0, 0, z], [0, 0, 1.0]])
    rows, columns = np.nonzero(picture)
    spots = np.linalg.solve(onto, np.stack([columns + 0.5, rows + 0.5, np.ones(len(rows))]))
    return (spots[:2] / spots[2]).T


def _with_handle(
    body: _Candidate, way: Float[np.ndarray, "2"], inner: float, extents: Size, z: float
) -> _Candidate:
    """Return a vessel with a block beside it, `inner` from its axis and at height `z`, towards `way`; x then points there.

    The block touches the wall and goes no further in: two closed surfaces side by side are one closed surface.
    """
    at = trimesh.transformations.translation_matrix([inner + extents[0] / 2, 0.0, z])
    handle = trimesh.creation.box(extents=extents, transform=at)
    turn = np.array([[way[0], way[1], 0.0], [-way[1], way[0], 0.0], [0.0, 0.0, 1.0]])
    vessel, *parts = (_turned(solid, turn) for solid in (body.mesh, *body.parts))
    mesh = trimesh.Trimesh(
        np.vstack([vessel.vertices, handle.vertices]),
        np.vstack([vessel.faces, handle.faces + len(vessel.vertices)]),
        process=False,
    )
    middle = mesh.bounds.mean(axis=0)
    for solid in (mesh, *parts, handle):
        solid.vertices -= middle
    return _Candidate(
        kind="revolution",
        mesh=mesh,
        parts=(*parts, handle),
        T_obj_shape=body.T_obj_shape @ transform(turn.T, turn.T @ middle),
    )


def _is_low(body: _Candidate) -> bool:
    return float(body.mesh.extents[2]) < _LOW * float(body.mesh.extents[:2].mean())


def _radius_at(mesh: trimesh.Trimesh, z: float) -> float:
    """Return the outer radius of a body of revolution at a height in its own frame."""
    heights, row = np.unique(mesh.vertices[:, 2].round(6), return_inverse=True)
    radii = np.zeros(len(heights))
    np.maximum.at(radii, row, np.hypot(mesh.vertices[:, 0], mesh.vertices[:, 1]))
    return float(np.interp(z, heights, radii))


def _as_large(shape: _Candidate, size_m: Size) -> bool:
    """Return whether its sides are about the fit's: seen aslant, what is flat can be inflated to any depth."""
    ratio = np.sort(shape.mesh.extents) / np.sort(size_m)
    return bool((np.maximum(ratio, 1 / ratio) < _OTHER_SIDES).all())


def _word(noun: Noun) -> str:
    if noun.bore:
        return "ring"
    hollow = "hollow " if noun.hollow else ""
    return hollow + {"box": "box", "cylinder": "cylinder", "sphere": "ball"}[noun.form]


def _iou(shape: _Candidate, views: Sequence[View], crops: list[Crop]) -> float:
    return float(
        np.mean(
            [
                crop.iou(crop.drawn(shape.mesh, view.T_world_obj @ shape.T_obj_shape))
                for view, crop in zip(views, crops, strict=True)
            ]
        )
    )


def _revolution(view: View, crop: Crop, size_m: Size, noun: Noun) -> _Candidate | None:
    """Return what the outline leaves of a body of revolution about the fit's z: at each height the largest disc in it.

    The silhouette of such a body is the union of its discs' silhouettes, so nothing larger can be right. Discs at the
    ends that other discs cover are dropped: the smallest body wins.
    """
    T, (diameter, _, height) = view.T_world_obj, size_m
    up = float(T[2, 2])
    low, high = (-height / 2 - _BEYOND * height, height / 2 + _BEYOND * height)
    if up > 0.9:
        low = -height / 2
    elif up < -0.9:
        high = height / 2
    z = np.linspace(low, high, _RINGS)
    radii = np.linspace(0, _MAX_RADIUS * diameter, _RADII)
    side = T[:3, :3].T @ np.cross(T[:3, 2], T[:3, 3] - crop.camera.T_world_cam[:3, 3])
    side = np.array([side[0], side[1], 0.0]) / max(float(np.hypot(side[0], side[1])), 1e-9)
    carved = [
        (shift, _carved(crop, T, z, radii, shift * diameter * side))
        for shift in (0.0, -0.03, 0.03, -0.07, 0.07)
    ]
    shift, radius = max(carved, key=lambda c: float((c[1] ** 2).sum()) * (1 - 0.1 * abs(c[0])))
    rows = np.flatnonzero(radius > 0.08 * float(radius.max()))
    if len(rows) < 4 or radius.max() <= 0:
        return None
    centre = T[:3, 3] + T[:3, :3] @ (shift * diameter * side)
    first, last = _needed(
        crop, T, centre, z, radius, rows, fitted=height / 2, bottom=up <= 0.9, top=up >= -0.9
    )
    if last - first < 3:
        return None
    z, radius = z[first : last + 1], radius[first : last + 1]
    radius = gaussian_filter1d(radius, 1.0, mode="nearest")
    middle = (z[0] + z[-1]) / 2
    profile = np.c_[np.maximum(radius, 1e-3 * diameter), z - middle]
    wide, tall = 2 * float(radius.max()), float(z[-1] - z[0])
    wall = wall_m((wide, wide, 2 * tall)) if noun.hollow else 0.0
    move = transform(np.eye(3), shift * diameter * side + np.array([0.0, 0.0, middle]))
    return _Candidate(
        kind="revolution",
        mesh=lathe(profile, wall),
        parts=lathe_parts(profile, wall),
        T_obj_shape=move,
    )


def _carved(
    crop: Crop,
    T_world_obj: Float[np.ndarray, "4 4"],
    z: Float[np.ndarray, "k"],
    radii: Float[np.ndarray, "j"],
    shift: Float[np.ndarray, "3"],
) -> Float[np.ndarray, "k"]:
    """Return per height the largest radius up to which all rings about the shifted axis lie in the mask."""
    angles = np.linspace(0, 2 * np.pi, _AROUND, endpoint=False)
    x, y = np.cos(angles), np.sin(angles)
    rings = np.empty((len(z), len(radii), _AROUND, 3))
    rings[..., 0] = radii[None, :, None] * x + shift[0]
    rings[..., 1] = radii[None, :, None] * y + shift[1]
    rings[..., 2] = z[:, None, None] + shift[2]
    world = rings @ T_world_obj[:3, :3].T + T_world_obj[:3, 3]
    fits = crop.looked_up(crop.may, world).mean(axis=2) >= _RING_INSIDE
    seen = (
        crop.looked_up(crop.mask, world).mean(axis=2) >= 0.5
    )  # a ring behind the hand says nothing
    reach = np.cumprod(fits, axis=1).sum(axis=1)
    sure = (np.cumprod(fits, axis=1) * seen).any(axis=1)
    return np.where((reach > 1) & sure, radii[np.maximum(reach - 1, 0)], 0.0)


def _needed(
    crop: Crop,
    T_world_obj: Float[np.ndarray, "4 4"],
    centre: Float[np.ndarray, "3"],
    z: Float[np.ndarray, "k"],
    radius: Float[np.ndarray, "k"],
    rows: np.ndarray,
    *,
    fitted: float,
    bottom: bool,
    top: bool,
) -> tuple[int, int]:
    """Return the first and last disc without which the silhouette would lack something, or the body its fitted height.

    `fitted` is half that height: the base of a bowl that lies on its mouth is seen within the outline, which does not need it.
    """
    angles = np.linspace(0, 2 * np.pi, _AROUND, endpoint=False)
    ring = np.stack([np.cos(angles), np.sin(angles), np.zeros(_AROUND)], axis=1)
    discs = []
    for k in rows.tolist():
        points = radius[k] * ring + np.array([0.0, 0.0, z[k]])
        pixels = crop.pixels(points @ T_world_obj[:3, :3].T + centre)
        picture = np.zeros(crop.mask.shape, np.uint8)
        if np.isfinite(pixels).all():
            cv2.fillConvexPoly(picture, ((pixels - 0.5) * 16).astype(np.int32), 1, cv2.LINE_8, 4)
        discs.append(picture > 0)
    stack = np.array(discs)
    covers = stack.sum(axis=0)
    allowed = 0.006 * float(crop.mask.sum())
    first, last = 0, len(rows) - 1
    for end, step in ((last, -1), (first, 1)):
        if not (top if step < 0 else bottom):
            continue
        k, lost, left = end, 0.0, covers.copy()
        while 0 <= k < len(rows) and abs(z[rows[k]]) > fitted:
            left = left - stack[k]
            lost = float(((left == 0) & (covers > 0) & crop.mask).sum())
            if lost > allowed:
                break
            k += step
        if step < 0:
            last = max(k, 0)
        else:
            first = min(k, len(rows) - 1)
    return int(rows[first]), int(rows[max(last, first)])


def _inflation(view: View, crop: Crop, size_m: Size) -> _Candidate | None:
    """Return the outline, seen in a plane through the object and inflated to the fit's thickness.

    What lies is seen in a plane along the table, what stands in the upright plane that faces the camera.
    """
    T = view.T_world_obj
    extents = np.abs(T[:3, :3]) @ np.array(size_m)
    tall = float(extents[2])
    lengths = [s for s, up in zip(size_m, np.abs(T[2, :3]), strict=True) if up < 0.7]
    lies = tall < _FLAT * max(lengths, default=tall)
    thin = tall if lies else min([*lengths, tall])
    eye = crop.camera.T_world_cam[:3, 3]
    ahead = T[:3, 3] - eye
    tilt = float(np.arctan2(-ahead[2], np.hypot(ahead[0], ahead[1])))
    forward = np.array([ahead[0], ahead[1], 0.0]) / max(float(np.hypot(*ahead[:2])), 1e-9)
    up = np.array([0.0, 0.0, 1.0])
    if not 0.1 < tilt < 1.45:
        lies = lies or tilt >= 1.45
    right = np.cross(forward, up)
    slant = 1 / np.tan(max(tilt, 0.1)) if lies else np.tan(min(tilt, 1.45))
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
        # Where the silhouette is too large the outline shrinks by as much, and the other way round.
        spots = np.nan_to_num(crop.pixels(plane), nan=0.0).astype(np.float32) - 0.5
        wrong = cv2.remap(
            goal - _signed(drawn), spots[..., 0], spots[..., 1], cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE
        )  # fmt: skip
        scale = float(np.abs(np.diff(spots[_PLANE_PX // 2, :, 0])).mean())
        field = field + 0.8 * np.clip(wrong / max(scale, 0.2), -8, 8)
    turn = _along(mesh) if lies else _UPRIGHT
    T_world_mesh = T_world_plane @ transform(turn, np.zeros(3))
    solids = [_turned(solid, turn.T) for solid in (mesh, *parts)]
    middle = solids[0].bounds.mean(axis=0)
    for solid in solids:
        solid.vertices -= middle
    T_world_mesh = T_world_mesh @ transform(np.eye(3), middle)
    grown, T_world_mesh = _settled(crop, solids[0], T_world_mesh)
    for solid in solids:
        solid.vertices *= grown
    return _Candidate(
        kind="inflated",
        mesh=solids[0],
        parts=tuple(solids[1:]),
        T_obj_shape=inverse(T) @ T_world_mesh,
    )


def _settled(
    crop: Crop, mesh: trimesh.Trimesh, T_world_mesh: Float[np.ndarray, "4 4"]
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
    """Return the world points of a square picture's pixels in the plane of the first two axes, `origin` in its middle."""
    line = (np.arange(_PLANE_PX) - _PLANE_PX / 2 + 0.5) * px
    u, v = np.meshgrid(line, line)
    return origin + u[..., None] * axes[:, 0] + v[..., None] * axes[:, 1]


def _ground_shift(
    crop: Crop, drawn: Bool[np.ndarray, "i j"], forward: Float[np.ndarray, "3"]
) -> float:
    """Return how much further along the table a thing stands whose foot is drawn too high or too low in the picture [m]."""
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
    """Return the inflated outline; what stands ends at the picture's middle row, where the table is."""
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

    A run of half length s along the view, of a thing half b thick, shows an ellipse of half length a with s² = a² + (b slant)²,
    and a = b where the thickness is not capped.
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
    """Return the outline going straight down below row `table`, so that its base has a thickness; it is cut off later."""
    rows = np.flatnonzero(outline.any(axis=1))
    tall = int(rows[-1]) - table
    if tall < 4:
        return outline
    base = max(table, int(rows[0])) + max(1, int(0.08 * tall))
    out = outline.copy()
    out[max(0, table - int(0.3 * tall)) : base] = outline[base]
    return out


def _along(mesh: trimesh.Trimesh) -> Float[np.ndarray, "3 3"]:
    """Return the rotation about z whose x axis lies along the mesh."""
    flat = mesh.vertices[:, :2] - mesh.vertices[:, :2].mean(axis=0)
    _, ways = np.linalg.eigh(flat.T @ flat)
    x, y = ways[:, 1]
    return np.array([[x, -y, 0.0], [y, x, 0.0], [0.0, 0.0, 1.0]])


def _turned(mesh: trimesh.Trimesh, rotation: Float[np.ndarray, "3 3"]) -> trimesh.Trimesh:
    return trimesh.Trimesh(mesh.vertices @ rotation.T, mesh.faces, process=False)

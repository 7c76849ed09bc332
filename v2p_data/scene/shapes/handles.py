"""The handle that a vessel's outline shows: low vessels have a stick near the rim, high ones a plate at half height."""

from dataclasses import dataclass

import cv2
import numpy as np
import trimesh
from jaxtyping import Bool, Float

from v2p_data.geometry.pose import transform
from v2p_data.scene.frames.mask_ops import largest
from v2p_data.scene.shapes.mesh_hypothesis import MeshHypothesis, Size, iou_of, turned
from v2p_data.scene.shapes.silhouette_view import SilhouetteCrop, SilhouetteView

_LOW = 0.6
"""Height over diameter: a lower vessel is a pan, with a stick for a handle; a higher one a mug."""
_HANDLE_AREA = 0.03
"""Share of the body's outline: what sticks out must be so large, or it is a shadow."""


@dataclass(frozen=True)
class Handle:
    """How a kind of handle is told from a dent of the body's."""

    shortest: float
    longest: float
    """Length as a share of the body's diameter."""
    gain: float
    """In units of IoU: what sticks out far need not cover much more."""
    heights: tuple[float, ...]
    """At which it may stick out, over the middle, in units of the body's height."""


_STICK = Handle(0.3, 1.1, 0.015, (0.2, 0.35, 0.5, 0.7))
_PLATE = Handle(0.12, 0.6, 0.03, (0.0,))
"""Handle of a low vessel, and of a high one."""


def handle_of_body(body: MeshHypothesis) -> Handle:
    """Return which kind of handle a vessel may have."""
    low = float(body.mesh.extents[2]) < _LOW * float(body.mesh.extents[:2].mean())
    return _STICK if low else _PLATE


def with_handle(
    body: MeshHypothesis, kind: Handle, view: SilhouetteView, crop: SilhouetteCrop
) -> MeshHypothesis | None:
    """Return the vessel with the handle that its outline shows; None where it shows none, or does not stand upright.

    Low vessels have a stick near the rim, tall ones a plate at half height, whose own height hides
    how far back it reaches: there directions and lengths are tried.
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
            _joined(body, way, inner, extents, z)
            for way, extents in _tries(_spots(spare, crop.matrix @ T, z), kind, body, inner)
            if kind.shortest * diameter < extents[0] < kind.longest * diameter
        ]
    return max(made, key=lambda one: iou_of(one, view, crop), default=None)


def _tries(
    spots: Float[np.ndarray, "n 2"], kind: Handle, body: MeshHypothesis, inner: float
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


def _joined(
    body: MeshHypothesis, way: Float[np.ndarray, "2"], inner: float, extents: Size, z: float
) -> MeshHypothesis:
    """Return a vessel with a block beside it, `inner` from its axis and at height `z`, towards `way`.

    X then points there.

    The block touches the wall and goes no further in: two closed surfaces side by side are one closed surface.
    """
    at = trimesh.transformations.translation_matrix([inner + extents[0] / 2, 0.0, z])
    handle = trimesh.creation.box(extents=extents, transform=at)
    turn = np.array([[way[0], way[1], 0.0], [-way[1], way[0], 0.0], [0.0, 0.0, 1.0]])
    vessel, *parts = (turned(solid, turn) for solid in (body.mesh, *body.parts))
    mesh = trimesh.Trimesh(
        np.vstack([vessel.vertices, handle.vertices]),
        np.vstack([vessel.faces, handle.faces + len(vessel.vertices)]),
        process=False,
    )
    middle = mesh.bounds.mean(axis=0)
    for solid in (mesh, *parts, handle):
        solid.vertices -= middle
    return MeshHypothesis(
        kind="revolution",
        mesh=mesh,
        parts=(*parts, handle),
        T_obj_shape=body.T_obj_shape @ transform(turn.T, turn.T @ middle),
    )


def _radius_at(mesh: trimesh.Trimesh, z: float) -> float:
    """Return the outer radius of a body of revolution at a height in its own frame."""
    heights, row = np.unique(mesh.vertices[:, 2].round(6), return_inverse=True)
    radii = np.zeros(len(heights))
    np.maximum.at(radii, row, np.hypot(mesh.vertices[:, 0], mesh.vertices[:, 1]))
    return float(np.interp(z, heights, radii))

"""A spoon is a bowl at the end of a rod: as the block that encloses it, no gripper could hold it by its handle.

Proportions are those of cutlery and of wooden cooking spoons: the bowl is a third (cutlery) to a quarter (wood) of the length,
two fifths of the height that a lying spoon has, and one to three millimetres thick; the rod is a fifth as wide as the bowl, leaves it at its rim and
rises to the full height over two thirds of its way. One view seldom shows more of it than which end the bowl is.
"""

import numpy as np
import trimesh
from jaxtyping import Float

from v2p_data.geometry.mesh import lathe
from v2p_data.scene.scale.nouns import Noun
from v2p_data.scene.shapes.mesh_hypothesis import MeshHypothesis, Size, turned

_BOWL_LENGTH, _BOWL_DEPTH, _WALL = 0.3, 0.42, 0.12
"""Of the spoon's length, and twice of its height."""
_ROD, _RISEN = 0.22, 0.7
"""Diameter in widths of the bowl, and on which part of its way it has risen."""
_PROFILE = np.array([(0.30, 0.0), (0.65, 0.22), (0.88, 0.6), (1.0, 1.0)])
"""Profile of the bowl: radius and height over its foot, in shares of its own."""
_RINGS, _AROUND, _A_PART = 9, 8, 2


def is_spoon(noun: Noun) -> bool:
    """Return whether things of that name are a bowl at the end of a rod."""
    return noun.word.endswith("spoon")


def spoons(
    size_m: Size, T_world_obj: Float[np.ndarray, "4 4"]
) -> tuple[MeshHypothesis, MeshHypothesis]:
    """Return the spoon that fills a fitted block, its bowl at the one end and at the other, open upwards.

    The bowl of the first is at the end that is lower: so a hand holds a spoon that it pushes with.
    """
    R = T_world_obj[:3, :3]
    long = int(np.argmax(size_m))
    up = max((axis for axis in range(3) if axis != long), key=lambda axis: abs(R[2, axis]))
    across = 3 - long - up
    axes = np.zeros((3, 3))  # own axes along the block's: the bowl's way, across, up
    axes[long, 0] = -1.0 if R[2, long] > 0 else 1.0
    axes[up, 2] = 1.0 if R[2, up] >= 0 else -1.0
    axes[:, 1] = np.cross(axes[:, 2], axes[:, 0])
    mesh, parts = _spoon(size_m[long], size_m[across], size_m[up])

    def lying(turn: Float[np.ndarray, "3 3"]) -> MeshHypothesis:
        return MeshHypothesis(
            kind="spoon",
            mesh=turned(mesh, turn),
            parts=tuple(turned(part, turn) for part in parts),
            T_obj_shape=np.eye(4),
        )

    return lying(axes), lying(axes @ np.diag([-1.0, -1.0, 1.0]))


def _spoon(
    length: float, width: float, height: float
) -> tuple[trimesh.Trimesh, list[trimesh.Trimesh]]:
    """Return a spoon along x, its bowl ahead, and convex solids that cover it: the bowl filled, the rod in pieces."""
    long, deep = _BOWL_LENGTH * length, _BOWL_DEPTH * height
    bowl = lathe(_PROFILE * [width / 2, deep] - [0, deep / 2], _WALL * height)
    bowl.vertices = bowl.vertices * [long / width, 1, 1] + [
        (length - long) / 2,
        0,
        (deep - height) / 2,
    ]
    radius = min(_ROD * width / 2, height / 2)
    share = np.linspace(0, 1, _RINGS)
    x = length / 2 - long - (length - long) * share
    low, high = max(deep, 2 * radius) - height / 2 - radius, height / 2 - radius
    z = low + (high - low) * np.sin(np.pi / 2 * np.minimum(share / _RISEN, 1))
    angle = np.linspace(0, 2 * np.pi, _AROUND, endpoint=False)
    ring = radius * np.stack([np.zeros(_AROUND), np.cos(angle), np.sin(angle)], 1)
    rings = np.stack([x, np.zeros(_RINGS), z], 1)[:, None] + ring
    rod = _tube(rings)
    mesh = trimesh.Trimesh(
        np.vstack([bowl.vertices, rod.vertices]),
        np.vstack([bowl.faces, rod.faces + len(bowl.vertices)]),
        process=False,
    )
    pieces = [
        trimesh.convex.convex_hull(rings[k : k + _A_PART + 1].reshape(-1, 3))
        for k in range(0, _RINGS - 1, _A_PART)
    ]
    parts = [trimesh.convex.convex_hull(bowl.vertices), *pieces]
    middle, scale = mesh.bounds.mean(0), np.array([length, width, height]) / mesh.extents
    for solid in (mesh, *parts):
        solid.vertices = (solid.vertices - middle) * scale
    return mesh, parts


def _tube(rings: Float[np.ndarray, "n k 3"]) -> trimesh.Trimesh:
    """Return the closed surface around rings of points."""
    n, k = rings.shape[:2]
    a = np.arange(n * k).reshape(n, k)
    b = np.roll(a, -1, axis=1)
    sides = [(a[:-1], b[:-1], b[1:]), (a[:-1], b[1:], a[1:])]
    faces = [np.stack(side, -1).reshape(-1, 3) for side in sides]
    fan = np.arange(1, k - 1)
    faces += [
        np.stack([np.zeros_like(fan), fan + 1, fan], 1),
        (n - 1) * k + np.stack([np.zeros_like(fan), fan, fan + 1], 1),
    ]
    mesh = trimesh.Trimesh(rings.reshape(-1, 3), np.vstack(faces), process=False)
    if mesh.volume < 0:
        mesh.invert()
    return mesh

"""How far two shapes overlap, whatever their own axes are called."""

import itertools
from dataclasses import dataclass

import numpy as np
import trimesh
from jaxtyping import Bool, Float
from scipy.spatial import QhullError

SAME_SIDES = 1.15
"""Two orders of a box's sides are alike where the worse fits no more than by this factor worse."""
MIN_CAVITY = 0.1
"""Of the convex hull; with less room inside a thing is not hollow."""
_GRID = 40
Turn = tuple[tuple[int, ...], tuple[int, ...]]


def shape_ious(
    true: trimesh.Trimesh,
    found: trimesh.Trimesh,
    *,
    hollow: tuple[bool, bool],
    cavity_matters: bool,
) -> tuple[float, float]:
    """Return volume IoU and shape IoU of two meshes stretched to one bounding box, at the best of 24 turns.

    Args:
        true: a closed mesh.
        found: a closed mesh.
        hollow: whether the true and the found one are vessels; their outsides are compared with the cavity closed.
        cavity_matters: whether the cavities are compared too.
    """
    a, b = _Solid.of(true), _Solid.of(found)
    best = (0.0, 0.0)
    for order, signs in cube_turns():
        c = b.turned(order, signs)
        shape = iou(a.outside(hollow[0]), c.outside(hollow[1]))
        if cavity_matters:
            shape = min(shape, iou(a.cavity, c.cavity))
        best = max(best, (shape, iou(a.filled, c.filled)))
    return best[1], best[0]


def opening(mesh: trimesh.Trimesh) -> Float[np.ndarray, "3"] | None:
    """Return the signed axis of the mesh's own frame towards which it is open; None for what is not hollow."""
    return _Solid.of(mesh).opening


def cube_turns() -> list[Turn]:
    """Return the 24 turns that take a cube to itself, as an order of axes and their signs."""
    out = []
    for order in itertools.permutations(range(3)):
        even = order in {(0, 1, 2), (1, 2, 0), (2, 0, 1)}
        out.extend(
            (order, signs)
            for signs in itertools.product((1, -1), repeat=3)
            if (np.prod(signs) > 0) == even
        )
    return out


def fitting_turns(
    true_m: tuple[float, float, float], found_m: tuple[float, float, float]
) -> list[Turn]:
    """Return the turns under which the found sides fit the true ones about as well as they can."""
    worst = {
        order: float(np.abs(np.log(np.array(found_m)[list(order)] / np.array(true_m))).max())
        for order in itertools.permutations(range(3))
    }
    bar = min(worst.values()) + np.log(SAME_SIDES)
    return [(order, signs) for order, signs in cube_turns() if worst[order] <= bar]


@dataclass(frozen=True)
class _Solid:
    """A mesh as voxels of its bounding box."""

    filled: Bool[np.ndarray, "n n n"]
    hull: Bool[np.ndarray, "n n n"]
    cavity: Bool[np.ndarray, "n n n"]
    """Room inside the hull that is reached from the open side without meeting the mesh."""
    opening: Float[np.ndarray, "3"] | None

    @classmethod
    def of(cls, mesh: trimesh.Trimesh) -> "_Solid":
        low, high = mesh.bounds
        filled = _voxels(mesh, low, high)
        try:
            hull = _voxels(mesh.convex_hull, low, high)
        except QhullError:  # a broken mesh without volume
            hull = filled
        best, towards = np.zeros_like(hull), None
        # Walls thinner than a cell are not seen from the side: up comes first, and others must be clearly roomier.
        for axis, sign in itertools.product((2, 0, 1), (1, -1)):
            from_there = np.flip(filled, axis) if sign > 0 else filled
            met = np.maximum.accumulate(from_there, axis=axis)
            room = hull & ~(np.flip(met, axis) if sign > 0 else met)
            if room.sum() > max(1.05 * best.sum(), MIN_CAVITY * hull.sum()):
                best, towards = room, sign * np.eye(3)[axis]
        return cls(filled, hull, best, towards)

    def outside(self, hollow: bool) -> Bool[np.ndarray, "n n n"]:
        """Return the solid; of a vessel with its cavity closed."""
        return self.filled | self.cavity if hollow else self.filled

    def turned(self, order: tuple[int, ...], signs: tuple[int, ...]) -> "_Solid":
        def turn(voxels: Bool[np.ndarray, "n n n"]) -> Bool[np.ndarray, "n n n"]:
            flipped = [i for i, sign in enumerate(signs) if sign < 0]
            return np.flip(voxels.transpose(order), flipped)

        return _Solid(turn(self.filled), turn(self.hull), turn(self.cavity), self.opening)


def _voxels(
    mesh: trimesh.Trimesh, low: Float[np.ndarray, "3"], high: Float[np.ndarray, "3"]
) -> Bool[np.ndarray, "n n n"]:
    """Return which cells of the box have their centre inside the mesh, by counting crossings along columns.

    A cell is inside where the surfaces above it, counted with the direction they face, do not cancel: parts that
    overlap and faces that are turned inside out as a whole do no harm.
    """
    n = _GRID
    # Centres are moved a little off: a column through an edge would cross both of its triangles.
    x, y = (np.arange(n) + 0.5 + 1e-3) / n, (np.arange(n) + 0.5 + 3.1e-3) / n
    columns = np.stack(np.meshgrid(x, y, indexing="ij"), axis=-1).reshape(-1, 2)
    corners = ((mesh.vertices - low) / np.maximum(high - low, 1e-9))[mesh.faces]
    crossings = np.zeros((n * n, n + 1), np.int32)
    for a, b, c in (corners[k : k + 256].swapaxes(0, 1) for k in range(0, len(corners), 256)):
        ab, ac = (b - a)[:, None, :2], (c - a)[:, None, :2]
        area = ab[..., 0] * ac[..., 1] - ab[..., 1] * ac[..., 0]
        to = columns[None] - a[:, None, :2]
        seen = np.where(np.abs(area) > 1e-12, area, np.nan)  # upright faces are no crossing
        s = (to[..., 0] * ac[..., 1] - to[..., 1] * ac[..., 0]) / seen
        t = (ab[..., 0] * to[..., 1] - ab[..., 1] * to[..., 0]) / seen
        face, column = np.nonzero((s >= 0) & (t >= 0) & (s + t <= 1))
        s, t = s[face, column], t[face, column]
        z = a[face, 2] + s * (b - a)[face, 2] + t * (c - a)[face, 2]
        below = np.clip(np.ceil(z * n - 0.5), 0, n).astype(int)
        facing = np.sign(area[face, 0]).astype(np.int32)
        np.add.at(crossings, (column, np.zeros_like(column)), facing)
        np.add.at(crossings, (column, below), -facing)
    return (crossings.cumsum(axis=1)[:, :n] != 0).reshape(n, n, n)


def iou(a: Bool[np.ndarray, "*shape"], b: Bool[np.ndarray, "*shape"]) -> float:
    union = int((a | b).sum())
    return float((a & b).sum() / union) if union else 0.0

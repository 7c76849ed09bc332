"""Closed surfaces with texture coordinates: boxes, bins, solids of revolution, ellipsoids, handles, smooth hands.

A texture has three patches: the print, a second plain area (insides, lids, undersides), and a detail (knobs, handles).
"""

import itertools
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Int

PATCH_ROWS = ((0.0, 0.6), (0.6, 0.8), (0.8, 1.0))
"""Which rows of the texture, of 1, belong to print, second area and detail."""

Vector = Sequence[float | int] | np.ndarray
"""Three numbers."""
Profile = Sequence[tuple[float | int, float | int]]
"""Radius and height, point by point."""


@dataclass(frozen=True, kw_only=True)
class Shape:
    """A closed triangle surface, outside counter-clockwise."""

    vertices: Float[np.ndarray, "v 3"]
    uv: Float[np.ndarray, "v 2"]
    """Texture coordinates; v counts rows downwards."""
    faces: Int[np.ndarray, "f 3"]

    @property
    def extents(self) -> Float[np.ndarray, "3"]:
        return np.ptp(self.vertices, axis=0)


def moved(shape: Shape, by: Vector) -> Shape:
    """Return the shape moved by this vector."""
    return Shape(vertices=shape.vertices + np.asarray(by), uv=shape.uv, faces=shape.faces)


def centred(shape: Shape) -> Shape:
    """Return the shape with the middle of its bounding box at the origin."""
    return moved(shape, -(shape.vertices.min(0) + shape.vertices.max(0)) / 2)


def joined(shapes: Sequence[Shape]) -> Shape:
    """Return all shapes as one."""
    first = np.cumsum([0, *(len(s.vertices) for s in shapes[:-1])])
    return Shape(
        vertices=np.concatenate([s.vertices for s in shapes]),
        uv=np.concatenate([s.uv for s in shapes]),
        faces=np.concatenate([s.faces + k for s, k in zip(shapes, first, strict=True)]),
    )


def patch_uv(patch: int, uv: Float[np.ndarray, "v 2"]) -> Float[np.ndarray, "v 2"]:
    """Return coordinates in the whole texture of coordinates in one patch, kept off its border."""
    low, high = PATCH_ROWS[patch]
    inset = 0.008 + 0.984 * uv.clip(0, 1)
    return np.stack([inset[:, 0], low + (high - low) * inset[:, 1]], 1)


def box(size: Vector, side_patches: int = 0, cap_patch: int = 1) -> Shape:
    """Return a cuboid: front and back show the print's left half, the other sides its right half."""
    half = np.asarray(size) / 2
    vertices, uv, faces = [], [], []
    for axis, sign in [(0, -1), (0, 1), (1, -1), (1, 1), (2, -1), (2, 1)]:
        normal = np.zeros(3)
        normal[axis] = sign
        up = np.array([0, 0, 1.0]) if axis < 2 else np.array([1.0, 0, 0])
        right = np.cross(up, normal)
        first = len(vertices)
        corners = np.array([(0, 0), (1, 0), (1, 1), (0, 1)], float)
        for u, v in corners:
            vertices.append((normal + (2 * u - 1) * right + (2 * v - 1) * up) * half)
        place = corners * (1, -1) + (0, 1)
        if axis < 2 and side_patches == 0:
            place = place * (0.5, 1) + (0.5 * axis, 0)
        uv.append(patch_uv(cap_patch if axis == 2 else side_patches, place))
        faces += [[first, first + 1, first + 2], [first, first + 2, first + 3]]
    return Shape(vertices=np.array(vertices), uv=np.concatenate(uv), faces=np.array(faces))


def flat_print(shape: Shape) -> Shape:
    """Return the shape with the print projected from above, as on a book's cover."""
    low, high = shape.vertices.min(0), shape.vertices.max(0)
    uv = (shape.vertices[:, :2] - low[:2]) / np.maximum(high - low, 1e-6)[:2]
    return Shape(vertices=shape.vertices, uv=patch_uv(0, uv), faces=shape.faces)


def bin_shape(size: Vector, wall: float, taper: float = 0.0) -> Shape:
    """Return a box without a lid; `taper` is how much narrower each side is at the floor."""
    x, y, z = np.asarray(size) / 2
    rings = [  # (half x, half y, height, patch)
        (x - taper, y - taper, -z, 0),
        (x, y, z, 0),
        (x - wall, y - wall, z, 1),
        (x - wall - taper, y - wall - taper, -z + wall, 1),
    ]
    signs = np.array([(-1, -1), (1, -1), (1, 1), (-1, 1)])
    parts = []
    for (ax, ay, az, _), (bx, by, bz, patch) in itertools.pairwise(rings):
        for k in range(4):
            s, t = signs[k], signs[(k + 1) % 4]
            quad = [
                (*(s * (ax, ay)), az),
                (*(t * (ax, ay)), az),
                (*(t * (bx, by)), bz),
                (*(s * (bx, by)), bz),
            ]
            uv = np.array([(0, 1), (1, 1), (1, 0), (0, 0)], float)
            if patch == 0:
                uv = uv * (0.5, 1) + (0.5 * ((k + 1) % 2), 0)
            parts.append(
                Shape(
                    vertices=np.array(quad, float),
                    uv=patch_uv(patch, uv),
                    faces=np.array([[0, 1, 2], [0, 2, 3]]),
                )
            )
    for ring, faces in ((rings[0], [[0, 2, 1], [0, 3, 2]]), (rings[-1], [[0, 1, 2], [0, 2, 3]])):
        quad = np.array([(*(s * ring[:2]), ring[2]) for s in signs])
        parts.append(
            Shape(vertices=quad, uv=patch_uv(1, (signs + 1) / 2.0), faces=np.array(faces))
        )
    return joined(parts)


def revolved(profile: Profile, patches: Sequence[int], sides: int = 40) -> Shape:
    """Return a solid of revolution about z.

    Args:
        profile: (radius, height) from the axis at the bottom, along the outside, and back to the axis.
        patches: which patch each of the profile's pieces shows; one fewer than points.
        sides: corners of each ring.
    """
    parts, angle = [], 2 * np.pi * np.arange(sides + 1) / sides
    ring = np.stack([np.cos(angle), np.sin(angle)], 1)
    k = np.arange(sides)
    faces = np.concatenate(
        [
            np.stack([k, k + 1, k + sides + 2], 1),
            np.stack([k, k + sides + 2, k + sides + 1], 1),
        ]
    )
    length = np.array([np.hypot(b[0] - a[0], b[1] - a[1]) for a, b in itertools.pairwise(profile)])
    share = {}
    for patch in set(patches):
        of = np.array([n if p == patch else 0.0 for n, p in zip(length, patches, strict=True)])
        share[patch] = np.concatenate([[0], np.cumsum(of)]) / max(of.sum(), 1e-9)
    for i, patch in enumerate(patches):
        (r0, z0), (r1, z1) = profile[i], profile[i + 1]
        low = np.column_stack([ring * r0, np.full(sides + 1, z0)])
        high = np.column_stack([ring * r1, np.full(sides + 1, z1)])
        u = angle / (2 * np.pi)
        v0, v1 = 1 - share[patch][i], 1 - share[patch][i + 1]
        uv = np.concatenate([np.column_stack([u, 0 * u + v0]), np.column_stack([u, 0 * u + v1])])
        keep = faces
        if r0 < 1e-9:
            keep = faces[sides:]
        elif r1 < 1e-9:
            keep = faces[:sides]
        parts.append(
            Shape(vertices=np.concatenate([low, high]), uv=patch_uv(patch, uv), faces=keep)
        )
    return joined(parts)


def ellipsoid(size: Vector, patch: int = 0, sides: int = 24) -> Shape:
    """Return an ellipsoid with these extents."""
    polar = np.linspace(-np.pi / 2, np.pi / 2, sides // 2 + 1)
    profile = [
        (max(float(np.cos(a)), 0.0) / 2 if 0 < k < len(polar) - 1 else 0.0, float(np.sin(a)) / 2)
        for k, a in enumerate(polar)
    ]
    unit = revolved(profile, [patch] * (len(profile) - 1), sides)
    return Shape(vertices=unit.vertices * np.asarray(size), uv=unit.uv, faces=unit.faces)


def tube(path: Float[np.ndarray, "k 3"], radius: float, patch: int = 2, sides: int = 10) -> Shape:
    """Return a closed tube along a path, such as a handle."""
    along = np.gradient(path, axis=0)
    along /= np.linalg.norm(along, axis=1, keepdims=True)
    helper = np.array([0, 1.0, 0]) if abs(along[:, 1]).max() < 0.9 else np.array([0.3, 0, 1.0])
    one = np.cross(helper, along)
    one /= np.linalg.norm(one, axis=1, keepdims=True)
    two = np.cross(along, one)
    angle = 2 * np.pi * np.arange(sides) / sides
    rings = path[:, None] + radius * (
        np.cos(angle)[None, :, None] * one[:, None] + np.sin(angle)[None, :, None] * two[:, None]
    )
    vertices = np.concatenate([rings.reshape(-1, 3), path[:1], path[-1:]])
    faces, n = [], len(path)
    for i in range(n - 1):
        for k in range(sides):
            a, b = i * sides + k, i * sides + (k + 1) % sides
            faces += [[a, b, b + sides], [a, b + sides, a + sides]]
    for k in range(sides):
        faces.append([n * sides, (k + 1) % sides, k])
        faces.append([n * sides + 1, (n - 1) * sides + k, (n - 1) * sides + (k + 1) % sides])
    uv = np.full((len(vertices), 2), 0.5)
    uv[:, 0] = np.linspace(0.1, 0.9, len(vertices))
    return Shape(vertices=vertices, uv=patch_uv(patch, uv), faces=np.array(faces))


def blended(
    distance: Callable[[Float[np.ndarray, "n 3"]], Float[np.ndarray, "n"]],
    low: Vector,
    high: Vector,
    step: float,
) -> tuple[Float[np.ndarray, "v 3"], Int[np.ndarray, "f 3"]]:
    """Return the surface where a signed distance is zero.

    Source: Gibson 1998, Constrained Elastic SurfaceNets; here without the relaxation, vertices at the mean crossing.
    """
    axes = [np.arange(a, b + step, step) for a, b in zip(low, high, strict=True)]
    grid = np.stack(np.meshgrid(*axes, indexing="ij"), -1)
    d = distance(grid.reshape(-1, 3)).reshape(grid.shape[:3])
    inside = d < 0
    shape = np.array(d.shape) - 1
    total, count = np.zeros((*shape, 3)), np.zeros(tuple(shape))
    quads = []
    cell = np.full(d.shape, -1)
    for axis in range(3):
        a = np.moveaxis(d, axis, 0)
        crossing = np.moveaxis(inside, axis, 0)
        crossing = crossing[1:] != crossing[:-1]
        i, j, k = np.nonzero(crossing)
        t = a[i, j, k] / (a[i, j, k] - a[i + 1, j, k])
        at = np.zeros((len(i), 3))
        other = [x for x in range(3) if x != axis]
        at[:, axis], at[:, other[0]], at[:, other[1]] = i + t, j, k
        index = np.stack([i, j, k], 1)
        whole = np.zeros_like(index)
        whole[:, axis], whole[:, other[0]], whole[:, other[1]] = index.T
        around = []
        for dj, dk in ((0, 0), (-1, 0), (-1, -1), (0, -1)):
            c = whole.copy()
            c[:, other[0]] += dj
            c[:, other[1]] += dk
            around.append(c)
            np.add.at(total, tuple(c.T), at)
            np.add.at(count, tuple(c.T), 1)
        leaves = a[i, j, k] < 0
        if axis == 1:  # (x, z) is not a right-handed pair about y
            leaves = ~leaves
        quads.append((np.stack(around, 1), leaves))
    used = count > 0
    cell = np.full(tuple(shape), -1)
    cell[used] = np.arange(used.sum())
    vertices = total[used] / count[used][:, None] * step + [a[0] for a in axes]
    faces = []
    for around, leaves in quads:
        q = cell[around[..., 0], around[..., 1], around[..., 2]]
        q[~leaves] = q[~leaves][:, ::-1]
        faces += [q[:, [0, 1, 2]], q[:, [0, 2, 3]]]
    return vertices, np.concatenate(faces)

"""An outline becomes a closed mesh: inflated like a pillow, thick where it is wide, and cut into convex parts.

The outline is a picture of the thing, one pixel `px_m` metres wide; columns run along x, rows along y. The mesh has its
silhouette in the plane z = 0 and is symmetric about it.
"""

import cv2
import numpy as np
import trimesh
from jaxtyping import Bool, Float, Int
from scipy import ndimage

MAX_PARTS = 8
_NODES = 56
"""Along the outline's longer side."""
_MEDIAL_POINTS = 250
_CONVEX_ENOUGH = 0.9
"""Parts that fill this share of their hull are not cut any further."""
_MIN_CUT_SHARE = 0.03
_EDGE_M = 0.0004
"""Half of what is left of the thickness at the rim."""


def inflated(
    outline: Bool[np.ndarray, "h w"], px_m: float, cap_m: float
) -> Float[np.ndarray, "h w"]:
    """Return half the thickness at each pixel [m]: balls fill the outline, flattened where they exceed `cap_m`.

    Narrow things come out round, wide ones become plates with rounded rims.
    """
    padded = np.pad(outline, 1)
    reach = cv2.distanceTransform(padded.astype(np.uint8), cv2.DIST_L2, 5)[1:-1, 1:-1]
    ridge = (reach >= cv2.dilate(reach, np.ones((3, 3), np.uint8)) - 0.1) & (reach > 0.9)
    y, x = np.nonzero(ridge)
    if len(y) > _MEDIAL_POINTS:
        chosen = np.linspace(0, len(y) - 1, _MEDIAL_POINTS).astype(int)
        y, x = y[chosen], x[chosen]
    height: Float[np.ndarray, "h w"] = np.array(
        reach, np.float32
    )  # a cone at least, or the gaps between medial points show
    for cy, cx, radius in zip(y.tolist(), x.tolist(), reach[y, x].tolist(), strict=True):
        k = int(np.ceil(radius))
        rows, cols = slice(max(0, cy - k), cy + k + 1), slice(max(0, cx - k), cx + k + 1)
        v = np.arange(rows.start, min(rows.stop, reach.shape[0]))[:, None] - cy
        u = np.arange(cols.start, min(cols.stop, reach.shape[1]))[None] - cx
        ball = np.sqrt(np.maximum(radius**2 - u**2 - v**2, 0.0))
        np.maximum(height[rows, cols], ball, out=height[rows, cols])
    height = ndimage.gaussian_filter(height, 1.0) * px_m
    highest = float(height.max())
    if highest <= 0:
        return height * 0.0
    soft = height / (1 + (height / cap_m) ** 4) ** 0.25
    return soft * min(highest, cap_m) / float(soft.max()) * outline


def pillow(
    outline: Bool[np.ndarray, "h w"], half_m: Float[np.ndarray, "h w"], px_m: float
) -> tuple[trimesh.Trimesh, tuple[trimesh.Trimesh, ...]]:
    """Return the closed mesh with this half thickness [m] over the outline, and convex parts that cover it.

    x and y are metres from the picture's upper left corner. Of an outline in pieces the largest is taken.

    Raises:
        ValueError: the outline is smaller than one cell of the mesh.
    """
    outline = _largest(outline)
    y, x = np.nonzero(outline)
    if not len(y):
        raise ValueError("the outline is empty")
    step = max(1.0, float(max(np.ptp(x), np.ptp(y))) / _NODES)
    pad = 4
    padded = np.pad(outline, pad)
    inner = cv2.distanceTransform(padded.astype(np.uint8), cv2.DIST_L2, 5)
    outer = cv2.distanceTransform((~padded).astype(np.uint8), cv2.DIST_L2, 5)
    signed = ndimage.gaussian_filter(np.asarray(inner - outer, np.float32), 1.0)
    half = np.pad(half_m, pad).astype(np.float32)
    rows = np.arange(y.min() - step, y.max() + 2 * step, step) + pad
    cols = np.arange(x.min() - step, x.max() + 2 * step, step) + pad
    nodes = np.stack(np.meshgrid(cols, rows), axis=-1)
    centres = nodes[:-1, :-1] + step / 2
    cells = _manifold(_largest(_sampled(signed, centres) > 0))
    if not cells.any():
        raise ValueError("the outline is too small for a mesh")
    used = np.zeros(nodes.shape[:2], np.int32)
    for dy in (0, 1):
        for dx in (0, 1):
            used[dy : dy + cells.shape[0], dx : dx + cells.shape[1]] += cells
    rim = (used > 0) & (used < 4)
    nodes = _on_rim(signed, nodes, rim, step)
    thick = np.maximum(_sampled(half, nodes), 0.0)
    thick = np.maximum(np.where(rim, np.minimum(thick, thick.max() / 2), thick), _EDGE_M)
    number = np.full(used.shape, -1)
    number[used > 0] = np.arange(int((used > 0).sum()))
    flat = (nodes[used > 0] - pad + 0.5) * px_m
    z = thick[used > 0]
    count = len(flat)
    vertices = np.concatenate([np.c_[flat, z], np.c_[flat, -z]])
    faces = _faces(cells, number, count)
    mesh = trimesh.Trimesh(vertices, faces, process=False)
    parts = _parts(mesh, cells, number, count, _pieces(padded)[_rounded(centres, padded.shape)])
    return mesh, parts


def _faces(
    cells: Bool[np.ndarray, "r c"], number: Int[np.ndarray, "p q"], count: int
) -> Int[np.ndarray, "f 3"]:
    """Return both sides of every cell, and a wall where a cell has no neighbour; outwards seen."""
    r, c = np.nonzero(cells)
    corner = [number[r + dy, c + dx] for dx, dy in ((0, 0), (1, 0), (1, 1), (0, 1))]
    a, b, d, e = corner
    front = np.concatenate([np.c_[a, b, d], np.c_[a, d, e]])
    faces = [front, front[:, ::-1] + count]
    ringed = np.pad(cells, 1)
    sides = ((-1, 0, 0, 1), (0, 1, 1, 2), (1, 0, 2, 3), (0, -1, 3, 0))
    for dr, dc, i, j in sides:
        alone = ~ringed[r + 1 + dr, c + 1 + dc]
        start, end = corner[i][alone], corner[j][alone]
        faces += [np.c_[start, start + count, end + count], np.c_[start, end + count, end]]
    return np.concatenate(faces)


def _parts(
    mesh: trimesh.Trimesh,
    cells: Bool[np.ndarray, "r c"],
    number: Int[np.ndarray, "p q"],
    count: int,
    piece: Int[np.ndarray, "r c"],
) -> tuple[trimesh.Trimesh, ...]:
    r, c = np.nonzero(cells)
    mine = piece[r, c]
    parts = []
    for k in np.unique(mine[mine > 0]).tolist():
        own = (mine == k) | ((mine == 0) & (k == mine.max()))
        i = np.unique([number[r[own] + dy, c[own] + dx] for dy in (0, 1) for dx in (0, 1)])
        parts.append(trimesh.convex.convex_hull(mesh.vertices[np.concatenate([i, i + count])]))
    return tuple(parts)


def _pieces(outline: Bool[np.ndarray, "h w"]) -> Int[np.ndarray, "h w"]:
    """Return numbers from 1 of nearly convex pieces, everywhere: pixels outside take the nearest piece's number."""
    least = _MIN_CUT_SHARE * float(outline.sum())
    pieces, done = [outline], []
    while pieces:
        piece = max(pieces, key=lambda p: _hull_area(p) - float(p.sum()))
        pieces = [p for p in pieces if p is not piece]
        cut = None
        if float(piece.sum()) < _CONVEX_ENOUGH * _hull_area(piece):
            cut = _cut(piece, least)
        if cut is None or len(done) + len(pieces) + len(cut) > MAX_PARTS:
            done.append(piece)
        else:
            pieces += cut
    label = np.zeros(outline.shape, np.int32)
    for k, piece in enumerate(done, start=1):
        label[piece] = k
    near = ndimage.distance_transform_edt(label == 0, return_distances=False, return_indices=True)
    return label[tuple(near)]  # pyright: ignore[reportCallIssue, reportArgumentType]


def _cut(piece: Bool[np.ndarray, "h w"], least: float) -> list[Bool[np.ndarray, "h w"]] | None:
    """Return the two halves whose hulls are smallest, cut at one of the deepest re-entrant points."""
    contours, _ = cv2.findContours(
        piece.astype(np.uint8), cv2.RETR_EXTERNAL, cv2.CHAIN_APPROX_NONE
    )
    contour = max(contours, key=len)
    deepest = _deepest(contour)
    if not len(deepest):
        return None
    y, x = np.nonzero(piece)
    points = np.c_[x, y].astype(np.float32)
    best: tuple[float, np.ndarray] | None = None
    for px, py in contour[deepest, 0]:
        for angle in np.linspace(0, np.pi, 12, endpoint=False):
            side = (x - px) * np.sin(angle) - (y - py) * np.cos(angle) > 0.01
            if min(side.sum(), (~side).sum()) < least:
                continue
            area = sum(cv2.contourArea(cv2.convexHull(points[s])) for s in (side, ~side))
            if best is None or area < best[0]:
                best = area, side
    if best is None:
        return None
    halves = []
    for side in (best[1], ~best[1]):
        half = np.zeros_like(piece)
        half[y[side], x[side]] = True
        halves.append(half)
    return halves


def _deepest(contour: Int[np.ndarray, "n 1 2"]) -> Int[np.ndarray, "k"]:
    """Return which points of the contour lie deepest inside its hull: at most two, of different dents."""
    hull = cv2.convexHull(contour, returnPoints=False)
    if len(hull) <= 3:
        return np.zeros(0, int)
    try:
        dents = cv2.convexityDefects(contour, hull)
    except cv2.error:
        # The contour goes back over its own pixels, as along a line one pixel wide.
        corners = contour[hull[:, 0].astype(int)]
        inside = [
            cv2.pointPolygonTest(corners, (float(x), float(y)), measureDist=True)
            for x, y in contour[:, 0]
        ]
        return np.array([int(np.argmax(inside))])
    if dents is None:
        return np.zeros(0, int)
    return dents[np.argsort(-dents[:, 0, 3])[:2], 0, 2]


def _hull_area(piece: Bool[np.ndarray, "h w"]) -> float:
    y, x = np.nonzero(piece)
    hull = cv2.convexHull(np.c_[x, y].astype(np.float32))
    # Pixel centres span a hull that lacks half a pixel all round.
    return float(cv2.contourArea(hull)) + 0.5 * float(cv2.arcLength(hull, closed=True)) + 1


def _largest(pieces: Bool[np.ndarray, "h w"]) -> Bool[np.ndarray, "h w"]:
    _, label, stats, _ = cv2.connectedComponentsWithStats(pieces.astype(np.uint8), connectivity=4)
    if len(stats) < 2:
        return pieces
    return label == 1 + int(np.argmax(stats[1:, cv2.CC_STAT_AREA]))


def _manifold(cells: Bool[np.ndarray, "r c"]) -> Bool[np.ndarray, "r c"]:
    """Return the cells with gaps closed where two touch at a corner only: four faces would share that edge."""
    cells = cells.copy()
    while True:
        a, b, c, d = cells[:-1, :-1], cells[:-1, 1:], cells[1:, :-1], cells[1:, 1:]
        touch = (a & d & ~b & ~c) | (b & c & ~a & ~d)
        if not touch.any():
            return cells
        r, q = np.nonzero(touch)
        cells[r, q] = cells[r + 1, q + 1] = cells[r, q + 1] = cells[r + 1, q] = True


def _on_rim(
    signed: Float[np.ndarray, "h w"],
    nodes: Float[np.ndarray, "p q 2"],
    rim: Bool[np.ndarray, "p q"],
    step: float,
) -> Float[np.ndarray, "p q 2"]:
    """Return the nodes with those of the rim moved onto the outline, by less than would fold a cell."""
    slope = np.stack(np.gradient(signed)[::-1], axis=-1).astype(np.float32)
    moved = nodes.copy()
    spots = nodes[rim]
    way = np.stack([_sampled(slope[..., k], spots[None])[0] for k in (0, 1)], axis=-1)
    way /= np.maximum(np.linalg.norm(way, axis=-1, keepdims=True), 1e-6)
    distance = np.clip(_sampled(signed, spots[None])[0], -0.45 * step, 0.45 * step)
    moved[rim] = spots - distance[:, None] * way
    return moved


def _sampled(
    field: Float[np.ndarray, "h w"], at: Float[np.ndarray, "p q 2"]
) -> Float[np.ndarray, "p q"]:
    """Return the field between pixel centres, at (column, row)."""
    x, y = at[..., 0].astype(np.float32), at[..., 1].astype(np.float32)
    found = cv2.remap(
        field.astype(np.float32), x, y, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE
    )
    return found.astype(float)


def _rounded(
    at: Float[np.ndarray, "p q 2"], shape: tuple[int, ...]
) -> tuple[Int[np.ndarray, "p q"], Int[np.ndarray, "p q"]]:
    x, y = (np.clip(at[..., k].round().astype(int), 0, shape[1 - k] - 1) for k in (0, 1))
    return y, x

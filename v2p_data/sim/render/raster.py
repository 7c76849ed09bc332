"""The loops of the z-buffer, compiled by numba: frames, geoms, triangles, rows, pixels.

The machine code is kept beside this file or, where that cannot be written, in the user's cache
folder; compiling takes a few seconds, once. Functions carry `no_type_check` because a run-time
type checker would wrap what numba compiles.

Pixel (row, column) looks through its centre (row + 1/2, column + 1/2), rows going down. A triangle
covers the centres between its left and its right edge, the left included. Along each row the
reciprocal of the distance is linear.
"""

# pyright: basic
# numba reads these functions as its own language.

from collections.abc import Callable
from typing import Any, no_type_check

import numba
import numpy as np
from jaxtyping import Float, Int, UInt8

LABEL_BITS = 4
_LABELS = np.int32((1 << LABEL_BITS) - 1)
_NEAREST = float(1 << 26)
"""What stands for the near plane; distance d [m] is `_NEAREST * near / d`, 0.5 um apart at 1 m."""


def _compiled(function: Callable[..., Any]) -> Callable[..., Any]:
    options: dict[str, Any] = {"nogil": True, "error_model": "numpy"}
    try:
        return numba.njit(cache=True, **options)(function)
    except RuntimeError:  # there is no folder for the machine code
        return numba.njit(**options)(function)


@_compiled
@no_type_check
def _fill(
    buffer: Int[np.ndarray, "h w"],
    label: int,
    x0: float,
    y0: float,
    z0: float,
    x1: float,
    y1: float,
    z1: float,
    x2: float,
    y2: float,
    z2: float,
) -> None:
    """Draw one triangle given in pixels; z is the scaled reciprocal of the distance."""
    twice_area = (x1 - x0) * (y2 - y0) - (x2 - x0) * (y1 - y0)
    if not twice_area < 0.0:  # seen from behind (rows go down), of no area, or not finite
        return
    height, width = float(buffer.shape[0]), float(buffer.shape[1])
    if min(x0, x1, x2) >= width or max(x0, x1, x2) <= 0.0:
        return
    # Upper corner first; an edge that two triangles share is then followed in the same way by both, without gaps.
    if y1 < y0:
        x0, y0, z0, x1, y1, z1 = x1, y1, z1, x0, y0, z0
        twice_area = -twice_area
    if y2 < y1:
        x1, y1, z1, x2, y2, z2 = x2, y2, z2, x1, y1, z1
        twice_area = -twice_area
        if y1 < y0:
            x0, y0, z0, x1, y1, z1 = x1, y1, z1, x0, y0, z0
            twice_area = -twice_area
    first_row = int(np.ceil(min(max(y0, 0.0), height) - 0.5))
    end_row = int(np.ceil(min(max(y2, 0.0), height) - 0.5))
    if end_row <= first_row:
        return
    z_right = ((z1 - z0) * (y2 - y0) - (z2 - z0) * (y1 - y0)) / twice_area
    z_down = ((z2 - z0) * (x1 - x0) - (z1 - z0) * (x2 - x0)) / twice_area
    long_slope = (x2 - x0) / (y2 - y0)
    upper_slope = (x1 - x0) / (y1 - y0)  # not used where the edge is level
    lower_slope = (x2 - x1) / (y2 - y1)
    step = np.float32(z_right)
    for row in range(first_row, end_row):
        y = row + 0.5
        on_long = x0 + (y - y0) * long_slope
        on_short = x0 + (y - y0) * upper_slope if y < y1 else x1 + (y - y1) * lower_slope
        left = int(np.ceil(min(max(min(on_long, on_short), 0.0), width) - 0.5))
        end = int(np.ceil(min(max(on_long, on_short), width) - 0.5))
        if end <= left:
            continue
        start = np.float32(z0 + (left + 0.5 - x0) * z_right + (y - y0) * z_down)
        line = buffer[row, left:end]
        for k in range(line.size):
            depth = np.int32(start + step * np.float32(k))
            line[k] = max(line[k], np.int32((depth << LABEL_BITS) | label))


@_compiled
@no_type_check
def _look(
    vertices: Float[np.ndarray, "vertex 4"],
    first: int,
    count: int,
    to_camera: Float[np.ndarray, "3 5"],
    near: float,
    seen: Float[np.ndarray, "point 3"],
) -> bool:
    """Write vertices as (x, y, distance) before the camera [m]; return whether all are beyond the near plane."""
    whole = True
    m = to_camera
    for k in range(count):
        for i in range(3):
            total = m[i, 4]
            for j in range(4):
                total += m[i, j] * vertices[first + k, j]
            seen[k, i] = total
        seen[k, 2] = -seen[k, 2]  # the camera looks along -z
        whole = whole and seen[k, 2] >= near
    return whole


@_compiled
@no_type_check
def _cut(
    seen: Float[np.ndarray, "point 3"],
    faces: Int[np.ndarray, "face 3"],
    first: int,
    count: int,
    near: float,
    pieces: Float[np.ndarray, "corner 3"],
) -> int:
    """Write what faces have beyond the near plane into `pieces`, three rows per triangle; return how many triangles."""
    done = 0
    for face in range(first, first + count):
        start = 3 * done
        corners = 0
        for k in range(3):
            here, there = faces[face, k], faces[face, (k + 1) % 3]
            if seen[here, 2] >= near:
                for i in range(3):
                    pieces[start + corners, i] = seen[here, i]
                corners += 1
            if (seen[here, 2] >= near) != (seen[there, 2] >= near):
                share = (near - seen[here, 2]) / (seen[there, 2] - seen[here, 2])
                for i in range(2):
                    pieces[start + corners, i] = seen[here, i] + share * (
                        seen[there, i] - seen[here, i]
                    )
                pieces[start + corners, 2] = near
                corners += 1
        if corners == 4:  # 0 1 2 3 becomes 0 1 2, 0 2 3
            for i in range(3):
                pieces[start + 5, i] = pieces[start + 3, i]
                pieces[start + 4, i] = pieces[start + 2, i]
                pieces[start + 3, i] = pieces[start, i]
        done += max(corners - 2, 0)
    return done


@_compiled
@no_type_check
def _project(
    points: Float[np.ndarray, "point 3"],
    count: int,
    focal: float,
    near: float,
    height: int,
    width: int,
) -> bool:
    """Turn (x, y, distance) into pixels and scaled reciprocal distance.

    Return whether any of it can be in the image.
    """
    low_x, high_x, low_y, high_y = np.inf, -np.inf, np.inf, -np.inf
    for k in range(count):
        reciprocal = 1.0 / points[k, 2]
        x = width / 2 + focal * points[k, 0] * reciprocal
        y = height / 2 - focal * points[k, 1] * reciprocal
        points[k, 0], points[k, 1], points[k, 2] = x, y, _NEAREST * near * reciprocal
        low_x, high_x, low_y, high_y = min(low_x, x), max(high_x, x), min(low_y, y), max(high_y, y)
    return low_x < width and high_x > 0.0 and low_y < height and high_y > 0.0


@_compiled
@no_type_check
def paint(
    vertices: Float[np.ndarray, "vertex 4"],
    faces: Int[np.ndarray, "face 3"],
    spans: Int[np.ndarray, "shape 4"],
    labels: Int[np.ndarray, "geom"],
    near: float,
    shape: Int[np.ndarray, "n geom"],
    stretch: Float[np.ndarray, "n geom 4"],
    pos: Float[np.ndarray, "n geom 3"],
    mat: Float[np.ndarray, "n geom 3 3"],
    cam_pos: Float[np.ndarray, "n 3"],
    cam_mat: Float[np.ndarray, "n 3 3"],
    focal: Float[np.ndarray, "n"],
    images: UInt8[np.ndarray, "n h w"],
) -> None:
    """Draw `n` frames into `images`: shapes from `Polyhedra`, places in the world [m], the focal length in pixels."""
    count, height, width = images.shape
    most = 0
    for k in range(len(spans)):
        most = max(most, spans[k, 1])
    buffer = np.empty((height, width), np.int32)
    seen = np.empty((most, 3))
    to_camera = np.empty((3, 5))
    for frame in range(count):
        for row in range(height):
            for column in range(width):
                buffer[row, column] = 0
        for geom in range(len(labels)):
            # From unit shape to the camera's axes: per axis the factors of a vertex's four numbers, and of 1.
            for i in range(3):
                to_camera[i, 4] = 0.0
                for j in range(3):
                    turned = 0.0
                    for k in range(3):
                        turned += cam_mat[frame, k, i] * mat[frame, geom, k, j]
                    to_camera[i, j] = turned * stretch[frame, geom, j]
                    if j == 2:  # a capsule's ends lie on z
                        to_camera[i, 3] = turned * stretch[frame, geom, 3]
                    away = pos[frame, geom, j] - cam_pos[frame, j]
                    to_camera[i, 4] += cam_mat[frame, j, i] * away
            span = spans[shape[frame, geom]]
            num_points, first, end = int(span[1]), int(span[2]), int(span[2] + span[3])
            points, triangles = seen, faces
            if not _look(vertices, span[0], num_points, to_camera, near, seen):
                points = np.empty((6 * (end - first), 3))
                triangles = np.arange(6 * (end - first)).astype(np.int32).reshape(-1, 3)
                first, end = 0, _cut(seen, faces, first, end - first, near, points)
                num_points = 3 * end
            if not _project(points, num_points, focal[frame], near, height, width):
                continue
            for k in range(first, end):
                a, b, c = triangles[k, 0], triangles[k, 1], triangles[k, 2]
                _fill(
                    buffer,
                    labels[geom],
                    points[a, 0],
                    points[a, 1],
                    points[a, 2],
                    points[b, 0],
                    points[b, 1],
                    points[b, 2],
                    points[c, 0],
                    points[c, 1],
                    points[c, 2],
                )
        for row in range(height):
            for column in range(width):
                images[frame, row, column] = buffer[row, column] & _LABELS

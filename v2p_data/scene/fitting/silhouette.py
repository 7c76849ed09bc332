"""Silhouettes become shapes on the table: fit position, yaw and proportions so that the outline matches the mask.

Everything here is in camera heights (the camera stands 1 above the table); `scale/camera_height.py` turns that into metres. A matching
outline alone is ambiguous (faces swap, flat things thicken), so the noun's proportions hold the fit.
"""

from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property
from typing import TYPE_CHECKING

import cv2
import numpy as np
from jaxtyping import Bool, Float, UInt8
from scipy.optimize import minimize
from scipy.spatial.transform import Rotation

from v2p_data.geometry.camera import Camera, intrinsics
from v2p_data.geometry.mesh import outline_points
from v2p_data.geometry.pose import inverse, transform
from v2p_data.geometry.raster import PARTS, fill, in_parts
from v2p_data.scene.data_types import Fit
from v2p_data.scene.frames.mask_ops import bounding_box, is_cut
from v2p_data.scene.scale.nouns import Noun

if TYPE_CHECKING:
    from v2p_data.scene.fitting.cuboid_network import CuboidGuess

_WORK_PX = 110
"""Longer side of the crop in which silhouettes are compared."""
_HIDDEN_WEIGHT = 0.15
"""Weight, 0 to 1, of pixels that may be hidden: without it a shape grows behind the hand."""
_LOOK_WEIGHT = 0.01
"""Cost in units of IoU of each nat by which the cuboid network finds a box less likely: outlines hardly tell a cube's yaw."""
_MOST_BY_LOOK = 0.15
"""Greatest cost by the cuboid network, in units of IoU: real boxes look different from the drawn ones it learned from."""
_LEAST_FACE_PX = 10
"""Side of the outline's bounding box below which a box shows nothing of its turn."""
_PRIOR_WEIGHT = 0.03
"""Cost of proportions one standard deviation off the noun's, in units of IoU."""


@dataclass(frozen=True, kw_only=True)
class Within:
    """A disc on the table over which an object's middle must be, in camera heights."""

    xy: Float[np.ndarray, "2"]
    radius: float


def camera_above(
    shape: tuple[int, int], pitch_rad: float, fov_rad: float, height: float = 1.0
) -> Camera:
    """Return the camera at (0, 0, height) that looks along +x, `pitch_rad` below the horizon.

    `fov_rad` is the horizontal field of view; roll is zero.
    """
    h, w = shape
    fovy = 2 * np.arctan(np.tan(fov_rad / 2) * h / w)
    c, s = np.cos(pitch_rad), np.sin(pitch_rad)
    forward, right = np.array([c, 0.0, -s]), np.array([0.0, -1.0, 0.0])
    rotation = np.stack([right, np.cross(forward, right), forward], axis=1)
    return Camera(
        width_px=w,
        height_px=h,
        K=intrinsics(w, h, float(fovy)),
        T_world_cam=transform(rotation, np.array([0.0, 0.0, height])),
    )


class Silhouette:
    """One mask, cropped and scaled so that comparing outlines is cheap."""

    def __init__(
        self,
        mask: Bool[np.ndarray, "h w"],
        unknown: Bool[np.ndarray, "h w"] | None,
        camera: Camera,
        image: UInt8[np.ndarray, "h w 3"] | None = None,
    ) -> None:
        """Crop the mask; `unknown` is what may hide the object, `image` shows how a box is turned, where that is asked."""
        x, y, w, h = bounding_box(mask)
        pad = int(0.35 * max(w, h)) + 3
        self.camera, self.box, self.mask = camera, (x, y, w, h), mask
        size = (w + 2 * pad, h + 2 * pad)
        zoom = _WORK_PX / max(size)
        crop = np.array([[zoom, 0, zoom * (pad - x)], [0, zoom, zoom * (pad - y)], [0, 0, 1.0]])
        # World to crop pixels in one matrix: a fit asks ten thousand times.
        self._matrix = crop @ camera.K @ inverse(camera.T_world_cam)[:3]
        move, canvas = crop[:2], (max(8, round(size[0] * zoom)), max(8, round(size[1] * zoom)))
        warped = cv2.warpAffine(mask.astype(np.float32), move, canvas, flags=cv2.INTER_LINEAR)
        known = cv2.warpAffine(np.ones(mask.shape, np.float32), move, canvas) > 0.5
        if unknown is not None:
            known &= ~(cv2.warpAffine((unknown & ~mask).astype(np.float32), move, canvas) > 0.5)
        self._known = known
        self._mask = _filled(warped > 0.5) & known
        self._area = int(self._mask.sum())
        self._at_border = is_cut(mask)
        self._picture = image if min(w, h) >= _LEAST_FACE_PX else None

    @cached_property
    def _guess(self) -> "CuboidGuess":
        """What the box network says, asked where a box is fitted."""
        from v2p_data.scene.fitting.cuboid_network import (
            cuboid_guess,
        )  # torch takes a second to import

        assert self._picture is not None
        return cuboid_guess(self._picture, self.mask, self.camera)

    def iou(self, points_world: Float[np.ndarray, "n 3"], hidden_weight: float = 0.0) -> float:
        """Return how well the convex hull of the projected points covers the mask, where it could be seen.

        With a `hidden_weight`, pixels that may be hidden count that much: else a shape grows behind the hand for ever.
        """
        overlap = self._overlap(points_world)
        if overlap is None:
            return -1.0
        common, wrong, hidden, _ = overlap
        return common / max(1.0, self._area + wrong + hidden_weight * hidden)

    def appearance_cost(
        self,
        form: str,
        size: Float[np.ndarray, "3"] | tuple[float, float, float],
        T_world_obj: Float[np.ndarray, "4 4"],
    ) -> float:
        """Return what a box costs that is not turned, or whose sides are not, as it looks, in units of IoU.

        Nothing without a picture, and for other forms.
        """
        if self._picture is None or form != "box":
            return 0.0
        return min(_MOST_BY_LOOK, _LOOK_WEIGHT * self._guess.cost(size, T_world_obj))

    def visible(self, points_world: Float[np.ndarray, "n 3"]) -> float:
        """Return the share of the projected hull that the mask confirms."""
        overlap = self._overlap(points_world)
        return 0.0 if overlap is None else overlap[0] / max(1.0, overlap[3])

    def _overlap(
        self, points_world: Float[np.ndarray, "n 3"]
    ) -> tuple[float, float, float, float] | None:
        """Return the hull's area on the mask, off it, on hidden pixels, and in all."""
        homogeneous = points_world @ self._matrix[:, :3].T + self._matrix[:, 3]
        if homogeneous[:, 2].min() < 1e-6:
            return None
        pixels = homogeneous[:, :2] / homogeneous[:, 2:]
        if not np.isfinite(pixels).all() or np.abs(pixels).max() > 4000:
            return None
        drawn = np.zeros(self._mask.shape, np.uint8)
        hull = cv2.convexHull(in_parts(pixels))
        fill(drawn, hull)
        covered = drawn > 0
        total = float(covered.sum())
        seen = covered & self._known
        common, hidden = float((seen & self._mask).sum()), total - float(seen.sum())
        beyond = 0.0 if self._at_border else max(0.0, cv2.contourArea(hull) / PARTS**2 - total)
        return common, float(seen.sum()) - common + beyond, hidden, total + beyond

    @property
    def centre(self) -> Float[np.ndarray, "2"]:
        """Return the middle of the mask's bounding box [px]."""
        x, y, w, h = self.box
        return np.array([x + w / 2, y + h / 2])

    def nearest_to(self, pixel: Float[np.ndarray, "2"]) -> Float[np.ndarray, "2"]:
        """Return the point of the mask that is nearest to a point of the picture [px]."""
        spots = np.argwhere(self.mask)[:, ::-1] + 0.5
        return spots[np.linalg.norm(spots - pixel, axis=1).argmin()]


def _filled(mask: Bool[np.ndarray, "h w"]) -> Bool[np.ndarray, "h w"]:
    """Return the mask without holes: what is fitted is convex, a ring's hole says nothing against it."""
    outlines, _ = cv2.findContours(mask.astype(np.uint8), cv2.RETR_EXTERNAL, cv2.CHAIN_APPROX_NONE)
    return cv2.drawContours(np.zeros(mask.shape, np.uint8), outlines, -1, 1, cv2.FILLED) > 0


def orientations(noun: Noun) -> list[tuple[Float[np.ndarray, "3 3"], float]]:
    """Return the ways a noun's shape can rest, as rotations with what each costs: upright first."""
    upright, cost = np.eye(3), 0.15 if noun.spread < 0.3 else 0.1
    if noun.form == "sphere":
        return [(upright, 0.0)]
    lying = Rotation.from_euler("y", 90, degrees=True).as_matrix()
    if noun.form == "cylinder":
        ways = [(upright, 0.0)]
        if noun.hollow and noun.taper < 0.9:
            ways.append((np.diag([1.0, -1.0, -1.0]), cost))
        if noun.size_m[2] > 0.9 * noun.size_m[0]:
            # An upright vessel and its shadow have the outline of a lying one: vessels are seldom laid down.
            ways.append((lying, 2 * cost if noun.hollow else cost))
        return ways
    smallest, middle, largest = sorted(noun.size_m)
    if noun.hollow or largest <= 1.3 * smallest:  # trays and bins stand with their mouth up
        return [(upright, 0.0)]
    on_side = Rotation.from_euler("x", 90, degrees=True).as_matrix()
    # What usually lies flat seldom stands on its edge; a box may stand on any side.
    cost = 0.08 if noun.size_m[2] == smallest < 0.7 * middle else 0.03
    return [(upright, 0.0), (lying, cost), (on_side, cost)]


def fit_shape(
    silhouette: Silhouette, noun: Noun, rest: Float[np.ndarray, "3 3"], *, thorough: bool = True
) -> Fit:
    """Return the noun's shape resting on the table in orientation `rest`, proportions free within the noun's spread."""
    prior = np.array(noun.size_m)
    spread = max(0.1, noun.spread * 0.8)
    scale0, ground = _start(silhouette, prior)
    free = {"box": [0, 1, 2], "cylinder": [0, 2], "sphere": [0]}[noun.form]

    def size_of(v: np.ndarray) -> np.ndarray:
        logs = np.zeros(3)
        logs[free] = v[3:]
        if noun.form != "box":
            logs[1] = logs[0]
        if noun.form == "sphere":
            logs[2] = logs[0]
        return prior * scale0 * np.exp(logs)

    def cost(v: np.ndarray) -> float:
        size = size_of(v)
        T = posed(v, size)
        points = (unit * size) @ T[:3, :3].T + T[:3, 3]
        off = (v[3:] - v[3:].mean()) / spread
        appearance = silhouette.appearance_cost(noun.form, size, T)
        held = _PRIOR_WEIGHT * float((off**2).sum())
        return 1 - silhouette.iou(points, _HIDDEN_WEIGHT) + held + appearance

    def posed(v: np.ndarray, size: np.ndarray) -> np.ndarray:
        return _resting(ground + v[:2] * scale0 * prior.max(), v[2], rest, size)

    unit = outline_points(noun.form, (1.0, 1.0, 1.0), noun.taper)

    def place(v: np.ndarray) -> np.ndarray:
        size = size_of(v)
        T = posed(v, size)
        return (unit * size) @ T[:3, :3].T + T[:3, 3]

    turns = _yaw_starts(noun, rest, thorough)
    starts = [
        _aligned(
            silhouette,
            np.array([0.0, 0.0, yaw, *np.full(len(free), grow)]),
            place,
            scale0 * prior.max(),
        )
        for yaw in turns
        for grow in ((0.0, 0.25) if thorough else (0.1,))
    ]
    steps = np.array([0.25, 0.25, 0.3, *[0.25] * len(free)])
    # Outlines of a box at two yaws are nearly as good as each other.
    best = search(cost, starts, steps, kept=4 if thorough and noun.form == "box" else 2)
    size = size_of(best)
    T = posed(best, size)
    points = outline_points(noun.form, tuple(size), noun.taper) @ T[:3, :3].T + T[:3, 3]
    return Fit(
        size=three(size),
        T_world_obj=T,
        iou=silhouette.iou(points),
        visible=silhouette.visible(points),
        cost=cost(best),
    )


def fit_pose(
    silhouette: Silhouette,
    noun: Noun,
    size: tuple[float, float, float],
    rest: Float[np.ndarray, "3 3"],
    *,
    yaw_near: float | None = None,
    support: float = 0.0,
    within: Within | None = None,
) -> Fit:
    """Return where a shape of known size rests in orientation `rest`, `support` above the table.

    `yaw_near` holds the yaw where the outline does not decide it; `within` holds the place.
    """
    extents = np.array(size)
    points0 = outline_points(noun.form, size, noun.taper)
    _, ground = _start(silhouette, extents)

    def place(v: np.ndarray) -> np.ndarray:
        T = _resting(ground + v[:2] * extents.max(), v[2], rest, extents)
        T[2, 3] += support
        return T

    def cost(v: np.ndarray) -> float:
        T = place(v)
        held = 0.0
        if yaw_near is not None:
            held = 0.01 * (1 - np.cos(2 * (v[2] - yaw_near)))
        if within is not None:
            outside = float(np.linalg.norm(T[:2, 3] - within.xy)) - within.radius
            held += max(0.0, outside) / max(within.radius, 0.5 * float(extents.max()))
        appearance = silhouette.appearance_cost(noun.form, extents, T)
        outline = points0 @ T[:3, :3].T + T[:3, 3]
        return 1 - silhouette.iou(outline, _HIDDEN_WEIGHT) + held + appearance

    turns = _yaw_starts(noun, rest, thorough=True)
    if yaw_near is not None:
        turns = [*turns, yaw_near]

    def outline(v: np.ndarray) -> np.ndarray:
        T = place(v)
        return points0 @ T[:3, :3].T + T[:3, 3]

    starts = [
        _aligned(silhouette, np.array([0.0, 0.0, yaw]), outline, float(extents.max()))
        for yaw in turns
    ]
    if within is not None:
        there = (within.xy - ground) / extents.max()
        starts += [np.array([*there, yaw]) for yaw in turns[:1]]
    best = search(cost, starts, np.array([0.15, 0.15, 0.3]))
    T = place(best)
    points = points0 @ T[:3, :3].T + T[:3, 3]
    return Fit(
        size=size,
        T_world_obj=T,
        iou=silhouette.iou(points),
        visible=silhouette.visible(points),
        cost=cost(best),
    )


def fit_lifted(
    silhouette: Silhouette,
    noun: Noun,
    size: tuple[float, float, float],
    T_first: Float[np.ndarray, "4 4"],
) -> Fit:
    """Return where a shape of known size is in the air, as far from the camera along the table as at first.

    One view does not show the depth of something in mid-air; lifted straight up is the assumption.
    """
    points0 = outline_points(noun.form, size, noun.taper)
    reach = max(size)
    x, y, w, h = silhouette.box
    start = on_wall(silhouette.camera, np.array([x + w / 2, y + h / 2]), T_first[0, 3])
    yaw0 = Rotation.from_matrix(T_first[:3, :3])

    def place(v: np.ndarray) -> np.ndarray:
        turned = (Rotation.from_rotvec([0, 0, v[2]]) * yaw0).as_matrix()
        height = max(start[2] + v[1] * reach, lowest(size, noun.form, turned))
        return transform(turned, np.array([T_first[0, 3], start[1] + v[0] * reach, height]))

    def cost(v: np.ndarray) -> float:
        T = place(v)
        appearance = silhouette.appearance_cost(noun.form, size, T)
        outline = points0 @ T[:3, :3].T + T[:3, 3]
        turned = 0.01 * (1 - np.cos(v[2]))
        return 1 - silhouette.iou(outline, _HIDDEN_WEIGHT) + turned + appearance

    best = search(
        cost,
        [np.zeros(3), np.array([0, 0, 0.5]), np.array([0, 0, -0.5])],
        np.array([0.2, 0.2, 0.2]),
    )
    T = place(best)
    points = points0 @ T[:3, :3].T + T[:3, 3]
    return Fit(
        size=size,
        T_world_obj=T,
        iou=silhouette.iou(points),
        visible=silhouette.visible(points),
        cost=cost(best),
    )


def three(values: Float[np.ndarray, "3"]) -> tuple[float, float, float]:
    """Return an array as plain numbers."""
    a, b, c = (float(v) for v in values)
    return a, b, c


def on_wall(camera: Camera, pixel: Float[np.ndarray, "2"], x: float) -> Float[np.ndarray, "3"]:
    """Return where the pixel's ray meets the upright plane at distance `x` along the table."""
    ray = camera.rays_world(pixel[None])[0]
    origin = camera.T_world_cam[:3, 3]
    return origin + ray * (x - origin[0]) / max(ray[0], 1e-6)


def lowest(
    size: tuple[float, float, float], form: str, rotation: Float[np.ndarray, "3 3"]
) -> float:
    """Return how far the centre is above the lowest point of the turned shape."""
    if form == "sphere":
        return size[0] / 2
    if form == "cylinder":
        axis_z = abs(float(rotation[2, 2]))
        return size[2] / 2 * axis_z + size[0] / 2 * float(np.sqrt(max(0.0, 1 - axis_z**2)))
    return float(np.abs(rotation[2]) @ np.array(size) / 2)


def yaw_of(rotation: Float[np.ndarray, "3 3"], rest: Float[np.ndarray, "3 3"]) -> float:
    """Return the yaw that takes the resting orientation `rest` to `rotation`."""
    turn = rotation @ rest.T
    return float(np.arctan2(turn[1, 0], turn[0, 0]))


def _resting(
    xy: np.ndarray, yaw: float, rest: np.ndarray, size: np.ndarray
) -> Float[np.ndarray, "4 4"]:
    c, s = np.cos(yaw), np.sin(yaw)
    turned = np.array([[c, -s, 0], [s, c, 0], [0, 0, 1.0]]) @ rest
    height = float(np.abs(rest[2]) @ size / 2)
    return transform(turned, np.array([xy[0], xy[1], height]))


def _start(silhouette: Silhouette, prior: np.ndarray) -> tuple[float, np.ndarray]:
    """Return camera heights per prior unit, and the table point under the mask."""
    x, y, w, h = silhouette.box
    camera = silhouette.camera
    foot = camera.on_plane(np.array([[x + w / 2, y + 0.8 * h]]))[0]
    if not np.isfinite(foot).all() or foot[0] > 12:
        foot = np.array([12.0, 0.0, 0.0])
    depth = float(camera.T_world_cam[:3, 2] @ (foot - camera.T_world_cam[:3, 3]))
    seen = np.sqrt(w * h) * max(depth, 0.2) / camera.K[0, 0]
    usual = float(np.cbrt(np.prod(np.maximum(prior, 0.25 * prior.max()))))
    return seen / usual, foot[:2]


def _yaw_starts(noun: Noun, rest: np.ndarray, thorough: bool) -> list[float]:
    lying_round = noun.form == "cylinder" and abs(rest[2, 2]) < 0.5
    if noun.form == "box" or lying_round:
        return [np.radians(a) for a in (range(0, 180, 30) if thorough else range(0, 180, 45))]
    return [0.0]


def _aligned(
    silhouette: Silhouette,
    start: np.ndarray,
    place: Callable[[np.ndarray], np.ndarray],
    unit: float,
) -> np.ndarray:
    """Return the start moved along the table so that its outline lies over the mask."""
    v, camera = start.copy(), silhouette.camera
    for _ in range(2):
        points = place(v)
        pixels = camera.project(points)
        if not np.isfinite(pixels).all():
            return start
        middle = (pixels.min(0) + pixels.max(0)) / 2
        height = float(points[:, 2].mean())
        spots = camera.on_plane(np.stack([silhouette.centre, middle]), height)
        if not np.isfinite(spots).all():
            return start
        v[:2] += np.clip((spots[0] - spots[1])[:2] / unit, -3, 3)
    return v


def search(
    cost: Callable[[np.ndarray], float],
    starts: list[np.ndarray],
    step: np.ndarray,
    kept: int = 2,
) -> np.ndarray:
    """Return the best of short Nelder-Mead runs, the `kept` best of them carried to the end."""

    def run(start: np.ndarray, iterations: int, reach: float) -> tuple[float, np.ndarray]:
        simplex = np.array([start, *(start + np.diag(step * reach))])
        options = {
            "maxiter": iterations,
            "xatol": 0.003,
            "fatol": 0.0005,
            "initial_simplex": simplex,
        }
        found = minimize(cost, start, method="Nelder-Mead", options=options)
        return float(found.fun), found.x

    short = sorted((run(start, 40, 1.0) for start in starts), key=lambda r: r[0])[:kept]
    return min((run(x, 220, 0.5) for _, x in short), key=lambda r: r[0])[1]

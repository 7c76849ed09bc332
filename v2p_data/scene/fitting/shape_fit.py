"""A noun's shape is fitted under one outline: position, yaw and proportions, on the table or in the air.

Everything here is in camera heights (the camera stands 1 above the table);
`scale/camera_height.py` turns that into metres. An outline alone is ambiguous (faces swap, flat
things thicken), so the noun's proportions hold the fit.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float
from scipy.optimize import minimize
from scipy.spatial.transform import Rotation

from v2p_data.geometry.camera import Camera
from v2p_data.geometry.mesh import outline_points
from v2p_data.geometry.pose import apply, transform
from v2p_data.scene.data_types import Fit
from v2p_data.scene.fitting.silhouette import Silhouette
from v2p_data.scene.scale.nouns import Noun

_HIDDEN_WEIGHT = 0.15
"""Weight, 0 to 1, of pixels that may be hidden: without it a shape grows behind the hand."""
_PRIOR_WEIGHT = 0.03
"""Cost of proportions one standard deviation off the noun's, in units of IoU."""
_STILL = np.zeros(3)


@dataclass(frozen=True, kw_only=True)
class Within:
    """A disc on the table over which an object's middle must be, in camera heights."""

    xy: Float[np.ndarray, "2"]
    radius: float


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


@dataclass(frozen=True, kw_only=True)
class Fitting:
    """A shape under its outlines, with the numbers that are searched for."""

    views: Sequence[tuple[Float[np.ndarray, "3"], Silhouette]]
    """By how far the shape has moved from its pose, and its outline then."""
    noun: Noun
    posed: Callable[[np.ndarray], tuple[np.ndarray, np.ndarray]]
    """Size and pose `T_world_obj` for these numbers."""
    outline: Callable[[np.ndarray], np.ndarray]
    """Points on the shape's outline in its own frame, for this size."""
    held: Callable[[np.ndarray, np.ndarray], float]
    """What these numbers and this pose cost, whatever is seen."""

    def place(self, v: np.ndarray) -> np.ndarray:
        """Return the outline's points in the world."""
        size, T = self.posed(v)
        return apply(T, self.outline(size))

    def cost(self, v: np.ndarray) -> float:
        size, T = self.posed(v)
        appearance = self.views[0][1].appearance_cost(self.noun.form, size, T)
        iou = self.iou(apply(T, self.outline(size)), _HIDDEN_WEIGHT)
        return 1 - iou + self.held(v, T) + appearance

    def iou(self, points_world: np.ndarray, hidden_weight: float = 0.0) -> float:
        """Return how well the shape covers its outlines, on average."""
        return float(
            np.mean([one.iou(points_world + moved, hidden_weight) for moved, one in self.views])
        )

    def best(self, starts: list[np.ndarray], step: np.ndarray, kept: int = 2) -> Fit:
        """Return the fit that a search from these numbers ends in."""
        v = search(self.cost, starts, step, kept)
        size, T = self.posed(v)
        points = apply(T, outline_points(self.noun.form, three(size), self.noun.taper))
        return Fit(
            size=three(size),
            T_world_obj=T,
            iou=self.iou(points),
            visible=float(np.mean([one.visible(points + moved) for moved, one in self.views])),
            cost=self.cost(v),
        )


def fit_shape(
    silhouette: Silhouette, noun: Noun, rest: Float[np.ndarray, "3 3"], *, thorough: bool = True
) -> Fit:
    """Return the noun's shape resting on the table in orientation `rest`, proportions free within the noun's spread."""
    prior = np.array(noun.size_m)
    spread = max(0.1, noun.spread * 0.8)
    scale0, ground = _start(silhouette, prior)
    free = {"box": [0, 1, 2], "cylinder": [0, 2], "sphere": [0]}[noun.form]
    unit = outline_points(noun.form, (1.0, 1.0, 1.0), noun.taper)
    reach = scale0 * prior.max()

    def posed(v: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        logs = np.zeros(3)
        logs[free] = v[3:]
        if noun.form != "box":
            logs[1] = logs[0]
        if noun.form == "sphere":
            logs[2] = logs[0]
        size = prior * scale0 * np.exp(logs)
        return size, _resting(ground + v[:2] * scale0 * prior.max(), v[2], rest, size)

    def held(v: np.ndarray, T: np.ndarray) -> float:
        off = (v[3:] - v[3:].mean()) / spread
        return _PRIOR_WEIGHT * float((off**2).sum())

    fitting = Fitting(
        views=[(_STILL, silhouette)],
        noun=noun,
        posed=posed,
        outline=lambda size: unit * size,
        held=held,
    )
    starts = [
        _aligned(
            silhouette, np.array([0.0, 0.0, yaw, *np.full(len(free), grow)]), fitting.place, reach
        )
        for yaw in _yaw_starts(noun, rest, thorough)
        for grow in ((0.0, 0.25) if thorough else (0.1,))
    ]
    step = np.array([0.25, 0.25, 0.3, *[0.25] * len(free)])
    # Outlines of a box at two yaws are nearly as good as each other.
    return fitting.best(starts, step, kept=4 if thorough and noun.form == "box" else 2)


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
    reach = float(extents.max())
    points = outline_points(noun.form, size, noun.taper)
    _, ground = _start(silhouette, extents)

    def posed(v: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        T = _resting(ground + v[:2] * reach, v[2], rest, extents)
        T[2, 3] += support
        return extents, T

    def held(v: np.ndarray, T: np.ndarray) -> float:
        cost = 0.0
        if yaw_near is not None:
            cost = 0.01 * (1 - np.cos(2 * (v[2] - yaw_near)))
        if within is not None:
            outside = float(np.linalg.norm(T[:2, 3] - within.xy)) - within.radius
            cost += max(0.0, outside) / max(within.radius, 0.5 * reach)
        return cost

    fitting = Fitting(
        views=[(_STILL, silhouette)], noun=noun, posed=posed, outline=lambda _: points, held=held
    )
    turns = _yaw_starts(noun, rest, thorough=True)
    if yaw_near is not None:
        turns = [*turns, yaw_near]
    starts = [
        _aligned(silhouette, np.array([0.0, 0.0, yaw]), fitting.place, reach) for yaw in turns
    ]
    if within is not None:
        there = (within.xy - ground) / extents.max()
        starts += [np.array([*there, yaw]) for yaw in turns[:1]]
    return fitting.best(starts, np.array([0.15, 0.15, 0.3]))


def fit_lifted(
    silhouette: Silhouette,
    noun: Noun,
    size: tuple[float, float, float],
    T_first: Float[np.ndarray, "4 4"],
) -> Fit:
    """Return where a shape of known size is in the air, as far from the camera along the table as at first.

    One view does not show the depth of something in mid-air; lifted straight up is the assumption.
    """
    extents, reach = np.array(size), max(size)
    points = outline_points(noun.form, size, noun.taper)
    x, y, w, h = silhouette.box
    start = on_wall(silhouette.camera, np.array([x + w / 2, y + h / 2]), T_first[0, 3])
    yaw0 = Rotation.from_matrix(T_first[:3, :3])

    def posed(v: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        turned = (Rotation.from_rotvec([0, 0, v[2]]) * yaw0).as_matrix()
        height = max(start[2] + v[1] * reach, lowest(size, noun.form, turned))
        place = np.array([T_first[0, 3], start[1] + v[0] * reach, height])
        return extents, transform(turned, place)

    fitting = Fitting(
        views=[(_STILL, silhouette)],
        noun=noun,
        posed=posed,
        outline=lambda _: points,
        held=lambda v, T: 0.01 * (1 - np.cos(v[2])),
    )
    starts = [np.zeros(3), np.array([0, 0, 0.5]), np.array([0, 0, -0.5])]
    return fitting.best(starts, np.array([0.2, 0.2, 0.2]))


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

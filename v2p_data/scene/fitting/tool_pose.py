"""The pose of a tool in a hand, from all frames in which the tool pushes.

One outline of a thin tool does not show its tilt, nor whether it leans towards the camera or away. Three habits tell more. The tip is
behind the pushed object and moves with it. The hand holds the tool as high as a fist. The tool points back to where the arm
comes from.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

from v2p_data.geometry.camera import Camera
from v2p_data.geometry.mesh import outline_points
from v2p_data.geometry.pose import transform
from v2p_data.scene.data_types import Fit
from v2p_data.scene.fitting.shape_fit import search, three
from v2p_data.scene.fitting.silhouette import Silhouette
from v2p_data.scene.fitting.trajectory import Trajectory
from v2p_data.scene.frames.hand import hand_end
from v2p_data.scene.frames.segmentation import Segmentation, hand_at
from v2p_data.scene.scale.nouns import Noun


@dataclass(frozen=True, kw_only=True)
class ToolPrior:
    """How hands hold what they push with, and what a deviation costs.

    All were set by hand. Drawn hands hold tools at 70 % of their length, 8.5 cm above the table; real ones were not measured.
    """

    grip_at: float = 0.7
    """Where a hand holds the tool: share of its length from the tip, 0 to 1."""
    grip_height_m: float = 0.08
    """Height of the grip over the table, of a hand that pushes."""
    lowest_grip_m: float = 0.04
    """Least height of the grip: a fist must clear the table."""
    steepest_sin: float = 0.81
    """Sine of the steepest tilt at which somebody holds a short pen."""
    least_usual_tilt_rad: float = 0.35
    """Least usual tilt: a long stick is seldom laid flatter."""
    tilt_sd_rad: float = 0.25
    """Standard deviation of the tilt from the usual one."""
    arm_sd_rad: float = 0.5
    """Standard deviation of the tool's heading from the arm's."""
    behind_sd_rad: float = 1.0
    """Standard deviation of the tool's heading from straight back along the push."""
    gap_sd_m: float = 0.01
    """Standard deviation of the tip from the pushed object, along the push."""
    aside_sd_m: float = 0.015
    """Standard deviation of the tip from the pushed object's middle, across the push."""
    away_sd_m: float = 0.1
    """Standard deviation of both before and after the push, when the tool need not touch."""
    farthest_away: float = 3.0
    """Farthest place of the tip before and after the push at which the search begins [tool lengths]."""
    weight: float = 0.03
    """Cost of one squared standard deviation, in units of IoU."""
    hidden_weight: float = 0.15
    """Weight, 0 to 1, of pixels that may be hidden, in the overlap."""


PRIOR = ToolPrior()
_TIP_AT = 0.35
"""Height at which the tip touches the pushed object, as a share of that object's height."""
_HIGHEST_TIP_M = 0.03
"""Greatest height of the tip over the table."""
_ELBOW_HEIGHT_M = 0.15
"""Height over the table of an arm where it comes into the picture."""
_FARTHEST_M = 2.0
"""Greatest distance of that place from the camera's foot."""
_SETS_OUT = 0.05
"""Share of an object's way that it has gone when the push begins, and that is left when the push ends."""
_LEAST_TRAVEL = 0.2
"""Travel in extents of the pushed object, below which it tells no direction."""


@dataclass(frozen=True, kw_only=True)
class PushMotion:
    """What is pushed, in camera heights, and what is known of who pushes it."""

    frames: tuple[int, int]
    """Working frames: it begins to move, and has come to rest."""
    spots: Float[np.ndarray, "time 2"]
    """Where its middle is on the table, in every working frame."""
    behind: Float[np.ndarray, "2"]
    """From its middle to where it is pushed."""
    way: Float[np.ndarray, "2"]
    """Unit vector along which it goes."""
    tip_height: float
    arm_rad: float | None
    """Heading from there to where the arm comes from, counterclockwise from +x; None where no arm is seen."""
    height_m: float
    """Metres per camera height."""


@dataclass(frozen=True, kw_only=True)
class Pushed:
    """What a tool pushes."""

    trajectory: Trajectory
    fit: Fit
    """The object at first."""
    form: str
    """Its noun's shape: `box`, `cylinder` or `sphere`."""


def push_motion(
    pushed: Pushed,
    num_frames: int,
    tool_xy: Float[np.ndarray, "2"],
    camera: Camera,
    height_m: float,
    segmentation: Segmentation | None,
) -> PushMotion:
    """Return how a thing is pushed.

    Args:
        pushed: the object, and its poses.
        num_frames: of the working clip.
        tool_xy: where the tool is seen, roughly: from there a thing is pushed that hardly moves.
        camera: one camera height above the table.
        height_m: metres per camera height.
        segmentation: what the network sees, where it was asked.
    """
    known = np.array([T[:2, 3] for T in pushed.trajectory.poses])
    times = np.arange(num_frames)
    spots = np.stack(
        [np.interp(times, pushed.trajectory.frames, known[:, k]) for k in range(2)], 1
    )
    whole = spots[-1] - spots[0]
    begins, ends = 0, num_frames - 1
    if np.linalg.norm(whole) < _LEAST_TRAVEL * max(pushed.fit.size):
        whole = spots[0] - tool_xy
    else:
        gone = (spots - spots[0]) @ whole / float(whole @ whole)
        begins = max(0, int((gone > _SETS_OUT).argmax()) - 1)
        ends = min(ends, int(np.flatnonzero(gone < 1 - _SETS_OUT)[-1]) + 1)
    way = whole / max(1e-9, float(np.linalg.norm(whole)))
    points = outline_points(pushed.form, pushed.fit.size) @ pushed.fit.T_world_obj[:3, :3].T
    behind = float((points[:, :2] @ way).min()) * way
    tall = float(np.ptp(points[:, 2]))
    arm = None
    if segmentation is not None:
        at = spots + behind
        arm = _arm_heading(segmentation, at, (begins, ends), camera, height_m)
    return PushMotion(
        frames=(begins, ends),
        spots=spots,
        behind=behind,
        way=way,
        tip_height=min(_HIGHEST_TIP_M / height_m, _TIP_AT * tall),
        arm_rad=arm,
        height_m=height_m,
    )


def _arm_heading(
    segmentation: Segmentation,
    at: Float[np.ndarray, "time 2"],
    frames: tuple[int, int],
    camera: Camera,
    height_m: float,
) -> float | None:
    """Return the heading from the tool's tip to where the arm comes from; None where none comes in from the picture's edge."""
    ways = []
    for i in segmentation.idx.tolist():
        end = hand_end(hand_at(segmentation, i)) if frames[0] <= i <= frames[1] else None
        if end is None:
            continue
        entry = np.array([end.entry_px])
        spot = camera.on_plane(entry, _ELBOW_HEIGHT_M / height_m)[0][:2]
        farthest = _FARTHEST_M / height_m
        if not np.linalg.norm(spot) < farthest:  # or it comes from over the horizon
            ray = camera.rays_world(entry)[0][:2]
            spot = ray / np.linalg.norm(ray) * farthest
        ways.append((spot - at[i]) / np.linalg.norm(spot - at[i]))
    if not ways:
        return None
    x, y = np.mean(ways, axis=0).tolist()
    return float(np.arctan2(y, x))


@dataclass(frozen=True, kw_only=True)
class ToolPose:
    """A tool in a hand."""

    fit: Fit
    """Where it is when the pushed object is where it was at first."""
    T_world_seen: Float[np.ndarray, "4 4"]
    """Its pose in the first of the views, in which it need not push yet."""


def fit_tool_pose(
    views: Sequence[tuple[int, Silhouette]],
    push: PushMotion,
    noun: Noun,
    size: tuple[float, float, float],
    spread: float,
) -> ToolPose:
    """Return where something long is that a hand pushes with.

    The tool keeps its turn and goes with the pushed object. Its tilt follows from the height of a fist; the outlines may pull it a little.

    Args:
        views: working frames, and the tool's outlines there.
        push: the pushed object's motion.
        noun: the tool's shape.
        size: its usual size, along its own axes [camera heights].
        spread: standard deviation of the logarithm of its length. It may be longer than usual; where it seems shorter, the
            hand or the picture's edge hides the rest.
    """
    model = _ToolModel(views, push, noun, size, spread)
    turns = np.radians(range(0, 360, 20))
    tip = model.first_tip()
    level = _Parameters(0.0, 0.0, 0.0, 0.0, 0.0)
    starts = [np.array([*tip, turn, model.usual_tilt(level), 0.0]) for turn in turns]
    best = search(model.cost, starts, np.array([0.1, 0.1, 0.3, 0.1, 0.1]))
    found = _Parameters.of(best)
    points = model.outline(found)
    covers = [
        (silhouette.iou(points + shift), silhouette.visible(points + shift))
        for shift, silhouette in model.shifted_views
    ]
    iou, visible = np.mean(covers, axis=0).tolist()
    pushing = _Parameters.of(best * [0, 0, 1, 1, 1]) if model.away else found
    fit = Fit(
        size=three(model.size_of(found)),
        T_world_obj=model.pose(pushing),
        iou=iou,
        visible=visible,
        cost=model.cost(best),
    )
    seen = model.pose(found)
    seen[:3, 3] += model.shifted_views[0][0]
    return ToolPose(fit=fit, T_world_seen=seen)


@dataclass(frozen=True)
class _Parameters:
    """What is searched for, in this order."""

    along: float
    """Distance of the tip from the pushed point, along the push [tool lengths]."""
    aside: float
    """The same across the push."""
    heading_rad: float
    """From the tip to the grip, counterclockwise from +x."""
    tilt_rad: float
    """Over the table."""
    log_length: float
    """Logarithm of the length over the usual one; its sign does not count."""

    @classmethod
    def of(cls, v: Float[np.ndarray, "5"]) -> "_Parameters":
        return cls(*v)


class _ToolModel:
    """A tool's shape, where its parameters place it, and what they cost."""

    def __init__(
        self,
        views: Sequence[tuple[int, Silhouette]],
        push: PushMotion,
        noun: Noun,
        size: tuple[float, float, float],
        spread: float,
    ) -> None:
        self.away = not all(push.frames[0] <= i <= push.frames[1] for i, _ in views)
        """Whether a view shows the tool before or after it pushes: then its tip is farther off."""
        self.shifted_views = [
            (np.array([*(push.spots[i] - push.spots[0]), 0.0]), silhouette)
            for i, silhouette in views
        ]
        """How far the pushed object had gone in each view, with the outline there."""
        self._views, self._push, self._size, self._spread = views, push, size, spread
        self._unit = outline_points(noun.form, (1.0, 1.0, 1.0), noun.taper)
        self._order = np.argsort(size)[::-1]
        self._aside = np.array([-push.way[1], push.way[0]])
        self._back_rad = float(np.arctan2(*(-push.way[::-1])))
        self._start = push.spots[0] + push.behind

    def size_of(self, p: _Parameters) -> Float[np.ndarray, "3"]:
        """Return the extents along the tool's own axes [camera heights]."""
        out = np.array(self._size)
        out[self._order[0]] *= np.exp(abs(p.log_length))
        return out

    def usual_tilt(self, p: _Parameters) -> float:
        """Return the tilt at which a hand usually holds a tool of this length."""
        return max(self._tilt_for(PRIOR.grip_height_m, p), PRIOR.least_usual_tilt_rad)

    def _tilt_for(self, grip_m: float, p: _Parameters) -> float:
        high = grip_m / self._push.height_m / (PRIOR.grip_at * self.size_of(p).max())
        return float(np.arcsin(min(high, PRIOR.steepest_sin)))

    def pose(self, p: _Parameters) -> Float[np.ndarray, "4 4"]:
        """Return the tool's pose while the pushed object is where it was at first."""
        order, push = self._order, self._push
        tilt = max(p.tilt_rad, self._tilt_for(PRIOR.lowest_grip_m, p))
        level = np.array([np.cos(p.heading_rad), np.sin(p.heading_rad), 0.0])
        along = np.cos(tilt) * level + np.array([0.0, 0.0, np.sin(tilt)])
        rotation = np.empty((3, 3))
        rotation[:, order[0]] = along
        rotation[:, order[1]] = (-level[1], level[0], 0.0)
        rotation[:, order[2]] = np.cross(along, rotation[:, order[1]])
        rotation[:, order[2]] *= np.sign(np.linalg.det(rotation))
        off = max(self._size) * (p.along * push.way + p.aside * self._aside)
        tip = np.array([*(self._start + off), push.tip_height])
        return transform(rotation, tip + along * self.size_of(p).max() / 2)

    def outline(self, p: _Parameters) -> Float[np.ndarray, "n 3"]:
        """Return points whose convex hull is the tool."""
        T = self.pose(p)
        return (self._unit * self.size_of(p)) @ T[:3, :3].T + T[:3, 3]

    def cost(self, v: Float[np.ndarray, "5"]) -> float:
        """Return how badly the outlines are covered, plus how unusually the tool is held, in units of IoU."""
        p = _Parameters.of(v)
        prior = self._prior(p)
        points = self.outline(p)
        ious = [
            silhouette.iou(points + shift, PRIOR.hidden_weight)
            for shift, silhouette in self.shifted_views
        ]
        return 1 - float(np.mean(ious)) + PRIOR.weight * float(prior)

    def _prior(self, p: _Parameters) -> float:
        """Return squared standard deviations; what is far off counts by its logarithm only."""
        push = self._push
        metres = max(self._size) * push.height_m
        loose = PRIOR.away_sd_m if self.away else 0.0
        turned = [
            (p.tilt_rad - self.usual_tilt(p)) / PRIOR.tilt_sd_rad,
            _between(p.heading_rad, self._back_rad) / PRIOR.behind_sd_rad,
        ]
        off = [
            p.log_length / self._spread,
            p.along * metres / np.hypot(PRIOR.gap_sd_m, loose),
            p.aside * metres / np.hypot(PRIOR.aside_sd_m, loose),
        ]
        if push.arm_rad is not None:
            off.append(_between(p.heading_rad, push.arm_rad) / PRIOR.arm_sd_rad)
        return np.square(turned).sum() + np.log1p(np.square(off)).sum()

    def first_tip(self) -> Float[np.ndarray, "2"]:
        """Return where the search for the tip begins, along and aside: at the push, or at the first view's nearest point."""
        tip = np.zeros(2)
        if not self.away:
            return tip
        push = self._push
        i, silhouette = self._views[0]
        here = np.array([*(push.spots[i] + push.behind), push.tip_height])
        pixel = silhouette.nearest_to(silhouette.camera.project(here[None])[0])
        off_xy = (silhouette.camera.on_plane(pixel[None], push.tip_height)[0] - here)[:2]
        if np.linalg.norm(off_xy) < PRIOR.farthest_away * max(self._size):
            tip = np.array([off_xy @ push.way, off_xy @ self._aside]) / max(self._size)
        return tip


def _between(a: float, b: float) -> float:
    """Return the angle between two headings, 0 to pi."""
    return abs(float(np.angle(np.exp(1j * (a - b)))))

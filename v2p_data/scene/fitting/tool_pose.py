"""How a hand holds what it pushes with, from all frames in which it pushes.

One outline of something thin does not show how steep it is, nor whether it leans towards the camera or away. But its tip is
behind what it pushes and goes with that, a hand holds it as high as a fist, and it points back to where the arm comes from
rather than ahead of where it pushes.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

from v2p_data.geometry.camera import Camera
from v2p_data.geometry.mesh import outline_points
from v2p_data.geometry.pose import transform
from v2p_data.scene.data_types import Fit
from v2p_data.scene.fitting.silhouette import Silhouette, search, three
from v2p_data.scene.fitting.trajectory import Trajectory
from v2p_data.scene.frames.hand import hand_end
from v2p_data.scene.frames.segmentation import Segmentation, hand_at
from v2p_data.scene.scale.nouns import Noun

_HIDDEN_WEIGHT = 0.15
"""Of pixels that may be hidden, in the overlap."""
_GRIP_AT = 0.7
"""From its tip, as a share of its length: where a hand holds it."""
_GRIP_HEIGHT_M, _LOWEST_GRIP_M = 0.08, 0.04
"""Over the table, of a hand that pushes with something, and at least: the fist must clear the table."""
_STEEPEST, _LEAST_USUAL_TILT_RAD = 0.81, 0.35
"""Sine: steeper nobody holds a short pen; and a long stick is seldom laid flatter."""
_TILT_SD_RAD = 0.25
_ARM_SD_RAD, _BEHIND_SD_RAD = 0.5, 1.0
"""How far the tool's heading is from the arm's, and from straight back."""
_GAP_SD_M, _ASIDE_SD_M = 0.01, 0.015
"""How far its tip is from what it pushes, and aside of the middle."""
_AWAY_SD_M, _FARTHEST_AWAY = 0.1, 3.0
"""The same before and after it pushes; and how many of its lengths away it is searched then."""
_PRIOR_WEIGHT = 0.03
"""Cost of what is one standard deviation off, in units of IoU."""
_TIP_AT, _HIGHEST_TIP_M = 0.35, 0.03
"""Of the pushed thing's height, and at most: where the tip touches it."""
_ELBOW_HEIGHT_M, _FARTHEST_M = 0.15, 2.0
"""Over the table, of an arm where it comes into the picture; and how far away that is, at most."""
_SETS_OUT = 0.05
"""Share of its way that a thing has gone when it is pushed, and that is left when it no longer is."""
_LEAST_TRAVEL = 0.2
"""Of its extent: what goes less far tells no direction."""


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


def push_motion(
    trajectory: Trajectory,
    fit: Fit,
    form: str,
    num_frames: int,
    tool_xy: Float[np.ndarray, "2"],
    camera: Camera,
    height_m: float,
    segmentation: Segmentation | None,
) -> PushMotion:
    """Return how a thing is pushed.

    Args:
        trajectory: its poses.
        fit: it at first.
        form: its shape.
        num_frames: of the working clip.
        tool_xy: where the tool is seen, roughly: from there a thing is pushed that hardly moves.
        camera: one camera height above the table.
        height_m: metres per camera height.
        segmentation: what the network sees, where it was asked.
    """
    known = np.array([T[:2, 3] for T in trajectory.poses])
    times = np.arange(num_frames)
    spots = np.stack([np.interp(times, trajectory.frames, known[:, k]) for k in range(2)], 1)
    whole = spots[-1] - spots[0]
    begins, ends = 0, num_frames - 1
    if np.linalg.norm(whole) < _LEAST_TRAVEL * max(fit.size):
        whole = spots[0] - tool_xy
    else:
        gone = (spots - spots[0]) @ whole / float(whole @ whole)
        begins = max(0, int((gone > _SETS_OUT).argmax()) - 1)
        ends = min(ends, int(np.flatnonzero(gone < 1 - _SETS_OUT)[-1]) + 1)
    way = whole / max(1e-9, float(np.linalg.norm(whole)))
    points = outline_points(form, fit.size) @ fit.T_world_obj[:3, :3].T
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
    """Where it is when what it pushes is where it was at first."""
    T_world_seen: Float[np.ndarray, "4 4"]
    """Where the first of the views shows it: elsewhere, if it does not push there."""


def fit_tool_pose(
    views: Sequence[tuple[int, Silhouette]],
    push: PushMotion,
    noun: Noun,
    size: tuple[float, float, float],
    spread: float,
) -> ToolPose:
    """Return where something long is that a hand pushes with.

    It keeps its turn, and goes where that goes. How steep it is follows from the height of a fist, from which the outlines
    may pull it a little.

    Args:
        views: working frames, and its outlines there.
        push: what it pushes, and whence.
        noun: its shape.
        size: its usual one, along its own axes, in camera heights like all lengths here.
        spread: standard deviation of the logarithm of its length. It may be longer than usual; where it seems shorter, the
            hand or the picture's edge hides the rest.
    """
    away = not all(push.frames[0] <= i <= push.frames[1] for i, _ in views)
    loose = _AWAY_SD_M if away else 0.0
    unit = outline_points(noun.form, (1.0, 1.0, 1.0), noun.taper)
    order = np.argsort(size)[::-1]
    shifts = [np.array([*(push.spots[i] - push.spots[0]), 0.0]) for i, _ in views]
    aside = np.array([-push.way[1], push.way[0]])
    back = float(np.arctan2(*(-push.way[::-1])))
    start = push.spots[0] + push.behind

    def size_of(v: np.ndarray) -> np.ndarray:
        out = np.array(size)
        out[order[0]] *= np.exp(abs(v[4]))
        return out

    def tilt_for(grip_m: float, v: np.ndarray) -> float:
        high = grip_m / push.height_m / (_GRIP_AT * size_of(v).max())
        return float(np.arcsin(min(high, _STEEPEST)))

    def place(v: np.ndarray) -> np.ndarray:
        tilt = max(v[3], tilt_for(_LOWEST_GRIP_M, v))
        level = np.array([np.cos(v[2]), np.sin(v[2]), 0.0])
        along = np.cos(tilt) * level + np.array([0.0, 0.0, np.sin(tilt)])
        rotation = np.empty((3, 3))
        rotation[:, order[0]] = along
        rotation[:, order[1]] = (-level[1], level[0], 0.0)
        rotation[:, order[2]] = np.cross(along, rotation[:, order[1]])
        rotation[:, order[2]] *= np.sign(np.linalg.det(rotation))
        tip = np.array([*(start + max(size) * (v[0] * push.way + v[1] * aside)), push.tip_height])
        return transform(rotation, tip + along * size_of(v).max() / 2)

    def outline(v: np.ndarray) -> np.ndarray:
        T = place(v)
        return (unit * size_of(v)) @ T[:3, :3].T + T[:3, 3]

    def usual_tilt(v: np.ndarray) -> float:
        return max(tilt_for(_GRIP_HEIGHT_M, v), _LEAST_USUAL_TILT_RAD)

    def cost(v: np.ndarray) -> float:
        metres = max(size) * push.height_m
        turned = [
            (v[3] - usual_tilt(v)) / _TILT_SD_RAD,
            _between(v[2], back) / _BEHIND_SD_RAD,
        ]
        off = [
            v[4] / spread,
            v[0] * metres / np.hypot(_GAP_SD_M, loose),
            v[1] * metres / np.hypot(_ASIDE_SD_M, loose),
        ]
        if push.arm_rad is not None:
            off.append(_between(v[2], push.arm_rad) / _ARM_SD_RAD)
        prior = np.square(turned).sum() + np.log1p(np.square(off)).sum()
        points = outline(v)
        ious = [
            silhouette.iou(points + shift, _HIDDEN_WEIGHT)
            for shift, (_, silhouette) in zip(shifts, views, strict=True)
        ]
        return 1 - float(np.mean(ious)) + _PRIOR_WEIGHT * float(prior)

    tip = np.zeros(2)
    if away:  # the view's point nearest to where the tip would push
        i, silhouette = views[0]
        here = np.array([*(push.spots[i] + push.behind), push.tip_height])
        pixel = silhouette.nearest_to(silhouette.camera.project(here[None])[0])
        off_xy = (silhouette.camera.on_plane(pixel[None], push.tip_height)[0] - here)[:2]
        if np.linalg.norm(off_xy) < _FARTHEST_AWAY * max(size):
            tip = np.array([off_xy @ push.way, off_xy @ aside]) / max(size)
    turns = np.radians(range(0, 360, 20))
    starts = [np.array([*tip, turn, usual_tilt(np.zeros(5)), 0.0]) for turn in turns]
    best = search(cost, starts, np.array([0.1, 0.1, 0.3, 0.1, 0.1]))
    points = outline(best)
    covers = [
        (silhouette.iou(points + shift), silhouette.visible(points + shift))
        for shift, (_, silhouette) in zip(shifts, views, strict=True)
    ]
    iou, visible = np.mean(covers, axis=0).tolist()
    pushing = best * [0, 0, 1, 1, 1] if away else best
    fit = Fit(
        size=three(size_of(best)),
        T_world_obj=place(pushing),
        iou=iou,
        visible=visible,
        cost=cost(best),
    )
    seen = place(best)
    seen[:3, 3] += shifts[0]
    return ToolPose(fit=fit, T_world_seen=seen)


def _between(a: float, b: float) -> float:
    """Return the angle between two headings, 0 to pi."""
    return abs(float(np.angle(np.exp(1j * (a - b)))))

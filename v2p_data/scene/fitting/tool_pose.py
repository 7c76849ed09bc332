"""The pose of a tool in a hand, in every frame in which it pushes.

One outline of a thin tool does not show its tilt, nor whether it leans towards the camera or away.
Three habits tell more. The tip is behind the pushed object and moves with it. The hand holds the
tool as high as a fist. The tool points back to where the arm comes from. All numbers of these
habits were set by hand; real ones were not measured.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Float

from v2p_data.geometry.camera import Camera
from v2p_data.geometry.mesh import outline_points
from v2p_data.geometry.pose import transform
from v2p_data.scene.data_types import Fit, ObjectTrack, PlacedObject
from v2p_data.scene.fitting.end_poses import EndPoses, placed_along
from v2p_data.scene.fitting.object_view import ObjectView, unknown_around
from v2p_data.scene.fitting.shape_fit import Fitting, three
from v2p_data.scene.fitting.silhouette import Silhouette
from v2p_data.scene.fitting.trajectory import Trajectory
from v2p_data.scene.frames.hand import hand_end
from v2p_data.scene.frames.segmentation import Segmentation, hand_at
from v2p_data.scene.frames.working_clip import WorkingClip
from v2p_data.scene.scale.nouns import Noun

_GRIP_AT, _GRIP_HEIGHT_M = 0.7, 0.08
"""Where a hand holds the tool, as a share of its length from the tip; and how high over the table."""
_STEEPEST_SIN, _LEAST_TILT_RAD, _TILT_SD_RAD = 0.81, 0.35, 0.25
"""Sine of the steepest and angle of the least usual tilt; standard deviation of the tilt from the usual one."""
_ARM_SD_RAD, _BEHIND_SD_RAD = 0.5, 1.0
"""Standard deviation of the tool's heading from the arm's, and from straight back along the push."""
_HABIT_WEIGHT = 0.03
"""Cost of one squared standard deviation, in units of IoU."""
_TIP_AT, _HIGHEST_TIP_M = 0.35, 0.03
"""Height at which the tip touches the pushed object, as a share of that object's height; and the most."""
_ELBOW_HEIGHT_M, _FARTHEST_M = 0.15, 2.0
"""Height over the table of an arm where it comes into the picture; and the greatest distance of
that place from the camera's foot."""
_SETS_OUT = 0.05
"""Share of an object's way that it has gone when the push begins, and that is left when the push ends."""
_LEAST_TRAVEL = 0.2
"""Travel in extents of the pushed object, below which it tells no direction."""
_NO_SPREAD = 0.01
"""Standard deviation of the logarithm of a length that the user gave."""
_MOST_VIEWS = 5
"""Frames in which a tool's outline is compared with its pose: more take longer and fit no better."""
_LATE = 0.6
"""Share of the pushed object's way, 0 to 1, from which on an outline shows how the tool ends."""
_LEAST_QUALITY = 0.4
"""Quality, 0 to 1, of a mask that is compared."""
_UNSEEN_SURE = 0.4
"""Confidence, 0 to 1, of a tool's pose in a frame without a mask."""


@dataclass(frozen=True, kw_only=True)
class PushMotion:
    """What is pushed, in camera heights, and what is known of who pushes it."""

    frames: tuple[int, int]
    """Working frames: it begins to move, and has come to rest."""
    gone: Float[np.ndarray, "time 3"]
    """How far it has gone over the table, in every working frame."""
    tip: Float[np.ndarray, "3"]
    """Where it is pushed, while it is where it was at first."""
    back_rad: float
    """Heading straight back along the push, counterclockwise from +x."""
    arm_rad: float | None
    """Heading from there to where the arm comes from; None where no arm is seen."""


def place_tool(
    see: ObjectView,
    thing: ObjectTrack,
    pushed: PlacedObject,
    camera: Camera,
    height_m: float,
    working: WorkingClip,
    segmentation: Segmentation,
) -> PlacedObject:
    """Return the poses of a tool in a hand while the pushed object moves."""
    s = see.s
    push = push_motion(pushed, thing.noun.form, s, camera, height_m, segmentation)
    begins, ends = push.frames
    seen = [
        i
        for i in range(max(s.at, begins), ends + 1)
        if s.masks[i].any() and s.quality[i] > _LEAST_QUALITY
    ] or [s.at]
    few = np.unique(np.linspace(0, len(seen) - 1, _MOST_VIEWS).round().astype(int))
    views = [
        (push.gone[i], Silhouette(s.masks[i], unknown_around(working, thing, s, i), camera))
        for i in (seen[k] for k in few)
    ]
    size, spread = (s.known_m, _NO_SPREAD) if s.known_m else (s.noun.size_m, s.noun.spread)
    fit = fit_tool(views, push, s.noun, three(np.array(size) / height_m), spread, height_m)
    way = np.linalg.norm(push.gone, axis=1)
    late = begins <= seen[-1] <= ends and way[seen[-1]] >= _LATE * way[-1]
    last_i = seen[-1] if late else ends
    at = sorted({begins, last_i} | {i for i in pushed.frames if begins < i < last_i})
    poses = [transform(np.eye(3), push.gone[i]) @ fit.T_world_obj for i in at]
    sure = [float(np.clip(fit.iou, 0, 1)) if i in seen else _UNSEEN_SURE for i in at]
    trajectory = Trajectory(at, poses, sure, ["no_depth"] * len(at))
    mask = s.masks[last_i] if late else np.zeros_like(s.first)
    unknown = unknown_around(working, thing, s, last_i) if late else mask
    see = replace(see, last_i=last_i, last_mask=mask, last_hidden=unknown)
    first, last = (replace(fit, T_world_obj=poses[k]) for k in (0, -1))
    placed = placed_along(see, EndPoses(first=first, last=last), trajectory)
    return replace(placed, hidden_in_hand=not late)


def push_motion(
    pushed: PlacedObject,
    form: str,
    tool: ObjectTrack,
    camera: Camera,
    height_m: float,
    segmentation: Segmentation,
) -> PushMotion:
    """Return how a thing is pushed.

    Args:
        pushed: the object, and its poses.
        form: its noun's shape.
        tool: what pushes it: where it is seen, from there a thing is pushed that hardly moves.
        camera: one camera height above the table.
        height_m: metres per camera height.
        segmentation: what the network sees.
    """
    times = np.arange(len(tool.masks))
    spots = np.stack(
        [np.interp(times, pushed.frames, pushed.T_world_objs[:, k, 3]) for k in range(2)], 1
    )
    whole = spots[-1] - spots[0]
    begins, ends = 0, len(times) - 1
    if np.linalg.norm(whole) < _LEAST_TRAVEL * max(pushed.first.size):
        ground = camera.on_plane(np.argwhere(tool.first).mean(0)[None, ::-1])[0][:2]
        whole = spots[0] - np.nan_to_num(ground)
    else:
        share = (spots - spots[0]) @ whole / float(whole @ whole)
        begins = max(0, int((share > _SETS_OUT).argmax()) - 1)
        ends = min(ends, int(np.flatnonzero(share < 1 - _SETS_OUT)[-1]) + 1)
    way = whole / max(1e-9, float(np.linalg.norm(whole)))
    points = outline_points(form, pushed.first.size) @ pushed.first.T_world_obj[:3, :3].T
    behind = float((points[:, :2] @ way).min()) * way
    tall = float(np.ptp(points[:, 2]))
    return PushMotion(
        frames=(begins, ends),
        gone=np.column_stack([spots - spots[0], np.zeros(len(spots))]),
        tip=np.array([*(spots[0] + behind), min(_HIGHEST_TIP_M / height_m, _TIP_AT * tall)]),
        back_rad=float(np.arctan2(-way[1], -way[0])),
        arm_rad=_arm_heading(segmentation, spots + behind, (begins, ends), camera, height_m),
    )


def _arm_heading(
    segmentation: Segmentation,
    at: Float[np.ndarray, "time 2"],
    frames: tuple[int, int],
    camera: Camera,
    height_m: float,
) -> float | None:
    """Return the heading from the tool's tip to where the arm comes from.

    None where none comes in from the picture's edge.
    """
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


def fit_tool(
    views: Sequence[tuple[Float[np.ndarray, "3"], Silhouette]],
    push: PushMotion,
    noun: Noun,
    size: tuple[float, float, float],
    spread: float,
    height_m: float,
) -> Fit:
    """Return where something long is that a hand pushes with, while the pushed object is where it was at first.

    Its tip touches the pushed object. Its heading, its tilt and its length are searched for.

    Args:
        views: how far the pushed object has gone, and the tool's outline then.
        push: the pushed object's motion.
        noun: the tool's shape.
        size: its usual size, along its own axes [camera heights].
        spread: standard deviation of the logarithm of its length. It may be longer than usual;
            where it seems shorter, the hand or the picture's edge hides the rest.
        height_m: metres per camera height.
    """
    unit, order = outline_points(noun.form, (1.0, 1.0, 1.0), noun.taper), np.argsort(size)[::-1]

    def posed(v: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        sides = np.array(size)
        sides[order[0]] *= np.exp(abs(v[2]))
        level = np.array([np.cos(v[0]), np.sin(v[0]), 0.0])
        along = np.cos(v[1]) * level + np.array([0.0, 0.0, np.sin(v[1])])
        rotation = np.empty((3, 3))
        rotation[:, order[0]] = along
        rotation[:, order[1]] = (-level[1], level[0], 0.0)
        rotation[:, order[2]] = np.cross(along, rotation[:, order[1]])
        rotation[:, order[2]] *= np.sign(np.linalg.det(rotation))
        return sides, transform(rotation, push.tip + along * sides.max() / 2)

    def usual_tilt(log_length: float) -> float:
        high = _GRIP_HEIGHT_M / height_m / (_GRIP_AT * max(size) * np.exp(abs(log_length)))
        return max(float(np.arcsin(min(high, _STEEPEST_SIN))), _LEAST_TILT_RAD)

    def held(v: np.ndarray, T: np.ndarray) -> float:
        tilt = (v[1] - usual_tilt(v[2])) / _TILT_SD_RAD
        turned = _between(v[0], push.back_rad) / _BEHIND_SD_RAD
        # What is far off counts by its logarithm only.
        far = [v[2] / spread]
        if push.arm_rad is not None:
            far.append(_between(v[0], push.arm_rad) / _ARM_SD_RAD)
        return _HABIT_WEIGHT * float(tilt**2 + turned**2 + np.log1p(np.square(far)).sum())

    fitting = Fitting(
        views=views,
        noun=noun,
        posed=posed,
        outline=lambda sides: unit * sides,
        held=held,
    )
    starts = [np.array([turn, usual_tilt(0.0), 0.0]) for turn in np.radians(range(0, 360, 20))]
    return fitting.best(starts, np.array([0.3, 0.1, 0.1]))


def _between(a: float, b: float) -> float:
    """Return the angle between two headings, 0 to pi."""
    return abs(float(np.angle(np.exp(1j * (a - b)))))

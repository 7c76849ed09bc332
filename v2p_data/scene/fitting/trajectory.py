"""Where an object is between its first and its last frame: seen on its way, or in the hand that hides it."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float
from scipy.ndimage import median_filter
from scipy.spatial.transform import Rotation

from v2p_data.geometry.camera import Camera
from v2p_data.geometry.pose import transform
from v2p_data.scene.data_types import Fit, ObjectTrack
from v2p_data.scene.fitting.plans import FitPlan
from v2p_data.scene.fitting.shape_fit import on_wall
from v2p_data.scene.frames.classes import MOVED
from v2p_data.scene.frames.hand import hand_end
from v2p_data.scene.frames.mask_ops import bounding_box, grow
from v2p_data.scene.frames.segmentation import Segmentation, hand_at
from v2p_data.scene.schema import Observed

TOUCH_PX = 5
"""Distance from an outline, in a picture 320 px wide, within which a hand touches the object."""
_SEEN_RISING = 0.5
"""Rise over the object's height in the picture; an object seen to rise less is hidden by the hand that lifts it."""
_LEFT_IN_SIGHT = 0.3
"""Share of the object's area; where more of what moved is in sight at the end, no hand hides the object."""
_TIPS_BESIDE = 7
"""Frames over which the median of a hand's end is taken."""
_JUMP = 0.1
"""Distance from that median, over the picture's width, from which a hand's end is a false one."""
_GOES_WITH_HAND = 0.5
"""Confidence, 0 to 1, of a pose that goes with a hand."""


@dataclass
class Trajectory:
    """Poses in the world frame, growing with time."""

    frames: list[int]
    """Frame numbers of the working clip."""
    poses: list[Float[np.ndarray, "4 4"]]
    sure: list[float]
    """How far to believe each pose, 0 to 1."""
    observed: list[Observed]

    def append(
        self, frame: int, pose: Float[np.ndarray, "4 4"], sure: float, observed: Observed
    ) -> "Trajectory":
        """Return the trajectory with one pose more, unless it has one at that frame."""
        if frame > self.frames[-1]:
            self.frames.append(frame)
            self.poses.append(pose)
            self.sure.append(float(np.clip(sure, 0, 1)))
            self.observed.append(observed)
        return self


def trajectory_between(
    s: ObjectTrack,
    plan: FitPlan,
    first_fit: Fit,
    last_fit: Fit,
    end: tuple[int, Bool[np.ndarray, "h w"]],
    camera: Camera,
    max_poses: int,
) -> Trajectory:
    """Return poses at well-tracked frames: position from the mask's centre, rotation blended."""
    first, last = first_fit.T_world_obj, last_fit.T_world_obj
    last_i, last_mask = end
    depth: Observed = "no_depth" if s.in_hand else "full"
    # What a hand brings has no pose before it comes.
    trajectory = Trajectory([s.at], [first], [float(np.clip(first_fit.iou, 0, 1))], [depth])
    count = min(max_poses, last_i - s.at + 1)
    spots = np.unique(np.linspace(s.at, last_i, count).round().astype(int))
    on_table = plan.slides
    turn = Rotation.from_matrix(last[:3, :3] @ first[:3, :3].T).as_rotvec()
    ends = [_centre(s.first), _centre(last_mask)]
    bias = [
        centre - camera.project(T[None, :3, 3])[0]
        for centre, T in zip(ends, (first, last), strict=True)
    ]
    travel = ends[1] - ends[0]
    for i in spots.tolist()[1:-1]:
        if s.quality[i] < 0.5 or not s.masks[i].any():
            continue
        centre = _centre(s.masks[i])
        share = float(np.clip((centre - ends[0]) @ travel / max(1.0, travel @ travel), 0, 1))
        pixel = centre - (1 - share) * bias[0] - share * bias[1]
        if on_table:
            position = camera.on_plane(pixel[None], float(first[2, 3]))[0]
        else:
            position = on_wall(
                camera, pixel, float((1 - share) * first[0, 3] + share * last[0, 3])
            )
            position[2] = max(position[2], min(first[2, 3], last[2, 3]))
        if not np.isfinite(position).all():
            continue
        rotation = Rotation.from_rotvec(share * turn).as_matrix() @ first[:3, :3]
        free = position[2] > max(first[2, 3], last[2, 3]) + 0.02
        trajectory.append(
            i,
            transform(rotation, position),
            0.7 * float(s.quality[i]),
            "no_depth" if free else depth,
        )
    in_air = plan.end == "in_air" or s.in_hand
    return trajectory.append(last_i, last, last_fit.iou, "no_depth" if in_air else "full")


def peak(s: ObjectTrack) -> int:
    """Return the working frame at which a lift is highest in the picture, among the believable ones.

    Where it is never higher than at first, that is the last believable one: a sleeve hides it from then on.
    """
    n = len(s.masks)
    heights = np.full(n, -np.inf)
    start = _centre(s.first)[1]
    for i in range(n):
        if s.quality[i] >= 0.5 and s.masks[i].any():
            heights[i] = start - _centre(s.masks[i])[1]
    top = heights.max()
    # The end of the clip counts as the peak when it is nearly as high: a hand that holds still trembles.
    near = heights >= 0.93 * top if top > 0 else np.isfinite(heights)
    return int(np.flatnonzero(near)[-1]) if near.any() else n - 1


def carried_by_hand(
    s: ObjectTrack, segmentation: Segmentation
) -> list[tuple[int, Float[np.ndarray, "2"]]]:
    """Return how far the hand moved in the picture since it took hold of a thing that it hides.

    It takes hold where its end stays longest, low and beside the thing. Nothing where the thing
    itself is seen going up, where no hand comes to it, where that hand does not rise, or where in
    the end something that moved is in sight.
    """
    i, (_, _, _, tall) = peak(s), bounding_box(s.first)
    if _centre(s.first)[1] - _centre(s.masks[i])[1] > _SEEN_RISING * tall:
        return []
    home = grow(s.first, TOUCH_PX)
    tips = _tips(segmentation)
    holding = [at for at in tips if (hand_at(segmentation, at) & home).any()]
    if not holding:
        return []
    middle = np.mean([max(tips[at][1] for at in holding), min(tip[1] for tip in tips.values())])
    order = list(tips)

    def haste(at: int) -> float:
        k = order.index(at)
        beside = order[max(0, k - 1) : k + 2]
        way = np.ptp([tips[other] for other in beside], axis=0)
        return float(np.linalg.norm(way)) / max(1, beside[-1] - beside[0])

    grip = min((at for at in holding if tips[at][1] >= middle), key=haste)
    since = [(at, tip - tips[grip]) for at, tip in tips.items() if at > grip]
    risen = [k for k, (_, by) in enumerate(since) if -by[1] > _SEEN_RISING * tall]
    if not risen:
        return []
    since = since[: risen[-1] + 1]
    ending = since[-max(1, len(since) // 3) :]
    in_sight = np.median([(segmentation.at(at)[MOVED] > 0.5).sum() for at, _ in ending])
    return [] if in_sight > _LEFT_IN_SIGHT * s.first.sum() else since


def _tips(segmentation: Segmentation) -> dict[int, Float[np.ndarray, "2"]]:
    """Return where the hand ends, by working frame; a jump is left out as another thing."""
    ends = {at: hand_end(hand_at(segmentation, at)) for at in segmentation.idx.tolist()}
    tips = {at: np.array(end.tip_px) for at, end in ends.items() if end is not None}
    if not tips:
        return {}
    usual = median_filter(np.array(list(tips.values())), (_TIPS_BESIDE, 1), mode="nearest")
    far = _JUMP * segmentation.early.shape[2]
    return {
        at: tip
        for (at, tip), there in zip(tips.items(), usual, strict=True)
        if np.linalg.norm(tip - there) < far
    }


def trajectory_in_hand(
    trajectory: "Trajectory", carried: list[tuple[int, Float[np.ndarray, "2"]]], camera: Camera
) -> "Trajectory":
    """Return the trajectory of what goes with a hand, as far away as it stood."""
    T_first = trajectory.poses[0]
    start = camera.project(T_first[None, :3, 3])[0]
    for i, by in carried:
        position = on_wall(camera, start + by, float(T_first[0, 3]))
        position[2] = max(position[2], T_first[2, 3])
        trajectory.append(i, transform(T_first[:3, :3], position), _GOES_WITH_HAND, "no_depth")
    return trajectory


def _centre(mask: Bool[np.ndarray, "h w"]) -> Float[np.ndarray, "2"]:
    y, x = np.nonzero(mask)
    return np.array([x.mean() + 0.5, y.mean() + 0.5]) if len(x) else np.array([np.nan, np.nan])

"""Where a hand takes hold of a thing, and how wide it opens for it."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

from drawn_clips.props import Prop, wall_m
from drawn_clips.story import GRIP_MAX_M, Actor, handle_offset_m
from v2p_data.geometry.pose import transform

UP = np.array([0.0, 0.0, 1.0])


@dataclass(frozen=True, kw_only=True)
class Grasp:
    """A hold on a thing."""

    T_obj_anchor: Float[np.ndarray, "4 4"]
    """The hand's anchor in the thing's frame: x along the fingers, z from thumb to fingers."""
    width_m: float


def unit(v: Float[np.ndarray, "3"]) -> Float[np.ndarray, "3"]:
    """Return the vector at length one."""
    return v / max(float(np.linalg.norm(v)), 1e-12)


def standing(actor: Actor) -> Float[np.ndarray, "4 4"]:
    """Return the thing's pose as it stands at first."""
    return stood(actor, np.array(actor.xy_m), actor.bottom_m, actor.yaw_rad)


def stood(
    actor: Actor, xy: Float[np.ndarray, "2"], bottom_m: float, yaw_rad: float
) -> Float[np.ndarray, "4 4"]:
    """Return the thing's pose when it stands with its lowest point at a height."""
    c, s = np.cos(yaw_rad), np.sin(yaw_rad)
    R = np.array([[c, -s, 0], [s, c, 0], [0, 0, 1.0]])
    if actor.upside_down:
        R = R @ np.diag([1.0, -1.0, -1.0])
    return transform(R, np.array([*xy, bottom_m + actor.extents_m[2] / 2]))


def frame_of(
    fingers: Float[np.ndarray, "3"], gap: Float[np.ndarray, "3"]
) -> Float[np.ndarray, "3 3"]:
    """Return the rotation with z along `gap` and x as near to `fingers` as that allows."""
    z = unit(gap)
    x = unit(fingers - (fingers @ z) * z)
    return np.stack([x, np.cross(z, x), z], 1)


def grasp_of(actor: Actor, arm: Float[np.ndarray, "3"], left: bool, from_side: bool) -> Grasp:
    """Return how a hand at the end of this arm would hold the thing as it stands.

    Args:
        actor: the thing.
        arm: direction from the hand to the shoulder.
        left: whether it is a left hand.
        from_side: prefer to reach around it rather than down on it, where both can be done.
    """
    p, T = actor.prop, standing(actor)
    R, top = T[:3, :3], T[2, 3] + actor.extents_m[2] / 2
    low = top - actor.extents_m[2]
    high = top - low
    axis = T[:3, 3] + R @ np.array([*handle_offset_m(p), 0.0])
    ahead = unit(-arm * (1, 1, 0))
    down = 0.85 * -UP + 0.5 * ahead
    out = np.cross(UP, ahead) * (1 if left else -1)
    if p.kind == "lid":
        return _held(T, [axis[0], axis[1], top - 0.008], down, _away(out, ahead), 0.034)
    if p.hollow and not actor.upside_down and p.size_m[0] > GRIP_MAX_M:
        return _by_rim(actor, T, axis, ahead, down)
    round_thing = p.kind in ("can", "cup", "mug", "jar", "bottle", "bowl")
    if round_thing and from_side and high > 0.055 and p.kind != "bowl":
        share = 0.4 if actor.upside_down or p.kind in ("bottle", "jar") else 0.55
        z = low + max(0.042, share * high)
        return _held(
            T, [axis[0], axis[1], z], ahead - 0.12 * UP, out, _width(actor, (z - low) / high)
        )
    if round_thing:
        z = top - min(0.022, 0.5 * high)
        if p.kind == "bottle":
            z = top - 0.35 * high
        if p.kind == "bowl":
            z = top - 0.010
        return _held(
            T, [axis[0], axis[1], z], down, _away(out, ahead), _width(actor, (z - low) / high)
        )
    x_wide, y_wide = actor.extents_m[:2]
    own = 0 if x_wide <= y_wide else 1
    if max(x_wide, y_wide) < GRIP_MAX_M:  # both ways fit: the one across the arm
        own = int(abs(R[:, 1] @ ahead) < abs(R[:, 0] @ ahead))
    gap, width = R[:, own], float(actor.extents_m[own])
    if p.kind in ("ball", "duck"):
        gap, width = (
            _away(out, ahead),
            float(min(x_wide, y_wide)) * (0.95 if p.kind == "ball" else 0.6),
        )
        z = low + 0.55 * high if p.kind == "ball" else low + 0.75 * high
        spot = [axis[0], axis[1], max(0.012, z)]
        if p.kind == "duck":
            spot = (T @ [0, -0.24 * p.size_m[1], (z - low) - high / 2, 1])[:3].tolist()
        return _held(T, spot, down, gap, width)
    gap = gap * (1 if gap @ (out + 0.6 * ahead) > 0 else -1)
    if from_side and high > 0.10:
        along = unit(ahead - (ahead @ gap) * gap)
        half = float(np.abs(R[:, :2].T @ along) @ (actor.extents_m[:2] / 2))
        spot = axis - along * max(0.0, half - 0.035)
        return _held(T, [spot[0], spot[1], low + 0.55 * high], along - 0.12 * UP, gap, width)
    return _held(
        T, [axis[0], axis[1], max(low + 0.010, top - min(0.028, 0.55 * high))], down, gap, width
    )


def _away(out: Float[np.ndarray, "3"], ahead: Float[np.ndarray, "3"]) -> Float[np.ndarray, "3"]:
    return unit(0.6 * ahead + 0.8 * out)


def _by_rim(
    actor: Actor,
    T: Float[np.ndarray, "4 4"],
    axis: Float[np.ndarray, "3"],
    ahead: Float[np.ndarray, "3"],
    down: Float[np.ndarray, "3"],
) -> Grasp:
    """Return a pinch of the wall at the side of the arm."""
    p, top = actor.prop, T[2, 3] + actor.extents_m[2] / 2
    inward = ahead
    reach = p.size_m[0] / 2
    if p.kind == "bin":
        sides = T[:3, :3] @ np.array([[1, 0, 0], [-1, 0, 0], [0, 1, 0], [0, -1, 0]]).T
        k = int((sides.T @ ahead).argmax())
        inward, reach = sides[:, k], p.size_m[0 if k < 2 else 1] / 2
    spot = axis - inward * (reach - wall_m(p) / 2)
    return _held(
        T,
        [spot[0], spot[1], top - 0.012 if p.kind != "plate" else top - 0.005],
        down,
        inward,
        wall_m(p) + 0.002,
    )


def _width(actor: Actor, share: float) -> float:
    """Return how wide a round thing is at a share of its height as it stands."""
    p: Prop = actor.prop
    at = 1 - share if actor.upside_down else share
    r = min(p.size_m[:2])
    if p.kind == "cup":
        low = 0.70 + 0.25 * p.shape_draw
        return float(r * (low + (1 - low) * at))
    if p.kind == "bowl":
        return float(r * (0.40 + 0.15 * p.shape_draw + 0.12))
    if p.kind == "bottle" and at > 0.6:
        return float(0.62 * r)
    return float(r)


def _held(
    T: Float[np.ndarray, "4 4"],
    spot: list[float],
    fingers: Float[np.ndarray, "3"],
    gap: Float[np.ndarray, "3"],
    width: float,
) -> Grasp:
    anchor = transform(frame_of(fingers, gap), np.array(spot))
    return Grasp(T_obj_anchor=np.linalg.inv(T) @ anchor, width_m=min(width, GRIP_MAX_M))

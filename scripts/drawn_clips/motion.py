"""How things and hand move in a drawn clip, one plan per kind; nothing passes visibly through anything else."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Int

from drawn_clips.grasp import UP, frame_of, grasp_of, standing, stood, unit
from drawn_clips.hand import WRIST, Hand, Pose, anchor_of, flat, grip, pointing
from drawn_clips.story import Actor, Story
from v2p_data.geometry.pose import transform

GRAVITY = 9.81


@dataclass(frozen=True, kw_only=True)
class Timing:
    """When the hand comes, acts and leaves, in shares of the clip."""

    come: tuple[float, float] = (0.05, 0.25)
    close: tuple[float, float] = (0.26, 0.34)
    act: tuple[float, float] = (0.36, 0.68)
    leave: tuple[float, float] = (0.73, 0.93)
    starts_in_view: bool = False
    stays_in_view: bool = False
    from_side: bool = True
    """Whether the hand prefers to reach around a thing rather than down on it."""
    push: str = "palm"
    """`palm` or `fingers`."""
    brings: bool = False
    """Whether the hand comes with the thing that it puts down, which never stood on the table before."""


@dataclass(frozen=True, kw_only=True)
class Motion:
    """Where everything is in every frame."""

    T_world_things: Float[np.ndarray, "thing time 4 4"]
    T_world_hand: Float[np.ndarray, "time 4 4"]
    arm: Float[np.ndarray, "time 3"]
    """Direction from wrist to shoulder."""
    gesture: Int[np.ndarray, "time"]
    """Which of `gestures` the hand makes."""
    gestures: tuple[Pose, ...]


def ease(t: Float[np.ndarray, "time"], start: float, end: float) -> Float[np.ndarray, "time"]:
    """Return 0 before `start`, 1 after `end`, and a minimum-jerk step between."""
    x = ((t - start) / max(end - start, 1e-6)).clip(0, 1)
    return x**3 * (10 - 15 * x + 6 * x * x)


def animate(
    story: Story, hand: Hand, timing: Timing, seconds: float, fps: int, hide_m: float
) -> Motion:
    """Return the motion of all things and of the hand.

    Args:
        story: who plays.
        hand: whose hand.
        timing: when.
        seconds: how long the clip is.
        fps: frames per second.
        hide_m: how far the hand draws back along its arm to be out of the picture.
    """
    n = round(seconds * fps)
    t = np.arange(n) / (n - 1)
    things = np.stack([np.tile(standing(a), (n, 1, 1)) for a in story.actors])
    arm = unit(np.array(hand.shoulder_m) - things[0, 0, :3, 3])
    plan = {
        "push_left": _push,
        "push_right": _push,
        "push_next_to": _push,
        "slide_to": _push,
        "push_with": _push_with,
        "tip_over": _tip,
    }.get(story.kind, _carry)
    things, anchors, gestures, gesture, aside = plan(story, hand, timing, t, seconds, things, arm)
    T_anchor_hands = np.stack([np.linalg.inv(anchor_of(g, hand)) for g in gestures])

    comes = np.ones(n) if timing.starts_in_view else ease(t, *timing.come)
    goes = ease(t, *timing.leave) * (
        0.0 if timing.stays_in_view or story.kind == "lift_up" else 1.0
    )
    offset = (hide_m * ((1 - comes) + goes))[:, None] * arm + aside
    if story.kind == "push_with":  # the tool comes and goes in the hand
        things[1, :, :3, 3] += offset
    if timing.brings:
        things[0, :, :3, 3] += (hide_m * (1 - comes))[:, None] * arm
    anchors = anchors.copy()
    anchors[:, :3, 3] += offset
    hands = anchors @ T_anchor_hands[gesture]
    shoulder = np.array(hand.shoulder_m) + (hide_m * ((1 - comes) + goes))[:, None] * arm
    wrist = hands[:, :3, 3] + hands[:, :3, :3] @ (WRIST * hand.scale)
    along = shoulder - wrist
    return Motion(
        T_world_things=things,
        T_world_hand=hands,
        arm=along / np.linalg.norm(along, axis=1, keepdims=True),
        gesture=gesture,
        gestures=gestures,
    )


def _carry(story, hand, timing, t, seconds, things, arm):  # noqa: ANN001, ANN202
    """Take hold, carry or lift or throw, let go."""
    a, kind = story.actors[0], story.kind
    a0, a1 = timing.act
    span = a1 - a0
    hold = grasp_of(a, arm, hand.left, timing.from_side)
    start = things[0, 0]
    anchor0 = start @ hold.T_obj_anchor
    target = stood(
        a, np.array(story.target_xy_m), story.target_bottom_m, a.yaw_rad + story.turn_rad
    )
    across = ease(t, a0 + 0.22 * span, a1 - 0.22 * span)
    up, down = ease(t, a0, a0 + 0.4 * span), ease(t, a1 - 0.35 * span, a1)
    up = np.ones(len(t)) if timing.brings else up
    turn = a.yaw_rad + story.turn_rad * across
    xy = np.array(a.xy_m) + across[:, None] * (np.array(story.target_xy_m) - a.xy_m)
    above = anchor0[2, 3] - (
        start[2, 3] - a.extents_m[2] / 2
    )  # of the hold over the thing's lowest point
    release = story.target_bottom_m
    if kind == "insert" and story.actors[1].prop.mouth_m() < 0.17:
        release = max(release, story.actors[1].extents_m[2] + 0.008 - above)
    if kind == "drop_in_front_of":
        release = story.lift_m
    bottom = a.bottom_m + story.lift_m * up - (a.bottom_m + story.lift_m - release) * down
    released = np.zeros(len(t), bool)
    if kind == "lift_up":
        bottom = a.bottom_m + story.lift_m * ease(t, a0, a1)
    elif kind == "throw_into":
        xy, bottom, released = _thrown(story, timing, t, seconds, above)
    else:
        let_go = a1 + 0.015
        released = t >= let_go
        fallen = 0.5 * GRAVITY * ((t - let_go).clip(0) * seconds) ** 2
        bottom = np.where(released, np.maximum(bottom - fallen, story.target_bottom_m), bottom)
        bottom += _bounce(t, let_go, release - story.target_bottom_m, seconds)
    track = np.stack([stood(a, p, b, y) for p, b, y in zip(xy, bottom, turn, strict=True)])
    held = track.copy()
    last = int(np.argmax(released)) if released.any() else len(t)
    if kind == "lift_up":
        tilt = 0.12 * ease(t, a0, a1) * np.sin(2 * np.pi * 0.7 * t)
        for i, angle in enumerate(tilt):
            held[i, :3, :3] = _turned(arm * (1, 1, 0), angle) @ held[i, :3, :3]
        track = held
    if kind == "throw_into" and last < len(t):
        spin = (
            2
            * np.pi
            * ease(t, t[last], t[min(last + max(3, round(0.35 / seconds * len(t))), len(t) - 1)])
        )
        side = np.cross(UP, unit(np.array([*story.target_xy_m, 0.0])))
        for i in range(last, len(t)):
            track[i, :3, :3] = _turned(side, spin[i]) @ track[i, :3, :3]
    if last < len(t):
        through = held[max(last - 1, 0)] - held[max(last - 2, 0)]
        steps = np.arange(len(t) - last + 1)[1:]
        slow = (1 - 0.75**steps) * 3 if kind == "throw_into" else 0 * steps
        held[last:] = held[last - 1]
        held[last:, :3, 3] += slow[:, None] * through[:3, 3]
    things[0] = track
    if kind not in ("lift_up", "throw_into"):
        things[0, -1] = things[0, -2] = target if not (False) else track[-1]
    anchors = held @ hold.T_obj_anchor
    gestures = tuple(grip(min(hold.width_m + extra, 0.105)) for extra in (0.0, 0.014, 0.03))
    closed = np.ones(len(t)) if timing.brings else ease(t, *timing.close)
    closed = closed - (ease(t, a1 + 0.01, a1 + 0.05) if released.any() else 0)
    gesture = np.where(closed > 0.8, 0, np.where(closed > 0.35, 1, 2))
    if timing.starts_in_view and not released[0]:
        gesture = np.where(t < timing.close[1], np.minimum(gesture, 1), gesture)
    fingers = anchor0[:3, 0]
    back = np.maximum(1 - ease(t, timing.come[1] - 0.08, timing.close[0]), 0.0)
    if timing.starts_in_view or timing.brings:
        back = 0 * back
    back = back + (ease(t, a1 + 0.05, a1 + 0.14) if released.any() else 0)
    away = -fingers + (0.0 if fingers[2] < -0.5 else 0.15) * UP
    return things, anchors, gestures, gesture, 0.075 * back[:, None] * away


def _thrown(story, timing, t, seconds, above):  # noqa: ANN001, ANN202
    """Return the way of a thing swung and thrown: places, heights and when it is free."""
    a0, a1 = timing.act
    to, rim = np.array(story.target_xy_m), story.actors[1].extents_m[2]
    flight = 0.30 + 0.12 * story.lift_m
    free_at = a0 + 0.85 * (a1 - a0)
    p0 = np.array([0.0, 0.0, 0.0])
    p1 = np.array([*(0.30 * to), max(rim + 0.03 - above, 0.04) + 0.03])
    p2 = np.array([*to, story.target_bottom_m])
    v1 = (p2 - p1) / flight + np.array([0, 0, GRAVITY * flight / 2])
    swing = 0.38 / seconds
    ready = np.array([*(-0.06 * unit(np.array([*to, 0]))[:2]), 0.6 * p1[2]])
    lifted = ease(t, a0, free_at - swing)[:, None]
    x = ((t - (free_at - swing)) / swing).clip(0, 1)[:, None]
    T = swing * seconds
    swung = ready * (2 * x**3 - 3 * x**2 + 1) + p1 * (3 * x**2 - 2 * x**3) + v1 * T * (x**3 - x**2)
    place = np.where(t[:, None] < free_at - swing, p0 + lifted * (ready - p0), swung)
    tau = ((t - free_at) * seconds).clip(0)[:, None]
    flying = p1 + v1 * tau + np.array([0, 0, -GRAVITY / 2]) * tau**2
    rest = p2 + np.array([0, 0, 0.012]) * np.sin(np.pi * ((tau - flight) / 0.10).clip(0, 1))
    place = np.where(tau > 0, np.where(tau < flight, flying, rest), place)
    place[:, 2] = place[:, 2].clip(0)
    return place[:, :2], place[:, 2], t >= free_at


def _bounce(t, let_go, drop_m, seconds):  # noqa: ANN001, ANN202
    """Return the height of one small rebound after a fall."""
    if drop_m < 0.02:
        return 0 * t
    hits = let_go + np.sqrt(2 * drop_m / GRAVITY) / seconds
    high = 0.06 * drop_m
    lasts = 2 * np.sqrt(2 * high / GRAVITY) / seconds
    x = ((t - hits) / lasts).clip(0, 1)
    return 4 * high * x * (1 - x)


def _push(story, hand, timing, t, seconds, things, arm):  # noqa: ANN001, ANN202
    """Touch the side that looks away from the goal and move along the table."""
    a = story.actors[0]
    a0, a1 = timing.act
    to = np.array(story.target_xy_m)
    far = float(np.linalg.norm(to))
    d = np.array([*to / far, 0.0])
    share = ease(t, a0, a1)
    follows = share
    if story.kind == "slide_to":
        # flicked: even speed-up over 40 % of the way, then friction takes the speed away
        speed = np.sqrt(2 * 0.22 * GRAVITY * 0.6 * far)
        t1, t2 = 0.8 * far / speed, 1.2 * far / speed
        tau = ((t - a0) * seconds).clip(0)
        late = (tau - t1).clip(0, t2)
        gone = np.where(
            tau < t1,
            0.5 * speed / t1 * tau**2,
            0.4 * far + speed * late - 0.5 * speed / t2 * late**2,
        )
        share = gone / far
        follows = np.minimum(share, 0.4 + 0.12 * (1 - np.exp(-(share - 0.4).clip(0) / 0.12)))
    for i, s in enumerate(share):
        things[0, i] = stood(a, s * to, a.bottom_m, a.yaw_rad + story.turn_rad * s)
    touch, R, gestures = _touch(a, d, arm, timing, min(0.5 * a.extents_m[2], 0.06))
    anchors = np.stack([transform(R, touch + d * far * s) for s in follows])
    back = (1 - ease(t, timing.come[1] - 0.02, a0 - 0.01)) * (0.25 if timing.starts_in_view else 1)
    leaves = ease(t, min(a1, 0.9) if story.kind != "slide_to" else a0 + 0.12, a1 + 0.12)
    aside = (0.06 * back + 0.04 * leaves)[:, None] * -d
    return things, anchors, gestures, np.zeros(len(t), int), aside


def _touch(a: Actor, d, arm, timing, high):  # noqa: ANN001, ANN202
    """Return point of contact, the anchor's rotation and the gesture for pushing towards d."""
    R_own = standing(a)[:3, :3]
    half = a.extents_m / 2
    own = R_own.T @ d
    middle = standing(a)[:3, 3]
    flat_on = float(np.abs(own) @ half) if a.prop.symmetry != "round" else float(half[:2].max())
    ray = (
        float(1 / max(np.abs(own[:2]) / half[:2]))
        if a.prop.symmetry != "round"
        else float(half[:2].max())
    )
    if a.prop.kind == "bowl":  # a finger's height is below the rim
        ray *= 0.55 + 0.4 * min(1.0, high / max(a.extents_m[2], 1e-3))
    ahead = unit(-arm * (1, 1, 0))
    if timing.push == "palm" and abs(float(ahead @ d)) < 0.85:
        x = unit(ahead - (ahead @ d) * d)
        at = middle - d * (flat_on + 0.003)
        at[2] = max(0.047, high)
        return at, frame_of(x - 0.1 * UP, -d), (flat(0.12 if a.prop.symmetry != "round" else 0.2),)
    x = unit(0.55 * ahead + 0.45 * d) - 0.75 * UP
    at = middle - d * (ray + 0.0095)
    at[2] = max(0.012, min(high, 0.05))
    back = np.cross(x, np.cross(UP, x))
    return at, frame_of(x, back), (pointing(),)


def _tip(story, hand, timing, t, seconds, things, arm):  # noqa: ANN001, ANN202
    """Push high up until it falls over its lower edge."""
    a = story.actors[0]
    R0, half = standing(a)[:3, :3], a.extents_m / 2
    sign = 1 if float(R0[:, 0] @ arm) < 0 else -1
    d = unit(R0[:, 0] * sign * (1, 1, 0))
    axis = np.cross(UP, d)
    a0, a1 = timing.act
    x = ((t - a0) / (a1 - a0)).clip(0, 1)
    angle = np.pi / 2 * (0.32 * x + 0.68 * x**4)
    corner = things[0, 0, :3, 3] + d * half[0] - UP * half[2]
    arm_of = things[0, 0, :3, 3] - corner
    turns = np.stack([_turned(axis, w) for w in angle])
    things[0, :, :3, 3] = corner + turns @ arm_of
    things[0, :, :3, :3] = turns @ R0
    touch, R, gestures = _touch(a, d, arm, timing, 0.06)
    touch[2] = max(0.05, 0.80 * a.extents_m[2])
    if a.prop.kind == "bottle":
        touch[2] = 0.5 * a.extents_m[2]
    followed = np.minimum(angle, 0.55)
    turns = np.stack([_turned(axis, w) for w in followed])
    places = corner + turns @ (touch - corner)
    lean = np.stack([_turned(axis, 0.5 * w) for w in followed])
    anchors = np.stack([transform(q @ R, p) for q, p in zip(lean, places, strict=True)])
    back = (1 - ease(t, timing.come[1] - 0.02, a0 - 0.01)) + ease(t, a1 - 0.08, a1 + 0.08)
    return things, anchors, gestures, np.zeros(len(t), int), 0.05 * back[:, None] * -d


def _push_with(story, hand, timing, t, seconds, things, arm):  # noqa: ANN001, ANN202
    """Hold a long tool near its end and push with its other end."""
    a, tool = story.actors[:2]
    to = np.array(story.target_xy_m)
    far = float(np.linalg.norm(to))
    d = np.array([*to / far, 0.0])
    share = ease(t, *timing.act)
    for i, s in enumerate(share):
        things[0, i] = stood(a, s * to, a.bottom_m, a.yaw_rad)
    size = tool.extents_m
    tilt = float(np.clip(np.arcsin(min(0.95, 0.085 / (0.7 * size[1]))), 0.35, 0.95))
    ahead = unit(-arm * (1, 1, 0))
    level = unit(ahead + 0.25 * d) if float(ahead @ d) > -0.2 else unit(ahead + 1.0 * d)
    along = np.cos(tilt) * level - np.sin(tilt) * UP
    y = -along
    z = unit(UP - (UP @ y) * y)
    R = np.stack([np.cross(y, z), y, z], 1)
    at, _, _ = _touch(a, d, arm, Timing(push="fingers"), 0.0)
    # the finger's radius is replaced by what the tool's end reaches towards the thing
    sideways = float(np.abs(R.T @ d)[[0, 2]] @ (size[[0, 2]] / 2))
    at = at + d * 0.0095 - d * (sideways + 0.0015)
    at[2] = float(np.clip(0.35 * a.extents_m[2], 0.006, 0.03)) + float(
        np.abs(R[2, [0, 2]]) @ (size[[0, 2]] / 2)
    )
    centre = at - along * size[1] / 2
    back = (1 - ease(t, timing.come[1] - 0.02, timing.act[0] - 0.01)) * (
        0.4 if timing.starts_in_view else 1
    )
    leaves = ease(t, timing.act[1] + 0.01, timing.act[1] + 0.12)
    aside = (0.07 * back + 0.05 * leaves)[:, None] * -d + 0.02 * (back + leaves)[:, None] * UP
    tools = np.stack([transform(R, centre + d * far * s) for s in share])
    things[1] = tools
    thin = 0 if size[0] <= size[2] else 2
    gap = (
        R[:, 2]
        if thin == 2
        else R[:, 0] * (1 if (R[:, 0] @ np.cross(UP, ahead) > 0) == hand.left else -1)
    )
    T_obj_anchor = np.linalg.inv(transform(R, centre)) @ transform(
        frame_of(along, gap), centre - along * 0.22 * size[1]
    )
    width = float(size[thin]) if tool.prop.kind == "stick" else 0.010
    return things, tools @ T_obj_anchor, (grip(width),), np.zeros(len(t), int), aside


def _turned(axis: Float[np.ndarray, "3"], angle: float) -> Float[np.ndarray, "3 3"]:
    """Return the rotation about an axis (Rodrigues)."""
    x, y, z = unit(axis)
    K = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
    return np.eye(3) + np.sin(angle) * K + (1 - np.cos(angle)) * K @ K

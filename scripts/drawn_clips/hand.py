"""A hand with a smooth skin: finger bones placed by inverse kinematics, blended into one surface.

Hand frame: origin in the middle of the palm's surface, x along the fingers, y to the thumb's side of a right hand,
z out of the hand's back. A left hand is the mirror image in y.
"""

from dataclasses import dataclass
from functools import cache, lru_cache
from typing import Literal

import numpy as np
from jaxtyping import Float

from drawn_clips.shapes import Shape, blended, patch_uv
from drawn_clips.textures import Rgb
from v2p_data.geometry.pose import transform

WRIST = np.array([-0.058, 0.0, 0.014])
_KNUCKLES = np.array(
    [[0.043, 0.031, 0.012], [0.046, 0.010, 0.014], [0.043, -0.011, 0.013], [0.035, -0.030, 0.010]]
)
_FINGER = np.array([0.043, 0.027, 0.020])
_LONG = (0.95, 1.05, 1.0, 0.80)
_THICK = (0.0086, 0.0088, 0.0084, 0.0074)
_THUMB_BASE = np.array([-0.018, 0.030, 0.000])
_THUMB = (0.048, 0.060)
_THUMB_R = 0.0100
_STEP_M = 0.0038


@dataclass(frozen=True, kw_only=True)
class Hand:
    """Whose hand it is and where it comes from."""

    left: bool = False
    scale: float = 1.0
    skin: Rgb = (0.80, 0.58, 0.46)
    sleeve: Rgb | None = (0.25, 0.30, 0.42)
    """None for a bare arm."""
    sleeve_print: Literal["plain", "stripes", "checker"] = "plain"
    cuff_m: float = 0.06
    """From the wrist to where the sleeve begins."""
    shoulder_m: tuple[float, float, float] = (-0.5, -0.4, 0.4)
    """Towards where the arm goes."""


@dataclass(frozen=True, kw_only=True)
class Pose:
    """One pose of the fingers."""

    bones: tuple[tuple[Float[np.ndarray, "3"], Float[np.ndarray, "3"], float, float], ...]
    """Capsules: from, to, radius at each end."""
    T_hand_anchor: Float[np.ndarray, "4 4"]
    """Where the hand touches: x along the fingers, z from thumb to fingers or out of the back."""


@lru_cache(maxsize=64)
def grip(width_m: float) -> Pose:
    """Return thumb and fingers around something this wide."""
    low, high = -0.08, 0.075
    pose, _ = _grip_at(low, width_m)
    for _ in range(14):  # the higher the finger tips the wider the gap
        middle = (low + high) / 2
        pose, gap = _grip_at(middle, width_m)
        low, high = (middle, high) if gap < width_m else (low, middle)
    return pose


def flat(curl: float = 0.15) -> Pose:
    """Return an open hand that pushes with its palm."""
    bones = [b for f in range(4) for b in _finger(f, 0.10 + curl * (0.6 + 0.2 * f), 1.3 * curl)]
    tip = np.array([0.045, 0.070, 0.004])
    anchor = transform(np.eye(3), np.array([0.02, 0.0, -0.001]))
    return Pose(bones=(*bones, *_thumb(tip)), T_hand_anchor=anchor)


def pointing() -> Pose:
    """Return two fingers stretched out, the others curled."""
    bones = [b for f in (0, 1) for b in _finger(f, 0.12, 0.25)]
    bones += [b for f in (2, 3) for b in _finger(f, 1.15, 1.5)]
    tip = (bones[2][1] + bones[5][1]) / 2
    thumb = _thumb(np.array([0.055, 0.004, -0.040]))
    return Pose(bones=(*bones, *thumb), T_hand_anchor=transform(np.eye(3), tip))


def skin_of(pose: Pose, hand: Hand) -> Shape:
    """Return the hand's surface in its frame, scaled and mirrored."""
    a = np.array([b[0] for b in pose.bones])
    ends = np.concatenate([a, [b[1] for b in pose.bones], [WRIST]])
    low, high = ends.min(0) - 0.022, ends.max(0) + 0.022
    low[0] = min(low[0], WRIST[0] - 0.03)

    def distance(p: Float[np.ndarray, "n 3"]) -> Float[np.ndarray, "n"]:
        palm = _palm(p)
        fingers = np.full(len(p), 1.0)
        for start, end, r0, r1 in pose.bones:
            box_low, box_high = np.minimum(start, end) - 0.03, np.maximum(start, end) + 0.03
            near = ((p > box_low) & (p < box_high)).all(1)
            d = _capsule(p[near], start, end, r0, r1)
            fingers[near] = _smooth_min(fingers[near], d, 0.0022)
        return _smooth_min(palm, fingers, 0.009)

    vertices, faces = blended(distance, low.tolist(), high.tolist(), _STEP_M)
    uv = patch_uv(0, (vertices[:, :2] - low[:2]) / (high - low)[:2])
    vertices = vertices * hand.scale
    if hand.left:
        vertices, faces = vertices * (1, -1, 1), faces[:, ::-1]
    return Shape(vertices=vertices, uv=uv, faces=faces)


def anchor_of(pose: Pose, hand: Hand) -> Float[np.ndarray, "4 4"]:
    """Return `T_hand_anchor` for this hand's size and side."""
    T = pose.T_hand_anchor.copy()
    T[:3, 3] *= hand.scale
    if hand.left:
        mirror = np.diag([1.0, -1.0, 1.0])
        T[:3, :3], T[:3, 3] = mirror @ T[:3, :3] @ mirror, mirror @ T[:3, 3]
    return T


def _grip_at(tip_z: float, width: float) -> tuple[Pose, float]:
    bones, pads = [], []
    for f in range(4):
        reach = (0.083 - 0.10 * max(0.0, 0.03 - tip_z)) * _LONG[f]
        down = float(np.clip(_KNUCKLES[f, 2] - tip_z, -0.075, 0.075))
        angle, bend = _reaching(reach, down, _LONG[f])
        mine = _finger(f, angle, bend)
        bones += mine
        pads.append(mine[2][1])
    fingers = (pads[0] + pads[1]) / 2
    wish = np.array([fingers[0] - 0.010, 0.016, fingers[2] - width - 0.018])
    along = wish - _THUMB_BASE
    along *= min(1.0, 0.100 / float(np.linalg.norm(along)))
    tip = _THUMB_BASE + along
    axis = fingers - tip
    gap = float(np.linalg.norm(axis)) - _THUMB_R * 0.9 - 0.0078
    z = axis / np.linalg.norm(axis)
    x = np.array([1.0, 0, 0]) - z[0] * z
    x /= np.linalg.norm(x)
    T = transform(np.stack([x, np.cross(z, x), z], 1), (tip + z * (_THUMB_R * 0.9 + gap / 2)))
    return Pose(bones=(*bones, *_thumb(tip)), T_hand_anchor=T), gap


def _reaching(reach: float, down: float, scale: float) -> tuple[float, float]:
    """Return first angle and bend of a finger whose tip lies `reach` away and `down` below its knuckle."""
    bends, tips, far = _bent(scale)
    k = int(np.abs(far - reach).argmin())
    want = np.arcsin(np.clip(down / far[k], -0.95, 0.95))
    return float(want - np.arctan2(tips[k, 1], tips[k, 0])), float(bends[k])


@cache
def _bent(scale: float) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return bends of a finger, and where its tip lies and how far away."""
    bends = np.linspace(0.05, 1.9, 60)
    tips = np.stack([_links(0.0, b, scale)[-1] for b in bends])
    return bends, tips, np.linalg.norm(tips, axis=1)


def _links(angle: float, bend: float, scale: float) -> Float[np.ndarray, "4 2"]:
    """Return knuckle, joints and tip in the finger's plane: (forward, down)."""
    at, points = np.zeros(2), [np.zeros(2)]
    for length, a in zip(_FINGER * scale, np.cumsum([angle, bend, 0.55 * bend]), strict=True):
        at = at + length * np.array([np.cos(a), np.sin(a)])
        points.append(at)
    return np.array(points)


def _finger(
    f: int, angle: float, bend: float
) -> list[tuple[np.ndarray, np.ndarray, float, float]]:
    plane = _links(angle, bend, _LONG[f])
    splay = 0.10 * (1.3 - f)
    joints = _KNUCKLES[f] + np.stack([plane[:, 0], splay * plane[:, 0], -plane[:, 1]], 1)
    r = _THICK[f] * np.array([1.08, 1.0, 0.92, 0.84])
    return [(joints[i], joints[i + 1], float(r[i]), float(r[i + 1])) for i in range(3)]


def _thumb(tip: Float[np.ndarray, "3"]) -> list[tuple[np.ndarray, np.ndarray, float, float]]:
    along = tip - _THUMB_BASE
    d = float(np.linalg.norm(along))
    a, b = _THUMB
    forward = (a * a - b * b + d * d) / (2 * d)
    out = np.sqrt(max(a * a - forward * forward, 0.0))
    bulge = np.array([0.2, 1.0, -0.1])
    bulge = bulge - along * (bulge @ along) / d**2
    bulge /= np.linalg.norm(bulge)
    elbow = _THUMB_BASE + along * forward / d + out * bulge
    middle = elbow + 0.55 * (tip - elbow) + 0.003 * bulge
    root = np.array([-0.045, 0.012, 0.008])
    return [
        (root, _THUMB_BASE, 0.017, 0.015),
        (_THUMB_BASE, elbow, 0.0145, 0.0115),
        (elbow, middle, 0.0112, 0.0104),
        (middle, tip, 0.0104, 0.0090),
    ]


def _palm(p: Float[np.ndarray, "n 3"]) -> Float[np.ndarray, "n"]:
    """Return the distance to a rounded slab that narrows to the wrist, and the wrist."""
    centre, half, r = np.array([-0.004, 0.0, 0.013]), np.array([0.040, 0.029, 0.003]), 0.011
    q = p - centre
    wide = half[1] + 0.10 * q[:, 0].clip(-0.05, 0.05)
    over = np.stack(
        [np.abs(q[:, 0]) - half[0], np.abs(q[:, 1]) - wide, np.abs(q[:, 2]) - half[2]], 1
    )
    slab = np.linalg.norm(over.clip(0), axis=1) + over.max(1).clip(max=0) - r
    flat_p = p * (1, 0.75, 1)
    wrist = _capsule(
        flat_p, WRIST - np.array([0.035, 0, 0]), WRIST + np.array([0.03, 0, 0]), 0.0195, 0.0195
    )
    return _smooth_min(slab, wrist, 0.015)


def _capsule(
    p: Float[np.ndarray, "n 3"], a: np.ndarray, b: np.ndarray, r0: float, r1: float
) -> Float[np.ndarray, "n"]:
    ab = b - a
    t = ((p - a) @ ab / max(float(ab @ ab), 1e-12)).clip(0, 1)
    return np.linalg.norm(p - a - t[:, None] * ab, axis=1) - (r0 + (r1 - r0) * t)


def _smooth_min(
    a: Float[np.ndarray, "n"], b: Float[np.ndarray, "n"], k: float
) -> Float[np.ndarray, "n"]:
    h = (k - np.abs(a - b)).clip(0) / k
    return np.minimum(a, b) - h * h * k / 4

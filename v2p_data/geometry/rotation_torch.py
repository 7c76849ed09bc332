"""Quaternion arithmetic for many worlds on torch tensors of any device. Worlds come first.

Quaternions are `wxyz` unit quaternions of shape (n, 4), rotation vectors (n, 3) [rad]. `rotation` has the same
functions for numpy, with worlds last.
"""

import math

import torch
from jaxtyping import Float

Quats = Float[torch.Tensor, "n 4"]


def product(a: Quats, b: Quats) -> Quats:
    """Return the quaternion products `a b`: the rotation `b`, then `a`."""
    w1, x1, y1, z1 = a.unbind(1)
    w2, x2, y2, z2 = b.unbind(1)
    return torch.stack(
        [
            w1 * w2 - x1 * x2 - y1 * y2 - z1 * z2,
            w1 * x2 + x1 * w2 + y1 * z2 - z1 * y2,
            w1 * y2 - x1 * z2 + y1 * w2 + z1 * x2,
            w1 * z2 + x1 * y2 - y1 * x2 + z1 * w2,
        ],
        dim=1,
    )


def exp(rotvec: Float[torch.Tensor, "n 3"]) -> Quats:
    """Return the quaternions of rotation vectors [rad]."""
    half = rotvec.norm(dim=1, keepdim=True) / 2
    return torch.cat([half.cos(), 0.5 * torch.sinc(half / torch.pi) * rotvec], dim=1)


def matrices(quat_wxyz: Float[torch.Tensor, "*batch 4"]) -> Float[torch.Tensor, "*batch 3 3"]:
    """Return the rotation matrices of unit quaternions."""
    w, x, y, z = quat_wxyz.unbind(-1)
    rows = (
        (1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)),
        (2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)),
        (2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)),
    )
    return torch.stack([torch.stack(row, dim=-1) for row in rows], dim=-2)


def limited_to(quat: Quats, anchor: Quats, limit_rad: float) -> Quats:
    """Return `quat`, turned back towards `anchor` where the angle between them exceeds the limit; normalised.

    The angle comes from the sine: in float32 the arc cosine is off by 0.03 degrees near zero.
    """
    quat = quat / quat.norm(dim=1, keepdim=True)
    dot = (quat * anchor).sum(1, keepdim=True)
    near = quat * torch.where(dot < 0, -1.0, 1.0)
    half = torch.atan2((near - anchor * dot.abs()).norm(dim=1, keepdim=True), dot.abs())
    part = limit_rad / 2
    sine = half.sin().clamp_min(1e-6)
    back = ((half - part).sin() * anchor + math.sin(part) * near) / sine
    return torch.where(half > part, back, quat)


def tilt_limited(quat: Quats, limit_rad: float) -> Quats:
    """Return `quat`, leaned back where its z axis is further than the limit from straight down."""
    w, x, y, z = quat.unbind(1)
    axis_x, axis_y = 2 * (x * z + w * y), 2 * (y * z - w * x)
    axis_z = 1 - 2 * (x * x + y * y)
    level = torch.hypot(axis_x, axis_y)
    over = torch.atan2(level, -axis_z) - limit_rad
    back = torch.stack([-axis_y, axis_x, torch.zeros_like(axis_x)], dim=1)
    back = back / level.clamp_min(1e-12)[:, None]
    leaned = product(exp(back * over.clamp_min(0)[:, None]), quat)
    return torch.where((over > 0)[:, None], leaned, quat)

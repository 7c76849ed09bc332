"""Quaternion arithmetic for many worlds in numpy. Worlds come last, along which numpy is fastest.

Quaternions are `wxyz` unit quaternions of shape (4, n), rotation vectors (3, n) [rad].
"""

import numpy as np
from jaxtyping import Float


def product(a: Float[np.ndarray, "4 n"], b: Float[np.ndarray, "4 n"]) -> Float[np.ndarray, "4 n"]:
    """Return the quaternion products `a b`: the rotation `b`, then `a`."""
    p = a[:, None] * b
    out = np.empty_like(b)
    out[0] = p[0, 0] - p[1, 1] - p[2, 2] - p[3, 3]
    out[1] = p[0, 1] + p[1, 0] + p[2, 3] - p[3, 2]
    out[2] = p[0, 2] - p[1, 3] + p[2, 0] + p[3, 1]
    out[3] = p[0, 3] + p[1, 2] - p[2, 1] + p[3, 0]
    return out


def conjugates(quat: Float[np.ndarray, "4 n"]) -> Float[np.ndarray, "4 n"]:
    """Return the inverse rotations."""
    return quat * np.array([[1.0], [-1.0], [-1.0], [-1.0]])


def exp(rotvec: Float[np.ndarray, "3 n"]) -> Float[np.ndarray, "4 n"]:
    """Return the quaternions of rotation vectors [rad]."""
    half = 0.5 * np.sqrt(dot(rotvec, rotvec))
    tangent = np.tan(0.5 * half)  # numpy's sine and cosine take ten times as long
    scale = 1.0 / (1.0 + tangent * tangent)
    out = np.empty((4, rotvec.shape[1]))
    out[0] = (1.0 - tangent * tangent) * scale
    out[1:] = rotvec * (tangent * scale / np.maximum(half, 1e-12))
    return out


def dot(a: Float[np.ndarray, "k n"], b: Float[np.ndarray, "k n"]) -> Float[np.ndarray, "n"]:
    """Return the inner products of columns; a column's result does not depend on the number of columns."""
    if a.shape[1] == 1:  # einsum rounds a single column in another way
        return dot(np.repeat(a, 2, axis=1), np.repeat(b, 2, axis=1))[:1]
    return np.einsum("kn,kn->n", a, b)


def matrices(quat_wxyz: Float[np.ndarray, "*batch 4 n"]) -> Float[np.ndarray, "*batch 3 3 n"]:
    """Return the rotation matrices of unit quaternions."""
    twice = 2 * quat_wxyz
    wx, wy, wz = np.moveaxis(quat_wxyz[..., :1, :] * twice[..., 1:, :], -2, 0)
    xx, xy, xz = np.moveaxis(quat_wxyz[..., 1:2, :] * twice[..., 1:, :], -2, 0)
    yy, yz = np.moveaxis(quat_wxyz[..., 2:3, :] * twice[..., 2:, :], -2, 0)
    zz = quat_wxyz[..., 3, :] * twice[..., 3, :]
    out = np.empty((*quat_wxyz.shape[:-2], 3, 3, quat_wxyz.shape[-1]), quat_wxyz.dtype)
    out[..., 0, 0, :] = 1 - (yy + zz)
    out[..., 0, 1, :] = xy - wz
    out[..., 0, 2, :] = xz + wy
    out[..., 1, 0, :] = xy + wz
    out[..., 1, 1, :] = 1 - (xx + zz)
    out[..., 1, 2, :] = yz - wx
    out[..., 2, 0, :] = xz - wy
    out[..., 2, 1, :] = yz + wx
    out[..., 2, 2, :] = 1 - (xx + yy)
    return out


def quats_about_z(yaw_rad: Float[np.ndarray, "n"]) -> Float[np.ndarray, "4 n"]:
    """Return the rotations about +z."""
    zero = np.zeros_like(yaw_rad)
    return np.stack([np.cos(yaw_rad / 2), zero, zero, np.sin(yaw_rad / 2)])


def quats_pointing_down(yaw_rad: Float[np.ndarray, "n"]) -> Float[np.ndarray, "4 n"]:
    """Return the orientations whose z axis is straight down, turned about the vertical from `(0, 1, 0, 0)`."""
    zero = np.zeros_like(yaw_rad)
    return np.stack([zero, np.cos(yaw_rad / 2), np.sin(yaw_rad / 2), zero])


def rotvec_from_down(quat_wxyz: Float[np.ndarray, "4 n"]) -> Float[np.ndarray, "3 n"]:
    """Return the rotation vectors of `R_down^T R`, where `R_down` is `(0, 1, 0, 0)`; their angle is at most pi."""
    w, x, y, z = quat_wxyz
    return log(np.stack([x, -w, z, -y]))  # conj(0, 1, 0, 0) * quat


def quats_from_down(rotvec: Float[np.ndarray, "3 n"]) -> Float[np.ndarray, "4 n"]:
    """Return the quaternions whose `rotvec_from_down` are these [rad]."""
    w, x, y, z = exp(rotvec)
    return np.stack([-x, w, -z, y])


def log(quat_wxyz: Float[np.ndarray, "4 n"]) -> Float[np.ndarray, "3 n"]:
    """Return the rotation vectors of quaternions [rad]; their angle is at most pi."""
    relative = np.array(quat_wxyz.T, order="C")
    relative *= np.where(relative[:, :1] < 0, -1.0, 1.0)
    sine = np.linalg.norm(relative[:, 1:], axis=1, keepdims=True)
    angle = 2 * np.arctan2(sine, relative[:, :1])
    return (relative[:, 1:] * np.where(sine < 1e-9, 2.0, angle / np.maximum(sine, 1e-12))).T


def limited_to(
    quat: Float[np.ndarray, "4 n"], anchor: Float[np.ndarray, "4 n"], limit_rad: float
) -> Float[np.ndarray, "4 n"]:
    """Return `quat`, turned back towards `anchor` where the angle between them exceeds the limit; normalised."""
    quat = quat / np.sqrt(dot(quat, quat))
    cosine = dot(quat, anchor)
    far = np.flatnonzero(np.abs(cosine) < np.cos(limit_rad / 2))
    if len(far):
        a, b = np.take(anchor, far, axis=1), np.take(quat, far, axis=1) * np.sign(cosine[far])
        half = np.arccos(np.clip(np.abs(cosine[far]), 0, 1))
        part = limit_rad / 2
        quat[:, far] = (np.sin(half - part) * a + np.sin(part) * b) / np.sin(half)
    return quat


def tilt_limited(quat: Float[np.ndarray, "4 n"], limit_rad: float) -> Float[np.ndarray, "4 n"]:
    """Return `quat`, leaned back where its z axis is further than the limit from straight down. May write to it."""
    w, x, y, z = quat
    axis_z = 1 - 2 * (x * x + y * y)
    far = np.flatnonzero(-axis_z < np.cos(limit_rad))
    if len(far):
        w, x, y, z = leaning = np.take(quat, far, axis=1)
        # The axis crossed with (0, 0, -1); its length is the sine of the tilt.
        back = np.zeros((3, len(far)))
        back[0] = 2 * (w * x - y * z)
        back[1] = 2 * (x * z + w * y)
        over = np.arccos(np.clip(-axis_z[far], -1, 1)) - limit_rad
        back *= over / np.maximum(np.sqrt(dot(back, back)), 1e-12)
        quat[:, far] = product(exp(back), leaning)
    return quat

"""Rigid transforms as 4 x 4 matrices and poses as position + `quat_wxyz`."""

import numpy as np
from jaxtyping import Float
from scipy.spatial.transform import Rotation


def transform(
    rotation: Float[np.ndarray, "3 3"], position: Float[np.ndarray, "3"]
) -> Float[np.ndarray, "4 4"]:
    """Return `T` with the given rotation matrix and translation [m]."""
    T = np.eye(4)
    T[:3, :3] = rotation
    T[:3, 3] = position
    return T


def inverse(T: Float[np.ndarray, "4 4"]) -> Float[np.ndarray, "4 4"]:
    """Return the inverse of a rigid transform."""
    R = T[:3, :3]
    return transform(R.T, -R.T @ T[:3, 3])


def apply(
    T: Float[np.ndarray, "4 4"], points: Float[np.ndarray, "n 3"]
) -> Float[np.ndarray, "n 3"]:
    """Return `points` taken through `T`."""
    return points @ T[:3, :3].T + T[:3, 3]


def matrix_from_quat(quat_wxyz: Float[np.ndarray, "4"]) -> Float[np.ndarray, "3 3"]:
    """Return the rotation matrix of a quaternion, which need not be normalised."""
    return Rotation.from_quat(quat_wxyz, scalar_first=True).as_matrix()


def quat_from_matrix(rotation: Float[np.ndarray, "3 3"]) -> Float[np.ndarray, "4"]:
    """Return `quat_wxyz` with w >= 0."""
    return Rotation.from_matrix(rotation).as_quat(canonical=True, scalar_first=True)


def pose_from_transform(T: Float[np.ndarray, "4 4"]) -> Float[np.ndarray, "7"]:
    """Return `[x, y, z, qw, qx, qy, qz]`."""
    return np.concatenate([T[:3, 3], quat_from_matrix(T[:3, :3])])


def transform_from_pose(pose: Float[np.ndarray, "7"]) -> Float[np.ndarray, "4 4"]:
    """Return `T` of a pose `[x, y, z, qw, qx, qy, qz]`."""
    return transform(matrix_from_quat(pose[3:]), pose[:3])


def angle_between(a: Float[np.ndarray, "3 3"], b: Float[np.ndarray, "3 3"]) -> float:
    """Return the geodesic angle between two rotations [rad]."""
    return float(Rotation.from_matrix(a.T @ b).magnitude())

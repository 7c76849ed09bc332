"""Laws of rigid transforms; MuJoCo, which also writes quaternions `wxyz`, computes every pose anew."""

import mujoco
import numpy as np
import pytest

from v2p_data.geometry.pose import (
    angle_between,
    apply,
    inverse,
    matrix_from_quat,
    pose_from_transform,
    quat_from_matrix,
    transform_from_pose,
)


def mujoco_matrix(quat_wxyz) -> np.ndarray:
    found = np.zeros(9)
    mujoco.mju_quat2Mat(found, np.asarray(quat_wxyz, float))
    return found.reshape(3, 3)


def mujoco_pose(T) -> tuple[np.ndarray, np.ndarray]:
    quat = np.zeros(4)
    mujoco.mju_mat2Quat(quat, T[:3, :3].ravel())
    return T[:3, 3].copy(), quat


def same_up_to_sign(a, b) -> bool:
    return np.allclose(a, b) or np.allclose(a, -np.asarray(b))


def test_points_go_where_mujoco_takes_them(rng, draw_transform):
    T, points = draw_transform(rng), rng.normal(size=(5, 3))
    position, quat = mujoco_pose(T)

    moved = apply(T, points)

    for point, there in zip(points, moved, strict=True):
        expected = np.zeros(3)
        mujoco.mju_trnVecPose(expected, position, quat, point)
        np.testing.assert_allclose(there, expected, atol=1e-12)


def test_the_inverse_is_that_of_the_matrix_and_of_mujoco(rng, draw_transform):
    T = draw_transform(rng)
    position, quat = np.zeros(3), np.zeros(4)
    mujoco.mju_negPose(position, quat, *mujoco_pose(T))

    found = inverse(T)

    np.testing.assert_allclose(found, np.linalg.inv(T), atol=1e-12)
    np.testing.assert_allclose(found[:3, 3], position, atol=1e-12)
    np.testing.assert_allclose(found[:3, :3], mujoco_matrix(quat), atol=1e-12)
    np.testing.assert_allclose(found @ T, np.eye(4), atol=1e-12)
    np.testing.assert_allclose(inverse(found), T, atol=1e-12)


def test_the_first_number_of_a_quaternion_is_its_scalar(rng):
    quat = rng.normal(size=4)
    unit = quat / np.linalg.norm(quat)

    np.testing.assert_allclose(matrix_from_quat(unit), mujoco_matrix(unit), atol=1e-12)
    np.testing.assert_allclose(matrix_from_quat(3 * quat), mujoco_matrix(unit), atol=1e-12)
    np.testing.assert_allclose(matrix_from_quat(-unit), mujoco_matrix(unit), atol=1e-12)
    np.testing.assert_allclose(matrix_from_quat(np.array([1.0, 0, 0, 0])), np.eye(3))


def test_a_quaternion_comes_back_from_its_matrix_with_a_scalar_that_is_not_negative(rng):
    quat = rng.normal(size=4)
    unit = quat / np.linalg.norm(quat)

    found = quat_from_matrix(mujoco_matrix(unit))

    assert found[0] >= 0
    np.testing.assert_allclose(found, unit if unit[0] >= 0 else -unit, atol=1e-9)


def test_a_pose_is_where_and_then_how_turned(rng, draw_transform):
    T = draw_transform(rng)
    position, quat = mujoco_pose(T)

    pose = pose_from_transform(T)

    np.testing.assert_allclose(pose[:3], position)
    assert same_up_to_sign(pose[3:], quat)
    np.testing.assert_allclose(transform_from_pose(pose), T, atol=1e-12)
    np.testing.assert_allclose(
        transform_from_pose(np.concatenate([position, quat])), T, atol=1e-12
    )


def test_the_angle_between_two_rotations_is_the_turn_that_leads_from_one_to_the_other(
    rng, draw_transform
):
    A, axis = draw_transform(rng)[:3, :3], rng.normal(size=3)
    turn = rng.uniform(0.01, np.pi - 0.01)
    quat = np.zeros(4)
    mujoco.mju_axisAngle2Quat(quat, axis / np.linalg.norm(axis), turn)
    B = A @ mujoco_matrix(quat)

    assert angle_between(A, B) == pytest.approx(turn)
    assert angle_between(B, A) == pytest.approx(turn)
    assert angle_between(A, A) == pytest.approx(0, abs=1e-7)
    common = draw_transform(rng)[:3, :3]
    assert angle_between(common @ A, common @ B) == pytest.approx(turn)

"""Axioms of rotations, with worlds last; scipy is the independent oracle."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from v2p_data.geometry import rotation
from v2p_data.seeds import rng_for

N = 200


def random_quats(name: str) -> np.ndarray:
    quat = rng_for(0, "rotations", name).normal(size=(4, N))
    return quat / np.linalg.norm(quat, axis=0)


def random_rotvecs(name: str, longest_rad: float = 3.0) -> np.ndarray:
    rng = rng_for(0, "rotation-vectors", name)
    way = rng.normal(size=(3, N))
    return way / np.linalg.norm(way, axis=0) * rng.uniform(0, longest_rad, N)


def scipy_of(quat: np.ndarray) -> Rotation:
    return Rotation.from_quat(quat.T, scalar_first=True)


def angle_between(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """Return the angle between rotations; `q` and `-q` are the same one."""
    return (scipy_of(a).inv() * scipy_of(b)).magnitude()


def test_products_and_matrices_are_those_of_scipy():
    a, b = random_quats("a"), random_quats("b")

    matrices = np.moveaxis(rotation.matrices(a), -1, 0)

    np.testing.assert_allclose(matrices, scipy_of(a).as_matrix(), atol=1e-12)
    out, wanted = rotation.product(a, b), (scipy_of(a) * scipy_of(b)).as_quat(scalar_first=True).T
    np.testing.assert_allclose(out * np.sign((out * wanted).sum(0)), wanted, atol=1e-12)


def test_exp_is_that_of_scipy_and_its_inverse_turns_back():
    rotvec = random_rotvecs("a")

    out = rotation.exp(rotvec)

    np.testing.assert_allclose(scipy_of(out).as_rotvec().T, rotvec, atol=1e-9)
    np.testing.assert_allclose(rotation.exp(-rotvec), rotation.conjugates(out), atol=1e-12)


def test_no_rotation_is_the_identity():
    np.testing.assert_array_equal(rotation.exp(np.zeros((3, 2)))[:, 0], [1, 0, 0, 0])


def test_a_limited_rotation_is_within_its_limit_and_stays_where_it_was_within():
    anchor = random_quats("anchor")
    near = rotation.product(rotation.exp(random_rotvecs("near", 0.45)), anchor)
    far = rotation.product(rotation.exp(random_rotvecs("far", 3.0)), anchor)

    np.testing.assert_allclose(rotation.limited_to(near, anchor, 0.5), near, atol=1e-9)
    assert angle_between(rotation.limited_to(far, anchor, 0.5), anchor).max() < 0.5 + 1e-6


def test_a_tilt_is_limited_without_turning_about_another_axis():
    yaw = rng_for(0, "yaws").uniform(-3, 3, N)
    leaning = rotation.product(
        rotation.exp(random_rotvecs("lean", 1.2)), rotation.quats_pointing_down(yaw)
    )

    out = rotation.tilt_limited(leaning.copy(), 0.35)

    down = -rotation.matrices(out)[2, 2]
    before = -rotation.matrices(leaning)[2, 2]
    assert np.arccos(np.clip(down, -1, 1)).max() < 0.35 + 1e-6
    leaned_back = np.maximum(np.arccos(np.clip(before, -1, 1)) - 0.35, 0)
    np.testing.assert_allclose(angle_between(leaning, out), leaned_back, atol=1e-6)


def test_pointing_down_is_a_rotation_vector_about_the_tool_axis():
    yaw = rng_for(0, "yaws").uniform(-3, 3, N)

    out = rotation.rotvec_from_down(rotation.quats_pointing_down(yaw))

    np.testing.assert_allclose(out, np.stack([0 * yaw, 0 * yaw, -yaw]), atol=1e-12)


@pytest.mark.parametrize("past_pi", [-1e-3, -1e-9, 1e-9, 1e-3])
def test_a_rotation_vector_near_pi_is_that_of_scipy_whatever_the_quaternions_sign(past_pi):
    quat = rotation.quats_pointing_down(np.array([np.pi + past_pi, -np.pi - past_pi]))
    down = Rotation.from_quat((0, 1, 0, 0), scalar_first=True)

    out = rotation.rotvec_from_down(quat)

    np.testing.assert_allclose(out.T, (down.inv() * scipy_of(quat)).as_rotvec(), atol=1e-12)
    np.testing.assert_array_equal(rotation.rotvec_from_down(-quat), out)


def test_a_yaw_is_a_rotation_vector_about_z():
    yaw = rng_for(0, "yaws").uniform(-3, 3, N)

    out = scipy_of(rotation.quats_about_z(yaw)).as_rotvec()

    np.testing.assert_allclose(out.T, np.stack([0 * yaw, 0 * yaw, yaw]), atol=1e-12)


def test_a_column_does_not_depend_on_how_many_there_are():
    rotvec = random_rotvecs("a")

    np.testing.assert_array_equal(rotation.exp(rotvec)[:, :1], rotation.exp(rotvec[:, :1]))

"""Boxes are turned and as high as they look; tests ask the real weights about boxes that are drawn here."""

import itertools

import cv2
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from v2p_data.geometry.pose import transform
from v2p_data.scene.fitting.cuboid_network import CuboidGuess, aim_at, cuboid_guess
from v2p_data.scene.fitting.silhouette import camera_above

SHAPE, PITCH_RAD, FOV_RAD = (240, 320), 0.6, 0.9
COLOURS = ((200, 60, 50), (150, 40, 35), (230, 110, 90))


def turned(yaw_rad: float) -> np.ndarray:
    return Rotation.from_euler("z", yaw_rad).as_matrix()


def drawn(size, T, camera):
    """Return a picture of a box with one colour per pair of faces, and its outline."""
    rgb = np.full((*SHAPE, 3), (120, 118, 110), np.uint8)
    mask = np.zeros(SHAPE, np.uint8)
    eye = T[:3, :3].T @ (camera.T_world_cam[:3, 3] - T[:3, 3])
    half = np.array(size) / 2
    for axis, side in itertools.product(range(3), (-1, 1)):
        if side * eye[axis] <= half[axis]:
            continue
        a, b = (k for k in range(3) if k != axis)
        corners = np.zeros((4, 3))
        corners[:, axis] = side * half[axis]
        corners[:, a] = half[a] * np.array([-1, 1, 1, -1])
        corners[:, b] = half[b] * np.array([-1, -1, 1, 1])
        px = camera.project(corners @ T[:3, :3].T + T[:3, 3])
        points = ((px - 0.5) * 16).round().astype(np.int32)
        cv2.fillConvexPoly(rgb, points, COLOURS[axis], cv2.LINE_AA, 4)
        cv2.fillConvexPoly(mask, points, 1, cv2.LINE_8, 4)
    return cv2.GaussianBlur(rgb, (0, 0), 0.7), mask > 0


def standing(size, yaw_rad, x=1.4, y=0.1):
    return transform(turned(yaw_rad), np.array([x, y, size[2] / 2]))


GUESS = CuboidGuess(
    azimuth_rad=0.1,
    fourfold=(8 * np.cos(4 * 0.4), 8 * np.sin(4 * 0.4)),
    twofold=(0.7 * np.cos(2 * 0.4), 0.7 * np.sin(2 * 0.4)),
    twofold_sd=0.15,
    height=0.2,
    height_sd=0.2,
)
WIDE = (0.2 * np.exp(0.7), 0.2, 0.2 * np.exp(0.35 + 0.2))


def test_what_the_network_says_costs_nothing_and_half_a_turn_is_the_same():
    for yaw in (0.5, 0.5 + np.pi):
        assert GUESS.cost(WIDE, standing(WIDE, yaw)) == pytest.approx(0, abs=1e-6)


def test_turns_swapped_sides_and_other_heights_cost():
    other_axes = (WIDE[1], WIDE[0], WIDE[2])
    flat = (WIDE[0], WIDE[1], 0.3 * WIDE[2])

    assert GUESS.cost(other_axes, standing(other_axes, 0.5 + np.pi / 2)) == pytest.approx(
        0, abs=1e-6
    )
    assert GUESS.cost(WIDE, standing(WIDE, 0.5 + np.pi / 2)) > 5
    assert GUESS.cost(WIDE, standing(WIDE, 0.5 + 0.4)) > 5
    assert GUESS.cost(flat, standing(flat, 0.5)) > 3


def test_a_tilted_box_is_not_judged():
    tilted = Rotation.from_euler("xz", [0.5, 2.0]).as_matrix()

    assert GUESS.cost(WIDE, transform(tilted, np.array([1, 0, 0.3]))) == 0


def test_the_camera_that_looks_straight_at_an_outline_sees_it_in_its_middle():
    camera = camera_above(SHAPE, PITCH_RAD, FOV_RAD)
    T = standing((0.2, 0.2, 0.2), 0.3, x=1.6, y=0.5)
    _, mask = drawn((0.2, 0.2, 0.2), T, camera)

    aim = aim_at(mask, camera, 80, 1.45)
    seen = cv2.warpPerspective(mask.astype(np.float32), aim.H, (80, 80)) > 0.5
    y, x = np.nonzero(seen)

    assert max(np.ptp(x), np.ptp(y)) + 1 == pytest.approx(80 / 1.45, abs=2)
    assert (x.min() + x.max() + 1) / 2 == pytest.approx(40, abs=1.5)
    assert aim.azimuth_rad == pytest.approx(np.arctan2(0.5, 1.6), abs=0.02)
    assert aim.below_rad == pytest.approx(np.arctan2(0.9, np.hypot(1.6, 0.5)), abs=0.03)


@pytest.mark.parametrize("yaw_deg", [-60, -25, 10, 40, 65])
def test_a_cube_s_yaw_is_seen_by_its_faces(yaw_deg):
    camera = camera_above(SHAPE, PITCH_RAD, FOV_RAD)
    size, yaw = (0.2, 0.2, 0.2), np.radians(yaw_deg)
    rgb, mask = drawn(size, standing(size, yaw), camera)

    guess = cuboid_guess(rgb, mask, camera)

    right = guess.cost(size, standing(size, yaw))
    for off in (20, 45, 70):
        assert guess.cost(size, standing(size, yaw + np.radians(off))) > right + 2


@pytest.mark.parametrize("yaw_deg", [-50, 15, 45])
def test_the_longer_side_is_seen(yaw_deg):
    camera = camera_above(SHAPE, PITCH_RAD, FOV_RAD)
    size, yaw = (0.3, 0.15, 0.12), np.radians(yaw_deg)
    rgb, mask = drawn(size, standing(size, yaw), camera)

    guess = cuboid_guess(rgb, mask, camera)

    across = standing(size, yaw + np.pi / 2)
    assert guess.cost(size, standing(size, yaw)) + 3 < guess.cost(size, across)

"""The robot's drawn mask against the simulator's own, from joint angles alone."""

from dataclasses import replace

import numpy as np

from v2p_data.deployment.robot import fingers_m
from v2p_data.deployment.silhouette import Silhouette
from v2p_data.scene.frames.mask_ops import iou
from v2p_data.sim.render.masks import ROBOT, rgb_to_labels


def drawn(robot, camera):
    return Silhouette(camera).draw(robot.joints(), fingers_m(robot.opening()))


def test_the_silhouette_is_the_robots_true_mask(blind_robot, restarted):
    restarted(blind_robot, seed=3)

    mask = drawn(blind_robot, blind_robot.calibration())

    true = rgb_to_labels(blind_robot.arm.mask()) == ROBOT
    assert true.sum() > 2000
    assert iou(mask, true) > 0.99


def test_a_moved_principal_point_moves_the_silhouette(blind_robot, restarted):
    restarted(blind_robot)
    camera = blind_robot.calibration()
    K = camera.K + np.array([[0, 0, 7.0], [0, 0, -4.0], [0, 0, 0]])

    moved = drawn(blind_robot, replace(camera, K=K))

    still = drawn(blind_robot, camera)
    assert iou(moved[:-4, 7:], still[4:, :-7]) > 0.999


def test_a_wider_pixel_narrows_the_silhouette(blind_robot, restarted):
    restarted(blind_robot)
    camera = blind_robot.calibration()
    K = camera.K.copy()
    K[0, 0] /= 2

    narrow = drawn(blind_robot, replace(camera, K=K))

    # What was seen across the whole width now fills its middle half.
    still = drawn(blind_robot, camera)
    assert iou(narrow[:, 64:192], still[:, ::2]) > 0.95

"""What the box network is told of a box is what the picture shows of it."""

import cv2
import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation

from v2p_data.geometry.mesh import outline_points
from v2p_data.geometry.pose import apply, transform
from v2p_data.scene.fitting.silhouette import camera_above

EXTENTS = np.array([0.3, 0.15, 0.1])


@pytest.fixture(scope="module")
def trainer(load_script):
    return load_script("train_box_network")


def seen(trainer, yaw_rad, y=0.4):
    """Return what is kept of a box at (1.5, y) on the table."""
    camera = camera_above((360, 480), 0.6, 0.9)
    rotation = Rotation.from_euler("z", yaw_rad).as_matrix()
    T = transform(rotation, np.array([1.5, y, EXTENTS[2] / 2]))
    corners = camera.project(apply(T, outline_points("box", (0.3, 0.15, 0.1))))
    outline = np.zeros((360, 480), np.uint8)
    cv2.fillConvexPoly(outline, cv2.convexHull(corners.round().astype(np.int32)), 1)
    rgb = np.full((360, 480, 3), 90, np.uint8)
    return trainer._row(camera, T, EXTENTS, rgb, outline > 0)


def test_yaws_count_from_the_line_of_sight(trainer):
    row = seen(trainer, 0.5)

    assert row["truth"][0] == pytest.approx(0.5 - np.arctan2(0.4, 1.5), abs=0.02)
    assert row["truth"][1] == pytest.approx(np.log(2), abs=1e-4)
    assert row["truth"][2] == pytest.approx(np.log(0.1 / np.sqrt(0.3 * 0.15)), abs=1e-4)
    assert row["known"][0] == pytest.approx(np.arctan2(0.95, np.hypot(1.5, 0.4)), abs=0.02)


def test_nothing_is_likelier_than_the_truth(trainer):
    yaw, ratio, height = 0.4, 0.7, -0.3
    truth = torch.tensor([[yaw, ratio, height]])

    def loss(yaw, ratio, height):
        said = [8 * np.cos(4 * yaw), 8 * np.sin(4 * yaw)]
        said += [ratio * np.cos(2 * yaw), ratio * np.sin(2 * yaw), -2.0, height, -2.0]
        return float(trainer.loss_of(torch.tensor([said], dtype=torch.float32), truth))

    least = loss(yaw, ratio, height)
    assert loss(yaw + np.pi, ratio, height) == pytest.approx(least, abs=1e-4)
    assert loss(yaw + np.pi / 2, -ratio, height) == pytest.approx(least, abs=1e-4)
    for other in (
        (yaw + 0.3, ratio, height),
        (yaw, -ratio, height),
        (yaw, ratio + 0.3, height),
        (yaw, ratio, height + 0.3),
    ):
        assert loss(*other) > least + 0.3


def test_examples_are_changed_in_ways_that_keep_them_true(trainer):
    row = seen(trainer, 0.5)
    scene = {key: value[None] for key, value in row.items()}
    rng = np.random.default_rng(0)

    yaws = set()
    for _ in range(20):
        planes, known, truth = trainer.varied(scene, 0, rng)
        assert planes.shape == (6, 80, 80)
        assert np.isfinite(planes).all()
        assert 0.1 < planes[3].mean() < 0.7
        assert truth[1:] == pytest.approx(row["truth"][1:], abs=1e-5)
        assert known[1] == row["known"][1]
        yaws.add(round(float(truth[0]), 4))
    assert yaws == {round(float(sign * row["truth"][0]), 4) for sign in (1, -1)}

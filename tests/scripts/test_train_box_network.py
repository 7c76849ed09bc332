"""What the box network is told of a box is what the picture shows of it."""

import cv2
import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation

from drawn_clips.clips import random_spec
from v2p_data.geometry.mesh import outline_points
from v2p_data.geometry.pose import apply, transform
from v2p_data.scene.fitting.silhouette import camera_above
from v2p_data.seeds import rng_for

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


def test_the_same_box_seen_from_the_same_side_looks_the_same_wherever_it_stands(trainer):
    """Turned with the line of sight it is seen as before, but for its distance."""
    left, right = (seen(trainer, np.arctan2(y, 1.5) + 0.3, y) for y in (0.4, -0.4))

    a, b = left["mask"] > 127, right["mask"] > 127
    assert (a & b).sum() / (a | b).sum() > 0.95


def test_a_tilted_or_hidden_box_is_left_out(trainer):
    camera = camera_above((360, 480), 0.6, 0.9)
    tilted = transform(Rotation.from_euler("x", 0.3).as_matrix(), np.array([1.5, 0, 0.1]))
    outline = np.zeros((360, 480), bool)
    outline[150:200, 200:280] = True
    rgb = np.zeros((360, 480, 3), np.uint8)

    assert trainer._row(camera, tilted, EXTENTS, rgb, outline) is None
    level = transform(np.eye(3), np.array([1.5, 0, 0.05]))
    outline[155:] = False
    assert trainer._row(camera, level, EXTENTS, rgb, outline) is None


def test_ducks_and_oval_bottles_are_learned_beside_boxes_and_round_bottles_are_not(trainer):
    kinds = set()
    for number in range(60):
        rng = rng_for(number, "box network")
        spec = random_spec(f"clip{number}", "push_left", rng, 4)
        for k, actor in enumerate(spec.story.actors):
            prop, learned = actor.prop, k in trainer._boxes(spec)
            assert learned == (prop.kind in trainer.BOXES or trainer._is_along(prop))
            if prop.kind in trainer.ALONG:
                assert learned == (len({round(s, 6) for s in prop.size_m[:2]}) == 2)
                kinds.add((prop.kind, learned))
    assert {("duck", True), ("bottle", True), ("bottle", False)} <= kinds


def test_a_duck_fills_less_of_its_box(trainer):
    camera = camera_above((360, 480), 0.6, 0.9)
    T = transform(np.eye(3), np.array([1.5, 0.4, EXTENTS[2] / 2]))
    corners = camera.project(apply(T, outline_points("box", (0.3, 0.15, 0.1))))
    middle = corners.mean(0)
    half = np.zeros((360, 480), np.uint8)
    inner = cv2.convexHull((middle + 0.7 * (corners - middle)).round().astype(np.int32))
    cv2.fillConvexPoly(half, inner, 1)
    rgb = np.full((360, 480, 3), 90, np.uint8)

    assert trainer._row(camera, T, EXTENTS, rgb, half > 0) is None
    assert trainer._row(camera, T, EXTENTS, rgb, half > 0, trainer.SHARE_OF_BOX) is not None


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

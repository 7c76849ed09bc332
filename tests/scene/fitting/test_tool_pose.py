"""A block is pushed over a table with a stick; the hand hides the stick's upper third."""

from dataclasses import replace

import cv2
import numpy as np
import pytest

from v2p_data.geometry.mesh import outline_points
from v2p_data.geometry.pose import transform
from v2p_data.scene.data_types import Fit
from v2p_data.scene.fitting.shape_fit import three
from v2p_data.scene.fitting.silhouette import Silhouette, camera_above
from v2p_data.scene.fitting.tool_pose import Pushed, PushMotion, fit_tool_pose, push_motion
from v2p_data.scene.fitting.trajectory import Trajectory
from v2p_data.scene.frames.classes import CLASSES, HAND
from v2p_data.scene.frames.segmentation import Segmentation
from v2p_data.scene.scale.camera_height import SeenCamera
from v2p_data.scene.scale.nouns import noun_for

H, W, HEIGHT_M, FRAMES = 240, 320, 0.5, 20
STICK = noun_for("stick")
CAMERA = camera_above((H, W), 0.61, 1.01)
SIDE = 0.1
"""Of the block, in camera heights."""
FROM, TO = np.array([1.2, 0.25]), np.array([1.3, -0.15])


def block() -> tuple[Trajectory, Fit]:
    """Return the block's poses: it moves in frames 5 to 15."""
    poses = [
        transform(np.eye(3), np.array([*(FROM + share * (TO - FROM)), SIDE / 2]))
        for share in np.clip((np.arange(FRAMES) - 5) / 10, 0, 1)
    ]
    fit = Fit(size=(SIDE, SIDE, SIDE), T_world_obj=poses[0], iou=0.9, visible=1.0, cost=0.1)
    return Trajectory(list(range(FRAMES)), poses, [1.0] * FRAMES, ["full"] * FRAMES), fit


def arm_from(spot: np.ndarray) -> Segmentation:
    """Return what the network sees of an arm that comes in from the picture's edge to a spot of the table."""
    tip = CAMERA.project(spot[None])[0].round().astype(int)
    hand = np.zeros((H, W), np.uint8)
    cv2.line(hand, (0, int(tip[1])), tuple(int(v) for v in tip), 1, 25)
    shares = np.zeros((FRAMES, len(CLASSES), H, W), np.float32)
    shares[:, HAND] = hand
    camera = SeenCamera(
        pitch_rad=0.6, pitch_sd_rad=0.1, focal_widths=0.9, table_width_m=0.6, table_width_sd=0.2
    )
    return Segmentation(
        idx=np.arange(FRAMES), shares=shares, early=shares[0], late=shares[-1], camera=camera
    )


def pushed(segmentation: Segmentation | None = None) -> PushMotion:
    trajectory, fit = block()
    return push_motion(
        Pushed(trajectory=trajectory, fit=fit, form="box"),
        FRAMES,
        np.zeros(2),
        CAMERA,
        HEIGHT_M,
        segmentation,
    )


def stick(
    push: PushMotion, yaw: float, tilt: float, longer: float
) -> tuple[np.ndarray, tuple[float, float, float]]:
    """Return the stick's pose when the block is where it was at first, and its size."""
    size = np.array(STICK.size_m) / HEIGHT_M * (longer, 1, 1)
    tip = np.array([*(push.spots[0] + push.behind), push.tip_height])
    level = np.array([np.cos(yaw), np.sin(yaw), 0])
    along = np.cos(tilt) * level + np.array([0, 0, np.sin(tilt)])
    side = np.cross([0, 0, 1], level)
    R = np.stack([along, side, np.cross(along, side)], 1)
    return transform(R, tip + along * size[0] / 2), three(size)


def seen(T: np.ndarray, size: tuple[float, float, float], shift: np.ndarray) -> Silhouette:
    """Return the outline of the stick as far as a hand leaves it free."""
    points = outline_points("box", size) @ T[:3, :3].T + T[:3, 3] + [*shift, 0]
    mask = np.zeros((H * 8, W * 8), np.uint8)
    cv2.fillConvexPoly(mask, cv2.convexHull((CAMERA.project(points) * 8).astype(np.int32)), 1)
    whole = cv2.resize(mask, (W, H), interpolation=cv2.INTER_AREA) > 0
    grip = CAMERA.project((T[:3, 3] + 0.35 * size[0] * T[:3, 0] + [*shift, 0])[None])[0]
    hand = np.zeros((H, W), np.uint8)
    cv2.circle(hand, grip.round().astype(int).tolist(), 11, 1, -1)
    return Silhouette(whole & (hand == 0), hand > 0, CAMERA)


def test_a_push_begins_and_ends_with_the_motion_and_comes_from_behind():
    push = pushed(arm_from(np.array([0.9, 0.5, 0.1])))

    assert push.frames == (5, 15)
    np.testing.assert_allclose(push.way, (TO - FROM) / np.linalg.norm(TO - FROM), atol=1e-6)
    assert push.behind @ push.way == pytest.approx(-SIDE / 2 * np.abs(push.way).sum())
    assert push.arm_rad is not None
    assert np.sin(push.arm_rad) > 0.5  # from the left


def test_what_goes_nowhere_is_pushed_from_where_the_tool_is():
    trajectory, fit = block()
    still = replace(trajectory, poses=[trajectory.poses[0]] * FRAMES)

    push = push_motion(
        Pushed(trajectory=still, fit=fit, form="box"),
        FRAMES,
        FROM - [0.4, 0],
        CAMERA,
        HEIGHT_M,
        None,
    )

    assert push.frames == (0, FRAMES - 1)
    np.testing.assert_allclose(push.way, [1, 0], atol=1e-6)
    assert push.arm_rad is None


@pytest.mark.parametrize(("longer", "yaw", "tilt"), [(1.0, 2.4, 0.6), (1.3, 1.2, 0.4)])
def test_a_stick_is_found_tip_down_behind_the_block_with_the_length_that_is_seen(
    longer, yaw, tilt
):
    push = pushed()
    T, size = stick(push, yaw, tilt, longer)
    views = [(i, seen(T, size, push.spots[i] - push.spots[0])) for i in (5, 10, 15)]

    held = fit_tool_pose(
        views, push, STICK, three(np.array(STICK.size_m) / HEIGHT_M), STICK.spread
    )

    assert float(held.fit.T_world_obj[:3, 0] @ T[:3, 0]) > np.cos(np.radians(15))
    assert held.fit.size[0] == pytest.approx(size[0], rel=0.15)
    np.testing.assert_allclose(held.fit.T_world_obj[:3, 3], T[:3, 3], atol=0.07)
    np.testing.assert_allclose(held.T_world_seen, held.fit.T_world_obj, atol=1e-9)
    assert held.fit.iou > 0.6


def test_what_is_seen_only_before_it_pushes_is_put_behind_the_block_with_the_same_turn():
    """It is seen 8 cm away from there."""
    push = pushed()
    T, size = stick(push, 2.4, 0.5, 1.0)
    away = np.array([-0.05, 0.15])

    held = fit_tool_pose([(2, seen(T, size, away))], push, STICK, size, STICK.spread)

    tip = held.fit.T_world_obj[:3, 3] - held.fit.T_world_obj[:3, 0] * held.fit.size[0] / 2
    np.testing.assert_allclose(tip[:2], FROM + push.behind, atol=1e-6)
    np.testing.assert_allclose(held.T_world_seen[:3, 3], T[:3, 3] + [*away, 0], atol=0.1)
    assert float(held.fit.T_world_obj[:3, 0] @ T[:3, 0]) > np.cos(np.radians(30))

"""A block is pushed over a table with a stick; the hand hides the stick's upper third."""

import cv2
import numpy as np
import pytest

from v2p_data.geometry.mesh import outline_points
from v2p_data.geometry.pose import transform
from v2p_data.scene.data_types import Fit, ObjectTrack, PlacedObject
from v2p_data.scene.fitting.shape_fit import three
from v2p_data.scene.fitting.silhouette import Silhouette, camera_above
from v2p_data.scene.fitting.tool_pose import PushMotion, fit_tool, push_motion
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


def block(*, still: bool = False) -> PlacedObject:
    """Return the block with its poses: it moves in frames 5 to 15."""
    poses = np.stack(
        [
            transform(np.eye(3), np.array([*(FROM + share * (TO - FROM)), SIDE / 2]))
            for share in np.clip((np.arange(FRAMES) - 5) / 10, 0, 0 if still else 1)
        ]
    )
    fit = Fit(size=(SIDE, SIDE, SIDE), T_world_obj=poses[0], iou=0.9, visible=1.0, cost=0.1)
    nothing = np.zeros((H, W), bool)
    return PlacedObject(
        first=fit,
        last=fit,
        last_i=FRAMES - 1,
        last_mask=nothing,
        hidden=nothing,
        last_hidden=nothing,
        frames=tuple(range(FRAMES)),
        T_world_objs=poses,
        confidences=(1.0,) * FRAMES,
        observed=("full",) * FRAMES,
        rival=None,
    )


def arm_from(spot: np.ndarray | None) -> Segmentation:
    """Return what the network sees of an arm that reaches from the picture's edge to a spot, or of none."""
    hand = np.zeros((H, W), np.uint8)
    if spot is not None:
        tip = CAMERA.project(spot[None])[0].round().astype(int)
        cv2.line(hand, (0, int(tip[1])), tuple(int(v) for v in tip), 1, 25)
    shares = np.zeros((FRAMES, len(CLASSES), H, W), np.float32)
    shares[:, HAND] = hand
    camera = SeenCamera(
        pitch_rad=0.6, pitch_sd_rad=0.1, focal_widths=0.9, table_width_m=0.6, table_width_sd=0.2
    )
    return Segmentation(
        idx=np.arange(FRAMES), shares=shares, early=shares[0], late=shares[-1], camera=camera
    )


def pushed(
    arm_at: np.ndarray | None = None, tool_xy: np.ndarray = FROM, *, still: bool = False
) -> PushMotion:
    masks = np.zeros((FRAMES, H, W), bool)
    u, v = CAMERA.project(np.array([[*tool_xy, 0.0]]))[0].round().astype(int)
    masks[:, v - 1 : v + 2, u - 1 : u + 2] = True
    tool = ObjectTrack(
        phrase="stick",
        role="tool",
        noun=STICK,
        masks=masks,
        quality=np.ones(FRAMES),
        moves=True,
        at=0,
        known_m=None,
        sure=1.0,
        why="",
    )
    return push_motion(block(still=still), "box", tool, CAMERA, HEIGHT_M, arm_from(arm_at))


def stick(
    push: PushMotion, yaw: float, tilt: float, longer: float
) -> tuple[np.ndarray, tuple[float, float, float]]:
    """Return the stick's pose when the block is where it was at first, and its size."""
    size = np.array(STICK.size_m) / HEIGHT_M * (longer, 1, 1)
    level = np.array([np.cos(yaw), np.sin(yaw), 0])
    along = np.cos(tilt) * level + np.array([0, 0, np.sin(tilt)])
    side = np.cross([0, 0, 1], level)
    R = np.stack([along, side, np.cross(along, side)], 1)
    return transform(R, push.tip + along * size[0] / 2), three(size)


def seen(T: np.ndarray, size: tuple[float, float, float], gone: np.ndarray) -> Silhouette:
    """Return the outline of the stick as far as a hand leaves it free."""
    points = outline_points("box", size) @ T[:3, :3].T + T[:3, 3] + gone
    mask = np.zeros((H * 8, W * 8), np.uint8)
    cv2.fillConvexPoly(mask, cv2.convexHull((CAMERA.project(points) * 8).astype(np.int32)), 1)
    whole = cv2.resize(mask, (W, H), interpolation=cv2.INTER_AREA) > 0
    grip = CAMERA.project((T[:3, 3] + 0.35 * size[0] * T[:3, 0] + gone)[None])[0]
    hand = np.zeros((H, W), np.uint8)
    cv2.circle(hand, grip.round().astype(int).tolist(), 11, 1, -1)
    return Silhouette(whole & (hand == 0), hand > 0, CAMERA)


def test_a_push_begins_and_ends_with_the_motion_and_comes_from_behind():
    push = pushed(np.array([0.9, 0.5, 0.1]))

    assert push.frames == (5, 15)
    way = (TO - FROM) / np.linalg.norm(TO - FROM)
    assert push.back_rad == pytest.approx(np.arctan2(*(-way[::-1])))
    assert (push.tip[:2] - FROM) @ way == pytest.approx(-SIDE / 2 * np.abs(way).sum())
    assert push.arm_rad is not None
    assert np.sin(push.arm_rad) > 0.5  # from the left


def test_what_goes_nowhere_is_pushed_from_where_the_tool_is():
    push = pushed(tool_xy=FROM - [0.4, 0], still=True)

    assert push.frames == (0, FRAMES - 1)
    assert abs(push.back_rad) == pytest.approx(np.pi, abs=0.02)
    assert push.arm_rad is None


@pytest.mark.parametrize(("longer", "yaw", "tilt"), [(1.0, 2.4, 0.6), (1.3, 1.2, 0.4)])
def test_a_stick_is_found_tip_down_behind_the_block_with_the_length_that_is_seen(
    longer, yaw, tilt
):
    push = pushed()
    T, size = stick(push, yaw, tilt, longer)
    views = [(push.gone[i], seen(T, size, push.gone[i])) for i in (5, 10, 15)]

    usual = three(np.array(STICK.size_m) / HEIGHT_M)

    held = fit_tool(views, push, STICK, usual, STICK.spread, HEIGHT_M)

    assert float(held.T_world_obj[:3, 0] @ T[:3, 0]) > np.cos(np.radians(15))
    assert held.size[0] == pytest.approx(size[0], rel=0.15)
    np.testing.assert_allclose(held.T_world_obj[:3, 3], T[:3, 3], atol=0.07)
    assert held.iou > 0.6

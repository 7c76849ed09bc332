"""Laws of the pinhole camera; OpenCV projects and resizes, MuJoCo frames its cameras, as oracles."""

from dataclasses import replace

import cv2
import mujoco
import numpy as np
import pytest

from v2p_data.geometry.camera import (
    Camera,
    between_centres,
    intrinsics,
    look_at,
    mujoco_xyaxes,
    poses_over_table,
)
from v2p_data.geometry.pose import apply, transform

WIDTH_PX, HEIGHT_PX, FOVY_RAD = 64, 48, 0.9


@pytest.fixture
def camera(rng, draw_transform) -> Camera:
    """Of no symmetry: the principal point off the middle, pixels that are not square."""
    K = np.array([[70.0, 0, 20], [0, 90, 33], [0, 0, 1]])
    return Camera(width_px=WIDTH_PX, height_px=HEIGHT_PX, K=K, T_world_cam=draw_transform(rng))


@pytest.fixture
def seen_points(rng, camera) -> np.ndarray:
    """In the world, before the camera."""
    in_camera = np.c_[rng.uniform(-1, 1, (7, 2)), rng.uniform(0.5, 4, 7)]
    return apply(camera.T_world_cam, in_camera)


def test_points_are_projected_as_opencv_does(camera, seen_points):
    T_cam_world = np.linalg.inv(camera.T_world_cam)
    rotation, _ = cv2.Rodrigues(T_cam_world[:3, :3])
    expected, _ = cv2.projectPoints(
        seen_points, rotation, T_cam_world[:3, 3], camera.K, np.zeros(4)
    )

    np.testing.assert_allclose(camera.project(seen_points), expected[:, 0], atol=1e-6)


def test_a_point_behind_the_camera_has_no_pixel(camera):
    behind = apply(camera.T_world_cam, np.array([[0.1, 0.2, -1.0], [0.1, 0.2, 1.0]]))

    found = camera.project(behind)

    assert np.isnan(found[0]).all()
    assert np.isfinite(found[1]).all()


def test_the_ray_through_a_points_pixel_leads_to_the_point(camera, seen_points):
    rays = camera.rays_world(camera.project(seen_points))

    ways = seen_points - camera.T_world_cam[:3, 3]
    np.testing.assert_allclose(np.linalg.norm(rays, axis=1), 1)
    np.testing.assert_allclose(rays, ways / np.linalg.norm(ways, axis=1)[:, None], atol=1e-9)


@pytest.mark.parametrize("height_m", [-0.2, 0.0, 0.3])
def test_points_of_a_plane_are_found_again_from_their_pixels(rng, height_m: float):
    eye = np.array([*rng.uniform(-0.5, 0.5, 2), rng.uniform(0.5, 1.0)])
    camera = Camera(
        width_px=WIDTH_PX,
        height_px=HEIGHT_PX,
        K=intrinsics(WIDTH_PX, HEIGHT_PX, FOVY_RAD),
        T_world_cam=look_at(eye, np.array([0.8, 0.1, height_m])),
    )
    points = np.c_[rng.uniform([0.6, -0.2], [1.0, 0.4], (6, 2)), np.full(6, height_m)]

    found = camera.on_plane(camera.project(points), height_m)

    np.testing.assert_allclose(found, points, atol=1e-9)


def test_a_pixel_above_the_horizon_meets_no_table():
    level = look_at(np.array([0.0, 0, 0.5]), np.array([1.0, 0, 0.5]))
    camera = Camera(
        width_px=WIDTH_PX,
        height_px=HEIGHT_PX,
        K=intrinsics(WIDTH_PX, HEIGHT_PX, FOVY_RAD),
        T_world_cam=level,
    )

    above, on, below = camera.on_plane(np.array([[32.0, 10], [32, 24], [32, 40]]))

    assert np.isnan(above).all()
    assert np.isnan(on).all()
    assert below[0] > 0
    assert below[2] == pytest.approx(0)
    assert np.isfinite(camera.on_plane(np.array([[32.0, 10]]), height_m=0.9)).all()


def test_the_edge_of_the_picture_is_half_the_opening_away_and_pixels_are_square():
    K = intrinsics(WIDTH_PX, HEIGHT_PX, FOVY_RAD)

    top = np.linalg.inv(K) @ [WIDTH_PX / 2, 0, 1]
    right = np.linalg.inv(K) @ [WIDTH_PX, HEIGHT_PX / 2, 1]

    np.testing.assert_allclose(top, [0, -np.tan(FOVY_RAD / 2), 1])
    np.testing.assert_allclose(right, [np.tan(FOVY_RAD / 2) * WIDTH_PX / HEIGHT_PX, 0, 1])


def test_a_camera_looks_at_its_target_with_the_horizon_level_and_the_world_upright(rng):
    eye, target = rng.normal(size=(2, 3))

    T = look_at(eye, target)

    camera = Camera(
        width_px=WIDTH_PX,
        height_px=HEIGHT_PX,
        K=intrinsics(WIDTH_PX, HEIGHT_PX, FOVY_RAD),
        T_world_cam=T,
    )
    way = (target - eye) / np.linalg.norm(target - eye)
    left_of_way = np.cross([0, 0, 1.0], way)
    pixels = camera.project(target + 0.01 * np.array([[0, 0, 0], [0, 0, 1.0], left_of_way]))
    np.testing.assert_allclose(pixels[0], [WIDTH_PX / 2, HEIGHT_PX / 2], atol=1e-9)
    assert pixels[1, 1] < pixels[0, 1]
    assert pixels[1, 0] == pytest.approx(pixels[0, 0])
    assert pixels[2, 0] < pixels[0, 0]
    assert np.linalg.det(T[:3, :3]) == pytest.approx(1)
    np.testing.assert_allclose(T[:3, 3], eye)


def test_mujoco_looks_where_the_camera_looks(rng, draw_transform):
    T = draw_transform(rng)
    xyaxes, position = (" ".join(map(str, v)) for v in (mujoco_xyaxes(T), T[:3, 3]))
    model = mujoco.MjModel.from_xml_string(
        f'<mujoco><worldbody><camera pos="{position}" xyaxes="{xyaxes}"'
        f' fovy="{np.degrees(FOVY_RAD)}"/></worldbody></mujoco>'
    )
    data = mujoco.MjData(model)
    mujoco.mj_forward(model, data)
    scene, view = mujoco.MjvScene(model, maxgeom=2), mujoco.MjvCamera()
    view.type, view.fixedcamid = mujoco.mjtCamera.mjCAMERA_FIXED, 0
    mujoco.mjv_updateScene(
        model, data, mujoco.MjvOption(), None, view, mujoco.mjtCatBit.mjCAT_ALL, scene
    )
    head, forward, up, right = (np.zeros(3) for _ in range(4))

    mujoco.mjv_cameraFrame(head, forward, up, right, data, view)

    right_cv, down_cv, forward_cv = T[:3, :3].T
    np.testing.assert_allclose(head, T[:3, 3], atol=1e-6)
    np.testing.assert_allclose(forward, forward_cv, atol=1e-6)
    np.testing.assert_allclose(up, -down_cv, atol=1e-6)
    np.testing.assert_allclose(right, right_cv, atol=1e-6)
    half = np.linalg.inv(intrinsics(WIDTH_PX, HEIGHT_PX, FOVY_RAD)) @ [WIDTH_PX / 2, HEIGHT_PX, 1]
    eye = scene.camera[0]
    assert eye.frustum_top / eye.frustum_near == pytest.approx(half[1], rel=1e-5)


@pytest.mark.parametrize("scale", [(2.0, 2.0), (0.5, 0.25), (3.0, 1.0)])
def test_a_homography_between_pixels_resizes_as_opencv_does(rng, scale):
    slope = np.array([*rng.uniform(2, 4, 2)])
    picture = (np.mgrid[:24, :32].T @ slope).T.astype(np.float32)
    size = (int(32 * scale[0]), int(24 * scale[1]))

    warped = cv2.warpPerspective(
        picture,
        between_centres(np.diag([*scale, 1.0])),
        size,
        flags=cv2.INTER_LINEAR,
        borderMode=cv2.BORDER_REPLICATE,
    )

    # OpenCV's warps round places to a thirty-second of a pixel; a quarter of one would be off by more.
    expected = cv2.resize(picture, size, interpolation=cv2.INTER_LINEAR)
    np.testing.assert_allclose(warped, expected, atol=slope.sum() / 32)


@pytest.fixture
def over_table() -> Camera:
    """Over a table, as people film."""
    pose = look_at(np.array([-0.6, 0.1, 0.5]), np.array([0.1, 0.0, 0.0]))
    return Camera(width_px=640, height_px=480, K=intrinsics(640, 480, 0.8), T_world_cam=pose)


def moved(camera: Camera, rng: np.random.Generator, zoom: float = 1.0) -> Camera:
    """Return the camera after a small motion in a hand."""
    turn, _ = cv2.Rodrigues(rng.normal(0, 0.05, 3))
    K = camera.K * np.array([[zoom, 1, 1], [1, zoom, 1], [1, 1, 1]])
    pose = camera.T_world_cam @ transform(turn, rng.normal(0, 0.03, 3))
    return replace(camera, K=K, T_world_cam=pose)


def table_homography(first: Camera, other: Camera) -> np.ndarray:
    """Return the map of the table's pixels from one camera to another, by four of its points and OpenCV."""
    corners = np.array([[-0.2, -0.2, 0], [0.4, -0.2, 0], [0.4, 0.2, 0], [-0.2, 0.2, 0]])
    return cv2.findHomography(first.project(corners), other.project(corners))[0]


def test_the_poses_of_a_moving_camera_follow_from_what_it_sees_of_the_table(rng, over_table):
    others = [over_table, *(moved(over_table, rng) for _ in range(5))]
    maps = np.stack([-3.0 * table_homography(over_table, other) for other in others])

    poses = poses_over_table(over_table, maps)

    np.testing.assert_allclose(poses, [other.T_world_cam for other in others], atol=1e-6)


def test_a_zoom_costs_little_of_the_pose(rng, over_table):
    other = moved(over_table, rng, zoom=1.05)

    (pose,) = poses_over_table(over_table, table_homography(over_table, other)[None])

    turn = pose[:3, :3].T @ other.T_world_cam[:3, :3]
    assert np.degrees(np.arccos((np.trace(turn) - 1) / 2)) < 2.0
    assert np.linalg.norm(pose[:3, 3] - other.T_world_cam[:3, 3]) < 0.06
    np.testing.assert_allclose(turn @ turn.T, np.eye(3), atol=1e-9)

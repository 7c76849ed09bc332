"""Known bodies at known poses, drawn by the rasteriser of `test_shape.py`'s kind.

What is recovered is compared with them.
"""

import cv2
import numpy as np
import pytest
import trimesh
from scipy.spatial.transform import Rotation

from v2p_data.geometry.mesh import lathe
from v2p_data.geometry.pose import angle_between, transform
from v2p_data.scene.fitting.refine_pose import refine_pose, warped_trajectory
from v2p_data.scene.fitting.silhouette import camera_above
from v2p_data.scene.shapes.silhouette_view import SilhouetteView

CAMERA = camera_above((240, 320), 0.6, 1.01, 0.5)


def jug() -> trimesh.Trimesh:
    """A body of revolution with a spout far to one side, which its bounding box does not tell from the other side."""
    body = lathe(np.array([(0.04, -0.05), (0.04, 0.05)]), 0.0)
    spout = trimesh.creation.box(
        (0.05, 0.02, 0.02), trimesh.transformations.translation_matrix([0.065, 0, 0.02])
    )
    mesh = trimesh.util.concatenate([body, spout])
    mesh.vertices -= mesh.bounds.mean(axis=0)
    return mesh


def pose(x, y, z, yaw_deg):
    turn = Rotation.from_euler("z", yaw_deg, degrees=True).as_matrix()
    return transform(turn, np.array([x, y, z]))


def seen(mesh, T):
    world = np.asarray(mesh.vertices) @ T[:3, :3].T + T[:3, 3]
    picture = np.zeros((CAMERA.height_px * 4, CAMERA.width_px * 4), np.uint8)
    pixels = ((CAMERA.project(world) * 4 - 0.5) * 16).astype(np.int32)
    for triangle in pixels[mesh.faces]:
        cv2.fillConvexPoly(picture, triangle, 1, cv2.LINE_8, 4)
    size = (CAMERA.width_px, CAMERA.height_px)
    return cv2.resize(picture.astype(np.float32), size, interpolation=cv2.INTER_AREA) > 0.5


@pytest.mark.parametrize("yaw_deg", [-90, 0, 60, 130])
def test_a_spout_tells_how_a_jug_was_turned(yaw_deg):
    mesh, T_true = jug(), pose(0.75, -0.08, 0.05, yaw_deg)
    T_first, guess = pose(0.65, 0.1, 0.05, 20), pose(0.77, -0.09, 0.05, 20)

    found = refine_pose(
        SilhouetteView(mask=seen(mesh, T_true), T_world_obj=guess),
        T_first,
        mesh,
        CAMERA,
        in_air=False,
    )

    assert found is not None
    assert found.iou > 0.9
    assert np.degrees(angle_between(found.T_world_mesh[:3, :3], T_true[:3, :3])) < 15
    assert np.linalg.norm(found.T_world_mesh[:3, 3] - T_true[:3, 3]) < 0.01


def test_what_fits_already_stays_as_it_is():
    mesh, T = jug(), pose(0.7, 0.0, 0.05, 45)

    found = refine_pose(
        SilhouetteView(mask=seen(mesh, T), T_world_obj=T), T, mesh, CAMERA, in_air=False
    )

    assert found is not None
    np.testing.assert_array_equal(found.T_world_mesh, T)


def test_what_is_held_up_moves_across_the_view_only():
    mesh, T_true = jug(), pose(0.7, 0.05, 0.2, 90)
    guess = pose(0.7, 0.02, 0.17, 90)

    found = refine_pose(
        SilhouetteView(mask=seen(mesh, T_true), T_world_obj=guess),
        guess,
        mesh,
        CAMERA,
        in_air=True,
    )

    assert found is not None
    assert found.T_world_mesh[0, 3] == guess[0, 3]
    assert np.linalg.norm(found.T_world_mesh[:3, 3] - T_true[:3, 3]) < 0.01


def test_a_speck_and_what_a_hand_hides_say_nothing():
    mesh, T = jug(), pose(0.7, 0.0, 0.05, 45)
    mask = seen(mesh, T)
    speck = mask & (np.arange(mask.size).reshape(mask.shape) % 97 == 0)
    rows = np.flatnonzero(mask.any(axis=1))
    hand = np.zeros_like(mask)
    hand[: int(rows.mean()) + 8] = True

    assert (
        refine_pose(SilhouetteView(mask=speck, T_world_obj=T), T, mesh, CAMERA, in_air=False)
        is None
    )
    hidden = SilhouetteView(mask=mask & ~hand, T_world_obj=T, hidden=hand)
    assert refine_pose(hidden, T, mesh, CAMERA, in_air=False) is None


def test_poses_on_the_way_bend_towards_the_new_last_one():
    poses = np.stack([pose(0.6 + 0.05 * k, 0.0, 0.05, 0) for k in range(5)])
    T_new = pose(0.8, 0.04, 0.05, 80)

    out = warped_trajectory(poses, T_new)

    np.testing.assert_array_equal(out[0], poses[0])
    np.testing.assert_allclose(out[-1], T_new)
    yaws = np.degrees(np.arctan2(out[:, 1, 0], out[:, 0, 0]))
    np.testing.assert_allclose(yaws, [0, 20, 40, 60, 80], atol=1e-6)
    np.testing.assert_allclose(out[:, 1, 3], [0, 0.01, 0.02, 0.03, 0.04], atol=1e-9)

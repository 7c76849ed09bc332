"""Labels carried from a displaced camera to the training camera: plane geometry, a drawn box, refusals."""

from dataclasses import replace

import cv2
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from v2p_data.deployment.view import PLANE_M, ViewTransfer, view_for
from v2p_data.errors import V2PError
from v2p_data.geometry.camera import Camera
from v2p_data.geometry.pose import transform
from v2p_data.scene.frames.mask_ops import iou
from v2p_data.sim.render.camera import training_camera
from v2p_data.sim.render.masks import FIRST_OBJECT, ROBOT

SIZE_PX = 256
HOME = np.array([0.0, 0.0, 0.0, -np.pi / 2, 0.0, np.pi / 2, np.pi / 4])


def displaced(by_m: tuple[float, float, float], by_rad: tuple[float, float, float]) -> Camera:
    camera = training_camera(SIZE_PX)
    T = camera.T_world_cam
    turned = T[:3, :3] @ Rotation.from_rotvec(by_rad).as_matrix()
    return replace(camera, T_world_cam=transform(turned, T[:3, 3] + by_m))


def box_labels(camera: Camera, middle: tuple[float, float], half_m: float) -> np.ndarray:
    """Draw a cube on the table as label 2."""
    signs = np.array(np.meshgrid([-1, 1], [-1, 1], [0, 2])).reshape(3, -1).T
    corners = np.array([*middle, 0.0]) + half_m * signs
    hull = cv2.convexHull(np.rint(camera.project(corners) - 0.5).astype(np.int32))
    labels = np.zeros((SIZE_PX, SIZE_PX), np.uint8)
    cv2.fillConvexPoly(labels, hull, FIRST_OBJECT)
    return labels


def test_a_point_of_the_plane_lands_where_the_training_camera_sees_it():
    source = displaced((0.04, -0.03, 0.05), (0.05, -0.03, 0.04))
    point = np.array([[0.55, 0.05, PLANE_M]])
    (u, v) = source.project(point)[0]
    dot = np.zeros((SIZE_PX, SIZE_PX), np.uint8)
    cv2.circle(dot, (round(u * 16 - 8), round(v * 16 - 8)), 6 * 16, FIRST_OBJECT, -1, shift=4)

    carried = ViewTransfer(source, training_camera(SIZE_PX)).labels(dot, HOME, 0.04)

    rows, columns = np.nonzero(carried == FIRST_OBJECT)
    middle = [columns.mean() + 0.5, rows.mean() + 0.5]
    np.testing.assert_allclose(
        middle, training_camera(SIZE_PX).project(point)[0], rtol=0, atol=0.35
    )


@pytest.mark.parametrize("shift", [(0.03, 0, 0), (0, 0.03, 0), (0, 0, 0.03), (-0.05, 0.04, 0.05)])
def test_a_box_looks_as_from_the_training_camera(shift: tuple[float, float, float]):
    source, target = displaced(shift, (0.01, 0.02, -0.02)), training_camera(SIZE_PX)
    seen, wanted = (box_labels(c, (0.58, 0.0), 0.03) for c in (source, target))

    carried = ViewTransfer(source, target).labels(seen, HOME, 0.04)

    assert iou(seen == FIRST_OBJECT, wanted == FIRST_OBJECT) < 0.8
    assert iou(carried == FIRST_OBJECT, wanted == FIRST_OBJECT) > 0.88


def test_the_robot_is_drawn_in_the_training_camera():
    target = training_camera(SIZE_PX)
    nothing = np.zeros((SIZE_PX, SIZE_PX), np.uint8)

    from_afar = ViewTransfer(displaced((0.03, 0.02, 0.02), (0, 0, 0)), target)
    drawn = from_afar.labels(nothing, HOME, 0.04)

    here = ViewTransfer(target, target).labels(nothing, HOME, 0.04)
    assert (here == ROBOT).sum() > 500
    np.testing.assert_array_equal(drawn, here)


def test_the_training_camera_itself_needs_no_transfer():
    assert view_for(training_camera(SIZE_PX)) is None


def test_a_camera_that_looks_elsewhere_is_refused():
    with pytest.raises(V2PError, match="of the training camera's picture"):
        view_for(displaced((0, 0, 0), (0, 0.5, 0)))


def test_a_wide_picture_is_refused():
    with pytest.raises(V2PError, match="square"):
        view_for(replace(training_camera(SIZE_PX), width_px=320))

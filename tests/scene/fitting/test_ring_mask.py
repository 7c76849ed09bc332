"""A ring's masks lose what one sees through it."""

import cv2
import numpy as np
import pytest

from v2p_data.geometry.mesh import ring
from v2p_data.geometry.pose import apply, transform
from v2p_data.scene.fitting.ring_mask import seen_through, without_hole
from v2p_data.scene.fitting.silhouette import camera_above


def drawn(mesh, T, camera):
    """Return where any face of a mesh is seen, and where its hull is."""
    pixels = (camera.project(apply(T, np.asarray(mesh.vertices))) - 0.5) * 16
    faces, hull = np.zeros((960, 1280), np.uint8), np.zeros((960, 1280), np.uint8)
    for triangle in pixels.astype(np.int32)[mesh.faces]:
        cv2.fillConvexPoly(faces, triangle, 1, cv2.LINE_8, 4)
    cv2.fillConvexPoly(hull, cv2.convexHull(pixels.astype(np.int32)), 1, cv2.LINE_8, 4)
    return faces > 0, hull > 0


@pytest.mark.parametrize(
    ("pitch", "bore", "open_"), [(1.1, 0.65, 1), (0.6, 0.65, 1), (0.35, 0.3, 0)]
)
def test_what_is_seen_through_a_ring_is_where_none_of_it_is_drawn(pitch, bore, open_):
    camera = camera_above((960, 1280), pitch, 1.01, 0.4)
    size = (0.15, 0.15, 0.04)
    T = transform(np.eye(3), camera.on_plane(np.array([[680.0, 500.0]]), 0.02)[0])
    faces, hull = drawn(ring(size[0], size[2], bore), T, camera)

    hole = seen_through(size, bore, T, camera)

    true = hull & ~faces
    assert (true.sum() > 3000) == bool(open_)
    assert (hole & ~true).sum() <= 0.1 * true.sum(), "rims are drawn a pixel wide"
    assert (hole & true).sum() >= 0.95 * true.sum()
    assert hole.any() == bool(open_)


def test_a_ring_behind_the_camera_hides_nothing():
    camera = camera_above((960, 1280), 0.6, 1.01, 0.4)
    T = transform(np.eye(3), np.array([-2.0, 0.0, 0.4]))

    assert not seen_through((0.1, 0.1, 0.02), 0.6, T, camera).any()


def test_a_mask_keeps_its_hole_filled_where_the_ring_is_not_as_posed():
    camera = camera_above((960, 1280), 1.1, 1.01, 0.4)
    size, bore = (0.15, 0.15, 0.03), 0.65
    here, elsewhere = (
        transform(np.eye(3), camera.on_plane(np.array([[x, 500.0]]), 0.015)[0])
        for x in (680.0, 420.0)
    )
    faces, whole = drawn(ring(size[0], size[2], bore), here, camera)

    assert (without_hole(whole, size, bore, here, camera) & ~faces).sum() < 0.05 * (
        whole & ~faces
    ).sum()
    np.testing.assert_array_equal(without_hole(whole, size, bore, elsewhere, camera), whole)

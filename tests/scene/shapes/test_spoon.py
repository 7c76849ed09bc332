"""Spoons have a bowl at one end and a rod that a gripper can hold; which end, the outline says."""

import cv2
import numpy as np
import pytest
import trimesh
from scipy.spatial.transform import Rotation

from v2p_data.geometry.pose import transform
from v2p_data.scene.fitting.silhouette import camera_above
from v2p_data.scene.scale.nouns import noun_for
from v2p_data.scene.shapes.shape import SilhouetteView, best_shape
from v2p_data.scene.shapes.spoon import is_spoon, spoons

SIZE = (0.19, 0.04, 0.02)
WOODEN = (0.3, 0.055, 0.018)
"""Its rod is thicker than its bowl is deep."""
CAMERA = camera_above((240, 320), 0.6, 1.01, 0.5)


def width_at(mesh: trimesh.Trimesh, x: float) -> float:
    section = mesh.section(plane_origin=[x, 0, 0], plane_normal=[1, 0, 0])
    assert section is not None
    return float(np.ptp(section.vertices[:, 1]))


def lying(yaw_deg: float = 0.0) -> np.ndarray:
    R = Rotation.from_euler("z", yaw_deg, degrees=True).as_matrix()
    return transform(R, np.array([0.7, 0.02, SIZE[2] / 2]))


def seen(mesh: trimesh.Trimesh, T: np.ndarray) -> np.ndarray:
    pixels = CAMERA.project(np.asarray(mesh.vertices) @ T[:3, :3].T + T[:3, 3]) * 4
    large = np.zeros((960, 1280), np.uint8)
    for triangle in (pixels * 16).astype(np.int32)[mesh.faces]:
        cv2.fillConvexPoly(large, triangle, 1, cv2.LINE_8, 4)
    return cv2.resize(large.astype(np.float32), (320, 240), interpolation=cv2.INTER_AREA) > 0.5


def test_a_spoon_is_closed_and_fills_the_block_that_was_fitted():
    mesh = spoons(SIZE, lying())[0].mesh

    assert mesh.is_watertight
    assert mesh.volume > 0
    np.testing.assert_allclose(mesh.extents, SIZE, rtol=1e-6)
    np.testing.assert_allclose(mesh.bounds.mean(0), 0, atol=1e-9)


@pytest.mark.parametrize("size", [SIZE, WOODEN])
def test_its_handle_is_thin_enough_to_be_held(size):
    one, other = (candidate.mesh for candidate in spoons(size, lying()))

    widths = sorted(width_at(mesh, 0.33 * size[0]) for mesh in (one, other))
    assert widths[0] == pytest.approx(0.22 * size[1], rel=0.05)
    assert widths[1] > 0.8 * size[1]


def test_its_convex_parts_cover_it():
    spoon = spoons(SIZE, lying())[0]
    points = np.asarray(spoon.mesh.sample(500, seed=0))

    inside = np.zeros(len(points), bool)
    for part in spoon.parts:
        assert part.is_convex
        offsets = np.einsum("fk,fk->f", part.face_normals, part.triangles[:, 0])
        inside |= (points @ part.face_normals.T <= offsets + 1e-6).all(1)
    assert inside.mean() > 0.99


def test_a_hand_that_pushes_with_it_holds_the_rod():
    """Its far end is down on the table, the other one in the hand."""
    raised = transform(Rotation.from_euler("y", -25, degrees=True).as_matrix(), np.zeros(3))

    spoon = spoons(SIZE, raised)[0].mesh

    assert width_at(spoon, -0.07) > 2.5 * width_at(spoon, 0.05), "+x is the raised end"


@pytest.mark.parametrize("which", [0, 1])
def test_the_outline_says_which_end_is_the_bowl(which):
    T = lying(65)
    true = spoons(SIZE, T)[which].mesh
    view = SilhouetteView(mask=seen(true, T), T_world_obj=T)

    choice = best_shape([view], CAMERA, SIZE, noun_for("spoon"))

    assert choice.kind == "spoon"
    assert width_at(choice.mesh, 0.06) == pytest.approx(width_at(true, 0.06), rel=0.05)


def test_a_spoon_fills_its_block_however_that_is_turned():
    """Which of a block's own axes is long, and which points up, is not the spoon's to say."""
    for order in ((1, 0, 2), (2, 1, 0), (1, 2, 0)):
        size = tuple(np.array(SIZE)[list(order)].tolist())
        turn = np.eye(3)[list(order)].T
        turn[:, 0] *= np.sign(np.linalg.det(turn))

        mesh = spoons(size, transform(turn, np.zeros(3)))[0].mesh

        np.testing.assert_allclose(mesh.extents, size, rtol=1e-6)


def test_only_spoons_are_spoons():
    assert is_spoon(noun_for("wooden spoon"))
    assert is_spoon(noun_for("steel spoon"))
    assert not is_spoon(noun_for("fork"))
    assert not is_spoon(noun_for("ladle"))

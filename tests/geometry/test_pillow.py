"""Laws of the pillow: what an outline's shape, place and scale say of the mesh made of it."""

import cv2
import numpy as np
import pytest
from parts import outside

from v2p_data.geometry.pillow import MAX_PARTS, inflated, pillow

PX_M = 0.001
NO_CAP = 1.0


def disc(radius_px: int = 20, at: tuple[int, int] = (40, 30)) -> np.ndarray:
    picture = np.zeros((64, 96), np.uint8)
    cv2.circle(picture, at, radius_px, 1, -1)
    return picture > 0


def boot() -> np.ndarray:
    """Return an outline of no symmetry: a shaft at the left, a toe at the lower right."""
    picture = np.zeros((64, 96), bool)
    picture[8:56, 12:30] = True
    picture[40:56, 12:70] = True
    return picture


def made(outline: np.ndarray, *, cap_m: float = NO_CAP, px_m: float = PX_M):
    return pillow(outline, inflated(outline, px_m, cap_m).astype(np.float32), px_m)


def test_a_disc_is_inflated_to_a_ball():
    outline = disc()

    half = inflated(outline, PX_M, NO_CAP)

    y, x = np.nonzero(outline)
    inner = np.hypot(x - 40, y - 30) < 15
    ball = np.sqrt(20.5**2 - (x - 40) ** 2 - (y - 30) ** 2) * PX_M
    np.testing.assert_allclose(half[y, x][inner], ball[inner], rtol=0.1)
    assert not half[~outline].any()


def test_nothing_is_thicker_than_the_cap_and_what_is_flat_stays_the_same():
    outline = disc()

    free, flat = inflated(outline, PX_M, NO_CAP), inflated(outline, PX_M, 0.004)

    assert flat.max() == pytest.approx(0.004)
    assert free.max() > 0.015
    assert (flat <= np.maximum(free, 0.004) + 1e-9).all()
    y, x = np.nonzero(outline)
    assert flat[y, x][np.hypot(x - 40, y - 30) < 15].min() > 0.95 * 0.004  # a plate, no cone
    assert not inflated(np.zeros((20, 20), bool), PX_M, NO_CAP).any()


def test_columns_run_along_x_and_rows_along_y():
    outline = boot()
    y, x = np.nonzero(outline)

    mesh, _ = made(outline)

    np.testing.assert_allclose(
        mesh.bounds[:, :2] / PX_M, [[x.min(), y.min()], [x.max() + 1, y.max() + 1]], atol=1.0
    )
    # the toe lies at large x and large y only
    toe = mesh.vertices[mesh.vertices[:, 0] > 0.04]
    assert toe[:, 1].min() > 0.037
    section = mesh.vertices[mesh.vertices[:, 1] < 0.03]
    assert section[:, 0].max() < 0.033


def test_the_rim_lies_on_the_outline_to_half_a_pixel():
    outline = disc()

    mesh, _ = made(outline)

    upright = np.abs(mesh.face_normals[:, 2]) < 1e-6
    rim = mesh.vertices[np.unique(mesh.faces[upright]), :2] / PX_M
    radii = np.linalg.norm(rim - [40.5, 30.5], axis=1)  # the middle of the pixel (40, 30)
    np.testing.assert_allclose(radii, np.sqrt(outline.sum() / np.pi), atol=0.5)


@pytest.mark.parametrize("outline", [disc(), boot()], ids=["disc", "boot"])
def test_a_pillow_is_closed_turned_outwards_and_the_same_from_both_sides(outline):
    mesh, _ = made(outline, cap_m=0.008)

    assert mesh.is_watertight
    assert mesh.is_winding_consistent
    assert mesh.volume > 0
    np.testing.assert_allclose(mesh.bounds[0, 2], -mesh.bounds[1, 2])
    np.testing.assert_allclose(mesh.center_mass[2], 0, atol=1e-9)
    front = mesh.face_normals[mesh.triangles_center[:, 2] > 1e-3]
    assert (front[:, 2] > 0).mean() > 0.9


@pytest.mark.parametrize("outline", [disc(), boot()], ids=["disc", "boot"])
def test_convex_parts_cover_the_pillow_and_add_little(outline):
    mesh, parts = made(outline, cap_m=0.008)

    assert 1 <= len(parts) <= MAX_PARTS
    assert all(part.is_convex and part.is_watertight for part in parts)
    assert outside(mesh.vertices, parts).max() < 1e-6
    assert sum(part.volume for part in parts) < 1.35 * mesh.volume


def test_a_boot_is_cut_so_that_the_air_above_its_toe_is_free():
    _, parts = made(boot(), cap_m=0.008)

    assert len(parts) >= 2
    assert outside(np.array([[0.060, 0.020, 0.0]]), parts)[0] > 0.01


@pytest.mark.parametrize("pixels", [0, 1])
def test_an_outline_smaller_than_a_cell_is_refused(pixels: int):
    outline = np.zeros((20, 20), bool)
    outline[10, 10 : 10 + pixels] = True

    with pytest.raises(ValueError, match=r"empty|too small"):
        pillow(outline, np.zeros((20, 20), np.float32), PX_M)

import math

import numpy as np
import pytest
import trimesh

from v2p_data.geometry.mesh import mesh_for, outline_points, write_obj

SHAPES = [
    ("box", (0.1, 0.06, 0.2), False, 1.0),
    ("box", (0.26, 0.2, 0.12), True, 1.0),
    ("cylinder", (0.066, 0.066, 0.122), False, 1.0),
    ("cylinder", (0.16, 0.16, 0.06), True, 0.5),
    ("cylinder", (0.24, 0.24, 0.022), True, 0.6),
    ("sphere", (0.07, 0.07, 0.07), False, 1.0),
]


@pytest.mark.parametrize(("form", "size", "hollow", "taper"), SHAPES)
def test_a_mesh_fills_its_bounding_box_around_the_origin(form, size, hollow, taper):
    mesh = mesh_for(form, size, hollow=hollow, taper=taper)

    np.testing.assert_allclose(mesh.extents, size, rtol=0.01)
    np.testing.assert_allclose(mesh.bounds.mean(axis=0), 0, atol=1e-9)


def test_solid_volumes_are_those_of_the_school_book():
    can = mesh_for("cylinder", (0.066, 0.066, 0.122))
    ball = mesh_for("sphere", (0.07, 0.07, 0.07))
    frustum = mesh_for("cylinder", (0.2, 0.2, 0.1), taper=0.5)

    assert can.volume == pytest.approx(math.pi * 0.033**2 * 0.122, rel=0.01)
    assert ball.volume == pytest.approx(math.pi / 6 * 0.07**3, rel=0.02)
    assert frustum.volume == pytest.approx(
        math.pi * 0.1 / 3 * (0.1**2 + 0.1 * 0.05 + 0.05**2), rel=0.01
    )
    assert can.is_watertight
    assert ball.is_watertight


def test_a_bowl_is_mostly_empty_and_open_at_the_top():
    bowl = mesh_for("cylinder", (0.16, 0.16, 0.06), hollow=True, taper=0.5)

    assert bowl.volume < 0.35 * bowl.convex_hull.volume
    middle = np.hypot(bowl.vertices[:, 0], bowl.vertices[:, 1]) < 0.02
    assert bowl.vertices[middle, 2].max() < -0.02  # above the middle of the floor there is nothing


def test_a_written_mesh_is_read_back_in_metres(tmp_path):
    write_obj(mesh_for("box", (0.1, 0.06, 0.2)), tmp_path / "box.obj")

    np.testing.assert_allclose(trimesh.load_mesh(tmp_path / "box.obj").extents, (0.1, 0.06, 0.2))


@pytest.mark.parametrize(("form", "size", "hollow", "taper"), SHAPES)
def test_outline_points_span_the_same_box_as_the_mesh(form, size, hollow, taper):
    points = outline_points(form, size, taper)

    np.testing.assert_allclose(np.ptp(points, axis=0), size, rtol=0.03)

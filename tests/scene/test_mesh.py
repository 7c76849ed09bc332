import math
from itertools import pairwise

import numpy as np
import pytest
import trimesh

from v2p_data.geometry.mesh import (
    lathe,
    lathe_parts,
    mesh_for,
    outline_points,
    parts_for,
    write_obj,
    write_ply,
)

SHAPES = [
    ("box", (0.1, 0.06, 0.2), False, 1.0),
    ("box", (0.26, 0.2, 0.12), True, 1.0),
    ("cylinder", (0.066, 0.066, 0.122), False, 1.0),
    ("cylinder", (0.16, 0.16, 0.06), True, 0.5),
    ("cylinder", (0.24, 0.24, 0.022), True, 0.6),
    ("sphere", (0.07, 0.07, 0.07), False, 1.0),
]


BOTTLE = np.array([(0.03, 0.0), (0.035, 0.01), (0.035, 0.13), (0.014, 0.17), (0.014, 0.2)])
VASE = np.array([(0.03, 0.0), (0.06, 0.06), (0.05, 0.12), (0.03, 0.16), (0.035, 0.18)])


def depth_in_parts(points, parts):
    """How far each point lies outside the nearest convex part [m]; negative inside."""
    out = np.full(len(points), np.inf)
    for part in parts:
        planes = (points @ part.face_normals.T) - np.einsum(
            "fk,fk->f", part.face_normals, part.triangles[:, 0]
        )
        out = np.minimum(out, planes.max(axis=1))
    return out


@pytest.mark.parametrize(("form", "size", "hollow", "taper"), SHAPES)
def test_a_mesh_is_one_closed_surface_turned_outwards(form, size, hollow, taper):
    mesh = mesh_for(form, size, hollow=hollow, taper=taper)

    assert mesh.is_watertight
    assert mesh.is_winding_consistent
    assert mesh.volume > 0
    assert mesh.body_count == 1


@pytest.mark.parametrize(("form", "size", "hollow", "taper"), SHAPES)
def test_convex_parts_cover_the_mesh_and_leave_its_inside_free(form, size, hollow, taper):
    mesh = mesh_for(form, size, hollow=hollow, taper=taper)
    parts = parts_for(form, size, hollow=hollow, taper=taper)

    surface = mesh.sample(2000, seed=0)
    assert all(p.is_convex and p.is_watertight and p.volume > 0 for p in parts)
    assert depth_in_parts(surface, parts).max() < 0.02 * max(size)
    assert sum(p.volume for p in parts) == pytest.approx(mesh.volume, rel=0.05)
    if hollow:
        inside = np.array([[0.0, 0.0, z] for z in np.linspace(-0.2, 0.5, 8) * size[2]])
        assert depth_in_parts(inside, parts).min() > 0


def test_a_bottle_is_cut_at_its_shoulder_into_few_convex_parts():
    parts = lathe_parts(BOTTLE)

    frusta = [
        math.pi * (b[1] - a[1]) / 3 * (a[0] ** 2 + a[0] * b[0] + b[0] ** 2)
        for a, b in pairwise(BOTTLE)
    ]
    assert len(parts) == 2
    assert all(part.is_convex for part in parts)
    assert sum(part.volume for part in parts) == pytest.approx(sum(frusta), rel=0.03)
    assert lathe(BOTTLE).volume == pytest.approx(sum(frusta), rel=0.01)


def test_a_vase_has_a_wall_of_even_thickness_and_room_inside():
    vase, parts = lathe(VASE, 0.004), lathe_parts(VASE, 0.004)

    side = 2 * math.pi * sum((a[0] + b[0]) / 2 * math.hypot(*(b - a)) for a, b in pairwise(VASE))
    assert vase.is_watertight
    assert vase.volume == pytest.approx(0.004 * (side + math.pi * 0.03**2), rel=0.12)
    assert depth_in_parts(vase.sample(2000, seed=0), parts).max() < 0.003
    axis = np.array([[0.0, 0.0, z] for z in np.linspace(0.006, 0.18, 20)])
    assert depth_in_parts(axis, parts).min() > 0.001


@pytest.mark.parametrize("scale", [0.1, 1.0])
@pytest.mark.parametrize("above_m", [2e-7, 2e-6, 1e-5, 1e-4])
def test_a_vessel_is_closed_where_a_ring_of_its_profile_all_but_lies_on_its_floor(above_m, scale):
    wall = 0.004
    profile = np.array([(0.045, 0.0), (0.0451, wall + above_m), (0.05, 0.06)])

    bowl = lathe(scale * profile, scale * wall)

    assert bowl.is_watertight
    assert bowl.is_volume


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
    mesh = mesh_for("box", (0.1, 0.06, 0.2))

    write_obj(mesh, tmp_path / "box.obj")
    write_ply(mesh, tmp_path / "box.ply")

    for name in ("box.obj", "box.ply"):
        np.testing.assert_allclose(trimesh.load_mesh(tmp_path / name).extents, (0.1, 0.06, 0.2))


@pytest.mark.parametrize(("form", "size", "hollow", "taper"), SHAPES)
def test_outline_points_span_the_same_box_as_the_mesh(form, size, hollow, taper):
    points = outline_points(form, size, taper)

    np.testing.assert_allclose(np.ptp(points, axis=0), size, rtol=0.03)

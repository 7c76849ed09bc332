import math
from itertools import pairwise

import numpy as np
import pytest
import trimesh
from parts import outside

from v2p_data.geometry.mesh import (
    box,
    lathe,
    lathe_parts,
    mass_properties,
    mesh_for,
    outline_points,
    parts_for,
    revolution,
    ring,
    ring_parts,
    wall_m,
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
    assert outside(surface, parts).max() < 0.02 * max(size)
    assert sum(p.volume for p in parts) == pytest.approx(mesh.volume, rel=0.05)
    if hollow:
        inside = np.array([[0.0, 0.0, z] for z in np.linspace(-0.2, 0.5, 8) * size[2]])
        assert outside(inside, parts).min() > 0


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
    assert outside(vase.sample(2000, seed=0), parts).max() < 0.003
    axis = np.array([[0.0, 0.0, z] for z in np.linspace(0.006, 0.18, 20)])
    assert outside(axis, parts).min() > 0.001


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


@pytest.mark.parametrize(("form", "size", "hollow", "taper"), SHAPES)
def test_outline_points_span_the_same_box_as_the_mesh(form, size, hollow, taper):
    points = outline_points(form, size, taper)

    np.testing.assert_allclose(np.ptp(points, axis=0), size, rtol=0.03)


def heights_of_centres(*meshes) -> list[float]:
    return [float(mass_properties(mesh, 1.0)[0][2]) for mesh in meshes]


def test_a_box_weighs_around_its_middle_as_the_school_book_says():
    a, b, c = size = (0.1, 0.06, 0.2)

    centre, inertia = mass_properties(box(size), 0.3)

    np.testing.assert_allclose(centre, 0, atol=1e-12)
    np.testing.assert_allclose(
        inertia,
        0.3 / 12 * np.diag([b * b + c * c, a * a + c * c, a * a + b * b]),
        rtol=1e-9,
        atol=1e-12,
    )


def test_a_profile_turns_with_its_first_point_at_the_bottom():
    bottle = lathe(BOTTLE)

    radii = np.hypot(*bottle.vertices[:, :2].T)
    for r, z in BOTTLE:
        at = np.isclose(bottle.vertices[:, 2], z, atol=1e-9)
        assert radii[at].max() == pytest.approx(r, rel=1e-6)
    np.testing.assert_allclose(bottle.bounds[:, 2], [0, 0.2], atol=1e-9)


def test_the_base_is_the_narrow_end_below_one_and_the_wide_end_above():
    """Of a cone frustum, base `taper` times the top: its height of centre is the school book's."""
    h, share = 0.1, 0.5
    up = h * (0.25 * (share**2 + 2 * share + 3) / (share**2 + share + 1) - 0.5)

    cup, cone = revolution(0.2, h, taper=0.5), revolution(0.2, h, taper=2.0)

    assert heights_of_centres(cup, cone) == pytest.approx([up, -up], rel=1e-3)
    np.testing.assert_allclose(cup.extents[:2], 0.2)
    np.testing.assert_allclose(cone.extents[:2], 0.2)


@pytest.mark.parametrize("taper", [0.5, 1.0, 2.0])
def test_an_outline_has_its_wide_end_where_the_mesh_has(taper: float):
    size = (0.2, 0.2, 0.1)

    hull = trimesh.convex.convex_hull(outline_points("cylinder", size, taper))

    mesh = mesh_for("cylinder", size, taper=taper)
    assert hull.volume == pytest.approx(mesh.volume, rel=0.03)
    assert heights_of_centres(hull) == pytest.approx(heights_of_centres(mesh), abs=5e-4)


def test_a_hollow_box_has_the_volume_of_its_walls_and_its_floor_below():
    a, b, c = size = (0.26, 0.2, 0.12)
    wall = wall_m(size)

    tray = box(size, hollow=True)

    inside = (a - 2 * wall) * (b - 2 * wall) * (c - wall)
    assert tray.volume == pytest.approx(a * b * c - inside, rel=1e-9)
    assert heights_of_centres(tray)[0] == pytest.approx(
        -inside * wall / 2 / (a * b * c - inside), rel=1e-6
    )


@pytest.mark.parametrize(
    ("size", "expected"),
    [
        ((0.1, 0.1, 0.05), 0.003),  # six hundredths of the least extent
        ((0.3, 0.3, 0.3), 0.006),  # at most
        ((0.2, 0.03, 0.1), 0.0025),  # at least
        ((0.2, 0.005, 0.1), 0.001),  # but a fifth of the least extent
    ],
)
def test_a_wall_is_as_thick_as_the_least_extent_allows(size, expected: float):
    assert wall_m(size) == pytest.approx(expected)


@pytest.mark.parametrize("bore", [0.3, 0.65, 0.9])
def test_a_ring_is_a_can_less_its_hole(bore: float):
    whole = revolution(0.15, 0.04)

    found = ring(0.15, 0.04, bore)

    assert found.is_watertight
    assert found.volume == pytest.approx(whole.volume * (1 - bore**2), rel=1e-6)
    np.testing.assert_allclose(found.bounds, [[-0.075, -0.075, -0.02], [0.075, 0.075, 0.02]])
    same = mesh_for("cylinder", (0.15, 0.15, 0.04), bore=bore)
    np.testing.assert_allclose(same.vertices, found.vertices)


@pytest.mark.parametrize("bore", [0.3, 0.65, 0.9])
def test_the_parts_of_a_ring_cover_it_and_leave_its_hole_free(bore: float):
    parts = ring_parts(0.15, 0.04, bore)

    around = np.linspace(0, 2 * np.pi, 64)
    hole = np.stack([np.cos(around), np.sin(around), 0 * around], axis=1) * 0.075 * bore * 0.99
    surface = ring(0.15, 0.04, bore).sample(500, seed=0)
    assert all(p.is_convex and p.is_watertight for p in parts)
    assert outside(hole, parts).min() > -1e-9
    assert outside(surface, parts).max() < 0.08 * 0.075
    volume = sum(p.volume for p in parts)
    assert volume == pytest.approx(np.pi * 0.075**2 * 0.04 * (1 - bore**2), rel=0.2)
    of_form = parts_for("cylinder", (0.15, 0.15, 0.04), bore=bore)
    assert len(of_form) == len(parts)
    assert sum(p.volume for p in of_form) == pytest.approx(volume)


@pytest.mark.parametrize("name", ["thing.obj", "thing.ply"])
def test_a_written_mesh_keeps_its_axes_and_faces_outwards(tmp_path, name: str):
    mesh = lathe(BOTTLE)
    mesh.apply_translation([0.1, 0.2, 0.3])

    (write_obj if name.endswith("obj") else write_ply)(mesh, tmp_path / name)

    read = trimesh.load_mesh(tmp_path / name)
    np.testing.assert_allclose(read.bounds, mesh.bounds, atol=1e-6)
    assert read.volume == pytest.approx(mesh.volume, rel=1e-5)
    assert heights_of_centres(read) == pytest.approx(heights_of_centres(mesh), rel=1e-5)

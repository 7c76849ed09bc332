# pyright: reportAttributeAccessIssue=false
"""Cousins of an object: shapes that the laws of affine maps hold for, that a gripper takes, and whose files agree."""

import xml.etree.ElementTree as ET
from dataclasses import replace
from pathlib import Path

import mujoco
import numpy as np
import pytest
import trimesh

from v2p_data.errors import ItemRejectedError
from v2p_data.geometry.mesh import lathe, lathe_parts, write_obj
from v2p_data.scene.export import write_relative
from v2p_data.scene.scene import Scene
from v2p_data.sim.model.cousins import cousin_of
from v2p_data.sim.model.world import build_world
from v2p_data.sim.robot.robot import COARSE

BOTTLE = np.array([(0.03, -0.1), (0.035, -0.09), (0.035, 0.03), (0.014, 0.07), (0.014, 0.1)])


@pytest.fixture
def bottle(tmp_path_factory: pytest.TempPathFactory, make_object, make_scene) -> Scene:
    """Return a scene of a bottle 0.2 m high, with its convex parts, as the engine writes it."""
    folder = tmp_path_factory.mktemp("bottle")
    (folder / "meshes").mkdir()
    parts = [f"meshes/bottle_part_{k:02d}.obj" for k in range(len(lathe_parts(BOTTLE)))]
    write_obj(lathe(BOTTLE), folder / "meshes/bottle.obj")
    for part, file in zip(lathe_parts(BOTTLE), parts, strict=True):
        write_obj(part, folder / file)
    thing = make_object(
        "bottle", "mesh", (0.07, 0.07, 0.2), mesh="meshes/bottle.obj", pos=(0.0, 0.0, 0.1)
    )
    scene = make_scene(replace(thing, parts=tuple(parts), symmetry="round"), folder=folder)
    return replace(scene, title="lift_bottle")


@pytest.mark.parametrize("number", range(9))
def test_a_cousin_is_closed_fills_its_size_and_keeps_its_parts_share_of_the_volume(
    bottle: Scene, number: int
):
    before = sum(p.volume for p in lathe_parts(BOTTLE)) / lathe(BOTTLE).volume

    thing, mesh, parts = cousin_of(bottle, number, 0)

    assert mesh.is_watertight
    assert mesh.volume > 0
    assert mesh.extents == pytest.approx(thing.size_m, rel=1e-6)
    if len(parts) > 1:
        assert sum(p.volume for p in parts) / mesh.volume == pytest.approx(before, rel=0.03)
    corners = np.concatenate([p.vertices for p in parts])
    assert (np.abs(corners) <= np.array(thing.size_m) / 2 + 1e-6).all()


def test_a_third_is_under_15_mm_high_a_third_over_150_and_the_simulator_takes_all(bottle: Scene):
    family = [cousin_of(bottle, number, 3)[0] for number in range(12)]

    heights = [thing.size_m[2] for thing in family]
    assert all(h <= 0.015 for h in heights[1::3])
    assert all(h >= 0.15 for h in heights[2::3])
    assert len({thing.size_m for thing in family}) == 12
    assert max(thing.mass_kg for thing in family) > 2 * min(thing.mass_kg for thing in family)
    for thing in family:  # it stands on the table where the bottle stood
        assert thing.poses_world[0][2] == pytest.approx(thing.size_m[2] / 2)


@pytest.mark.parametrize("number", [0, 1, 2, 5])
def test_the_files_of_a_cousin_weigh_and_turn_like_its_mesh(
    bottle: Scene, tmp_path: Path, number: int
):
    thing, mesh, parts = cousin_of(bottle, number, 0)
    write_relative(bottle, "lift_bottle_cousin_000", thing, mesh, parts, tmp_path)

    scene = Scene.load(tmp_path)

    assert (scene.title, scene.family, scene.video) == (
        "lift_bottle_cousin_000",
        "lift_bottle",
        "",
    )
    build_world(scene, COARSE)  # the gripper can take it
    assert trimesh.load_mesh(tmp_path / scene.manipulated.mesh).extents == pytest.approx(
        thing.size_m, rel=1e-3
    )
    density = thing.mass_kg / mesh.volume
    root = ET.parse(tmp_path / scene.manipulated.urdf).getroot()
    moments = root.find("link/inertial/inertia")
    assert moments is not None
    assert float(moments.attrib["izz"]) == pytest.approx(
        density * mesh.moment_inertia[2, 2], rel=0.01
    )
    model = mujoco.MjModel.from_xml_path(str(tmp_path / "scene.xml"))
    body = model.body("bottle")
    assert body.mass[0] == pytest.approx(thing.mass_kg, rel=1e-4)
    principal = density * np.linalg.eigvalsh(mesh.moment_inertia)
    assert np.sort(body.inertia) == pytest.approx(principal, rel=0.01)


def test_a_stretched_box_is_a_box_whose_inertia_is_the_formulas(
    make_object, make_scene, tmp_path: Path
):
    cube = replace(
        make_scene(make_object(size_m=(0.05, 0.04, 0.03)), folder=tmp_path), title="lift"
    )
    (tmp_path / "cousin").mkdir()
    thing, mesh, parts = cousin_of(cube, 0, 0)

    write_relative(cube, "lift_cousin_000", thing, mesh, parts, tmp_path / "cousin")

    x, y, z = thing.size_m
    model = mujoco.MjModel.from_xml_path(str(tmp_path / "cousin/scene.xml"))
    diagonal = thing.mass_kg / 12 * np.array([y**2 + z**2, x**2 + z**2, x**2 + y**2])
    assert thing.shape == "box"
    assert np.sort(model.body("cube").inertia) == pytest.approx(np.sort(diagonal), rel=1e-4)


def test_what_was_drawn_does_not_depend_on_how_many_are_asked_for(bottle: Scene):
    again = cousin_of(bottle, 4, 0)[0]

    assert again == cousin_of(bottle, 4, 0)[0]
    assert again.size_m != cousin_of(bottle, 4, 1)[0].size_m


@pytest.mark.parametrize("kind", ["cover", "insert", "uncover", "throw_into"])
def test_kinds_in_which_two_objects_must_fit_have_no_cousins(bottle: Scene, kind: str):
    with pytest.raises(ItemRejectedError, match=rf"'{kind}' asks that two objects fit") as told:
        cousin_of(replace(bottle, kind=kind), 0, 0)

    assert told.value.reason == "no_cousins"


def test_an_open_mesh_has_no_cousins(make_object, make_scene, tmp_path: Path):
    half = trimesh.creation.box((0.04, 0.04, 0.04))
    half.update_faces(np.arange(len(half.faces)) > 5)
    half.export(tmp_path / "open.obj")
    scene = make_scene(make_object(shape="mesh", mesh="open.obj"), folder=tmp_path)

    with pytest.raises(ItemRejectedError, match="is open, so nobody knows") as told:
        cousin_of(scene, 0, 0)

    assert told.value.reason == "open_mesh"


def test_a_gripper_that_spans_none_says_so_with_its_opening(bottle: Scene):
    with pytest.raises(ItemRejectedError, match="gripper, which opens by 10 mm") as told:
        cousin_of(bottle, 0, 0, opening_m=0.01)

    assert told.value.reason == "too_few_shapes"

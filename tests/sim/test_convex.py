from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import trimesh

from v2p_data.errors import ItemRejectedError
from v2p_data.scene.scene import Scene, SceneObject
from v2p_data.seeds import rng_for
from v2p_data.sim.env.cpu_physics import CpuPhysics
from v2p_data.sim.env.physics import SimConfig
from v2p_data.sim.env.randomize import Randomizer
from v2p_data.sim.env.ranges import RandomizationConfig
from v2p_data.sim.model.convex import ConvexConfig
from v2p_data.sim.model.solids import solids_of
from v2p_data.sim.model.world import MESH_SCALES, build_world
from v2p_data.sim.robot.robot import COARSE
from v2p_data.task.cache import cache_folder

SIZE = (0.08, 0.08, 0.04)
NOTCH = np.array([0.02, 0.02, 0.0])
"""Inside the hull of the angle, outside the angle."""
LEGS = [((0.08, 0.02, 0.04), (0.0, -0.03)), ((0.02, 0.06, 0.04), (-0.03, 0.01))]
"""The angle as two boxes: size, and centre in x and y, about the centre of its bounding box."""


@pytest.fixture(autouse=True)
def _own_cache(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setenv("V2P_CACHE_DIR", str(tmp_path / "cache"))


@pytest.fixture
def angle_file(tmp_path: Path) -> Path:
    """An angle of two legs, 8 cm long, 2 cm thick and 4 cm high, in its file four times smaller."""
    outline = np.array([(0, 0), (4, 0), (4, 1), (1, 1), (1, 4), (0, 4)], float) * 0.005
    n = len(outline)
    vertices = np.concatenate([np.c_[outline, np.zeros(n)], np.c_[outline, np.full(n, 0.01)]])
    sides = [
        f for i in range(n) for j in [(i + 1) % n] for f in [(i, j, j + n), (i, j + n, i + n)]
    ]
    lid = [(0, 1, 2), (0, 2, 3), (0, 3, 5), (3, 4, 5)]
    lids = [(a + n, b + n, c + n) for a, b, c in lid] + [(c, b, a) for a, b, c in lid]
    path = tmp_path / "angle.obj"
    trimesh.Trimesh(vertices, sides + lids, process=False).export(path)
    return path


@pytest.fixture
def angle_scene(
    angle_file: Path, make_object: Callable[..., SceneObject], make_scene: Callable[..., Scene]
) -> Scene:
    angle = make_object("angle", "mesh", SIZE, mesh=angle_file.name)
    return make_scene(angle, folder=angle_file.parent)


def contains(part: trimesh.Trimesh, point: np.ndarray) -> bool:
    """Whether a convex solid holds a point: it is behind every face."""
    centre = part.vertices.mean(0)
    out = part.triangles_center - centre
    normals = part.face_normals * np.sign((part.face_normals * out).sum(1))[:, None]
    return bool(((point - part.triangles_center) * normals).sum(1).max() < 0)


def test_a_concave_mesh_becomes_parts_that_leave_its_notch_free(angle_file: Path):
    solids = solids_of(angle_file, "angle", SIZE)

    assert 2 <= len(solids.parts) <= 8
    assert max(len(p.vertices) for p in solids.parts) <= 32
    assert sum(p.volume for p in solids.parts) == pytest.approx(7 * 0.02 * 0.02 * 0.04, rel=0.05)
    assert not any(contains(p, NOTCH) for p in solids.parts)
    assert any(contains(p, np.array([-0.03, -0.03, 0.0])) for p in solids.parts)
    np.testing.assert_allclose(np.ptp(solids.hull, axis=0), SIZE, rtol=1e-6)


@pytest.fixture
def leg_files(tmp_path: Path) -> list[Path]:
    """The angle's two legs where they are in its file, which is four times smaller and begins at the origin."""
    files = [tmp_path / f"leg_{k}.obj" for k in range(len(LEGS))]
    for file, (size, centre) in zip(files, LEGS, strict=True):
        leg = trimesh.creation.box(np.array(size) / 4)
        leg.apply_translation((np.array([*centre, 0.0]) + np.array(SIZE) / 2) / 4)
        leg.export(file)
    return files


def test_a_scene_that_brings_parts_along_is_built_of_them_and_nothing_is_split(
    angle_scene: Scene, leg_files: list[Path]
):
    angle = replace(angle_scene.objects[0], parts=tuple(f.name for f in leg_files))

    world = build_world(replace(angle_scene, objects=(angle,)), COARSE)

    assert not cache_folder(
        "convex"
    ).exists()  # where parts that were found by splitting would lie
    obj, model = world.objects[0], world.model
    np.testing.assert_allclose(np.ptp(obj.hull, axis=0), SIZE, rtol=1e-6)
    assert len(obj.geom_ids) == len(LEGS)
    for geom, (size, centre) in zip(obj.geom_ids, LEGS, strict=True):
        np.testing.assert_allclose(model.geom_pos[geom], [*centre, 0.0], atol=1e-6)
        np.testing.assert_allclose(
            np.sort(2 * model.geom_aabb[geom, 3:]), np.sort(size), atol=1e-6
        )


def test_one_part_of_a_concave_mesh_is_its_hull_and_does_not_save_it_the_splitting(
    angle_file: Path, tmp_path: Path
):
    hull = tmp_path / "hull.obj"
    trimesh.load_mesh(angle_file).convex_hull.export(hull)

    assert len(solids_of(angle_file, "angle", SIZE, ready=[hull]).parts) >= 2


BOARDS = [
    ((0.08, 0.08, 0.01), (0.0, 0.0, -0.015)),
    *(((0.01, 0.08, 0.03), (x, 0.0, 0.005)) for x in (-0.035, 0.035)),
    *(((0.06, 0.01, 0.03), (0.0, y, 0.005)) for y in (-0.035, 0.035)),
]
"""A tray of five boards that share edges: size and centre."""


def _tray(apart: bool) -> tuple[list[trimesh.Trimesh], trimesh.Trimesh]:
    boards = [
        trimesh.creation.box(size, trimesh.transformations.translation_matrix(at))
        for size, at in BOARDS
    ]
    tray = trimesh.Trimesh(
        *trimesh.util.append_faces([b.vertices for b in boards], [b.faces for b in boards]),
        process=not apart,
    )
    return boards, tray


@pytest.mark.parametrize("form", ["obj", "obj with shared corners", "stl", "obj with a hole"])
@pytest.mark.parametrize("brings_parts", [True, False])
def test_closed_pieces_that_touch_do_not_become_their_hull(
    tmp_path: Path, form: str, brings_parts: bool
):
    boards, tray = _tray(form != "obj with shared corners")
    if form == "obj with a hole":
        tray.update_faces(np.arange(len(tray.faces)) > 0)
    path = tmp_path / f"tray.{form[:3]}"
    tray.export(path)
    ready = [tmp_path / f"board_{k}.obj" for k in range(len(boards))]
    for file, board in zip(ready, boards, strict=True):
        board.export(file)

    solids = solids_of(path, "tray", SIZE, ready=ready if brings_parts else ())

    if form == "obj with a hole" and not brings_parts:
        assert len(solids.parts) == 1
        return
    assert len(solids.parts) == 5
    assert not any(contains(p, np.array([0.0, 0.0, 0.01])) for p in solids.parts)
    volume = 0.08 * 0.08 * 0.01 + 2 * 0.01 * 0.08 * 0.03 + 2 * 0.06 * 0.01 * 0.03
    assert sum(p.volume for p in solids.parts) == pytest.approx(volume, rel=1e-6)
    assert solids.body.volume == pytest.approx(volume, rel=1e-6)


def test_a_part_that_is_not_there_is_named(angle_file: Path, leg_files: list[Path]):
    leg_files[1].unlink()

    with pytest.raises(ItemRejectedError, match=r"mesh of 'angle' is missing: .*leg_1\.obj"):
        solids_of(angle_file, "angle", SIZE, ready=leg_files)


def test_a_split_mesh_has_the_inertia_of_the_mesh(angle_scene: Scene):
    # By hand, about the two legs' common centre of mass.
    mass = np.array([np.prod(size) for size, _ in LEGS])
    mass *= 0.12 / mass.sum()
    com = mass @ np.array([c for _, c in LEGS]) / 0.12
    around_z = sum(
        m * ((s[0] ** 2 + s[1] ** 2) / 12 + ((np.array(c) - com) ** 2).sum())
        for m, (s, c) in zip(mass, LEGS, strict=True)
    )

    body = build_world(angle_scene, COARSE).model.body("angle")

    np.testing.assert_allclose(body.ipos, [*com, 0.0], atol=1e-6)
    assert body.inertia.max() == pytest.approx(around_z, rel=1e-4)


def test_a_convex_mesh_stays_one_hull_and_is_not_cached(tmp_path: Path):
    path = tmp_path / "ball.obj"
    trimesh.creation.icosphere(subdivisions=2, radius=0.03).export(path)

    assert len(solids_of(path, "ball", SIZE).parts) == 1
    assert not cache_folder("convex").exists()


def test_a_damaged_cache_entry_is_made_again(angle_file: Path):
    solids_of(angle_file, "angle", SIZE)
    (entry,) = cache_folder("convex").glob("*.npz")
    entry.write_bytes(b"half a file")

    assert len(solids_of(angle_file, "angle", SIZE).parts) >= 2


def test_a_mesh_that_takes_too_long_collides_as_its_hull_and_says_so(angle_file: Path, caplog):
    solids = solids_of(angle_file, "angle", SIZE, ConvexConfig(time_limit_s=1e-9))

    assert len(solids.parts) == 1
    assert contains(solids.parts[0], NOTCH - 0.012 * np.array([1, 1, 0]))
    assert "cannot be split (not done after 0 s): it collides as its hull" in caplog.text
    assert "remove that file to try again" in caplog.text


def test_the_parts_of_one_object_change_size_together(angle_scene: Scene):
    world = build_world(angle_scene, COARSE)
    physics = CpuPhysics(world, SimConfig(), 1.0, 32, 1)
    randomizer = Randomizer(world, physics, RandomizationConfig(), rng_for(0, "bank"))

    randomizer.draw(np.arange(32), rng_for(0, "draw"))

    obj, model = world.objects[0], world.model
    fields = randomizer.fields()
    seen = set()
    for env in range(32):
        scale = randomizer.size_m[env, 0, 0] / SIZE[0]
        seen.add(round(scale, 2))
        for part, geom in enumerate(obj.geom_ids):
            mesh = int(fields["geom_dataid"][env, geom])
            assert mesh == obj.mesh_ids[part][MESH_SCALES.index(round(scale, 2))]
            np.testing.assert_allclose(
                fields["geom_pos"][env, geom], model.mesh_pos[mesh], atol=1e-7
            )
    assert len(seen) > 2


@pytest.mark.parametrize("name", ["angle", "cube", "ball"])
def test_all_sizes_of_a_mesh_are_turned_alike(
    name: str, angle_scene: Scene, make_object, make_scene, tmp_path: Path
):
    trimesh.creation.box((1, 1, 1)).export(tmp_path / "cube.obj")
    trimesh.creation.icosphere(subdivisions=2).export(tmp_path / "ball.obj")
    thing = make_object("thing", "mesh", (0.06, 0.06, 0.06), mesh=f"{name}.obj")

    world = build_world(make_scene(thing, folder=tmp_path), COARSE)

    for ids in world.objects[0].mesh_ids:
        quats = world.model.mesh_quat[list(ids)]
        np.testing.assert_allclose(np.abs(quats @ quats[0]), 1.0, atol=1e-6)

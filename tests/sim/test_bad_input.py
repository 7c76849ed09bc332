"""What is wrong with a scene or a task is said in one sentence, before anything is trained."""

import time
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
import trimesh

from v2p_data.errors import ItemRejectedError, V2PError
from v2p_data.scene.scene import Scene, SceneObject
from v2p_data.sim.env.batch_env import BatchEnv
from v2p_data.sim.env.task_check import check_reward, check_task
from v2p_data.sim.model.solids import _is_closed, read_mesh, solids_of
from v2p_data.sim.model.world import build_world
from v2p_data.sim.robot.robot import COARSE
from v2p_data.task.task import Task, TaskBundle

SIZE = (0.06, 0.06, 0.06)


@pytest.fixture
def ball() -> trimesh.Trimesh:
    return trimesh.creation.icosphere(subdivisions=2, radius=0.03)


@pytest.fixture
def world_of(
    make_object: Callable[..., SceneObject], make_scene: Callable[..., Scene], tmp_path: Path
):
    def build(mesh: trimesh.Trimesh | str, size: tuple[float, float, float] = SIZE):
        path = tmp_path / "thing.obj"
        path.write_text(mesh) if isinstance(mesh, str) else mesh.export(path)
        thing = make_object("thing", "mesh", size, mesh="thing.obj")
        return build_world(make_scene(thing, folder=tmp_path), COARSE)

    return build


def obj_text(vertices: np.ndarray, faces: np.ndarray) -> str:
    lines = [f"v {x} {y} {z}" for x, y, z in vertices]
    return "\n".join(lines + [f"f {a} {b} {c}" for a, b, c in faces + 1])


# --- meshes ------------------------------------------------------------------------------------------------------


def test_a_mesh_with_holes_becomes_its_hull_and_a_warning(world_of, ball, caplog):
    bowl = trimesh.Trimesh(ball.vertices, ball.faces[:250], process=False)

    world = world_of(bowl)

    assert "has holes" in caplog.text
    assert len(world.objects[0].geom_ids) == 1
    np.testing.assert_allclose(np.ptp(world.objects[0].hull, axis=0), SIZE, rtol=1e-6)


def test_a_mesh_that_lacks_one_face_is_mended(world_of, ball, caplog):
    world_of(trimesh.Trimesh(ball.vertices, ball.faces[1:], process=False))

    assert "small holes (3 open edges), which are closed" in caplog.text


def test_a_mesh_that_is_inside_out_weighs_what_it_weighs_outside_out(world_of, ball, caplog):
    right = world_of(ball)
    inverted = world_of(trimesh.Trimesh(ball.vertices, ball.faces[:, ::-1], process=False))

    assert "inside out" in caplog.text
    np.testing.assert_allclose(
        inverted.model.body("thing").inertia, right.model.body("thing").inertia, rtol=1e-3
    )


def test_a_mesh_with_some_faces_turned_inwards_is_mended(world_of, ball, caplog):
    faces = ball.faces.copy()
    faces[:40] = faces[:40, ::-1]

    world_of(trimesh.Trimesh(ball.vertices, faces, process=False))

    assert "turned inwards" in caplog.text


def test_a_mesh_in_millimetres_is_brought_to_the_objects_size_with_a_warning(
    world_of, ball, caplog
):
    ball.apply_scale(1000)

    world = world_of(ball)

    assert "60 m large and the object 0.06 m: taken to be in millimetres" in caplog.text
    np.testing.assert_allclose(np.ptp(world.objects[0].hull, axis=0), SIZE, rtol=1e-6)


CUBE = trimesh.creation.box(extents=SIZE)


def two_cubes(first: int, second: int) -> np.ndarray:
    """Return the faces of two cubes, each with its vertices in the order given by a step of 1 or -1."""
    return np.concatenate([CUBE.faces[:, ::first], CUBE.faces[:, ::second] + 8])


@pytest.mark.parametrize(
    ("first", "second"), [(1, 1), (-1, 1), (1, -1), (-1, -1)], ids=["++", "-+", "+-", "--"]
)
@pytest.mark.parametrize("share", [0.5, 1.0])
def test_pieces_of_a_mesh_that_are_inside_out_weigh_what_they_weigh_outside_out(
    tmp_path, first, second, share
):
    small = CUBE.vertices * share + [0.05 + 0.03 * share, 0, 0]
    path = tmp_path / "thing.obj"
    path.write_text(obj_text(np.concatenate([CUBE.vertices, small]), two_cubes(first, second)))

    mended = read_mesh(path, "thing")

    assert _is_closed(mended, path, "thing")
    # 6 cm a side, and `share` of that
    assert mended.volume == pytest.approx(0.06**3 * (1 + share**3), rel=1e-6)


@pytest.mark.parametrize("way", [1, -1], ids=["outside out", "inside out"])
def test_a_closed_cavity_stays_a_cavity(tmp_path, way):
    path = tmp_path / "thing.obj"
    vertices = np.concatenate([CUBE.vertices, 0.5 * CUBE.vertices])
    path.write_text(obj_text(vertices, two_cubes(way, -way)))
    mesh = read_mesh(path, "thing")

    assert _is_closed(mesh, path, "thing")
    assert mesh.volume == pytest.approx(0.06**3 * (1 - 0.5**3), rel=1e-6)


STRAY = np.array([[0.2, 0, 0], [0.21, 0, 0], [0.2, 0.01, 0]])


@pytest.mark.parametrize(
    "faces",
    [
        np.concatenate([CUBE.faces, CUBE.faces]),
        np.concatenate([CUBE.faces, CUBE.faces[:5, ::-1]]),
        np.concatenate([CUBE.faces, [[0, 0, 1], [1, 1, 1]]]),
        np.concatenate([CUBE.faces, [[8, 9, 10]]]),
    ],
    ids=["twice", "some on both sides", "without area", "a stray triangle"],
)
def test_faces_that_enclose_nothing_do_not_change_a_mesh(tmp_path, caplog, faces):
    path = tmp_path / "thing.obj"
    path.write_text(obj_text(np.concatenate([CUBE.vertices, STRAY]), faces))

    solids = solids_of(path, "thing", SIZE)

    assert "has holes" not in caplog.text
    assert solids.body.volume == pytest.approx(0.06**3, rel=1e-6)


def test_a_sheet_of_a_fifth_of_a_millimetre_is_thickened(world_of, caplog):
    world = world_of(trimesh.creation.box(extents=(0.08, 0.05, 0.0002)), (0.08, 0.05, 0.0006))

    assert "thickened to 10 mm" in caplog.text
    assert np.ptp(world.objects[0].hull, axis=0) == pytest.approx((0.08, 0.05, 0.01))


NAN_VERTEX = "v 0 0 0\nv 0.1 0 0\nv 0 0.1 0\nv nan 0 0.1\nf 1 2 3\nf 1 2 4\nf 2 3 4\nf 1 3 4\n"
POINT = "v 0 0 0\nv 0 0 0\nv 0 0 0\nf 1 2 3\n"
TRIANGLE = "v 0 0 0\nv 0.1 0 0\nv 0 0.1 0\nf 1 2 3\n"
LINE = "v 0 0 0\nv 0.1 0.1 0.1\nv 0.2 0.2 0.2\nf 1 2 3\n"
SLANTED_SHEET = "v 0 0 0\nv 0.1 0 0.1\nv 0 0.1 0.1\nv 0.1 0.1 0.2\nf 1 2 3\nf 2 4 3\n"
MISSING_VERTEX = "v 0 0 0\nv 0.1 0 0\nv 0 0.1 0\nv 0 0 .1\nf 1 2 9\nf 1 2 4\nf 1 2 3\n"


@pytest.mark.parametrize(
    ("text", "reason", "says"),
    [
        (NAN_VERTEX, "mesh_not_finite", "1 of 4 vertices"),
        (NAN_VERTEX.replace("nan", "1e308"), "mesh_not_finite", "1 of 4 vertices"),
        (POINT, "flat_mesh", "encloses nothing"),
        (LINE, "flat_mesh", "encloses nothing"),
        (TRIANGLE, "flat_mesh", "encloses nothing"),
        (SLANTED_SHEET, "flat_mesh", "encloses nothing"),
        (MISSING_VERTEX, "mesh_unreadable", "thing.obj"),
        ("", "mesh_unreadable", "no faces"),
        ("hello\x00 world", "mesh_unreadable", "no faces"),
    ],
    ids=[
        "NaN",
        "far away",
        "point",
        "line",
        "triangle",
        "slanted sheet",
        "missing vertex",
        "empty",
        "text",
    ],
)
def test_a_hopeless_mesh_is_refused_by_object_and_file(world_of, text, reason, says):
    with pytest.raises(ItemRejectedError, match=r"'thing' in .*thing\.obj") as caught:
        world_of(text)

    assert caught.value.reason == reason
    assert says in caught.value.detail


@pytest.mark.long
@pytest.mark.slow
def test_a_mesh_of_a_million_faces_takes_seconds(world_of):
    sphere = trimesh.creation.icosphere(subdivisions=8, radius=0.03)  # 1.3 million

    start = time.process_time()
    world = world_of(obj_text(sphere.vertices, sphere.faces))

    assert time.process_time() - start < 30
    assert world.model.mesh_vertnum.max() <= 40
    np.testing.assert_allclose(np.ptp(world.objects[0].hull, axis=0), SIZE, rtol=1e-6)


def test_a_file_too_large_to_be_read_is_refused_unread(world_of, ball, monkeypatch):
    monkeypatch.setattr("v2p_data.sim.model.solids.MAX_MESH_MB", 0.001)

    with pytest.raises(ItemRejectedError, match="decimate") as caught:
        world_of(ball)

    assert caught.value.reason == "mesh_too_large"


# --- objects -----------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("change", "reason", "says"),
    [
        ({"size_m": (80.0, 60.0, 60.0)}, "object_too_large", "80 mm: are the extents in metres?"),
        ({"size_m": (0.4, 0.05, 0.05)}, "object_too_large", "at most 0.35 m"),
        ({"size_m": (float("nan"), 0.05, 0.05)}, "size_impossible", "three lengths"),
        ({"size_m": (-0.05, 0.05, 0.05)}, "size_impossible", "three lengths"),
        ({"size_m": (0.05, 0.05, 0.0)}, "size_impossible", "three lengths"),
        ({"mass_kg": 0.0}, "mass_impossible", "at least 0.1 g"),
        ({"mass_kg": float("nan")}, "mass_impossible", "at least 0.1 g"),
        ({"size_m": (0.12, 0.1, 0.05)}, "not_graspable", "100 mm wide"),
        ({"size_m": (0.1, 0.1, 0.001)}, "not_graspable", "100 mm wide"),
        (
            {"shape": "cylinder", "size_m": (0.1, 0.1, 0.1)},
            "not_graspable",
            "gripper opens by 85 mm",
        ),
        (
            {"shape": "sphere", "size_m": (0.12, 0.12, 0.12)},
            "not_graspable",
            "gripper opens by 85",
        ),
    ],
)
def test_an_object_the_robot_cannot_handle_is_refused_with_the_number(
    change: dict,
    reason: str,
    says: str,
    make_object: Callable[..., SceneObject],
    make_scene: Callable[..., Scene],
):
    with pytest.raises(ItemRejectedError, match="'thing' of scene 'test'") as caught:
        build_world(make_scene(make_object("thing", **change)), COARSE)

    assert caught.value.reason == reason
    assert says in caught.value.detail
    assert caught.value.value is not None


@pytest.mark.parametrize(
    ("kind", "change"),
    [
        ("push_left", {"size_m": (0.12, 0.1, 0.05)}),  # pushing needs no grasp
        ("lift_up", {"size_m": (0.2, 0.06, 0.2)}),  # narrow one way
        ("lift_up", {"size_m": (0.12, 0.12, 0.05), "hollow": True}),  # taken by the wall
        ("lift_up", {"size_m": (0.12, 0.12, 0.06), "quat": (0.5**0.5, 0.0, 0.5**0.5, 0.0)}),
    ],
    ids=["pushed", "narrow", "hollow", "lying"],
)
def test_wide_objects_are_welcome_where_the_gripper_can_do_with_them(
    kind: str,
    change: dict,
    make_object: Callable[..., SceneObject],
    make_scene: Callable[..., Scene],
):
    build_world(make_scene(make_object("thing", **change), kind=kind), COARSE)


def test_a_thin_object_is_thickened_with_a_warning(
    make_object: Callable[..., SceneObject], make_scene: Callable[..., Scene], caplog
):
    world = build_world(make_scene(make_object("card", size_m=(0.08, 0.05, 0.001))), COARSE)

    assert "only 1.0 mm thick and is thickened to 10 mm" in caplog.text
    assert world.objects[0].size_m == (0.08, 0.05, 0.01)


@pytest.mark.parametrize("name", ["table", "cube two", "2nd", 'a"b', "cube"])
def test_names_that_task_code_cannot_use_are_refused(
    name: str, make_object: Callable[..., SceneObject], make_scene: Callable[..., Scene]
):
    scene = make_scene(make_object("cube"), make_object(name, role="reference"))

    with pytest.raises(ItemRejectedError, match="each used once") as caught:
        build_world(scene, COARSE)

    assert caught.value.reason == "object_name"


# --- starts ------------------------------------------------------------------------------------------------------


class Liftable(Task):
    def compute_success(self, states: dict[str, torch.Tensor]) -> torch.Tensor:
        return states["cube_pos"][:, 2] > states["cube_start_pos"][:, 2] + 0.10

    def compute_reward(
        self, actions: torch.Tensor, states: dict[str, torch.Tensor]
    ) -> tuple[torch.Tensor, dict[str, torch.Tensor]]:
        height = states["cube_pos"][:, 2]
        return height, {"height": height}


class Stacked(Liftable):
    offset = (0.0, 0.0, 0.0)

    def reset_objects_states(self, env_ids: torch.Tensor) -> dict[str, torch.Tensor]:
        poses = self.envs.sample_object_poses(env_ids)
        poses["can"][:] = poses["cube"]
        poses["can"][:, :3] += torch.tensor(self.offset)
        return poses


@pytest.mark.parametrize(
    ("offset", "reason", "says"),
    [
        ((0.0, 0.02, 0.0), "objects_start_in_each_other", "inside"),
        ((0.0, 0.1, -0.02), "starts_in_the_table", "inside the table"),
        ((1.5, 0.0, 0.0), "starts_off_the_table", "1.4 m"),
    ],
    ids=["each other", "table", "off"],
)
def test_task_code_that_starts_objects_where_they_cannot_be_is_refused(
    offset,
    reason,
    says,
    make_object: Callable[..., SceneObject],
    make_bundle: Callable[..., TaskBundle],
):
    bundle = make_bundle(make_object("cube"), make_object("can", role="reference"))
    task = type("Moved", (Stacked,), {"offset": offset})

    with pytest.raises(ItemRejectedError, match="task 'test' starts") as caught:
        BatchEnv(bundle, num_envs=2, seed=0, num_threads=1, task=task)

    assert caught.value.reason == reason
    assert says in caught.value.detail


def test_objects_that_overlap_in_the_video_start_apart(
    make_object: Callable[..., SceneObject], make_bundle: Callable[..., TaskBundle]
):
    here = (0.0, 0.0, 0.02)
    bundle = make_bundle(
        make_object("cube", pos=here), make_object("can", role="reference", pos=here)
    )

    env = BatchEnv(bundle, num_envs=8, seed=0, num_threads=1, task=Liftable)

    gap = env.states()["cube_pos"][:, :2] - env.states()["can_pos"][:, :2]
    assert gap.norm(dim=1).min() > 0.04


# --- success functions -------------------------------------------------------------------------------------------


class AlwaysTrue(Liftable):
    def compute_success(self, states: dict[str, torch.Tensor]) -> torch.Tensor:
        return torch.ones_like(states["progress"], dtype=torch.bool)


class TrueAtStart(Liftable):
    def compute_success(self, states: dict[str, torch.Tensor]) -> torch.Tensor:
        return states["cube_pos"][:, 2] < 0.05


class TrueOnceItRests(Liftable):
    """Objects start half a millimetre above the table, and moving: true when they have come down."""

    def compute_success(self, states: dict[str, torch.Tensor]) -> torch.Tensor:
        return (states["progress"] > 0.1) & (states["cube_vel_linear"].norm(dim=1) < 0.01)


class NeverTrue(Liftable):
    def compute_success(self, states: dict[str, torch.Tensor]) -> torch.Tensor:
        return states["cube_pos"][:, 2] > 10.0  # metres, where centimetres were meant


@pytest.mark.parametrize(
    ("task", "reason", "value"),
    [
        (AlwaysTrue, "success_always_true", 1.0),
        (TrueAtStart, "success_at_start", 1.0),
        (TrueOnceItRests, "success_by_itself", 1.0),
        (NeverTrue, "success_unreachable", 0.0),
    ],
)
def test_a_success_that_no_training_is_worth_is_refused(
    task: type[Task], reason: str, value: float, make_bundle: Callable[..., TaskBundle]
):
    with pytest.raises(
        ItemRejectedError, match=r"success of task 'test' \(lift_up\) is"
    ) as caught:
        check_task(make_bundle(), task=task)

    assert caught.value.reason == reason
    assert caught.value.value == value


def paying(formula: Callable[[dict[str, torch.Tensor]], torch.Tensor]) -> type[Task]:
    """A task whose reward is this of the states."""

    class Paying(Liftable):
        def compute_reward(self, actions, states):
            return formula(states), {"paid": formula(states)}

    return Paying


HEIGHT = "cube_pos"


@pytest.mark.parametrize(
    ("formula", "reason", "words"),
    [
        (lambda s: 0 * s[HEIGHT][:, 2] + 7, "reward_constant", "is 7 in each of"),
        (lambda s: 1e9 * s[HEIGHT][:, 2], "reward_unbounded", "a full one is 100"),
        (lambda s: torch.log(s[HEIGHT][:, 2] - 0.05), "reward_not_finite", "is not finite in"),
    ],
)
def test_a_reward_that_teaches_nothing_is_refused_before_any_training(
    formula, reason: str, words: str, make_bundle: Callable[..., TaskBundle]
):
    with pytest.raises(
        ItemRejectedError, match=rf"reward of task 'test' \(lift_up\) .*{words}"
    ) as caught:
        check_reward(make_bundle(), task=paying(formula))

    assert caught.value.reason == reason


def test_a_reward_that_leaves_its_bounds_in_a_simulation_ends_it_with_one_sentence(
    make_bundle: Callable[..., TaskBundle],
):
    task = paying(lambda s: torch.where(s["progress"] > 0.15, 2e4, 1.0))
    env = BatchEnv(replace(make_bundle(), horizon_steps=20), num_envs=2, seed=0, task=task)
    still = np.zeros((2, env.act_dim))

    for _ in range(3):
        env.step(still)
    with pytest.raises(
        V2PError, match=r"is 20000.0 in world 0 .*within \+-10000, a full one is 100"
    ):
        env.step(still)


def test_a_sound_task_passes(make_bundle: Callable[..., TaskBundle]):
    check_task(make_bundle(), task=Liftable)
    check_reward(make_bundle(), task=paying(lambda s: s[HEIGHT][:, 2]))

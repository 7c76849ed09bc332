from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import mujoco
import numpy as np
import pytest
import trimesh
from scipy.spatial.transform import Rotation

from v2p_data.errors import ItemRejectedError
from v2p_data.scene.scene import Scene, SceneObject
from v2p_data.sim.model.world import CAMERA, build_world, hollow_parts
from v2p_data.sim.robot.robot import COARSE, FINE, TARGET_HIGH_M, TARGET_LOW_M


@pytest.fixture
def ball_folder(tmp_path: Path) -> Path:
    trimesh.creation.icosphere(subdivisions=2, radius=0.03).export(tmp_path / "ball.obj")
    return tmp_path


def test_bodies_geoms_and_joints_carry_the_objects_names(
    make_object: Callable[..., SceneObject], make_scene: Callable[..., Scene], ball_folder: Path
):
    scene = make_scene(
        make_object("cube"),
        make_object("bowl", "cylinder", (0.14, 0.14, 0.05), role="container", hollow=True),
        make_object("ball", "mesh", (0.06, 0.06, 0.06), role="reference", mesh="ball.obj"),
        folder=ball_folder,
    )

    world = build_world(scene, COARSE)

    assert [o.name for o in world.objects] == ["cube", "bowl", "ball"]
    for obj in world.objects:
        names = [world.model.geom(i).name for i in obj.geom_ids]
        assert names == [f"{obj.name}_{k}" for k in range(len(obj.geom_ids))]
        assert world.model.body(obj.name).id == obj.body_id
        assert world.model.joint(obj.name).type[0] == mujoco.mjtJoint.mjJNT_FREE


@pytest.mark.parametrize(
    ("shape", "size", "geom"),
    [
        ("box", (0.04, 0.06, 0.08), 'type="box" size="0.02 0.03 0.04"'),
        ("cylinder", (0.05, 0.05, 0.1), 'type="cylinder" size="0.025 0.05"'),
        ("sphere", (0.05, 0.05, 0.05), 'type="sphere" size="0.025"'),
    ],
)
def test_a_primitive_has_the_inertia_mujoco_gives_it(
    shape: str,
    size: tuple[float, float, float],
    geom: str,
    make_object: Callable[..., SceneObject],
    make_scene: Callable[..., Scene],
):
    world = build_world(make_scene(make_object("thing", shape, size, mass_kg=0.2)), COARSE)

    oracle = mujoco.MjModel.from_xml_string(
        f'<mujoco><worldbody><body><freejoint/><geom {geom} mass="0.2"/></body></worldbody></mujoco>'
    )
    np.testing.assert_allclose(
        np.sort(world.model.body("thing").inertia), np.sort(oracle.body_inertia[1]), rtol=1e-6
    )


def test_a_containers_mass_properties_are_those_mujoco_finds_for_its_parts(
    make_object: Callable[..., SceneObject], make_scene: Callable[..., Scene]
):
    size = (0.14, 0.10, 0.06)
    world = build_world(
        make_scene(make_object("crate", "box", size, role="container", hollow=True, mass_kg=0.3)),
        COARSE,
    )

    geoms = "".join(
        f'<geom type="box" size="{" ".join(map(str, p.half_size))}" pos="{" ".join(map(str, p.pos))}"/>'
        for p in hollow_parts(size, is_round=False)
    )
    oracle = mujoco.MjModel.from_xml_string(
        f"<mujoco><worldbody><body><freejoint/>{geoms}</body></worldbody></mujoco>"
    )
    body = world.model.body("crate")
    np.testing.assert_allclose(body.ipos, oracle.body_ipos[1], atol=1e-9)
    np.testing.assert_allclose(
        np.sort(body.inertia),
        np.sort(oracle.body_inertia[1]) * 0.3 / oracle.body_mass[1],
        rtol=1e-6,
    )


def test_a_meshs_inertia_is_that_of_its_solid_hull(
    make_object: Callable[..., SceneObject], make_scene: Callable[..., Scene], ball_folder: Path
):
    size = (0.06, 0.06, 0.06)
    scene = make_scene(make_object("ball", "mesh", size, mesh="ball.obj"), folder=ball_folder)

    world = build_world(scene, COARSE)

    solid_ball = 0.4 * 0.12 * 0.03**2  # the hull keeps 40 of 162 points, so it is a little smaller
    np.testing.assert_allclose(world.model.body("ball").inertia, solid_ball, rtol=0.25)
    hull = world.objects[0].hull
    np.testing.assert_allclose(np.ptp(hull, axis=0), size, rtol=1e-6)


@pytest.mark.parametrize("is_round", [False, True], ids=["box", "bowl"])
@pytest.mark.parametrize("upside_down", [False, True], ids=["open above", "open below"])
def test_a_container_fills_its_size_and_is_open(is_round: bool, upside_down: bool):
    size = (0.12, 0.12, 0.06)

    parts = hollow_parts(size, is_round=is_round, upside_down=upside_down)

    tops = [p.pos[2] + p.half_size[2] for p in parts]
    bottoms = [p.pos[2] - p.half_size[2] for p in parts]
    assert max(tops) == pytest.approx(0.03)
    assert min(bottoms) == pytest.approx(-0.03)
    assert parts[0].half_size[0] == pytest.approx(0.06)
    walls = parts[1:]
    mouth = -0.03 if upside_down else 0.03
    assert all(mouth == pytest.approx(p.pos[2] + np.sign(mouth) * p.half_size[2]) for p in walls)
    corners = [np.hypot(np.hypot(*p.pos[:2]) + p.half_size[0], p.half_size[1]) for p in walls]
    if is_round:
        assert max(corners) <= 0.0601


@pytest.mark.parametrize("friction", [0.3, 1.2])
def test_an_object_slides_on_the_table_with_its_own_friction(
    friction: float, make_object: Callable[..., SceneObject], make_scene: Callable[..., Scene]
):
    world = build_world(make_scene(replace(make_object("thing"), friction=friction)), FINE)
    data = mujoco.MjData(world.model)
    data.qpos[world.objects[0].qpos_adr :][:3] = 0.5, 0.5, 0.02

    mujoco.mj_step(world.model, data, nstep=50)

    touching = [c for c in data.contact if world.model.geom("table").id in c.geom]
    assert touching
    np.testing.assert_allclose([c.friction[0] for c in touching], friction)


@pytest.mark.parametrize("physics", [COARSE, FINE], ids=["coarse", "fine"])
def test_a_ball_dropped_into_a_bowl_comes_to_rest_on_its_floor(
    physics, make_object: Callable[..., SceneObject], make_scene: Callable[..., Scene]
):
    scene = make_scene(
        make_object("ball", "sphere", (0.04, 0.04, 0.04), mass_kg=0.05),
        make_object("bowl", "cylinder", (0.14, 0.14, 0.06), role="container", hollow=True),
    )
    world = build_world(scene, physics)
    data = mujoco.MjData(world.model)
    ball, bowl = world.objects
    data.qpos[bowl.qpos_adr : bowl.qpos_adr + 3] = 0.55, 0.2, 0.03
    data.qpos[ball.qpos_adr : ball.qpos_adr + 3] = 0.56, 0.21, 0.15
    data.ctrl[:] = [0.45, -0.2, 0.3, 0, 1, 0, 0, 0.04]

    for _ in range(round(2 / physics.timestep_s)):
        mujoco.mj_step(world.model, data)

    pos = data.qpos[ball.qpos_adr : ball.qpos_adr + 3]
    floor = 0.2 * 0.06
    assert pos[2] == pytest.approx(floor + 0.02, abs=0.003)
    assert np.hypot(*(pos[:2] - data.qpos[bowl.qpos_adr : bowl.qpos_adr + 2])) < 0.07


def test_an_object_lying_in_the_video_lies_in_the_world(
    make_object: Callable[..., SceneObject], make_scene: Callable[..., Scene]
):
    quarter = np.sqrt(0.5)
    lying = make_object("box", "box", (0.02, 0.04, 0.1), quat=(quarter, 0.0, quarter, 0.05))

    obj = build_world(make_scene(lying), COARSE).objects[0]

    R = np.zeros(9)
    mujoco.mju_quat2Mat(R, np.asarray(obj.rest_quat))
    height = np.ptp(obj.hull @ R.reshape(3, 3).T, axis=0)[2]
    assert height == pytest.approx(0.02)  # turned about y: its x axis is vertical


def test_a_pen_held_steeply_in_the_video_lies_on_its_side_in_the_world(
    make_object: Callable[..., SceneObject], make_scene: Callable[..., Scene]
):
    """It points to +y and up by 60 degrees: nearer to standing than to lying."""
    R = Rotation.from_euler("zy", [90, -60], degrees=True)
    pen = make_object("pen", "box", (0.14, 0.02, 0.01), quat=R.as_quat(scalar_first=True))
    held = replace(pen, observed=("no_depth",) * len(pen.poses_world))

    obj = build_world(make_scene(held), COARSE).objects[0]
    laid = Rotation.from_quat(held.laid_pose[3:], scalar_first=True).as_matrix()

    rest = Rotation.from_quat(obj.rest_quat, scalar_first=True).as_matrix()
    assert np.ptp(obj.hull @ rest.T, axis=0)[2] == pytest.approx(0.01)
    np.testing.assert_allclose(laid[:, 0], [0, 1, 0], atol=1e-9)
    assert abs(laid[2, 2]) == pytest.approx(1)
    assert np.linalg.det(laid) == pytest.approx(1)
    assert held.laid_pose[2] == pytest.approx(0.005)
    np.testing.assert_array_equal(pen.laid_pose, pen.first_pose)


@pytest.mark.parametrize(
    ("change", "reason"),
    [
        ({"size_m": (0.4, 0.1, 0.1)}, "object_too_large"),
        ({"size_m": (0.01, 0.01, 0.01)}, "object_too_small"),
        ({"mass_kg": 3.5}, "object_too_heavy"),
        ({"shape": "mesh", "mesh": "missing.obj"}, "mesh_missing"),
    ],
)
def test_an_object_that_does_not_suit_the_robot_is_rejected_by_name(
    change: dict,
    reason: str,
    make_object: Callable[..., SceneObject],
    make_scene: Callable[..., Scene],
    tmp_path: Path,
):
    with pytest.raises(ItemRejectedError, match="thing") as caught:
        build_world(make_scene(make_object("thing", **change), folder=tmp_path), COARSE)

    assert caught.value.reason == reason


def test_a_flat_mesh_is_rejected(
    make_object: Callable[..., SceneObject], make_scene: Callable[..., Scene], tmp_path: Path
):
    (tmp_path / "flat.obj").write_text("v 0 0 0\nv 0.1 0 0\nv 0 0.1 0\nf 1 2 3\n")

    with pytest.raises(ItemRejectedError, match="flat"):
        build_world(
            make_scene(make_object("sheet", "mesh", mesh="flat.obj"), folder=tmp_path), COARSE
        )


def test_the_camera_sees_the_workspace_with_left_on_the_left(
    make_object: Callable[..., SceneObject], make_scene: Callable[..., Scene]
):
    model = build_world(make_scene(make_object()), COARSE).model
    data = mujoco.MjData(model)
    mujoco.mj_forward(model, data)
    camera = model.camera(CAMERA).id
    R, pos = data.cam_xmat[camera].reshape(3, 3), data.cam_xpos[camera]
    half = np.tan(np.radians(model.cam_fovy[camera]) / 2)

    def image(point: tuple[float, float, float]) -> np.ndarray:
        x, y, z = R.T @ (np.asarray(point) - pos)
        return np.array([x, y]) / (-z * half)  # -1 to 1 inside the image

    low, high = TARGET_LOW_M, TARGET_HIGH_M
    for x in (0.35, 0.7):
        for y in (-0.3, 0.3):
            assert np.abs(image((x, y, 0.0))).max() < 1
    for x in (low[0], high[0]):
        assert np.abs(image((x, 0.0, 0.25))).max() < 1
    assert image((0.5, 0.2, 0.0))[0] < image((0.5, -0.2, 0.0))[0]
    assert image((0.5, 0.0, 0.3))[1] > image((0.5, 0.0, 0.0))[1]

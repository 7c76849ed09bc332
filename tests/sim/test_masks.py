"""Masks against OpenGL and rays, palettes against the codec's arithmetic."""

import copy
from dataclasses import dataclass
from pathlib import Path

import mujoco
import numpy as np
import pytest
import trimesh
from mujoco.batch import Batch

from v2p_data.errors import V2PError
from v2p_data.geometry.camera import Camera
from v2p_data.scene.scene import Scene, SceneObject
from v2p_data.sim.env.batch_env import BatchEnv, SimConfig
from v2p_data.sim.model.world import World, build_world
from v2p_data.sim.render.masks import (
    FIRST_OBJECT,
    PALETTE,
    MaskRenderer,
    _GLPainter,
    _NoGLError,
    geom_labels,
    label_names,
    labels_to_rgb,
    rgb_to_labels,
)
from v2p_data.sim.robot.robot import FINE, HOME_QPOS
from v2p_data.task.benchmark import load_benchmark

SIZE_PX = 256


@dataclass
class Moments:
    """What `BatchEnv.snapshot` gives, made by hand."""

    qpos: np.ndarray
    geom_size: np.ndarray | None = None

    def write(self, model: mujoco.MjModel, data: mujoco.MjData, index: int) -> None:
        if self.geom_size is not None:
            model.geom_size[:] = self.geom_size[index]
        data.qpos[:] = self.qpos[index]
        mujoco.mj_forward(model, data)


def an_object(name: str, role: str, shape: str, size_m: tuple, **more) -> SceneObject:
    return SceneObject(
        name=name,
        label=name,
        role=role,
        shape=shape,
        size_m=size_m,
        mass_kg=0.1,
        friction=0.8,
        frames=(0,),
        poses_world=((0.0, 0.0, size_m[2] / 2, 1.0, 0.0, 0.0, 0.0),),
        **more,
    )


@pytest.fixture(scope="module")
def world(tmp_path_factory) -> World:
    folder: Path = tmp_path_factory.mktemp("scene")
    trimesh.creation.icosphere(2, radius=0.04).export(folder / "ball.obj")
    return build_world(
        Scene(
            title="masks",
            video="masks.mp4",
            description="lifting a box",
            kind="lift_up",
            objects=(
                an_object("box", "manipulated", "box", (0.05, 0.06, 0.08)),
                an_object("ball", "reference", "mesh", (0.08, 0.08, 0.08), mesh="ball.obj"),
                an_object("bowl", "container", "cylinder", (0.12, 0.12, 0.06), hollow=True),
            ),
            camera=Camera(width_px=64, height_px=48, K=np.eye(3), T_world_cam=np.eye(4)),
            fps=20.0,
            num_frames=2,
            confidence=1.0,
            folder=folder,
        ),
        FINE,
    )


@pytest.fixture(scope="module")
def moments(world: World) -> Moments:
    """Random arm poses and objects strewn on the table, boxes of different sizes."""
    rng = np.random.default_rng(5)
    count = 6
    qpos = np.tile(world.model.qpos0, (count, 1))
    qpos[:, :7] = np.asarray(HOME_QPOS) + rng.normal(0, 0.15, (count, 7))
    qpos[:, 7:9] = rng.uniform(0, 0.04, (count, 1))
    for obj in world.objects:
        at = obj.qpos_adr
        qpos[:, at : at + 2] = np.array((0.52, 0)) + rng.uniform(-0.12, 0.12, (count, 2))
        qpos[:, at + 2] = rng.uniform(0.05, 0.1, count)
        quat = rng.normal(size=(count, 4))
        qpos[:, at + 3 : at + 7] = quat / np.linalg.norm(quat, axis=1, keepdims=True)
    sizes = np.tile(world.model.geom_size, (count, 1, 1))
    sizes[:, world.objects[0].geom_ids[0]] *= rng.uniform(0.8, 1.2, (count, 1))
    return Moments(qpos=qpos, geom_size=sizes)


def test_every_label_survives_the_way_to_grey_and_back():
    labels = np.arange(len(PALETTE), dtype=np.uint8).reshape(1, 3, 3)

    assert (rgb_to_labels(labels_to_rgb(labels)) == labels).all()


def test_every_grey_survives_limited_range_luma():
    greys = np.asarray(PALETTE)
    luma = np.rint(16 + greys * 219 / 255)

    assert (np.clip(np.rint((luma - 16) * 255 / 219), 0, 255) == greys).all()


def test_a_label_without_a_grey_is_refused():
    with pytest.raises(ValueError, match="no grey"):
        labels_to_rgb(np.full((1, 1), len(PALETTE), np.uint8))


def test_labels_are_named_in_scene_order():
    assert label_names(("box", "bowl")) == {0: "background", 1: "robot", 2: "box", 3: "bowl"}


@pytest.fixture(scope="module")
def renderer(world: World):
    with MaskRenderer(world, SIZE_PX) as renderer:
        yield renderer


@pytest.fixture(scope="module")
def drawn(moments: Moments, renderer: MaskRenderer) -> np.ndarray:
    return renderer.draw_many([(moments, k) for k in range(len(moments.qpos))])


def least_overlap(a: np.ndarray, b: np.ndarray) -> float:
    """Return the lowest intersection over union of any label."""
    assert set(np.unique(a)) == set(np.unique(b)) == {0, 1, 2, 3, 4}
    return min(
        ((a == label) & (b == label)).sum() / ((a == label) | (b == label)).sum()
        for label in range(5)
    )


def labels_by_opengl(world: World, painter: _GLPainter, moments: Moments, k: int) -> np.ndarray:
    """Return the label of the geom whose number OpenGL draws as a colour."""
    for flag in (mujoco.mjtRndFlag.mjRND_SEGMENT, mujoco.mjtRndFlag.mjRND_IDCOLOR):
        painter.scene.flags[flag] = True
    shown = painter.draw(moments, k).astype(np.int32) @ [1, 1 << 8, 1 << 16]
    labels = np.zeros(painter.scene.ngeom + 1, np.uint8)
    for geom in painter.scene.geoms[: painter.scene.ngeom]:
        if geom.objtype == mujoco.mjtObj.mjOBJ_GEOM:
            labels[geom.segid + 1] = geom_labels(world)[geom.objid]
    return labels[shown]


def test_the_z_buffer_draws_what_opengl_draws(world: World, drawn: np.ndarray, moments: Moments):
    try:
        painter = _GLPainter(world.model, (SIZE_PX, SIZE_PX))
    except _NoGLError as error:
        pytest.skip(str(error))

    peers = np.stack([labels_by_opengl(world, painter, moments, k) for k in range(len(drawn))])
    painter.close()

    assert least_overlap(drawn, peers) >= 0.998


def labels_by_rays(world: World, moments: Moments, index: int) -> np.ndarray:
    """Return the label of what MuJoCo's ray through each pixel's centre hits first."""
    model = copy.copy(world.model)
    data, batch = mujoco.MjData(model), Batch(model, 1, 1)
    moments.write(model, data, index)
    batch.set_models(model)
    batch.bind("qpos")[0] = data.qpos
    camera = model.camera("view").id
    rows, columns = np.mgrid[0:SIZE_PX, 0:SIZE_PX] + 0.5 - SIZE_PX / 2
    focal_px = SIZE_PX / 2 / np.tan(np.radians(model.cam_fovy[camera]) / 2)
    beams = np.stack([columns, -rows, np.full_like(rows, -focal_px)], axis=-1).reshape(-1, 3)
    _, geoms = batch.ray(data.cam_xpos[camera], beams @ data.cam_xmat[camera].reshape(3, 3).T)
    return np.append(geom_labels(world), np.uint8(0))[geoms[0]].reshape(SIZE_PX, SIZE_PX)


def test_the_z_buffer_draws_what_rays_hit(world: World, drawn: np.ndarray, moments: Moments):
    peers = np.stack([labels_by_rays(world, moments, k) for k in range(len(drawn))])

    assert least_overlap(drawn, peers) >= 0.995


def test_images_need_not_be_square(world: World, moments: Moments, drawn: np.ndarray):
    image = MaskRenderer(world, (128, 64)).draw(moments, 0)

    # As high as wide is the whole; half as wide is its middle.
    assert image.shape == (128, 64)
    assert (image != drawn[0, 1::2, 65:193:2]).mean() < 0.05


def test_several_images_are_those_drawn_one_by_one(
    renderer: MaskRenderer, moments: Moments, drawn: np.ndarray
):
    assert (np.stack([renderer.draw(moments, k) for k in range(len(drawn))]) == drawn).all()


def test_pictures_are_drawn_beside_masks(renderer: MaskRenderer, moments: Moments):
    try:
        picture = renderer.draw_rgb(moments, 0)
    except V2PError as error:
        pytest.skip(str(error))

    assert picture.shape == (SIZE_PX, SIZE_PX, 3)
    assert picture.std() > 10


def test_a_moment_looks_the_same_whatever_was_drawn_before(
    moments: Moments, renderer: MaskRenderer
):
    first = renderer.draw(moments, 0)
    renderer.draw(moments, 3)

    assert (renderer.draw(moments, 0) == first).all()


def test_a_larger_box_covers_more_pixels(world: World, renderer: MaskRenderer):
    qpos = np.tile(world.model.qpos0, (2, 1))
    for k, obj in enumerate(world.objects):
        qpos[:, obj.qpos_adr : obj.qpos_adr + 3] = (0.45 + 0.1 * k, 0.15 * (k - 1), 0.05)
    sizes = np.tile(world.model.geom_size, (2, 1, 1))
    sizes[1, world.objects[0].geom_ids[0]] *= 1.3
    pair = Moments(qpos=qpos, geom_size=sizes)

    small, large = ((renderer.draw(pair, k) == 2).sum() for k in range(2))

    assert 1.3 * small < large < 2.0 * small


def test_the_robots_left_is_the_pictures_left(world: World, renderer: MaskRenderer):
    qpos = np.tile(world.model.qpos0, (2, 1))
    at = world.objects[0].qpos_adr
    for obj in world.objects[1:]:
        qpos[:, obj.qpos_adr : obj.qpos_adr + 3] = (-3, 0, 0.05)
    qpos[0, at : at + 3] = (0.5, 0.2, 0.04)
    qpos[1, at : at + 3] = (0.5, -0.2, 0.04)

    left, right = (np.nonzero(renderer.draw(Moments(qpos), k) == 2)[1].mean() for k in range(2))

    assert left < SIZE_PX / 2 < right


def test_the_callers_model_is_left_alone(world: World, moments: Moments, renderer: MaskRenderer):
    renderer.draw(moments, 0)

    assert world.model.geom_size[world.objects[0].geom_ids[0]] == pytest.approx(
        (0.025, 0.03, 0.04)
    )


def test_the_wrists_picture_lies_below_the_tables_and_shows_the_object_where_a_pinhole_does():
    bundle = load_benchmark("lift_up")
    env = BatchEnv(bundle, SimConfig(fine=True), num_envs=3, seed=0, num_threads=1)
    moments = [(env.snapshot(np.arange(3)), k) for k in range(3)]
    with (
        MaskRenderer(env.world, SIZE_PX, wrist=True) as both,
        MaskRenderer(env.world, SIZE_PX) as table,
    ):
        drawn, alone = both.draw_many(moments), table.draw_many(moments)

    assert np.array_equal(drawn[:, :SIZE_PX], alone)
    focal_px = SIZE_PX / 2 / np.tan(np.radians(80.0) / 2)
    seen, pos = 0, env.states()["tea_box_pos"].numpy()
    for k in range(3):
        x, y = env.observe()[k, 3:6], env.observe()[k, 6:9]
        down = np.cross(x, y)
        eye = env.robot_state()[k, :3] + 0.11 * x - 0.07 * down
        ahead = (-0.11 * x + 0.12 * down) / np.hypot(0.11, 0.12)
        to = pos[k] - eye
        depth = to @ ahead
        column = SIZE_PX / 2 + focal_px * (to @ np.cross(ahead, y)) / depth
        row = SIZE_PX / 2 - focal_px * (to @ y) / depth
        if depth > 0 and 0 <= column < SIZE_PX and 0 <= row < SIZE_PX:
            seen += drawn[k, SIZE_PX + int(row), int(column)] == FIRST_OBJECT
    assert seen >= 2

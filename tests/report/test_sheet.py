"""Contact sheets: where each thumbnail lies, which episodes are chosen, and that a rollout is really drawn."""

from dataclasses import dataclass, field

import cv2
import numpy as np
import pytest

from v2p_data.errors import V2PError
from v2p_data.geometry.camera import Camera
from v2p_data.report.sheet import (
    BAD,
    GOOD,
    GROUND,
    Row,
    SheetConfig,
    contact_sheet,
    draw_moment,
    draw_rollout,
    write_contact_sheet,
)
from v2p_data.scene.scene import Scene, SceneObject
from v2p_data.sim.model.world import World, build_world
from v2p_data.sim.render.masks import MaskRenderer
from v2p_data.sim.robot.robot import FINE

CFG = SheetConfig(thumbnail_px=40, label_px=60, gap_px=4, moments=3, successes=2, failures=1)


def a_row(value: int, *, succeeded: bool, count=3) -> Row:
    frames = np.zeros((count, 80, 80, 3), np.uint8)
    frames[:] = (value + np.arange(count) * 10)[:, None, None, None]
    return Row(
        label=f"world {value}",
        succeeded=succeeded,
        frames=frames,
        seconds=tuple(0.5 * k for k in range(count)),
    )


def thumbnail(sheet: np.ndarray, row: int, column: int) -> np.ndarray:
    top, left = row * 44, 60 + column * 44
    return sheet[top : top + 40, left : left + 40]


def test_rows_are_episodes_and_columns_are_moments():
    sheet = contact_sheet([a_row(50, succeeded=True), a_row(150, succeeded=False)], CFG)

    assert sheet.shape == (2 * 44, 60 + 3 * 44, 3)
    for row, value in ((0, 50), (1, 150)):
        for column in range(3):
            below_the_time = thumbnail(sheet, row, column)[20:]
            assert (below_the_time == value + 10 * column).all()


def test_no_episodes_give_a_sheet_that_says_so():
    sheet = contact_sheet([], CFG)

    assert (sheet != GROUND).any()


@dataclass
class Moments:
    """What `BatchEnv.snapshot` gives, made by hand."""

    qpos: np.ndarray

    def write(self, model, data, index):
        import mujoco

        data.qpos[:] = self.qpos[index]
        mujoco.mj_forward(model, data)


@dataclass
class Judged:
    successes: np.ndarray
    num_frames: np.ndarray
    snapshots: list[Moments]
    snapshot_seconds: list[float] = field(default_factory=list)


@pytest.fixture(scope="module")
def world(tmp_path_factory) -> World:
    box = SceneObject(
        name="box",
        label="a box",
        role="manipulated",
        shape="box",
        size_m=(0.08, 0.08, 0.08),
        mass_kg=0.1,
        friction=0.8,
        rgba=(0.9, 0.1, 0.1, 1.0),
        frames=(0,),
        poses_world=((0.0, 0.0, 0.04, 1.0, 0.0, 0.0, 0.0),),
    )
    scene = Scene(
        title="sheet",
        video="a.mp4",
        description="lifting a box",
        kind="lift_up",
        objects=(box,),
        fps=20.0,
        num_frames=2,
        confidence=1.0,
        folder=tmp_path_factory.mktemp("scene"),
        camera=Camera(width_px=64, height_px=48, K=np.eye(3), T_world_cam=np.eye(4)),
    )
    return build_world(scene, FINE)


@pytest.fixture(scope="module")
def snapshots(world) -> list[Moments]:
    """Four worlds whose boxes go to the left by a different distance each, at three moments."""
    start = np.tile(world.model.qpos0, (4, 1))
    moments = []
    for t in range(3):
        qpos = start.copy()
        qpos[:, world.objects[0].qpos_adr + 1] += 0.05 * t * np.arange(4)
        moments.append(Moments(qpos))
    return moments


def red_column(image: np.ndarray) -> float:
    """Mean column of the red pixels; of the brightest label where there is no colour."""
    is_grey = (np.ptp(image.astype(int), axis=-1) == 0).all()
    red = image[..., 0] == 128 if is_grey else image[..., 0] > image[..., 1].astype(int) + 60
    return float(np.nonzero(red)[1].mean())


def test_a_rollout_shows_the_object_where_it_is(world, snapshots):
    with MaskRenderer(world, 96) as renderer:
        resting, pushed = (draw_rollout(renderer, snapshots, env) for env in (0, 3))

    assert pushed.shape == (3, 96, 96, 3)
    np.testing.assert_array_equal(resting[0], resting[2])
    columns = [red_column(image) for image in pushed]
    assert columns[0] > columns[1] + 3 > columns[2] + 6  # +y is the image's left


def test_the_sheet_of_a_batch_shows_successes_then_failures(world, snapshots, tmp_path):
    lengths = np.array([3, 3, 2, 3])
    judged = Judged(np.array([False, True, True, True]), lengths, snapshots, [0.0, 1.0, 2.0])

    write_contact_sheet(world, judged, tmp_path / "sheet.png", CFG)

    sheet = cv2.imread(str(tmp_path / "sheet.png"))[..., ::-1]
    assert sheet.shape == (3 * 44, 60 + 3 * 44, 3)
    assert [tuple(sheet[8 + 44 * k, 1]) for k in range(3)] == [GOOD, GOOD, BAD]
    with MaskRenderer(world, 80) as renderer:
        last = cv2.resize(
            draw_moment(renderer, snapshots[1], 2), (40, 40), interpolation=cv2.INTER_AREA
        )
    np.testing.assert_array_equal(thumbnail(sheet, 1, 1)[20:], last[20:])
    assert (thumbnail(sheet, 1, 2) == GROUND).all()  # world 2's episode was shorter


class WithoutOpenGL(MaskRenderer):
    def draw_rgb(self, snapshot, index):
        raise V2PError("there is no OpenGL")


def test_without_opengl_a_moment_is_drawn_as_its_mask(world, snapshots):
    with WithoutOpenGL(world, 48) as renderer:
        image = draw_moment(renderer, snapshots[0], 0)

    assert set(np.unique(image)) == {0, 64, 128}

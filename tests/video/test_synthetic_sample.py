"""The sample clips: the truth beside them is the truth in them."""

import itertools
import json
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest

from v2p_data.errors import V2PError
from v2p_data.geometry.camera import Camera
from v2p_data.geometry.pose import apply, transform_from_pose
from v2p_data.video.captions import find_videos, parse_caption
from v2p_data.video.decode import read_clip
from v2p_data.video.synthetic_sample import VideoSpec, View, animate, render, write
from v2p_data.video.synthetic_scene import LABEL_OBJECT, Hand, Placed, Thing

SAMPLES = Path(__file__).parents[2] / "datasets" / "sample_videos"
BOX = Thing(
    label="red box",
    shape="box",
    size_m=(0.05, 0.06, 0.09),
    base=(0.8, 0.0, 0.0),
    accent=(0.9, 0.9, 0.9),
)
SMALL = VideoSpec(
    name="small",
    kind="push_left",
    thing=BOX,
    seconds=2.0,
    fps=8,
    view=View(width_px=320, height_px=240, side_m=0.05),
)


def corners(size_m, pose):
    signs = np.array(list(itertools.product((-0.5, 0.5), repeat=3)))
    return apply(transform_from_pose(np.asarray(pose, float)), signs * np.asarray(size_m))


def rims(size_m, pose):
    angles = np.linspace(0, 2 * np.pi, 60)
    ring = np.stack([np.cos(angles), np.sin(angles), np.ones(60)], 1)
    points = np.concatenate([ring, ring * (1, 1, -1)]) * np.asarray(size_m) / 2
    return apply(transform_from_pose(np.asarray(pose, float)), points)


def bounds_of(mask):
    rows, columns = np.nonzero(mask)
    return np.array([columns.min(), rows.min(), columns.max() + 1, rows.max() + 1])


def bounds_of_corners(camera, points):
    uv = camera.project(points)
    return np.concatenate([uv.min(0), uv.max(0)])


def drawn(spec):
    try:
        return render(spec)
    except V2PError as error:
        pytest.skip(str(error))


@pytest.fixture(scope="module")
def pushed():
    other = Placed(thing=replace(BOX, label="box"), xy_m=(0.15, -0.12), yaw_rad=0.4)
    return drawn(replace(SMALL, others=(other,)))


def test_masks_lie_where_the_true_box_projects(pushed):
    for mask, pose in (
        (pushed.mask_first, pushed.poses_world[0]),
        (pushed.mask_last, pushed.poses_world[-1]),
    ):
        expected = bounds_of_corners(pushed.camera, corners(BOX.size_m, pose))
        assert np.abs(bounds_of(mask == LABEL_OBJECT) - expected).max() < 1.5

    pose = [0.15, -0.12, 0.045, np.cos(0.2), 0, 0, np.sin(0.2)]
    expected = bounds_of_corners(pushed.camera, corners(BOX.size_m, pose))
    assert np.abs(bounds_of(pushed.mask_first == LABEL_OBJECT + 1) - expected).max() < 1.5


def test_the_hand_comes_and_goes(pushed):
    assert not pushed.hand_in_view[0]
    assert not pushed.hand_in_view[-1]
    assert pushed.hand_in_view.any()
    assert set(np.unique(pushed.mask_first)) == {0, LABEL_OBJECT, LABEL_OBJECT + 1}


def test_the_picture_shows_the_object_in_its_colour(pushed):
    inside = pushed.frames[0][pushed.mask_first == LABEL_OBJECT].astype(float)
    outside = pushed.frames[0][pushed.mask_first == 0].astype(float)

    assert (inside[:, 0] - inside[:, 1]).mean() > (outside[:, 0] - outside[:, 1]).mean() + 20


def test_the_same_spec_gives_the_same_pictures():
    spec = replace(SMALL, fps=2)

    assert np.array_equal(drawn(spec).frames, drawn(spec).frames)


def test_a_lifted_object_ends_higher_and_stays_in_the_hand():
    T = animate(replace(SMALL, kind="lift_up", distance_m=0.15)).T_world_obj

    # 9 cm tall: the centre starts at 4.5 cm
    assert T[0, :3, 3] == pytest.approx([0, 0, 0.045])
    assert T[-1, 2, 3] == pytest.approx(0.195)


@pytest.mark.parametrize(
    ("kind", "side", "y"), [("push_left", "right", 0.12), ("push_right", "left", -0.12)]
)
def test_pushing_moves_along_the_table_to_its_side(kind, side, y):
    T = animate(replace(SMALL, kind=kind, distance_m=0.12, hand=Hand(side=side))).T_world_obj

    assert T[-1, :3, 3] == pytest.approx([0, y, 0.045])
    assert T[-1, :3, :3] == pytest.approx(T[0, :3, :3])


@pytest.mark.parametrize(("side", "sign"), [("right", 1), ("left", -1)])
def test_a_tipped_object_lies_on_its_side_away_from_the_hand(side, sign):
    spec = replace(SMALL, kind="tip_over", yaw_rad=0.0, hand=Hand(side=side))

    T = animate(spec).T_world_obj[-1]

    # it turned about its lower edge at y = 3 cm: it now reaches from there to 12 cm, 6 cm high
    assert T[:3, 3] == pytest.approx([0, sign * 0.075, 0.03])
    assert T[:3, 2] == pytest.approx([0, sign, 0])


def test_a_written_clip_is_read_back_with_its_truth(pushed, tmp_path):
    path = write(pushed, tmp_path)

    (item,) = find_videos(tmp_path)
    clip = read_clip(item)
    truth = json.loads((tmp_path / "truth" / "small.json").read_text())
    assert item.path == path
    assert len(clip.frames) == truth["num_frames"] == 16
    assert clip.fps == pytest.approx(8)
    assert np.abs(clip.frames[0].astype(int) - pushed.frames[0]).mean() < 6
    assert len(truth["object"]["poses_world"]) == 16
    saved = cv2.imread(str(tmp_path / "truth" / "small_first.png"), cv2.IMREAD_UNCHANGED)
    assert saved is not None
    assert np.array_equal(saved, pushed.mask_first)


@pytest.mark.parametrize("path", sorted(SAMPLES.rglob("*.mp4")), ids=lambda p: p.stem)
def test_the_committed_samples_hold_together(path):
    (item,) = find_videos(path)
    clip = read_clip(item)
    truth = json.loads((path.parent / "truth" / f"{path.stem}.json").read_text())
    camera = Camera(
        width_px=640,
        height_px=480,
        K=np.array(truth["camera"]["K"]),
        T_world_cam=np.array(truth["camera"]["T_world_cam"]),
    )
    thing = truth["object"]
    mask = cv2.imread(str(path.parent / "truth" / f"{path.stem}_first.png"), cv2.IMREAD_UNCHANGED)

    assert path.stat().st_size < 1_000_000
    assert len(clip.frames) == truth["num_frames"] == 108
    assert clip.frames.shape[1:] == (480, 640, 3)
    assert clip.warnings == ()
    assert parse_caption(item.caption, item.objects).kind == truth["kind"]
    assert item.objects == (thing["label"],)
    outline = {"box": corners, "cylinder": rims}[thing["shape"]]
    points = outline(thing["size_m"], thing["poses_world"][0])
    assert np.abs(bounds_of(mask == 2) - bounds_of_corners(camera, points)).max() < 1.5
    assert not truth["hand_in_view"][0]
    assert truth["hand_in_view"][-1] == (truth["kind"] == "lift_up")


def test_there_are_samples():
    assert len(list(SAMPLES.glob("*.mp4"))) == 3

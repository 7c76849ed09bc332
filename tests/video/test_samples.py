"""The committed sample clips: the truth beside them is the truth in them. They are kept as they are.

Nothing draws them anew.
"""

import itertools
import json
from pathlib import Path

import cv2
import numpy as np
import pytest

from v2p_data.geometry.camera import Camera
from v2p_data.geometry.pose import apply, transform_from_pose
from v2p_data.video.captions import find_videos, parse_caption
from v2p_data.video.decode import read_clip

SAMPLES = Path(__file__).parents[2] / "datasets" / "sample_videos"


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

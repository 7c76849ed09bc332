import json
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest

from v2p_data.scene.data_types import RestingObject
from v2p_data.scene.fitting.hand_scale import (
    height_from_hand,
    planes_of,
    view_hand,
)
from v2p_data.scene.fitting.silhouette import camera_above
from v2p_data.scene.frames.classes import HAND
from v2p_data.scene.frames.hand import HandEnd
from v2p_data.scene.frames.segmentation import segment_clip
from v2p_data.scene.frames.working_clip import working_clip_of
from v2p_data.video.captions import find_videos
from v2p_data.video.decode import read_clip

SAMPLES = Path(__file__).parents[3] / "datasets" / "sample_videos"


def test_only_the_hand_is_looked_at():
    rng = np.random.default_rng(0)
    rgb = rng.integers(0, 255, (112, 112, 3), dtype=np.uint8)
    hand = np.zeros((112, 112), np.float32)
    hand[40:70, 30:80] = 1
    other = rgb.copy()
    other[:30] = 255 - other[:30]

    np.testing.assert_array_equal(planes_of(rgb, hand), planes_of(other, hand))
    assert planes_of(rgb, hand)[:3, 50, 50].any()


def test_twice_as_many_pixels_per_metre_show_the_same():
    rgb = cv2.GaussianBlur(
        np.random.default_rng(1).integers(0, 255, (120, 160, 3), dtype=np.uint8), (0, 0), 3
    )
    hand = cv2.line(np.zeros((120, 160), np.float32), (0, 60), (100, 80), 1, 12)
    end = HandEnd(tip_px=(104.0, 81.0), entry_px=(0.0, 81.0))
    foot = np.array([120.0, 90.0])

    one = view_hand(rgb, hand, end, foot, 200.0, 0.6, 0.1)
    big, big_hand = (cv2.resize(x, None, fx=2, fy=2) for x in (rgb, hand))
    far = HandEnd(tip_px=(208.0, 162.0), entry_px=(0.0, 162.0))
    two = view_hand(big, big_hand, far, 2 * foot, 400.0, 0.6, 0.1)

    np.testing.assert_allclose(one.known, two.known, rtol=1e-6)
    assert np.abs(one.planes[3] - two.planes[3]).mean() < 0.01
    assert np.abs(one.planes[:3] - two.planes[:3]).mean() < 0.05


def seen(item: str):
    """Return the arguments of height_by_hand for a sample clip with a true thing, and the true height."""
    video = next(v for v in find_videos(SAMPLES) if v.item == item)
    truth = json.loads((SAMPLES / "truth" / f"{video.path.stem}.json").read_text())
    labels = cv2.imread(str(SAMPLES / "truth" / truth["masks"]["first"]), cv2.IMREAD_UNCHANGED)
    assert labels is not None
    clip = read_clip(video)
    working = working_clip_of(clip)
    h, w = working.shape
    small = cv2.resize(labels, (w, h), interpolation=cv2.INTER_NEAREST)
    mask = small == truth["mask_labels"]["object"]
    T = np.array(truth["camera"]["T_world_cam"])
    K = np.array(truth["camera"]["K"])
    pitch, height = float(np.arcsin(-T[2, 2])), float(T[2, 3])
    camera = camera_above((h, w), pitch, float(2 * np.arctan(320 / K[0, 0])))
    masks = np.repeat(mask[None], len(working.rgb), 0)
    first = np.array(truth["object"]["poses_world"][0][:3])
    foot = (first - [T[0, 3], T[1, 3], 0]) / height
    resting = RestingObject(masks=masks, rests=[(mask, foot)], camera=camera, pitch_rad=pitch)
    return working, segment_clip(clip, working), resting, height


@pytest.mark.long
def test_the_height_of_a_sample_clip_s_camera_is_told_by_its_hand_from_a_wrong_guess():
    working, segmentation, resting, true = seen("push_blue_box_left")

    high, low = (
        height_from_hand(working, segmentation, resting, guess)
        for guess in (1.25 * true, true / 1.25)
    )

    for found in (high, low):
        assert found is not None
        assert abs(np.log(found[0] / true)) < 0.18
        assert 0.03 < found[1] < 0.3


@pytest.mark.long
def test_a_hand_that_touches_nothing_says_nothing():
    working, segmentation, resting, height = seen("push_blue_box_left")
    gone = replace(segmentation, shares=segmentation.shares.copy())
    gone.shares[:, HAND] = 0

    assert height_from_hand(working, gone, resting, height) is None
    away = np.zeros_like(resting.masks)
    away[:, 5:20, 5:20] = True  # where no hand comes
    far = replace(resting, masks=away, rests=[(away[0], resting.rests[0][1])])
    assert height_from_hand(working, segmentation, far, height) is None

"""Stretched videos: sample clips whose frames are repeated here, through the encoder as well."""

from dataclasses import replace
from pathlib import Path

import av
import numpy as np
import pytest

from v2p_data.scene.frames.repeats import changes_of, times_shown, uneven_repeats, without_repeats
from v2p_data.video.captions import VideoItem, find_videos
from v2p_data.video.clip import Clip
from v2p_data.video.decode import VideoConfig, read_clip

SAMPLES = Path(__file__).parents[3] / "datasets" / "sample_videos"
SMALL = VideoConfig(max_side_px=160)


@pytest.fixture(scope="module")
def clips() -> list[Clip]:
    return [read_clip(video, SMALL) for video in find_videos(SAMPLES)]


def encoded(clip: Clip, order: np.ndarray, path: Path) -> Clip:
    """Return the clip with its frames in this order, written to a file at 30 frames a second and read again."""
    with av.open(str(path), "w") as file:
        stream = file.add_stream("libx264", rate=30)
        stream.height, stream.width = clip.frames.shape[1:3]
        stream.pix_fmt = "yuv420p"
        for i in order:
            file.mux(stream.encode(av.VideoFrame.from_ndarray(clip.frames[i], "rgb24")))
        file.mux(stream.encode())
    item = VideoItem(
        item=clip.item, path=path, caption=clip.caption, objects=clip.objects, hints={}
    )
    return read_clip(item, SMALL)


def test_a_clip_without_repeats_is_left_as_it_is(clips):
    for clip in clips:
        assert without_repeats(clip) is clip


@pytest.mark.parametrize("times", [2, 3, 4])
def test_one_of_each_equal_frames_is_kept_and_time_stays(clips, times, tmp_path):
    true = clips[0]
    order = np.repeat(np.arange(20, 20 + 144 // times), times)
    stretched = encoded(true, order, tmp_path / "stretched.mp4")
    hint = {"red box": {"frame": 7 * times + 1, "box": [10.0, 10.0, 40.0, 40.0]}}

    kept = without_repeats(replace(stretched, hints=hint))

    assert len(kept.frames) == 144 // times
    assert kept.fps == pytest.approx(30 / times, rel=0.02)
    assert kept.duration_s == pytest.approx(stretched.duration_s, rel=0.02)
    assert kept.hints["red box"].get("frame") == 7
    assert f"{times} times" in kept.warnings[-1]
    wrong = np.abs(kept.frames.astype(int) - true.frames[order[::times]]).mean()
    assert wrong < 3


def test_repeats_in_no_even_pattern_are_told_and_kept(clips):
    true = clips[0]
    rng = np.random.default_rng(0)
    order = np.repeat(np.arange(len(true.frames)), rng.integers(1, 3, len(true.frames)))
    times_s = np.arange(len(order)) / true.fps
    halting = replace(true, frames=true.frames[order], source_frame=order, times_s=times_s)

    kept = without_repeats(halting)

    assert len(kept.frames) == len(order)
    assert "the video halts" in kept.warnings[-1]


def test_a_still_beginning_and_end_are_no_repeats():
    changes = np.array([0.0] * 20 + [30.0, 28, 31, 35, 30, 33, 29, 30] + [0.0] * 20)

    assert times_shown(changes) == 1
    assert uneven_repeats(changes) == (0, 8)


def test_small_motion_counts_in_a_large_still_picture():
    frames = np.zeros((4, 120, 160, 3), np.uint8)
    for t in range(4):
        frames[t, 50:62, 20 + 14 * t : 32 + 14 * t] = 200

    assert (changes_of(frames) > 100).all()

"""Edited videos: sample clips with bars and cuts, each put together here."""

from dataclasses import replace

import numpy as np
import pytest
from sample_clips import with_frames

from v2p_data.errors import ItemRejectedError
from v2p_data.scene.frames.footage import check_cuts, without_bars
from v2p_data.scene.frames.working_clip import working_clip_of
from v2p_data.video.clip import Clip


def another_scene(clip: Clip) -> np.ndarray:
    """Return frames that look like another room: the sample clips share one."""
    return np.ascontiguousarray(clip.frames[:, ::-1, ::-1])


def checked(clip: Clip) -> None:
    check_cuts(clip, working_clip_of(clip))


def test_a_clip_that_nobody_edited_is_left_as_it_is(clips):
    for clip in clips:
        assert without_bars(clip) is clip
        checked(clip)


@pytest.mark.parametrize(
    ("above", "below", "left", "right"), [(60, 60, 0, 0), (0, 0, 90, 70), (24, 40, 30, 16)]
)
def test_black_bars_are_cut_off_and_hints_go_along(clips, above, below, left, right):
    clip = clips[0]
    noise = np.random.default_rng(0).integers(0, 6, (len(clip.frames), 1, 1, 3), np.uint8)
    frames = np.pad(clip.frames, ((0, 0), (above, below), (left, right), (0, 0)))
    frames = np.maximum(frames, noise)  # bars of a real file are not quite black
    box = [left + 100.0, above + 50.0, left + 160.0, above + 90.0]
    padded = replace(with_frames(clip, frames), hints={"red box": {"frame": 0, "box": box}})

    cut = without_bars(padded)

    assert cut.crop is not None
    x0, y0, x1, y1 = cut.crop.box_px
    h, w = clip.frames.shape[1:3]
    for found, true in zip((x0, y0, x1, y1), (left, above, left + w, above + h), strict=True):
        assert abs(found - true) <= 1
    assert cut.frames.shape[1:3] == (y1 - y0, x1 - x0)
    np.testing.assert_allclose(cut.hints["red box"]["box"], [100, 50, 160, 90], atol=1)
    assert cut.in_file_px == tuple(2.0 * v for v in cut.crop.box_px)
    assert "black bars" in cut.warnings[-1]


def test_a_dark_table_edge_is_no_bar(clips):
    frames = clips[0].frames.copy()
    shade = np.linspace(0, 1, 120)[:, None, None]
    frames[:, -120:] = (frames[:, -120:] * shade[::-1]).astype(np.uint8)  # fades to black

    assert without_bars(with_frames(clips[0], frames)).crop is None


def test_a_cut_is_found_where_it_is_and_the_longest_part_is_advised(clips):
    a, b = clips[0].frames[:30], another_scene(clips[1])[:50]
    clip = with_frames(clips[0], np.concatenate([a, b]))

    with pytest.raises(ItemRejectedError, match=r"ffmpeg -ss \d+\.\d\d -to \d+\.\d\d -i") as error:
        checked(clip)

    assert error.value.reason == "cut"
    at = 30 / clip.fps
    assert f"-ss {at:.2f}" in error.value.detail
    assert error.value.value is not None
    assert error.value.value < 0.33


def test_a_jump_of_exposure_and_a_swaying_camera_are_no_cuts(clips):
    frames = clips[0].frames.astype(float)
    half = len(frames) // 2
    frames[half:] = (frames[half:] * 1.5 + 12).clip(0, 255)
    brighter = with_frames(clips[0], frames.astype(np.uint8))
    shifts = (10 * np.sin(np.arange(len(frames)) / 3)).astype(int)
    swaying = np.stack(
        [np.roll(f, (s, 2 * s), (0, 1)) for f, s in zip(clips[0].frames, shifts, strict=True)]
    )

    checked(brighter)
    checked(with_frames(clips[0], swaying))

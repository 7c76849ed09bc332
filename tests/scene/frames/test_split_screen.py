"""Split screens: sample clips put beside and above each other, and scenes with lines that look like seams, drawn here."""

from dataclasses import replace

import cv2
import numpy as np
import pytest
from sample_clips import with_frames

from v2p_data.errors import ItemRejectedError
from v2p_data.scene.frames.split_screen import Seam, check_split, seam_of
from v2p_data.scene.frames.working_clip import working_clip_of
from v2p_data.video.clip import Clip, Crop

W, H = 320, 240


def found(clip: Clip, frames: np.ndarray) -> Seam | None:
    return seam_of(frames, working_clip_of(with_frames(clip, frames)))


def composite(clips: list[Clip], share: float, *, upright: bool) -> np.ndarray:
    """Return two clips in one picture; the second is turned and darker, as in another room."""
    first, second = (
        clip.frames[np.linspace(0, len(clip.frames) - 1, 30).astype(int)] for clip in clips[:2]
    )
    second = second[:, ::-1, ::-1] // 2
    h, w = first.shape[1:3]
    if upright:
        cut = round(share * w)
        return np.concatenate([first[:, :, -cut:], second[:, :, : w - cut]], axis=2)
    cut = round(share * h)
    return np.concatenate([first[:, -cut:], second[:, : h - cut]], axis=1)


def checked_cloth(tilt_px: float, crossing_tilt: float) -> np.ndarray:
    """Return a picture of a checked cloth: one line of its checks is upright but for `tilt_px` over the height, its neighbours fan out."""
    y, x = np.mgrid[0:H, 0:W].astype(np.float32)
    middle = 0.5 * W + tilt_px * (y / (H - 1) - 0.5)
    columns = np.floor((x - middle) / (20 + 16 * y / H))
    rows = np.floor((y + crossing_tilt * x) / 26)
    luma = 250 - 45 * (columns % 2) - 40 * (rows % 2)
    grey = cv2.GaussianBlur(luma.astype(np.float32), (0, 0), 0.7)
    return np.repeat(grey[..., None], 3, -1).astype(np.uint8)


def with_hands(picture: np.ndarray, boxes: list[tuple[int, int, int, int]]) -> np.ndarray:
    """Return 24 frames in which dark rectangles (x0, y0, x1, y1) go down by 2 px per frame, from the second frame on."""
    frames = np.repeat(picture[None], 24, 0)
    for i, frame in enumerate(frames[1:], 1):
        for x0, y0, x1, y1 in boxes:
            frame[y0 + 2 * i : y1 + 2 * i, x0:x1] = (120, 80, 60)
    return frames


@pytest.mark.parametrize("upright", [True, False])
@pytest.mark.parametrize("share", [0.4, 0.5, 0.6])
def test_two_pictures_in_one_are_found_where_the_seam_is(clips, share, upright):
    frames = composite(clips, share, upright=upright)

    seam = found(clips[0], frames)

    assert seam is not None
    assert seam.direction == ("upright" if upright else "level")
    assert seam.place == pytest.approx(share, abs=2 / frames.shape[2 if upright else 1])


@pytest.mark.parametrize("crossing_tilt", [0.4, 0.6])
@pytest.mark.parametrize("tilt_px", [-4.0, -3.0, 0.0, 3.0, 4.0])
def test_a_line_of_a_checked_cloth_is_no_seam(clips, tilt_px, crossing_tilt):
    """It has a step along its whole length, and its neighbours are not parallel to it in perspective."""
    cloth = checked_cloth(tilt_px, crossing_tilt)
    frames = with_hands(cloth, [(30, 40, 100, 70), (250, 100, 290, 120)])

    assert found(clips[0], frames) is None


@pytest.mark.parametrize(("tilt_px", "is_seam"), [(0.0, True), (-4.0, False), (4.0, False)])
def test_an_edge_that_leans_by_a_degree_is_no_seam(clips, tilt_px, is_seam):
    """A door and a wall behind a table: no texture in common, and each hand stays on one side."""
    y, x = np.mgrid[0:H, 0:W]
    luma = np.where(x < 0.5 * W + tilt_px * (y / (H - 1) - 0.5), 90.0, 130.0)
    luma += np.random.default_rng(0).normal(0, 3, (H, W))
    picture = np.repeat(luma[..., None], 3, -1).clip(0, 255).astype(np.uint8)
    frames = with_hands(picture, [(30, 40, 100, 70), (250, 100, 290, 120)])

    assert (found(clips[0], frames) is not None) == is_seam


def wall_and_table(at: int) -> np.ndarray:
    """Return a picture of a plain wall above a plain table, whose far edge is level."""
    noise = np.random.default_rng(0).normal(0, 2, (H, W, 1))
    luma = np.where(np.arange(H)[:, None, None] < at, 90.0, 180.0) + noise
    return np.repeat(luma, 3, -1).clip(0, 255).astype(np.uint8)


def test_a_tables_edge_that_an_arm_reaches_across_is_no_seam(clips):
    """Nothing else tells such an edge: it is level to the pixel, and neither side has texture."""
    picture = wall_and_table(100)
    arm = with_hands(picture, [(100, 20, 140, 170)])
    two_pictures = with_hands(picture, [(60, 0, 100, 40), (200, 110, 240, 150)])

    assert found(clips[0], arm) is None
    seam = found(clips[0], two_pictures)
    assert seam is not None
    assert seam.direction == "level"
    assert seam.place == pytest.approx(100 / H, abs=1 / H)


@pytest.mark.parametrize("upright", [True, False])
def test_the_crop_that_is_advised_is_one_picture_without_bars(clips, upright):
    frames = composite(clips, 0.5, upright=upright)
    h, w = frames.shape[1:3]
    crop = Crop(box_px=(0, 40, w, 40 + h), full_px=(w, h + 80))
    clip = replace(with_frames(clips[0], frames), crop=crop, source_size_px=(2 * w, 2 * h + 160))

    with pytest.raises(ItemRejectedError, match=r"-vf crop=\d+:\d+:\d+:\d+ one.mp4") as error:
        check_split(clip, working_clip_of(clip))

    assert error.value.reason == "split_screen"
    cw, ch, x, y = (int(v) for v in error.value.detail.split("crop=")[1].split(" ")[0].split(":"))
    size, begin = (cw, x) if upright else (ch, y - 80)
    full = 2 * w if upright else 2 * h
    assert size == pytest.approx(full / 2, abs=4)
    assert min(begin, abs(begin - full / 2)) <= 4
    assert (ch, y) == (2 * h, 80) if upright else (cw, x) == (2 * w, 0)


def test_a_clip_of_one_picture_has_no_seam(clips):
    for clip in clips:
        assert found(clip, clip.frames) is None


def test_a_picture_too_narrow_to_be_split_has_no_seam(clips):
    strip = np.ascontiguousarray(clips[0].frames[:, :12])

    assert found(clips[0], strip) is None

"""Split screens: sample clips put beside and above each other, and scenes with lines that look like seams, drawn here."""

import cv2
import numpy as np
import pytest
from sample_clips import with_frames

from v2p_data.scene.frames.split_screen import Seam, panes_of, seam_of
from v2p_data.scene.frames.working_clip import working_clip_of
from v2p_data.video.clip import Clip

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


def two_pictures(clips: list[Clip], n: int = 24) -> tuple[np.ndarray, np.ndarray]:
    """Return two clips of one size; the second is turned and darker, as in another room."""
    first, second = (c.frames[np.linspace(0, len(c.frames) - 1, n).astype(int)] for c in clips[:2])
    return first, second[:, ::-1, ::-1] // 2


def panes(clip: Clip, frames: np.ndarray) -> list[tuple[int, int, int, int]]:
    return panes_of(frames, working_clip_of(with_frames(clip, frames)))


def test_two_pictures_on_a_page_with_titles_and_round_corners_are_found(clips):
    first, second = two_pictures(clips)
    h, w = first.shape[1:3]
    page = np.full((len(first), h + 70, 2 * w + 60, 3), 255, np.uint8)
    inside = np.zeros((h, w), np.uint8)
    cv2.rectangle(inside, (12, 0), (w - 13, h - 1), 1, -1)
    cv2.rectangle(inside, (0, 12), (w - 1, h - 13), 1, -1)
    for i, frame in enumerate(page):
        cv2.putText(frame, "Human", (w // 3, 28), cv2.FONT_HERSHEY_SIMPLEX, 0.8, (0, 0, 0), 2)
        frame[50 : 50 + h, 20 : 20 + w][inside > 0] = first[i][inside > 0]
        frame[50 : 50 + h, 40 + w : 40 + 2 * w][inside > 0] = second[i][inside > 0]

    found = panes(clips[0], page)

    expected = [(20, 50, 20 + w, 50 + h), (40 + w, 50, 40 + 2 * w, 50 + h)]
    assert len(found) == 2
    assert np.abs(np.array(found) - expected).max() <= 3


@pytest.mark.parametrize("bar_px", [0, 1, 6])
def test_two_pictures_beside_each_other_are_found_whatever_bar_is_between_them(clips, bar_px):
    first, second = two_pictures(clips)
    h, w = first.shape[1:3]
    bar = np.full((len(first), h, bar_px, 3), 255, np.uint8)

    found = panes(clips[0], np.concatenate([first, bar, second], 2))

    expected = [(0, 0, w, h), (w + bar_px, 0, 2 * w + bar_px, h)]
    assert len(found) == 2
    assert np.abs(np.array(found) - expected).max() <= 8


@pytest.mark.parametrize("margin_px", [0, 12])
def test_a_picture_in_the_picture_is_found(clips, margin_px):
    first, second = two_pictures(clips)
    h, w = first.shape[1:3]
    small = np.stack([cv2.resize(f, (w // 3, h // 3)) for f in 2 * second])
    small[:, [0, 1, -2, -1]] = small[:, :, [0, 1, -2, -1]] = 255  # the frame that editors draw
    x1, y1 = w - margin_px, h - margin_px
    frames = first.copy()
    frames[:, y1 - h // 3 : y1, x1 - w // 3 : x1] = small

    found = panes(clips[0], frames)

    assert len(found) == 2
    assert np.abs(np.array(found[0]) - (x1 - w // 3, y1 - h // 3, x1, y1)).max() <= 4
    assert found[1] == (0, 0, w, h)


def test_a_clip_of_one_picture_has_no_panes(clips):
    assert [panes(clip, clip.frames[::4]) for clip in clips] == [[]] * len(clips)


def test_a_clip_of_one_picture_has_no_seam(clips):
    for clip in clips:
        assert found(clip, clip.frames) is None


def test_a_picture_too_narrow_to_be_split_has_no_seam(clips):
    strip = np.ascontiguousarray(clips[0].frames[:, :12])

    assert found(clips[0], strip) is None

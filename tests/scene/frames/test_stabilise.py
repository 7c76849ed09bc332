"""Clips filmed from the hand: alignment with the first frame."""

from dataclasses import replace

import cv2
import numpy as np
import pytest

from v2p_data.errors import ItemRejectedError
from v2p_data.geometry.camera import between_centres
from v2p_data.scene.frames.stabilise import stabilised
from v2p_data.scene.frames.working_clip import camera_shift_px, working_clip_of
from v2p_data.video.clip import Clip, Hint

BOX = [150.0, 120.0, 190.0, 150.0]


def swaying(clip: Clip, far_px: float) -> tuple[Clip, list[np.ndarray]]:
    """Return the clip as a hand would have filmed it, and how each frame's pixels went."""
    h, w = clip.frames.shape[1:3]
    frames, moves = [], []
    for i, frame in enumerate(clip.frames):
        t = i / len(clip.frames)
        zoom, angle = 1 + 0.02 * np.sin(5 * t), 0.02 * np.sin(4 * t)
        c, s = zoom * np.cos(angle), zoom * np.sin(angle)
        M = np.array([[c, -s, far_px * np.sin(6 * t)], [s, c, 0.5 * far_px * t], [1e-5 * t, 0, 1]])
        moves.append(M)
        frames.append(cv2.warpPerspective(frame, M, (w, h), borderMode=cv2.BORDER_REPLICATE))
    return replace(clip, frames=np.stack(frames)), moves


def test_frames_of_a_swaying_camera_come_back_to_the_first(draw):
    clip, moves = swaying(draw(), 6.0)
    before = camera_shift_px(working_clip_of(clip))

    steady = stabilised(clip, working_clip_of(clip))

    assert before > 3
    assert camera_shift_px(working_clip_of(steady)) < 0.5
    assert "the camera swayed" in steady.warnings[-1]
    spots = np.array([[[60.0, 60.0], [250, 80], [160, 200]]])
    for own, true in zip(steady.to_filmed, moves, strict=True):
        there = cv2.perspectiveTransform(spots, own) - cv2.perspectiveTransform(spots, true)
        assert np.abs(there).max() < 1.2


def test_a_hint_goes_along_with_its_frame(draw):
    clip, moves = swaying(draw(), 6.0)
    x0, y0, x1, y1 = BOX
    corners = cv2.perspectiveTransform(np.array([[[x0, y0], [x1, y1]]]), moves[20])[0]
    hints = {
        "blue box": Hint(frame=20, box=corners.ravel().tolist()),
        "spot": Hint(frame=20, points=[corners[0].tolist()]),
    }

    steady = stabilised(replace(clip, hints=hints), working_clip_of(clip))

    assert steady.hints["blue box"]["box"] == pytest.approx(BOX, abs=2.5)
    assert steady.hints["spot"]["points"][0] == pytest.approx(BOX[:2], abs=2)
    assert hints["blue box"]["box"] == corners.ravel().tolist()


def test_a_clip_from_a_stand_stays_as_it_is(draw):
    clip = draw()

    assert stabilised(clip, working_clip_of(clip)) is clip


def test_a_camera_that_travels_is_turned_away_with_how_far(draw):
    clip, _ = swaying(draw(), 60.0)

    with pytest.raises(ItemRejectedError, match="at most 42 px") as caught:
        stabilised(clip, working_clip_of(clip))

    assert caught.value.reason == "camera_moves"
    assert caught.value.value == pytest.approx(66, abs=6)  # 60 px right, 30 px down


def test_what_an_aligned_frame_no_longer_shows_comes_from_another_one(draw):
    clip, _ = swaying(draw(), 12.0)

    steady = stabilised(clip, working_clip_of(clip))

    rim = steady.frames[:, :, :4].astype(int)
    assert np.median(np.abs(rim - rim[0])) < 6


def test_a_picture_without_anything_to_follow_is_left_alone(draw):
    clip = draw()
    plain = replace(clip, frames=np.full_like(clip.frames, 120))

    assert stabilised(plain, working_clip_of(plain)) is plain


def test_doubling_a_picture_takes_pixel_centres_to_pixel_centres():
    doubled = between_centres(np.diag([2.0, 2.0, 1.0]))

    # The first pixel spreads over the first two: from centre 0 to the middle of 0 and 1.
    np.testing.assert_allclose(doubled @ [0, 0, 1], [0.5, 0.5, 1])
    np.testing.assert_allclose(between_centres(np.eye(3)), np.eye(3), atol=1e-12)

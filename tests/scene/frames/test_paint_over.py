"""Letters and stickers that somebody put over a sample clip, each drawn here; the clip without them is the truth."""

from collections.abc import Callable
from dataclasses import replace

import cv2
import numpy as np
import pytest

from v2p_data.errors import ItemRejectedError
from v2p_data.scene.frames.paint_over import without_graphics
from v2p_data.video.clip import Clip

WHITE, BLACK, YELLOW = (255, 255, 255), (0, 0, 0), (255, 210, 30)


@pytest.fixture(scope="module")
def lift(clips) -> Clip:
    return next(clip for clip in clips if clip.path.stem == "lift_red_box")


def drawn_over(clip: Clip, shown: range, draw: Callable[[np.ndarray], None]) -> Clip:
    """Return the clip with something drawn over these frames."""
    frames = clip.frames.copy()
    for i in shown:
        draw(frames[i])
    return replace(clip, frames=frames)


def letters(text: str, at: tuple[int, int], size: float) -> Callable[[np.ndarray], None]:
    def draw(frame: np.ndarray) -> None:
        for colour, thick in ((BLACK, 4), (WHITE, 2)):
            cv2.putText(frame, text, at, cv2.FONT_HERSHEY_DUPLEX, size, colour, thick, cv2.LINE_AA)

    return draw


def sticker(frame: np.ndarray) -> None:
    cv2.circle(frame, (160, 300), 34, YELLOW, -1)
    cv2.circle(frame, (148, 290), 5, BLACK, -1)
    cv2.circle(frame, (172, 290), 5, BLACK, -1)
    cv2.ellipse(frame, (160, 306), (16, 10), 0, 0, 180, BLACK, 3)


def share_left(true: Clip, edited: Clip, cleaned: Clip) -> float:
    """Return how much of the drawn pixels still differs clearly from the clip without them."""
    put = np.abs(edited.frames.astype(int) - true.frames).max(-1) > 60
    left = np.abs(cleaned.frames.astype(int) - true.frames).max(-1) > 60
    return float((put & left).sum() / put.sum())


def test_a_clip_that_nobody_edited_is_left_as_it_is(clips):
    for clip in clips:
        assert without_graphics(clip) is clip


@pytest.mark.parametrize("shown", [range(33, 108), range(65), range(30, 70)])
def test_a_caption_is_painted_over_in_the_frames_that_show_it(lift, shown):
    edited = drawn_over(lift, shown, letters("Now lift the box", (160, 440), 0.9))

    cleaned = without_graphics(edited)

    assert share_left(lift, edited, cleaned) < 0.05
    assert "put over the video" in cleaned.warnings[-1]
    without = [i for i in range(len(lift.frames)) if abs(i - shown.start) > 6 and i not in shown]
    without = [i for i in without if abs(i - shown.stop) > 6]
    np.testing.assert_array_equal(cleaned.frames[without], lift.frames[without])


def test_letters_beside_a_moving_hand_and_over_the_object_are_painted_over(lift):
    for draw in (letters("WATCH", (220, 330), 1.8), letters("My video", (110, 240), 2.4)):
        edited = drawn_over(lift, range(40), draw)

        assert share_left(lift, edited, without_graphics(edited)) < 0.2


def test_a_sticker_is_replaced_by_what_stands_there_without_it(lift):
    edited = drawn_over(lift, range(54, 108), sticker)

    assert share_left(lift, edited, without_graphics(edited)) < 0.02


def test_letters_that_give_way_to_others_no_longer_change(lift):
    first = drawn_over(lift, range(38), letters("First we wait", (160, 440), 0.9))
    edited = drawn_over(first, range(38, 108), letters("Then we lift it", (160, 440), 0.9))

    cleaned = without_graphics(edited)

    line = cleaned.frames[:, 400:450, :300].astype(int)
    assert (np.abs(line[20] - line[100]).max(-1) > 60).mean() < 0.01


def test_a_graphic_over_much_of_the_picture_is_rejected_with_the_part_without_it(lift):
    def poster(frame: np.ndarray) -> None:
        frame[60:420, 40:400] = 230
        for row in range(80, 420, 24):
            cv2.putText(frame, "SUBSCRIBE NOW", (50, row), cv2.FONT_HERSHEY_DUPLEX, 1.2, BLACK, 3)

    with pytest.raises(ItemRejectedError, match=r"ffmpeg -ss 0\.\d\d -to 3\.\d\d -i") as error:
        without_graphics(drawn_over(lift, range(20), poster))

    assert error.value.reason == "overlay"
    assert error.value.value is not None
    assert error.value.value > 0.2

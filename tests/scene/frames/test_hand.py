import cv2
import numpy as np
import pytest

from v2p_data.scene.frames.hand import gap_px, hand_end


def arm(to: tuple[int, int], *, width: int = 12, start: tuple[int, int] = (0, 60)) -> np.ndarray:
    return cv2.line(np.zeros((120, 160), np.uint8), start, to, 1, width) > 0


def test_a_hand_ends_where_it_is_farthest_from_the_edge_that_its_arm_crosses():
    end = hand_end(arm((100, 80)))

    assert end is not None
    np.testing.assert_allclose(end.tip_px, (104, 81), atol=4)
    np.testing.assert_allclose(end.way, np.array([-100, -20]) / np.hypot(100, 20), atol=0.1)


def test_specks_elsewhere_are_no_hand():
    mask = arm((100, 80))
    mask[5:8, 150:153] = True

    assert hand_end(mask) == hand_end(arm((100, 80)))


@pytest.mark.parametrize(
    "mask",
    [np.zeros((120, 160), bool), arm((100, 60), start=(40, 60)), arm((4, 60))],
    ids=["nothing", "no arm", "hardly in the picture"],
)
def test_no_end_where_it_cannot_be_told(mask):
    assert hand_end(mask) is None


def test_the_gap_is_that_between_the_nearest_pixels():
    thing = np.zeros((120, 160), bool)
    thing[70:90, 120:140] = True

    assert gap_px(arm((100, 80)), thing) == pytest.approx(120 - 106, abs=2)
    assert gap_px(arm((130, 80)), thing) == 0

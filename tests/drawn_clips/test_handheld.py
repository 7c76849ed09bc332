"""The way of a camera in a hand."""

import cv2
import numpy as np
import pytest

from drawn_clips.camera import View
from drawn_clips.handheld import (
    Handheld,
    handheld_camera,
    random_handheld,
    table_homography,
)
from v2p_data.seeds import rng_for

FIRST = View().camera()


def test_the_first_frame_is_where_the_stand_would_be():
    way = handheld_camera(FIRST, Handheld(peak_px=30.0, pan=0.5, zoom=0.1, seed=3), 4.0)

    np.testing.assert_allclose(way.at(0.0).T_world_cam, FIRST.T_world_cam, atol=1e-12)
    np.testing.assert_allclose(way.at(0.0).K, FIRST.K)


@pytest.mark.parametrize("peak_px", [4.0, 15.0, 40.0])
def test_the_table_gets_as_far_as_asked(peak_px: float):
    way = handheld_camera(FIRST, Handheld(peak_px=peak_px, tremor_rad=0.0, seed=5), 4.0)
    middle = np.array([[FIRST.width_px / 2, 0.6 * FIRST.height_px]])
    spot = FIRST.on_plane(middle)

    far = [np.linalg.norm(way.at(float(t)).project(spot) - middle) for t in np.linspace(0, 4, 100)]

    assert max(far) * 320 / FIRST.width_px == pytest.approx(peak_px, rel=0.05)


def test_the_lens_zooms_evenly_to_what_was_asked():
    way = handheld_camera(FIRST, Handheld(zoom=-0.1, seed=1), 4.0)

    assert way.at(4.0).K[0, 0] == pytest.approx(0.9 * FIRST.K[0, 0])
    assert way.at(2.0).K[1, 1] == pytest.approx(0.95 * FIRST.K[1, 1])


def test_sway_is_slow_and_tremor_is_quick():
    way = handheld_camera(FIRST, Handheld(peak_px=12.0, seed=7), 20.0)
    times = np.arange(0, 20, 0.02)
    turn = np.array(
        [
            cv2.Rodrigues(FIRST.T_world_cam[:3, :3].T @ way.at(float(t)).T_world_cam[:3, :3])[0][
                0, 0
            ]
            for t in times
        ]
    )
    power = np.abs(np.fft.rfft((turn - turn.mean()) * np.hanning(len(turn)))) ** 2
    hz = np.fft.rfftfreq(len(turn), 0.02)

    def share(low: float, high: float) -> float:
        return power[(hz >= low) & (hz < high)].sum() / power.sum()

    assert share(0.0, 2.5) > 0.8
    assert share(5.5, 12.5) > 10 * share(3.0, 5.0)
    assert share(14.0, 25.0) < 1e-3


def test_the_tables_points_go_as_its_homography_says():
    way = handheld_camera(FIRST, Handheld(peak_px=25.0, turning=0.5, zoom=0.05, seed=2), 3.0)
    later = way.at(2.0)
    spots = np.array([[0.1, 0.1, 0.0], [0.0, -0.2, 0.0], [0.3, 0.05, 0.0]])

    there = cv2.perspectiveTransform(FIRST.project(spots)[None], table_homography(FIRST, later))[0]

    np.testing.assert_allclose(there, later.project(spots), atol=1e-6)


def test_drawn_hands_differ_and_stay_within_what_is_measured():
    hands = [random_handheld(rng_for(seed, "hand")) for seed in range(60)]

    assert all(4 <= hand.peak_px <= 40 and abs(hand.zoom) <= 0.1 for hand in hands)
    assert 0 < sum(hand.pan > 0 for hand in hands) < 40
    assert 0 < sum(hand.zoom != 0 for hand in hands) < 30


def test_a_hand_that_does_not_move_is_no_hand():
    with pytest.raises(ValueError, match="peak_px must be above 0"):
        Handheld(peak_px=0.0)

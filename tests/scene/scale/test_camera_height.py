import numpy as np
import pytest

from v2p_data.scene.data_types import CameraGuess
from v2p_data.scene.fitting.silhouette import camera_above
from v2p_data.scene.scale.camera_height import (
    SizeVote,
    camera_height_m,
    table_width_m,
)
from v2p_data.scene.scale.nouns import Noun

H, W = 240, 320


def _shown_m(pitch_rad: float, fov_rad: float, height_m: float, row: float) -> float:
    """Width of the table in one row of pixels, from where its left and right ends meet the table."""
    camera = camera_above((H, W), pitch_rad, fov_rad, height_m)
    left, right = camera.on_plane(np.array([[0.0, row], [float(W), row]]))
    return float(np.linalg.norm(right - left))


@pytest.mark.parametrize("pitch_rad", [0.3, 0.7, 1.2])
@pytest.mark.parametrize("row", [100.0, 120.0, 200.0])
def test_the_table_s_width_is_that_between_the_two_ends_of_a_row(pitch_rad, row):
    fov_rad, height_m = 0.9, 0.6

    width = table_width_m(pitch_rad, 0.5 / np.tan(fov_rad / 2), height_m, (row - H / 2) / W)

    assert width == pytest.approx(_shown_m(pitch_rad, fov_rad, height_m, row))


def test_rows_at_the_horizon_show_no_table():
    assert np.isnan(table_width_m(0.2, 0.8, 0.5, below=-0.3))


def test_a_width_says_how_high_the_camera_stands_at_the_pitch_that_was_fitted():
    guess = CameraGuess(pitch_rad=0.6, pitch_sd_rad=0.2, fov_rad=0.9, table_width_m=0.8)

    for pitch_rad in (0.4, 0.8):
        ((height_m, spread),) = guess.heights(pitch_rad)

        assert _shown_m(pitch_rad, 0.9, height_m, H / 2) == pytest.approx(0.8)
        assert spread == guess.table_width_sd


def test_a_known_height_and_a_seen_width_both_vote():
    guess = CameraGuess(
        pitch_rad=0.6,
        pitch_sd_rad=0.2,
        fov_rad=0.9,
        height_m=0.5,
        height_sd=0.02,
        table_width_m=0.8,
    )

    assert guess.heights(0.6)[0] == (0.5, 0.02)
    assert len(guess.heights(0.6)) == 2


def test_a_noun_that_contradicts_all_others_counts_little():
    """Three things say 0.5 m; what was taken for a pen, and is none, says 5 m."""
    cube = Noun(word="cube", form="box", size_m=(0.1, 0.1, 0.1), mass_kg=0.1, friction=0.5)
    right = SizeVote(size=(0.2, 0.2, 0.2), noun=cube)
    wrong = SizeVote(size=(0.02, 0.02, 0.02), noun=cube)

    agreed, _ = camera_height_m([right] * 3)
    with_wrong, _ = camera_height_m([right] * 3 + [wrong])

    assert agreed == pytest.approx(0.5, rel=0.02)
    assert with_wrong == pytest.approx(agreed, rel=0.05)

"""Faults of masks, on squares that can be counted by hand."""

import numpy as np
import pytest

from v2p_data.episodes.mask_noise import (
    Fault,
    MaskNoiseConfig,
    apply_faults,
    as_json,
    draw_faults,
)
from v2p_data.seeds import rng_for


@pytest.fixture
def squares() -> np.ndarray:
    """Ten frames of 64 x 64: a square of 20 x 20 with label 1, one of 10 x 10 with label 2 beside it."""
    labels = np.zeros((10, 64, 64), np.uint8)
    labels[:, 10:30, 10:30] = 1
    labels[:, 10:20, 40:50] = 2
    return labels


def test_an_eroded_mask_loses_its_border_for_as_long_as_the_fault_lasts(squares):
    fault = Fault(kind="erode", label=1, first_frame=3, num_frames=4, size_px=2)

    noisy = apply_faults(squares, [fault])

    assert [int((f == 1).sum()) for f in noisy] == [400] * 3 + [16 * 16] * 4 + [400] * 3
    assert (noisy == 2).sum() == (squares == 2).sum()
    assert (noisy[3, 12:28, 12:28] == 1).all()


def test_a_dilated_mask_spills_over_its_surroundings(squares):
    fault = Fault(kind="dilate", label=2, first_frame=0, num_frames=1, size_px=1)

    noisy = apply_faults(squares, [fault])

    # A disc of radius 1 is a cross: a pixel more on each side, none at the corners.
    assert (noisy[0] == 2).sum() == 100 + 4 * 10
    assert (noisy[1:] == squares[1:]).all()


def test_a_dropped_mask_is_background(squares):
    noisy = apply_faults(squares, [Fault(kind="drop", label=1, first_frame=8, num_frames=9)])

    assert (noisy[8:] == 1).sum() == 0
    assert (noisy[:8] == squares[:8]).all()
    assert (noisy[8:] == 2).sum() == 200


def test_a_swapped_blob_is_a_disc_within_its_mask(squares):
    middle = 0.5 + 10 / 400  # row 10 of 20, column 10 of 20
    fault = Fault(
        kind="swap", label=1, first_frame=0, num_frames=1, size_px=3, becomes=2, at=middle
    )

    changed = apply_faults(squares, [fault])[0] != squares[0]

    rows, columns = np.nonzero(changed)
    assert (rows.mean(), columns.mean()) == (20, 20)
    assert (rows.min(), rows.max(), columns.min(), columns.max()) == (17, 23, 17, 23)


def test_drawn_faults_can_be_made_again_from_what_is_kept(squares):
    cfg = MaskNoiseConfig(erode_per_s=2.0, dilate_per_s=2.0, drop_per_s=2.0, swap_per_s=2.0)

    faults = draw_faults(squares, cfg, rng_for(1, "faults"))
    again = [Fault(**row) for row in as_json(faults)]

    assert {f.kind for f in faults} == {"erode", "dilate", "drop", "swap"}
    assert (apply_faults(squares, again) == apply_faults(squares, faults)).all()
    assert (apply_faults(squares, faults) != squares).any()


def test_faults_come_as_often_and_as_large_as_is_said(squares):
    cfg = MaskNoiseConfig(erode_per_s=3.0, border_px=(8, 16), lasts_s=(0.1, 0.2))
    long = np.tile(squares, (40, 1, 1))  # 20 s, two labels: 120 faults are expected

    faults = draw_faults(long, cfg, rng_for(2, "faults"))

    assert 120 - 4 * 11 < len(faults) < 120 + 4 * 11
    assert {f.size_px for f in faults} == {2, 3, 4}  # a quarter of 8 to 16: masks are 64 px wide
    assert {f.num_frames for f in faults} <= {2, 3, 4}


def test_without_rates_nothing_is_drawn(squares):
    assert draw_faults(squares, MaskNoiseConfig(), rng_for(3, "faults")) == []
    assert MaskNoiseConfig().is_off


def test_impossible_ranges_are_refused():
    with pytest.raises(ValueError, match="0 or more"):
        MaskNoiseConfig(drop_per_s=-1.0)
    with pytest.raises(ValueError, match="lowest <= highest"):
        MaskNoiseConfig(border_px=(5, 2))

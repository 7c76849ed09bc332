"""The interval is right by hand numbers and by its defining equation."""

import math

import pytest

from policies.evaluation.rate import wilson

Z_95 = 1.959964
"""Two-sided 95 % quantile of the normal distribution, from a table."""


def test_nine_of_ten_has_the_interval_computed_by_hand():
    rate = wilson(9, 10)

    # centre (.9 + 3.8415/20) / 1.38415 = .78899, half 1.95996 sqrt(.009 + 3.8415/400) / 1.38415 = .19314
    assert rate.low == pytest.approx(0.5958, abs=1e-4)
    assert rate.high == pytest.approx(0.9821, abs=1e-4)
    assert rate.value == 0.9


def test_no_success_in_ten_still_leaves_room_for_28_percent():
    rate = wilson(0, 10)

    # z^2 / (n + z^2) = 3.8415 / 13.8415
    assert rate.low == 0.0
    assert rate.high == pytest.approx(0.27753, abs=1e-5)


@pytest.mark.parametrize(("successes", "trials"), [(1, 3), (50, 100), (399, 400)])
def test_both_ends_are_z_standard_errors_of_their_own_away_from_the_rate(successes, trials):
    rate = wilson(successes, trials)

    for end in (rate.low, rate.high):
        assert abs(end - rate.value) == pytest.approx(Z_95 * math.sqrt(end * (1 - end) / trials))


@pytest.mark.parametrize(("successes", "trials"), [(0, 0), (-1, 5), (6, 5)])
def test_impossible_counts_are_refused(successes, trials):
    with pytest.raises(ValueError, match="trials"):
        wilson(successes, trials)

"""Paired differences and their intervals, against numbers worked out by hand."""

import numpy as np
import pytest

from policies.evaluation.paired import median_difference, success_difference


def outcomes(letters: str) -> np.ndarray:
    return np.array([letter == "1" for letter in letters])


def test_two_wins_and_one_loss_in_ten_pairs_are_a_tenth_and_not_clear():
    ours, theirs = outcomes("1110000111"), outcomes("0011000111")

    difference = success_difference(ours, theirs)

    # 2 won, 1 lost of 10; with half a pair added to each outcome n = 12, won + lost = 4:
    # 1/12 +- 1.96 sqrt(4 - 1/12) / 12.
    assert difference.value == pytest.approx(0.1)
    assert (difference.low, difference.high) == pytest.approx((-0.23990, 0.40657), abs=1e-4)
    assert not difference.is_clear


def test_equal_outcomes_leave_an_interval_around_nothing():
    difference = success_difference(outcomes("1" * 50), outcomes("1" * 50))

    assert difference.value == 0
    assert difference.low == pytest.approx(-difference.high)
    assert 0 < difference.high < 0.05


def test_the_interval_of_a_median_is_that_of_the_order_statistics():
    theirs = np.zeros(10)
    ours = np.arange(1.0, 11.0)

    difference = median_difference(ours, theirs)

    # Of ten values the second and the ninth hold the median with 97.9 %; the third and eighth with 89 %.
    assert difference is not None
    assert difference.value == 5.5
    assert (difference.low, difference.high) == (2.0, 9.0)
    assert difference.is_clear


def test_five_pairs_say_nothing_of_a_median():
    assert median_difference(np.arange(5.0), np.zeros(5)) is None

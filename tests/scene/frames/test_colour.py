import numpy as np
import pytest

from v2p_data.scene.frames.colour import (
    balance,
    colour_match,
    histogram,
    lab_distance,
    lab_of,
    shadow,
    similarity,
)


def patch(rgb):
    return np.full((24, 24, 3), rgb, np.uint8)


@pytest.mark.parametrize(
    ("rgb", "word"),
    [
        ((200, 25, 30), "red"),
        ((240, 130, 20), "orange"),
        ((245, 215, 40), "yellow"),
        ((40, 150, 60), "green"),
        ((30, 60, 190), "blue"),
        ((125, 85, 50), "brown"),
        ((20, 20, 22), "black"),
        ((240, 240, 238), "white"),
    ],
)
def test_a_plain_colour_answers_to_its_name_better_than_to_the_others(rgb, word):
    words = ["red", "orange", "yellow", "green", "blue", "brown", "black", "white"]
    match = {w: float(colour_match(patch(rgb), (w,)).mean()) for w in words}

    assert max(match, key=match.__getitem__) == word
    assert match[word] > 0.6


def test_the_distance_of_two_pictures_is_numpys_norm_bit_for_bit():
    pictures = np.random.default_rng(0).normal(0, 50, (2, 7, 240, 320, 3)).astype(np.float32)

    found = lab_distance(pictures[0], pictures[1, 0])

    np.testing.assert_array_equal(found, np.linalg.norm(pictures[0] - pictures[1, 0], axis=-1))


@pytest.mark.parametrize("skin", [(225, 175, 150), (150, 100, 75), (85, 50, 35)])
def test_skin_of_any_shade_is_not_red(skin):
    assert colour_match(patch(skin), ("red",)).mean() < 0.3


def test_a_shadow_is_the_same_colour_with_less_light_and_a_thing_is_not():
    table = patch((190, 150, 110))
    shaded = (table * 0.6).astype(np.uint8)

    assert shadow(lab_of(shaded), lab_of(table)).all()
    assert not shadow(lab_of(patch((60, 90, 180))), lab_of(table)).any()
    assert not shadow(lab_of(table), lab_of(table)).any()


def test_balancing_leaves_grey_grey_and_takes_out_half_of_a_cast():
    grey, cast = patch((128, 128, 128)), patch((150, 120, 90))

    assert np.ptp(balance(grey)[0, 0].astype(int)) <= 1
    assert 0 < np.ptp(balance(cast)[0, 0].astype(int)) < np.ptp(cast[0, 0].astype(int)) * 1.5


def test_histograms_sum_to_one_and_know_their_own():
    red, blue = patch((200, 20, 20)).reshape(-1, 3), patch((20, 20, 200)).reshape(-1, 3)

    assert histogram(red).sum() == pytest.approx(1)
    assert histogram(red[:0]).sum() == 0
    assert similarity(histogram(red), histogram(red)) == pytest.approx(1)
    assert similarity(histogram(red), histogram(blue)) < 0.05

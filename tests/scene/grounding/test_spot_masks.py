"""A click or a line on an object becomes its outline; on bare table it becomes a sentence."""

import numpy as np
import pytest

from v2p_data.errors import V2PError
from v2p_data.scene.frames.classes import CLASSES, OTHER, TABLE
from v2p_data.scene.frames.mask_ops import iou
from v2p_data.scene.grounding.spot_masks import mask_at_spots, points_along

H, W = 240, 320


@pytest.fixture(scope="module")
def picture():
    """A red box of two shades, and a blue ball, on grey grain."""
    image = np.full((H, W, 3), (120, 118, 115)) + np.random.default_rng(0).integers(
        -6, 7, (H, W, 3)
    )
    image[100:130, 140:160] += np.array([80, -70, -70])
    image[100:130, 160:180] += np.array([40, -90, -90])
    y, x = np.mgrid[:H, :W]
    ball = np.hypot(x - 60, y - 180) < 18
    image[ball] = (40, 60, 170)
    return image.clip(0, 255).astype(np.uint8)


@pytest.fixture(scope="module")
def box():
    mask = np.zeros((H, W), bool)
    mask[100:130, 140:180] = True
    return mask


@pytest.fixture(scope="module")
def shares(box):
    """The network sees the box and the ball, and table all around."""
    y, x = np.mgrid[:H, :W]
    thing = box | (np.hypot(x - 60, y - 180) < 18)
    shares = np.zeros((len(CLASSES), H, W), np.float32)
    shares[OTHER], shares[TABLE] = 0.95 * thing, 1 - 0.95 * thing
    return shares


@pytest.mark.parametrize("click", [(160.0, 115.0), (152.0, 110.0), (170.0, 122.0)])
def test_a_click_outlines_the_object_around_it(picture, box, shares, click):
    assert iou(mask_at_spots(picture, [click], shares), box) > 0.85


def test_a_line_over_both_halves_takes_both(picture, box, shares):
    mask = mask_at_spots(picture, [(145.0, 105.0), (160.0, 118.0), (176.0, 125.0)], shares)

    assert iou(mask, box) > 0.85


@pytest.mark.parametrize("click", [(250.0, 60.0), (100.0, 60.0), (310.0, 235.0)])
def test_a_click_on_bare_table_is_refused_in_a_sentence(picture, shares, click):
    with pytest.raises(V2PError, match="stands out there from the table"):
        mask_at_spots(picture, [click], shares)


def test_a_line_is_followed_at_even_steps_and_stays_in_the_picture():
    spots = points_along([(0.0, 0.0), (30.0, 0.0), (30.0, 400.0)], (H, W))

    gaps = np.linalg.norm(np.diff(spots, axis=0), axis=1)
    assert gaps.max() <= 3.5
    assert spots[0] == (0.0, 0.0)
    assert spots[-1] == (30.0, H - 1.0)

"""Outlines from boxes that people draw, and how well any outline can be matched."""

import cv2
import numpy as np
import pytest

from v2p_data.scene.frames.mask_ops import attainable_iou, bounding_box, from_box

GREY, WHITE, RED = (120, 118, 115), (235, 235, 235), (190, 40, 40)
UNSEEN = np.zeros((120, 160), np.float32)
"""A network that sees no object."""


def picture(*things):
    image = np.full((120, 160, 3), GREY, np.uint8)
    for (x, y, w, h), colour in things:
        image[y : y + h, x : x + w] = colour
    return image


def overlap(mask, box):
    x, y, w, h = bounding_box(mask)
    common = max(0, min(x + w, box[2]) - max(x, box[0])) * max(
        0, min(y + h, box[3]) - max(y, box[1])
    )
    return common / (w * h + (box[2] - box[0]) * (box[3] - box[1]) - common)


def test_what_stands_out_in_a_box_is_cut_out():
    mask = from_box(picture(((60, 40, 30, 25), RED)), (57.0, 38.0, 93.0, 68.0), UNSEEN)

    assert bounding_box(mask) == (60, 40, 30, 25)


def test_a_white_thing_on_white_still_fills_its_box():
    box = (62.0, 44.0, 78.0, 62.0)
    print_on_it = ((66, 56, 6, 5), RED)

    mask = from_box(picture(((30, 30, 90, 60), WHITE), print_on_it), box, UNSEEN)

    assert overlap(mask, box) > 0.5


@pytest.mark.parametrize(("radius", "least", "most"), [(4, 0.7, 0.85), (30, 0.94, 0.99)])
def test_small_outlines_cannot_be_matched_exactly(radius, least, most):
    mask = cv2.circle(np.zeros((100, 100), np.uint8), (50, 50), radius, 1, -1) > 0

    assert least < attainable_iou(mask) < most

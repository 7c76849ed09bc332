"""What somebody draws on a frame becomes an outline there; people draw a few pixels off."""

from pathlib import Path

import numpy as np
import pytest

from v2p_data.scene.frames.classes import CLASSES, OTHER, TABLE
from v2p_data.scene.frames.mask_ops import bounding_box, iou
from v2p_data.scene.frames.segmentation import Segmentation
from v2p_data.scene.frames.working_clip import working_clip_of
from v2p_data.scene.grounding.methods.base import Mark, Seen, mark_in_box
from v2p_data.scene.scale.camera_height import SeenCamera
from v2p_data.video.clip import Clip

GREY, RED = (120, 118, 115), (190, 40, 40)
H, W = 240, 320
X, Y, WIDE, TALL = 140, 100, 40, 30
WHOLE = np.zeros((H, W), bool)
WHOLE[Y : Y + TALL, X : X + WIDE] = True


def seen_in(picture: np.ndarray, thing: np.ndarray) -> Seen:
    """Return a still clip of the picture, and the word of a network that sees the thing on a table."""
    clip = Clip(
        item="drawn",
        path=Path("drawn.mp4"),
        caption="",
        objects=(),
        hints={},
        frames=np.stack([picture] * 10),
        fps=12.0,
        total_frames=10,
        source_fps=12.0,
        source_frame=np.arange(10),
        times_s=np.arange(10) / 12,
        source_size_px=(W, H),
        warnings=(),
    )
    label = np.where(thing, OTHER, TABLE)
    shares = (0.02 + 0.9 * (label == np.arange(len(CLASSES))[:, None, None])).astype(np.float32)
    camera = SeenCamera(
        pitch_rad=0.6, pitch_sd_rad=0.1, focal_widths=0.9, table_width_m=0.6, table_width_sd=0.2
    )
    segmentation = Segmentation(
        idx=np.array([0, 9]),
        shares=np.stack([shares] * 2),
        early=shares,
        late=shares,
        camera=camera,
    )
    return Seen(clip=clip, working=working_clip_of(clip), segmentation=segmentation)


@pytest.fixture(scope="module")
def picture() -> np.ndarray:
    grain = np.random.default_rng(0).integers(-6, 7, (H, W, 3))
    image = np.full((H, W, 3), GREY) + grain
    image[Y : Y + TALL, X : X + WIDE] = RED + grain[Y : Y + TALL, X : X + WIDE]
    return image.astype(np.uint8)


@pytest.fixture(scope="module")
def drawn(picture: np.ndarray) -> Seen:
    return seen_in(picture, WHOLE)


def outlined(seen: Seen, *box: float) -> Mark:
    return mark_in_box(seen, 0, [float(v) for v in box], 0.9)


@pytest.mark.parametrize("off_px", [-3, 3])
def test_sides_that_a_box_cuts_off_belong_to_the_outline(drawn, off_px):
    box = (X + off_px, Y + 2, X + WIDE + off_px, Y + TALL - 2)

    x, y, w, h = bounding_box(outlined(drawn, *box).mask)

    assert (x, y, w, h) == pytest.approx((X, Y, WIDE, TALL), abs=1)


def test_what_was_drawn_stays_what_was_drawn(drawn):
    mark = outlined(drawn, X + 3, Y, X + WIDE + 3, Y + TALL)

    assert bounding_box(mark.box) == (X + 3, Y, WIDE, TALL)


def test_far_beside_a_box_nothing_belongs_to_it(drawn):
    """Of a box around the left half the right half is something else, as far as colours tell."""
    mask = outlined(drawn, X, Y, X + WIDE // 2, Y + TALL).mask

    assert not mask[:, X + WIDE // 2 + 5 :].any()


def test_a_face_in_the_colours_of_the_table_is_completed_by_what_the_network_sees(picture):
    image = picture.copy()
    face = np.zeros((H, W), bool)
    face[Y + TALL // 2 : Y + TALL, X + 5 : X + WIDE] = True
    image[face] = image[: TALL // 2, : WIDE - 5].reshape(-1, 3)

    unseen, seen = (
        outlined(seen_in(image, thing), X, Y, X + WIDE, Y + TALL).mask
        for thing in (np.zeros_like(WHOLE), WHOLE)
    )

    assert iou(seen, WHOLE) > 0.85
    assert iou(unseen, WHOLE) < iou(seen, WHOLE)

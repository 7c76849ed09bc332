"""What somebody draws on a frame becomes an outline there; people draw a few pixels off."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from v2p_data.scene.frames.classes import CLASSES, OTHER, TABLE
from v2p_data.scene.frames.mask_ops import bounding_box, iou
from v2p_data.scene.frames.segmentation import Segmentation
from v2p_data.scene.frames.working_clip import WorkingClip, working_clip_of
from v2p_data.scene.grounding.hint_masks import Box, hint_masks_of
from v2p_data.scene.scale.camera_height import SeenCamera
from v2p_data.video.clip import Clip

GREY, RED = (120, 118, 115), (190, 40, 40)
H, W = 240, 320
X, Y, WIDE, TALL = 140, 100, 40, 30


@pytest.fixture
def drawn() -> tuple[Clip, WorkingClip]:
    grain = np.random.default_rng(0).integers(-6, 7, (H, W, 3))
    image = np.full((H, W, 3), GREY) + grain
    image[Y : Y + TALL, X : X + WIDE] = RED + grain[Y : Y + TALL, X : X + WIDE]
    frames = np.stack([image.astype(np.uint8)] * 10)
    clip = Clip(
        item="drawn", path=Path("drawn.mp4"), caption="", objects=(), hints={}, frames=frames, fps=12.0,
        total_frames=10, source_fps=12.0, source_frame=np.arange(10), times_s=np.arange(10) / 12,
        source_size_px=(W, H), warnings=(),
    )  # fmt: skip
    return clip, working_clip_of(clip)


def outlined(drawn, *box):
    clip, working = drawn
    x0, y0, x1, y1 = (float(v) for v in box)
    said = Box(frame=0, box_xyxy=(x0, y0, x1, y1), score=0.9)
    return hint_masks_of(clip, working, None, {"box": said})["box"]


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


def test_a_face_in_the_colours_of_the_table_is_completed_by_what_the_network_sees(drawn):
    clip, working = drawn
    image = working.rgb[0].copy()
    face = np.zeros((H, W), bool)
    face[Y + TALL // 2 : Y + TALL, X + 5 : X + WIDE] = True
    image[face] = image[: TALL // 2, : WIDE - 5].reshape(-1, 3)
    frames = np.stack([image] * 10)
    clip, whole = replace(clip, frames=frames), np.zeros((H, W), bool)
    whole[Y : Y + TALL, X : X + WIDE] = True
    working = working_clip_of(clip)
    said = Box(frame=0, box_xyxy=(140.0, 100.0, 180.0, 130.0), score=0.9)
    label = np.where(whole, OTHER, TABLE)
    shares = 0.02 + 0.9 * (label == np.arange(len(CLASSES))[:, None, None])
    shares = shares.astype(np.float32)
    camera = SeenCamera(
        pitch_rad=0.6, pitch_sd_rad=0.1, focal_widths=0.9, table_width_m=0.6, table_width_sd=0.2
    )
    segmentation = Segmentation(
        idx=np.array([0, 9]), shares=np.stack([shares] * 2), early=shares, late=shares, camera=camera
    )  # fmt: skip

    alone, told = (
        hint_masks_of(clip, working, w, {"box": said})["box"].mask for w in (None, segmentation)
    )

    assert iou(told, whole) > 0.85
    assert iou(alone, whole) < 0.75

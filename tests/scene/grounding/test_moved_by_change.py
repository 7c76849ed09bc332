"""What stands still is found by what lies around it, drawn by hand."""

from pathlib import Path

import numpy as np
import pytest

from v2p_data.scene.frames.mask_ops import iou
from v2p_data.scene.frames.table import find_table
from v2p_data.scene.frames.working_clip import WorkingClip, working_clip_of
from v2p_data.scene.grounding.moved_by_change import Moved
from v2p_data.scene.grounding.static_by_change import find_static_by_change
from v2p_data.video.clip import Clip

H, W = 240, 320
TABLE_RGB, RED, BLUE = (150, 140, 120), (190, 40, 40), (70, 85, 130)


def block(x: int, y: int, w: int, h: int) -> np.ndarray:
    out = np.zeros((H, W), bool)
    out[y : y + h, x : x + w] = True
    return out


STANDS, FAR = block(200, 100, 36, 40), block(60, 20, 36, 40)


@pytest.fixture(scope="module")
def working() -> WorkingClip:
    """Return a red block that is pushed towards a dull blue one; one that looks like it stands farther away."""
    noise = np.random.default_rng(0).normal(0, 2, (H, W, 3))
    frames = []
    for i in range(16):
        image = np.tile(np.array(TABLE_RGB, float), (H, W, 1))
        image[FAR | STANDS], image[block(40 + 8 * i, 105, 30, 30)] = BLUE, RED
        frames.append(np.clip(image + noise, 0, 255).astype(np.uint8))
    clip = Clip(
        item="drawn", path=Path("drawn.mp4"), caption="", objects=(), hints={}, frames=np.stack(frames), fps=12.0,
        total_frames=16, source_fps=12.0, source_frame=np.arange(16), times_s=np.arange(16) / 12,
        source_size_px=(W, H), warnings=(),
    )  # fmt: skip
    return working_clip_of(clip)


def test_without_the_network_the_one_that_was_pushed_to_is_found(working):
    moved = Moved(
        first=block(40, 105, 30, 30), last=block(160, 105, 30, 30), score=1.0, colour_hist=np.zeros((12, 24, 24))
    )  # fmt: skip
    table = find_table(working.always, None)

    thing = find_static_by_change(working, table, "box", "push_next_to", moved)

    assert thing is not None
    assert iou(thing.mask, STANDS) > 0.85


def test_a_look_that_is_of_nothing_leaves_the_hand_as_it_is(working):
    assert working.knowing(np.zeros_like(working.hand_hist)) is working

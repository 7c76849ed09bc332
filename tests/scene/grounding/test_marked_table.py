"""What a person calls the table is table to the network, wherever a frame shows it bare."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from v2p_data.scene.frames.classes import CLASSES, HAND, OTHER, TABLE
from v2p_data.scene.frames.segmentation import Segmentation
from v2p_data.scene.frames.working_clip import working_clip_of
from v2p_data.scene.grounding.marked_table import with_marked_table
from v2p_data.scene.scale.camera_height import SeenCamera
from v2p_data.video.clip import Clip

H, W = 240, 320
GREY, RED = (120, 118, 115), (190, 40, 40)


@pytest.fixture
def clip():
    """A red box on a grey table; from frame 5 on it stands elsewhere."""
    frames = np.full((10, H, W, 3), GREY) + np.random.default_rng(0).integers(-4, 5, (H, W, 3))
    frames[:5, 100:130, 140:180] = RED
    frames[5:, 100:130, 40:80] = RED
    return Clip(
        item="drawn",
        path=Path("drawn.mp4"),
        caption="",
        objects=("box",),
        hints={},
        frames=frames.astype(np.uint8),
        fps=12.0,
        total_frames=10,
        source_fps=12.0,
        source_frame=np.arange(10),
        times_s=np.arange(10) / 12,
        source_size_px=(W, H),
    )


def seen_as(name):
    shares = np.zeros((10, len(CLASSES), H, W), np.float32)
    shares[:, name] = 1
    camera = SeenCamera(
        pitch_rad=0.6, pitch_sd_rad=0.2, focal_widths=1.0, table_width_m=0.7, table_width_sd=0.3
    )
    return Segmentation(
        idx=np.arange(10),
        shares=shares,
        early=shares[0].copy(),
        late=shares[-1].copy(),
        camera=camera,
    )


def marked(clip, **hint):
    return replace(clip, hints={"table": {"frame": 0, **hint}})


def test_without_the_mark_nothing_changes(clip):
    seen = seen_as(OTHER)

    assert with_marked_table(clip, working_clip_of(clip), seen) is seen


@pytest.mark.parametrize(
    "mark", [{"click": [20.0, 20.0]}, {"stroke": [[20.0, 20.0], [200.0, 30.0]]}]
)
def test_the_table_is_table_where_it_is_bare_and_not_where_something_stands(clip, mark):
    seen = with_marked_table(marked(clip, **mark), working_clip_of(clip), seen_as(OTHER))

    table = seen.shares[:, TABLE] > 0.5
    assert table[0, :60].mean() > 0.98
    assert not table[0, 102:128, 142:178].any()
    assert not table[9, 102:128, 42:78].any()
    assert seen.late[TABLE, :60].mean() > 0.98


def test_a_hand_above_the_table_stays_a_hand(clip):
    seen = with_marked_table(
        marked(clip, click=[20.0, 20.0]), working_clip_of(clip), seen_as(HAND)
    )

    assert not (seen.shares[:, TABLE] > 0.5).any()


def test_an_object_that_is_called_table_is_an_object(clip):
    seen = seen_as(OTHER)
    named = replace(marked(clip, click=[20.0, 20.0]), objects=("table",))

    assert with_marked_table(named, working_clip_of(clip), seen) is seen

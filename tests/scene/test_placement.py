from pathlib import Path

import numpy as np

from v2p_data.scene.footage import footage_of
from v2p_data.scene.nouns import noun_for
from v2p_data.scene.placement import _hidden
from v2p_data.scene.sight import Sighting
from v2p_data.video.clip import Clip

W, H = 320, 240


def block(x: int, y: int, side: int = 36) -> np.ndarray:
    out = np.zeros((H, W), bool)
    out[y : y + side, x : x + side] = True
    return out


def test_what_comes_later_hides_nothing_now_but_an_arm_does():
    """A red block is pushed beside a blue one; at first an arm lies on the blue one's other side."""
    places = [block(60 + 100 * min(12, max(0, i - 6)) // 12, 100) for i in range(24)]
    stands, arm = block(200, 100), block(238, 100)
    frames = np.full((24, H, W, 3), 150, np.uint8)
    frames[:, stands] = 30, 40, 200
    for frame, place in zip(frames, places, strict=True):
        frame[place] = 200, 30, 30
    frames[:4, arm] = 220, 170, 140
    clip = Clip(
        item="drawn", path=Path("drawn.mp4"), caption="", objects=(), hints={}, frames=frames, fps=12.0,
        total_frames=24, source_fps=12.0, source_frame=np.arange(24), times_s=np.arange(24) / 12,
        source_size_px=(W, H), warnings=(),
    )  # fmt: skip
    common = {"quality": np.ones(24), "at": 0, "known_m": None, "sure": 0.9, "why": ""}
    pushed = Sighting(
        phrase="red block", role="manipulated", noun=noun_for("block"), masks=np.stack(places), moves=True, **common
    )  # fmt: skip
    other = Sighting(
        phrase="blue block", role="reference", noun=noun_for("block"), masks=np.stack([stands] * 24), moves=False,
        **common,
    )  # fmt: skip

    hidden = _hidden(footage_of(clip), (pushed, other), stands, 0)

    assert hidden[arm].mean() > 0.2
    assert not hidden[block(160, 100)].any()

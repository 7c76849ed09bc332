"""Judging real clips against drawn boxes."""

from pathlib import Path

import av
import numpy as np
import pytest


@pytest.fixture(scope="module")
def judge(load_script):
    return load_script("judge_real_clips")


def film(path: Path, frames: int) -> Path:
    with av.open(str(path), "w") as out:
        stream = out.add_stream("libx264", rate=10)
        stream.width, stream.height, stream.pix_fmt = 64, 64, "yuv420p"
        for i in range(frames):
            picture = np.full((64, 64, 3), 20 * i, np.uint8)
            out.mux(stream.encode(av.VideoFrame.from_ndarray(picture, format="rgb24")))
        out.mux(stream.encode(None))
    return path


def test_what_is_seen_at_the_end_only_is_hinted_in_the_last_frame(judge, tmp_path):
    path = film(tmp_path / "clip.mp4", 7)

    hint = judge.hint_of({"first": None, "last": [5, 6, 20, 30]}, path)

    assert hint == {"frame": 6, "box": [5, 6, 20, 30]}


def test_overlap_of_boxes_is_that_of_their_areas(judge):
    # 2 x 2 shared, of two boxes of 4 x 4: 4 / (16 + 16 - 4)
    assert judge._iou([0, 0, 4, 4], [2, 2, 6, 6]) == pytest.approx(1 / 7)
    assert judge._iou([0, 0, 4, 4], None) == 0.0

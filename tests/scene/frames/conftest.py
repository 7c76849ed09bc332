"""Lets tests of edited videos share the sample clips and `sample_clips.py`."""

import sys
from pathlib import Path

import pytest

from v2p_data.video.captions import find_videos
from v2p_data.video.clip import Clip
from v2p_data.video.decode import read_clip

sys.path.insert(0, str(Path(__file__).parent))


@pytest.fixture(scope="module")
def clips() -> list[Clip]:
    samples = Path(__file__).parents[3] / "datasets" / "sample_videos"
    return [read_clip(video) for video in find_videos(samples)]

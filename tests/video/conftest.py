"""Small videos, written frame by frame."""

import sys
from pathlib import Path

import pytest

sys.path.insert(0, str(Path(__file__).parent))

from odd_files import write_film


@pytest.fixture
def film(tmp_path):
    """Return a function that writes a video and returns its path."""

    def write(name="clip.mp4", frames=None, **how):
        return write_film(tmp_path / name, frames, **how)

    return write

"""Damaged files end in a clip or in a reason, and soon."""

import time

import numpy as np
import pytest
from odd_files import odd_folders

from v2p_data.errors import ItemRejectedError, V2PError
from v2p_data.seeds import rng_for
from v2p_data.video.captions import VideoItem, read_footage
from v2p_data.video.clip import Clip
from v2p_data.video.decode import VideoConfig, read_clip

CFG = VideoConfig(max_decode_s=5.0)
MAX_S = 10.0


def damaged(data, rng):
    """Return the bytes with a few flipped, overwritten, lost, or moved."""
    out = bytearray(data)
    for _ in range(int(rng.integers(1, 4))):
        kind = int(rng.integers(6))
        at = int(rng.integers(len(out)))
        if kind == 0:
            for _ in range(int(rng.integers(1, 40))):
                out[int(rng.integers(len(out)))] ^= 1 << int(rng.integers(8))
        elif kind == 1:
            del out[at + 16 :]
        elif kind == 2:
            end = min(len(out), at + int(rng.integers(1, 200)))
            out[at:end] = rng.bytes(end - at)
        elif kind == 3:
            end = min(len(out) - 1, at + int(rng.integers(1, 200)))
            del out[at:end]
        elif kind == 4:
            # headers: sizes, counts and times that cannot be
            head = int(rng.integers(min(len(out), 1200)))
            out[head : head + 4] = b"\xff\xff\xff\xff" if rng.random() < 0.5 else bytes(4)
        else:
            out[at:at] = out[: int(rng.integers(1, 400))]
        if len(out) < 32:
            out += bytes(32)
    return bytes(out)


def read(path):
    """Return what became of the file and how long it took; anything but a clip or a reason is raised."""
    start = time.monotonic()
    try:
        clip = read_clip(VideoItem(item="x", path=path, caption="Lifting cup up"), CFG)
    except ItemRejectedError as error:
        outcome = error.reason
    else:
        assert isinstance(clip, Clip)
        assert len(clip.frames) >= 2
        assert np.isfinite(clip.fps)
        assert clip.fps > 0
        outcome = "clip"
    return outcome, time.monotonic() - start


@pytest.mark.parametrize(
    ("name", "codec", "pix_fmt"),
    [
        ("a.mp4", "libx264", "yuv420p"),
        ("a.avi", "mpeg4", "yuv420p"),
        ("a.webm", "libvpx-vp9", "yuv420p"),
        ("a.gif", "gif", "rgb8"),
        ("a.mkv", "ffv1", "bgra"),
        ("b.mp4", "libx265", "yuv420p10le"),
    ],
)
def test_a_damaged_file_gives_a_clip_or_a_reason(film, tmp_path, name, codec, pix_fmt, capfd):
    options = {"libx265": {"x265-params": "log-level=none"}}.get(codec, {})
    whole = film(name, codec=codec, pix_fmt=pix_fmt, options=options).read_bytes()
    capfd.readouterr()
    for i in range(15):
        path = tmp_path / f"damaged{i}.{name[2:]}"
        path.write_bytes(damaged(whole, rng_for(0, "fuzz", name, i)))
        before = sorted(tmp_path.iterdir())

        outcome, seconds = read(path)

        assert seconds < MAX_S, (i, outcome)
        assert sorted(tmp_path.iterdir()) == before
    assert capfd.readouterr().err == ""


ODD = list(odd_folders())


@pytest.mark.parametrize("fill", [fill for _, fill in ODD], ids=[name for name, _ in ODD])
def test_an_odd_folder_gives_clips_or_one_sentence_that_names_it(tmp_path, fill, capfd):
    folder = tmp_path / "videos"
    folder.mkdir()
    fill(folder)
    before = sorted(folder.iterdir())
    names = [str(folder), *(path.name for path in before)]
    capfd.readouterr()

    start = time.monotonic()
    try:
        for video in read_footage(folder).videos:
            clip = read_clip(video, CFG)
            assert len(clip.frames) >= 2
            assert 0 < clip.fps < np.inf
            clip.caption.encode()
    except V2PError as error:
        said = str(error)
        assert any(name in said for name in names)
        assert "\n" not in said
        assert len(said) < 1000

    assert time.monotonic() - start < MAX_S
    assert sorted(folder.iterdir()) == before
    assert "Traceback" not in capfd.readouterr().err

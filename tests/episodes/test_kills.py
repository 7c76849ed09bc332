"""Killed and started again, collecting and packing end like an undisturbed run.

Hundreds more: scripts/bench_kills.py.
"""

import os
import resource
import signal
import time
import warnings
from collections.abc import Callable
from contextlib import contextmanager
from pathlib import Path

import pytest
from toy_task import collect_toys

from v2p_data.episodes.config import EpisodesConfig
from v2p_data.episodes.dataset import shards
from v2p_data.episodes.dataset.writer import pack
from v2p_data.episodes.staging import Episode, staged_episodes
from v2p_data.errors import V2PError

SMALL = EpisodesConfig(num_episodes=4, batch_worlds=3, max_batches=4, size_px=48)


def contents(folder: Path) -> dict[str, bytes]:
    return {str(p.relative_to(folder)): p.read_bytes() for p in folder.rglob("*") if p.is_file()}


def killed_when(begun: Callable[[], bool], work: Callable[[], object]) -> bool:
    """Do some work in a child that is killed as soon as `begun`; tell whether it was still at work."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", DeprecationWarning)  # other threads sleep meanwhile
        child = os.fork()
    if not child:
        try:
            work()
        finally:
            os._exit(0)
    deadline = time.monotonic() + 60
    while not begun() and time.monotonic() < deadline and not os.waitpid(child, os.WNOHANG)[0]:
        time.sleep(0.0002)
    try:
        os.kill(child, signal.SIGKILL)
        return os.WIFSIGNALED(os.waitpid(child, 0)[1])
    except (ProcessLookupError, ChildProcessError):
        return False


@contextmanager
def files_up_to(size: int):
    """Let no file grow beyond `size` bytes, as on a disk that is full."""
    soft, hard = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (size, hard))
    try:
        yield
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, (soft, hard))


@pytest.fixture(scope="module")
def undisturbed(tmp_path_factory: pytest.TempPathFactory) -> dict[str, bytes]:
    out = tmp_path_factory.mktemp("undisturbed")
    collect_toys(out, SMALL)
    return contents(out)


@pytest.mark.parametrize(
    "glob", ["batches", "episodes/*.tmp", "episodes/*.npz", "batches/000.json"]
)
def test_a_killed_collection_ends_like_an_undisturbed_one(undisturbed, tmp_path: Path, glob: str):
    killed_when(lambda: any(tmp_path.glob(glob)), lambda: collect_toys(tmp_path, SMALL))
    for path in staged_episodes(tmp_path):
        assert Episode.load(path).num_frames >= 10
        assert undisturbed[f"episodes/{path.name}"] == path.read_bytes()

    collect_toys(tmp_path, SMALL)

    assert contents(tmp_path) == undisturbed


@pytest.mark.slow
@pytest.mark.parametrize("glob", ["shards/00001.json", "dataset/videos/*/*/*.tmp", "dataset/data"])
def test_a_killed_packing_ends_like_an_undisturbed_one(
    packed: Path, staged: list[Path], tmp_path: Path, monkeypatch: pytest.MonkeyPatch, glob: str
):
    monkeypatch.setattr(shards, "SHARD_FRAMES", 12)
    pack(staged, "user/toys", tmp_path / "whole")
    root = tmp_path / "toys"
    partial = tmp_path / "toys.partial"

    was_killed = killed_when(
        lambda: any(partial.glob(glob)),
        lambda: pack(staged, "user/toys", root),
    )
    if was_killed:
        assert not root.exists()
        pack(staged, "user/toys", root)

    assert contents(root) == contents(tmp_path / "whole")
    assert len(list(root.glob("videos/*/*/*.mp4"))) == 1


def test_a_full_disk_stops_collecting_with_one_sentence(undisturbed, tmp_path: Path):
    with (
        pytest.raises(V2PError, match=r"collecting episodes at .* may not grow"),
        files_up_to(1000),
    ):
        collect_toys(tmp_path, SMALL)
    assert not list(tmp_path.glob("episodes/*.tmp"))

    collect_toys(tmp_path, SMALL)

    assert contents(tmp_path) == undisturbed


@pytest.mark.slow
def test_a_full_disk_stops_packing_with_one_sentence(
    packed: Path, staged: list[Path], tmp_path: Path
):
    root = tmp_path / "toys"

    with pytest.raises(V2PError, match=r"packing at .* may not grow"), files_up_to(4000):
        pack(staged, "user/toys", root)

    assert not root.exists()
    provenance = {"commit": "abc", "packages": {"lerobot": "0.6.1"}}
    pack(staged, "user/toys", root, provenance=provenance)
    assert contents(root) == contents(packed)


@pytest.mark.skipif(not Path("/sys/kernel").is_dir(), reason="only Linux has it")
def test_a_place_that_cannot_be_written_to_is_named(staged: list[Path]):
    said = r"at /sys/kernel.* stopped: .*(read-only|permission|not permitted)"

    with pytest.raises(V2PError, match=said):
        collect_toys(Path("/sys/kernel/toys"), SMALL)
    with pytest.raises(V2PError, match=said):
        pack(staged, "user/toys", Path("/sys/kernel/toys"))

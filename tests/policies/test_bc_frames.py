"""The table of frames is LeRobot's own dataset, and its cache is never wrong; what is missing is named."""

import shutil
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import spoiled
import torch
from small_dataset import (
    FPS,
    FRONT,
    LENGTHS,
    MASK,
    REPO_ID,
    SIZE_PX,
    STATE,
    TASKS,
    are_equal,
    config,
    policy,
    write_dataset,
)

from policies.bc.frames import DatasetError, _cached_pictures, read_frames

OBSERVED, ACTED = [-2, -1, 0], [0, 1, 2]
NET = policy(config(num_labels=3))[0].net
"""Shares of labels and moments, hence two arrays."""


@pytest.fixture(scope="module")
def original(tmp_path_factory) -> Path:
    """A dataset of masks; do not write into it."""
    root = tmp_path_factory.mktemp("frames") / "small"
    write_dataset(root)
    return root


@pytest.fixture(scope="module")
def meta(original: Path):
    """LeRobot's, read once: it takes half a second."""
    from lerobot.datasets.dataset_metadata import LeRobotDatasetMetadata

    return LeRobotDatasetMetadata(REPO_ID, root=original)


@pytest.fixture(scope="module")
def whole(original: Path, meta, tmp_path_factory) -> Path:
    """The cache of its camera; do not write into it."""
    cache = tmp_path_factory.mktemp("cache") / MASK
    _cached_pictures(original, meta, NET, MASK, cache)
    return cache


@pytest.fixture
def dataset(original: Path, tmp_path: Path) -> Path:
    return Path(shutil.copytree(original, tmp_path / "small"))


def read(dataset: Path, cache: Path, net=NET):
    return read_frames(dataset, REPO_ID, net, cache)


def stamps(folder: Path) -> dict[str, tuple[int, int]]:
    files = (p for p in folder.rglob("*") if p.is_file())
    return {str(p.relative_to(folder)): (p.stat().st_ino, p.stat().st_mtime_ns) for p in files}


def pictures(dataset: Path, cache: Path, net=NET, key: str = MASK) -> dict[str, torch.Tensor]:
    return read(dataset, cache, net).pictures[key]


def change_rows(dataset: Path, change) -> None:
    import pyarrow as pa
    import pyarrow.parquet as pq

    (path,) = dataset.glob("data/*/*.parquet")
    table = pq.read_table(path)
    rows = table.to_pydict()
    change(rows)
    schema = pa.schema([field for field in table.schema if field.name in rows])
    pq.write_table(pa.table(rows, schema=schema), path)


def test_a_batch_is_what_lerobots_own_dataset_gives(original: Path, tmp_path: Path):
    from lerobot.datasets.lerobot_dataset import LeRobotDataset
    from torch.utils.data import default_collate

    seen = [k / FPS for k in OBSERVED]
    wanted = {MASK: seen, STATE: seen, "action": [k / FPS for k in ACTED]}
    theirs: Any = LeRobotDataset(REPO_ID, root=original, delta_timestamps=wanted)
    expected = default_collate([theirs[k] for k in range(len(theirs))])

    frames = read(original, tmp_path / "cache")
    batch = frames.batch(torch.arange(len(frames)), OBSERVED, ACTED)

    assert len(frames) == len(theirs) == sum(LENGTHS)
    for key in (STATE, "action", "action_is_pad"):
        assert torch.equal(batch[key], expected[key]), key
    assert batch["task"] == expected["task"]
    assert are_equal(batch[MASK], NET.prepare(MASK, expected[MASK]))


def test_observations_repeat_at_a_start_and_actions_are_padded_beyond_an_end(
    original: Path, tmp_path: Path
):
    frames = read(original, tmp_path / "cache")
    second, end = LENGTHS[0], LENGTHS[0] + LENGTHS[1] - 1

    batch = frames.batch(torch.tensor([second, end]), OBSERVED, ACTED)

    assert torch.equal(batch[STATE][0], frames.vectors[STATE][second].expand(3, -1))
    assert torch.equal(batch[STATE][1], frames.vectors[STATE][end - 2 : end + 1])
    assert batch["action_is_pad"].tolist() == [[False] * 3, [False, True, True]]
    assert batch["task"] == [TASKS[1], TASKS[1]]


def test_episodes_follow_a_dataset_with_their_own_words(original: Path, tmp_path: Path):
    frames = read(original, tmp_path / "cache")

    both = frames.extended(frames)

    rows = torch.tensor([0, LENGTHS[0], len(frames), len(frames) + LENGTHS[0]])
    batch = both.batch(rows, [-1, 0], [0])
    assert batch["task"] == [TASKS[0], TASKS[1]] * 2
    assert torch.equal(batch[STATE][:2], batch[STATE][2:])
    assert torch.equal(batch[STATE][:, 0], batch[STATE][:, 1])  # all four are starts


def test_a_cache_is_used_again_untouched(dataset: Path, tmp_path: Path):
    cache = tmp_path / "cache"
    before = pictures(dataset, cache)
    written = stamps(cache)

    again = pictures(dataset, cache)

    assert stamps(cache) == written
    assert are_equal(before, again)
    assert not list(cache.glob("*.partial"))


def test_a_cache_is_made_anew_when_a_video_changed(dataset: Path, tmp_path: Path):
    cache = tmp_path / "cache"
    before = pictures(dataset, cache)
    write_dataset(tmp_path / "other", seed=1)
    (theirs,), (ours,) = (
        list(root.glob("videos/**/*.mp4")) for root in (tmp_path / "other", dataset)
    )
    shutil.copy(theirs, ours)

    after = pictures(dataset, cache)

    assert not are_equal(before, after)
    assert are_equal(after, pictures(tmp_path / "other", tmp_path / "fresh"))


@pytest.mark.parametrize(
    "settings", [{"input_size_px": 48}, {"num_labels": 2}, {"mask_moments": False}]
)
def test_a_cache_is_made_anew_for_another_encoder(original: Path, tmp_path: Path, settings):
    other = policy(config(**{"num_labels": 3, **settings}))[0].net
    cache = tmp_path / "cache"
    pictures(original, cache)

    after = pictures(original, cache, other)

    assert are_equal(after, pictures(original, tmp_path / "fresh", other))


@pytest.mark.parametrize("name", spoiled.CACHES)
def test_a_damaged_cache_is_made_anew(
    original: Path, whole: Path, meta, tmp_path: Path, name: str
):
    expected = _cached_pictures(original, meta, NET, MASK, whole)
    cache = Path(shutil.copytree(whole, tmp_path / "cache"))
    spoiled.CACHES[name](cache)

    again = _cached_pictures(original, meta, NET, MASK, cache)

    assert are_equal(again, expected)
    written = stamps(cache)
    _cached_pictures(original, meta, NET, MASK, cache)
    assert stamps(cache) == written


def test_what_a_killed_writer_left_is_no_cache(original: Path, tmp_path: Path):
    left = tmp_path / "cache" / f"{MASK}.partial"
    left.mkdir(parents=True)
    (left / "picture.npy").write_bytes(b"half")

    found = pictures(original, tmp_path / "cache")

    assert found["picture"].shape[:2] == (sum(LENGTHS), 3)
    assert not left.exists()


def test_two_writers_at_once_spoil_nothing(original: Path, tmp_path: Path):
    other = policy(config(num_labels=3, input_size_px=48))[0].net
    expected = [pictures(original, tmp_path / f"alone-{k}", n) for k, n in enumerate((NET, other))]

    def work(number: int) -> list[bool]:
        net, wanted = ((NET, expected[0]), (other, expected[1]))[number % 2]
        return [are_equal(pictures(original, tmp_path / "shared", net), wanted) for _ in range(4)]

    with ThreadPoolExecutor(4) as pool:
        found = list(pool.map(work, range(4)))

    assert found == [[True] * 4] * 4


def test_pictures_that_are_no_video_are_read_exactly(tmp_path: Path):
    root, cache = tmp_path / "images", tmp_path / "cache"
    given = write_dataset(root, dtype="image")
    net = policy(config(FRONT, input_size_px=SIZE_PX))[0].net

    found = pictures(root, cache, net, FRONT)

    assert np.array_equal(found["picture"].numpy(), np.stack(given).transpose(0, 3, 1, 2))
    others = write_dataset(tmp_path / "others", dtype="image", seed=1)
    (theirs,), (ours,) = (list(r.glob("data/*/*.parquet")) for r in (tmp_path / "others", root))
    shutil.copy(theirs, ours)
    changed = pictures(root, cache, net, FRONT)
    assert np.array_equal(changed["picture"].numpy(), np.stack(others).transpose(0, 3, 1, 2))


@pytest.mark.parametrize("key", [STATE, "action"])
@pytest.mark.parametrize("value", [float("nan"), float("inf")])
def test_a_number_that_is_not_finite_is_named_with_file_and_row(
    dataset: Path, tmp_path: Path, key: str, value: float
):
    def spoil(rows: dict[str, Any]) -> None:
        rows[key][9] = [value, *rows[key][9][1:]]

    change_rows(dataset, spoil)

    with pytest.raises(
        DatasetError, match=rf"column '{key}' of .*file-000.parquet is not finite in row 9"
    ):
        read(dataset, tmp_path / "cache")


def test_a_missing_column_is_named_beside_those_there_are(dataset: Path, tmp_path: Path):
    change_rows(dataset, lambda rows: rows.pop(STATE))

    with pytest.raises(
        DatasetError, match=rf"file-000.parquet has no column '{STATE}'; it has action, "
    ):
        read(dataset, tmp_path / "cache")


def test_a_missing_camera_is_named_beside_those_there_are(original: Path, tmp_path: Path):
    net = policy(config(FRONT))[0].net

    with pytest.raises(DatasetError, match=rf"has no camera '{FRONT}'; it has {MASK}"):
        read(original, tmp_path / "cache", net)


def test_rows_that_are_missing_are_counted(dataset: Path, tmp_path: Path):
    def shorten(rows: dict[str, Any]) -> None:
        for values in rows.values():
            del values[-2:]

    change_rows(dataset, shorten)

    with pytest.raises(DatasetError, match="says 18 frames in meta/episodes and holds 16 rows"):
        read(dataset, tmp_path / "cache")


def test_a_video_that_is_too_short_is_refused(dataset: Path, tmp_path: Path):
    write_dataset(tmp_path / "other", lengths=(7, 3))
    (theirs,), (ours,) = (
        list(root.glob("videos/**/*.mp4")) for root in (tmp_path / "other", dataset)
    )
    shutil.copy(theirs, ours)

    with pytest.raises(
        DatasetError, match=r"\.mp4 ends at frame 10; .* episode of 5 frames starts at frame 7"
    ):
        read(dataset, tmp_path / "cache")
    assert not (tmp_path / "cache" / MASK).exists()


def test_a_video_that_is_missing_or_damaged_is_named(dataset: Path, tmp_path: Path):
    (video,) = dataset.glob("videos/**/*.mp4")
    video.write_bytes(video.read_bytes()[:300])
    with pytest.raises(DatasetError, match=r"file-000\.mp4 cannot be decoded"):
        read(dataset, tmp_path / "cache")

    video.unlink()
    with pytest.raises(DatasetError, match=r"file-000\.mp4 is missing"):
        read(dataset, tmp_path / "cache")

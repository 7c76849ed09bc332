"""Datasets that are damaged or malicious: each case spoils a good one, which `good_dataset` makes.

`REFUSED` maps a name to a function that spoils a folder so that no command may read its tables:
  one sentence, exit code 2.
What `FOUND` spoils can be read; `v2p verify` lists it, exit code 1.
"""

import json
import os
import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq

from v2p_data.episodes.dataset.writer import pack
from v2p_data.episodes.staging import Episode
from v2p_data.seeds import rng_for

Spoil = Callable[[Path], object]
INFO, STATS, ABOUT = "meta/info.json", "meta/stats.json", "meta/v2p.json"
DATA = "data/chunk-000/file-000.parquet"
TABLE = "meta/episodes/chunk-000/file-000.parquet"
TASKS = "meta/tasks.parquet"
VIDEO = "videos/observation.images.mask/chunk-000/file-000.mp4"
DEEP = "[" * 100_000
FRAMES = 6


def good_dataset(folder: Path) -> Path:
    """Write a dataset of two short episodes, and return it."""
    for number in range(2):
        rng = rng_for(11, "strange-dataset", number)
        labels = np.zeros((FRAMES, 32, 32), np.uint8)
        for t in range(FRAMES):
            labels[t, 4 + t : 12 + t, 6 : 14 + number] = 2
        Episode(
            id=f"toy_{number:05d}",
            item="toy",
            task="lift the toy up",
            seed=number,
            labels=labels,
            state=rng.normal(size=(FRAMES, 11)).astype(np.float32),
            action=rng.uniform(-1, 1, (FRAMES, 7)).astype(np.float32),
            success=np.arange(FRAMES) > 3,
            referee=True,
            objects=("toy",),
            params={},
        ).save(folder / "staged")
    staged = sorted((folder / "staged").glob("*.npz"))
    pack(staged, "user/strange", folder / "good")
    shutil.rmtree(folder / "staged")
    return folder / "good"


# --- how it is spoiled -----------------------------------------------------------------------------------------


def value(file: str, path: str, new: Any) -> Spoil:
    """Return what puts a value at a path with slashes in a JSON file."""

    def spoil(root: Path) -> None:
        data = json.loads((root / file).read_text())
        *way, last = path.split("/")
        place = data
        for part in way:
            place = place[part]
        place[last] = new
        (root / file).write_text(json.dumps(data))

    return spoil


def without(file: str, key: str) -> Spoil:
    def spoil(root: Path) -> None:
        data = json.loads((root / file).read_text())
        del data[key]
        (root / file).write_text(json.dumps(data))

    return spoil


def content(file: str, new: str | bytes) -> Spoil:
    return lambda root: (root / file).write_bytes(new if isinstance(new, bytes) else new.encode())


def instead(file: str, make: Callable[[Path], object]) -> Spoil:
    """Return what puts something else in a file's place."""

    def spoil(root: Path) -> None:
        (root / file).unlink()
        make(root / file)

    return spoil


def linked(file: str, target: str) -> Spoil:
    return instead(file, lambda path: path.symlink_to(target))


def linked_copy(root: Path) -> None:
    """Put a file beside the dataset, and a link to it in its place."""
    outside = root.with_name("outside.parquet")
    shutil.copyfile(root / DATA, outside)
    linked(DATA, str(outside))(root)


def huge(file: str) -> Spoil:
    return lambda root: os.truncate(root / file, 8 * 2**30)


def cells(file: str, column: str, new: Callable[[pa.ChunkedArray], pa.Array]) -> Spoil:
    """Return what puts other values, of any type, in a column of a table."""

    def spoil(root: Path) -> None:
        table = pq.read_table(root / file)
        k = table.column_names.index(column)
        pq.write_table(table.set_column(k, column, new(table.column(k))), root / file)

    return spoil


def cell(file: str, column: str, new: Any) -> Spoil:
    """Return what puts one value into the first row of a column, of the column's type."""
    return cells(file, column, lambda c: pa.array([new, *c.to_pylist()[1:]], type=c.type))


def many_rows(file: str, column: str) -> Spoil:
    """Return what puts 150 million rows into a table's file, which hold nothing and take hardly a byte each."""

    def spoil(root: Path) -> None:
        ten_million = pa.table({column: pa.nulls(10_000_000, pa.int64())})
        with pq.ParquetWriter(root / file, ten_million.schema) as writer:
            for _ in range(15):
                writer.write_table(ten_million, row_group_size=10_000_000)

    return spoil


def long_text(file: str, column: str, in_lists: bool) -> Spoil:
    """Return what fills a column with one text of a megabyte, which the file holds once."""

    def spoil(root: Path) -> None:
        rows = 20_000
        text = ["x" * 2**20]
        column_ = pa.DictionaryArray.from_arrays(
            pa.array(np.zeros(rows, np.int32)), pa.array(text)
        )
        if in_lists:
            column_ = pa.ListArray.from_arrays(
                pa.array(np.arange(rows + 1, dtype=np.int32)), column_
            )
        first = pq.read_table(root / file).slice(0, 1)
        table = first.take(pa.array(np.zeros(rows, np.int64)))
        table = table.set_column(table.column_names.index(column), column, column_)
        pq.write_table(table.replace_schema_metadata({}), root / file, store_schema=False)

    return spoil


REFUSED: dict[str, Spoil] = {
    f"{path} is {str(new)[:40]!r}": value(INFO, path, new)
    for path, options in {
        "fps": (0, -20, 1e9, 0.001, None, "20", True, [20]),
        "total_episodes": (10**18, -1, 2.5, None, "two", True),
        "total_frames": (10**18, -1, 10**30, "all"),
        "total_tasks": (10**18, "one"),
        "chunks_size": (0, 10**12, "1000"),
        "data_files_size_in_mb": (0, 10**12),
        "video_files_size_in_mb": (-5,),
        "data_path": (
            "{chunk_index:>3000000000}/file.parquet",
            "{chunk_index:3000000000d}/file.parquet",
            "{chunk_index:03d}/../../../etc/{file_index}",
            "/etc/passwd",
            "{chunk_index.__class__}/x",
            "{chunk_index!r:>900000000}",
            "{0}{1}",
            "{unknown}",
            "data/{",
            "a" * 100_000,
            7,
            "\0",
        ),
        "video_path": (
            "{video_key:>3000000000}.mp4",
            "../{video_key}/{file_index:03d}.mp4",
            "{video_key[0]}",
            ["a"],
            "{file_index:999999999d}",
        ),
        "features": ([], None, "x"),
        "features/action": (None, [], "float32"),
        "features/action/dtype": (["float32"], None, 32, "FLOAT32", "f" * 1000),
        "features/action/shape": (
            [-1],
            [0],
            [10**12],
            [100_000, 100_000],
            "7",
            None,
            [1] * 9,
            [7.5],
        ),
        "features/../..": ({"dtype": "float32", "shape": [1]},),
        "features/observation.images.mask/info": ([], "x"),
        "robot_type": (["v2p"], "x" * 5000),
        "splits": (["train"], {"train": 3}),
        "codebase_version": (3.0, "v2.1", None),
    }.items()
    if "../.." not in path
    for new in options
} | {
    "a column called ../..": lambda root: value(
        INFO,
        "features",
        json.loads((root / INFO).read_text())["features"]
        | {"../..": {"dtype": "video", "shape": [32, 32, 3]}},
    )(root),
    "info.json of text": content(INFO, "hello"),
    "info.json nested": content(INFO, DEEP),
    "info.json of 8 GB": huge(INFO),
    "info.json is a pipe": instead(INFO, os.mkfifo),
    "info.json is /dev/zero": linked(INFO, "/dev/zero"),
    "stats.json is /dev/zero": linked(STATS, "/dev/zero"),
    "stats.json is a pipe": instead(STATS, os.mkfifo),
    "stats.json of 8 GB": huge(STATS),
    "stats.json is a list": content(STATS, "[1, 2]"),
    "stats.json of texts": content(STATS, '{"action": "x"}'),
    "a statistic is a text": value(STATS, "action/mean", "0.5"),
    "a statistic of texts": value(STATS, "action/mean", ["0.5"] * 7),
    "a statistic is null": value(STATS, "action/std", None),
    "a statistic is ragged": value(STATS, "action/min", [[1.0], [1.0, 2.0]]),
    "a statistic is an object": value(STATS, "action/min", {"a": 1}),
    "a statistic of 300 digits": value(STATS, "action/count", [10**300]),
    "a table is a pipe": instead(DATA, os.mkfifo),
    "the episode table is a pipe": instead(TABLE, os.mkfifo),
    "the task table is a pipe": instead(TASKS, os.mkfifo),
    "a video is a pipe": instead(VIDEO, os.mkfifo),
    "another file is a pipe": lambda root: os.mkfifo(root / "meta/more.json"),
    "record.json is a pipe": lambda root: os.mkfifo(root / "record.json"),
    "v2p.json is a pipe": instead(ABOUT, os.mkfifo),
    "v2p.json of 8 GB": huge(ABOUT),
    "a table is a link to the outside": linked_copy,
    "a table is a link to nothing": linked(DATA, "nothing"),
    "a table is a link to itself": linked(DATA, "file-000.parquet"),
    "a video is /dev/zero": linked(VIDEO, "/dev/zero"),
    "a folder is a link to the outside": lambda root: (root / "more").symlink_to("/etc"),
    "150 million equal rows": many_rows(DATA, "index"),
    "150 million equal episodes": many_rows(TABLE, "length"),
    "a task of a megabyte in 20,000 rows": long_text(TASKS, "task", in_lists=False),
    "an episode's task of a megabyte in 20,000 rows": long_text(TABLE, "tasks", in_lists=True),
    "an episode of a negative length": cell(TABLE, "length", -6),
    "an episode of 10^15 frames": cell(TABLE, "length", 10**15),
    "an episode in file 10^18": cell(TABLE, "data/file_index", 10**18),
    "an episode in chunk -1": cell(TABLE, f"videos/{'observation.images.mask'}/chunk_index", -1),
    "lengths are fractions": cells(TABLE, "length", lambda c: pa.array([6.5, float("nan")])),
    "lengths are texts": cells(TABLE, "length", lambda c: pa.array(["six", "six"])),
    "tasks are numbers": cells(TABLE, "tasks", lambda c: pa.array([1, 2])),
    "the label 4000000000": value(
        ABOUT,
        "episodes",
        [
            {
                "id": "a",
                "item": "toy",
                "task": "lift the toy up",
                "seed": 0,
                "length": FRAMES,
                "labels": {"4000000000": "toy"},
                "params": {},
            }
        ],
    ),
    "a length is missing": cells(TABLE, "length", lambda c: pa.array([6, None])),
}
"""No command reads these."""

FOUND: dict[str, Spoil] = {
    "no columns said": value(INFO, "features", {}),
    "a million episodes said": value(INFO, "total_episodes", 1_000_000),
    "a hundred million frames said": value(INFO, "total_frames", 100_000_000),
    "stats.json of noise": content(STATS, b"\xff\xfe" * 100),
    "stats.json nested": content(STATS, DEEP),
    "stats.json without actions": without(STATS, "action"),
    "a mean of NaN": value(STATS, "action/mean", [float("nan")] * 7),
    "a mean of seven hundred numbers": value(STATS, "action/mean", [0.0] * 700),
    "pictures of 3,000 px said": value(
        INFO, "features/observation.images.mask/shape", [3000, 2000, 3]
    ),
    "a table of noise": content(DATA, b"PAR1" + b"\x00\xff" * 500 + b"PAR1"),
    "an empty table": content(DATA, b""),
    "the episode table of text": content(TABLE, "hello"),
    "the task table of text": content(TASKS, "hello"),
    "a video of noise": content(VIDEO, b"\x00\xff" * 500),
    "no video": lambda root: (root / VIDEO).unlink(),
    "no tasks": lambda root: (root / TASKS).unlink(),
    "no rows": lambda root: shutil.rmtree(root / "data"),
    "no episodes": lambda root: shutil.rmtree(root / "meta/episodes"),
    "a type that is none": value(INFO, "features/action/dtype", "float9999"),
    "a column that is missing": lambda root: value(
        INFO,
        "features",
        json.loads((root / INFO).read_text())["features"]
        | {"more": {"dtype": "float32", "shape": [1], "names": None}},
    )(root),
    "times are NaN": cell(TABLE, "videos/observation.images.mask/from_timestamp", float("nan")),
    "times of 10^30 s": cell(TABLE, "videos/observation.images.mask/from_timestamp", 1e30),
    "a task of number 10^9": cell(DATA, "task_index", 10**9),
}
"""These can be read, and are not as they should be."""

UNSOUND: dict[str, Spoil] = {
    f"{column} {what}": cells(DATA, column, new)
    for column in ("action", "observation.state", "next.success", "timestamp", "task_index")
    for what, new in {
        "is null": lambda c: pa.nulls(len(c), c.type),
        "is null once": lambda c: pa.array([None, *c.to_pylist()[1:]], type=c.type),
        "holds texts": lambda c: pa.array(["a"] * len(c)),
    }.items()
} | {
    "an action is too short": cells(
        DATA, "action", lambda c: pa.array([[0.5], *c.to_pylist()[1:]])
    ),
    "the tasks were edited": cells(TASKS, "task", lambda c: pa.array(["push it"] * len(c))),
    "the episodes' tasks were edited": cells(
        TABLE, "tasks", lambda c: pa.array([["push it"]] * len(c))
    ),
}
"""What no dataset may be made of."""
FOUND |= UNSOUND

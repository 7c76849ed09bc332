"""The tables of a LeRobot v3 dataset as they lie on disk, read without LeRobot.

LeRobot looks for what it misses on the Hub, and says "not found" where a file is damaged. So the tables are
read here first, and what does not fit together is named by file.
"""

import itertools
from collections.abc import Generator, Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc
import pyarrow.parquet as pq

from v2p_data.episodes.dataset.intake import INFO_FILE, STATS_FILE, check_info
from v2p_data.errors import V2PError
from v2p_data.json_files import json_or_none

TASKS_FILE = "meta/tasks.parquet"
EPISODES_GLOB = "meta/episodes/*/*.parquet"
DATA_GLOB = "data/*/*.parquet"
DATA_PATH = "data/chunk-{chunk_index:03d}/file-{file_index:03d}.parquet"
VIDEO_PATH = "videos/{video_key}/chunk-{chunk_index:03d}/file-{file_index:03d}.mp4"
BOOKKEEPING = ("timestamp", "frame_index", "episode_index", "index", "task_index")
FRAME_SLACK = 0.5
"""Video times may be off by less than this share of a frame."""


@dataclass(frozen=True, kw_only=True)
class Problem:
    """One thing that does not fit."""

    check: str
    where: str
    detail: str


def read_info(root: Path) -> dict[str, Any]:
    """Return `meta/info.json`.

    Raises:
        V2PError: there is no LeRobot v3 dataset at `root`, or the file says what it may not.
    """
    info = json_or_none(root / INFO_FILE)
    if not isinstance(info, dict) or not isinstance(info.get("features"), dict):
        raise V2PError(
            f"{root} holds no LeRobot dataset: there is no readable {INFO_FILE} in it; "
            "give the folder that 'v2p generate' named at its end"
        )
    version = str(info.get("codebase_version", ""))
    if not version.startswith("v3"):
        raise V2PError(
            f"{root} is a LeRobot dataset of version '{version}'; only v3 can be read, "
            "convert it with LeRobot's own converter"
        )
    check_info(root)
    return info


def camera_keys(info: dict[str, Any], *dtypes: str) -> list[str]:
    """Return the names of the columns that are pictures, of `dtypes` (both kinds by default)."""
    wanted = dtypes or ("video", "image")
    return [k for k, f in info["features"].items() if f.get("dtype") in wanted]


def tasks_of(root: Path) -> list[str]:
    """Return the instructions in the order of the file's rows, which is how LeRobot counts them."""
    table = pq.read_table(root / TASKS_FILE)
    named = [c for c in ("task", "__index_level_0__") if c in table.column_names]
    return [str(t) for t in table.column(named[0]).to_pylist()]


def episodes_of(root: Path, *, with_stats: bool = False) -> pa.Table:
    """Return the episode table, its files in order; statistics only where asked for, as they are wide."""
    tables = []
    for path in sorted(root.glob(EPISODES_GLOB)):
        names = pq.read_schema(path).names
        columns = [n for n in names if with_stats or not n.startswith("stats/")]
        tables.append(pq.read_table(path, columns=columns))
    return pa.concat_tables(tables, promote_options="default")


READING_ERRORS = (pa.ArrowException, OSError, LookupError, TypeError, ValueError, AttributeError)
"""What reading a damaged table or JSON of another shape ends in."""


@contextmanager
def damage_named(root: Path) -> Generator[None]:
    """Turn what a damaged dataset does to its readers into one sentence.

    Raises:
        V2PError: something could not be read.
    """
    try:
        yield
    except READING_ERRORS as error:
        raise V2PError(
            f"{root} is damaged ({_words(error)}); 'v2p verify {root}' names the file"
        ) from error


def layout_problems(root: Path, info: dict[str, Any]) -> list[Problem]:
    """Return what is missing, damaged or contradicts itself in the files, pictures aside."""
    try:
        return _layout_problems(root, info)
    except READING_ERRORS as error:
        return [
            Problem(
                check="unreadable_file",
                where="meta and data",
                detail=f"cannot be read ({_words(error)})",
            )
        ]


def demand_sound(root: Path, info: dict[str, Any]) -> None:
    """Raise unless `layout_problems` finds nothing.

    Raises:
        V2PError: names the first thing that is wrong.
    """
    if problems := layout_problems(root, info):
        raise V2PError(
            f"{root} is not sound ({problems[0].where}: {problems[0].detail}); 'v2p verify {root}' lists everything"
        )


def _layout_problems(root: Path, info: dict[str, Any]) -> list[Problem]:
    if found := list(_missing(root, info)) or list(_unreadable(root)):
        return found
    episodes = episodes_of(root)
    if found := list(_missing_parts(root, info, episodes)):
        return found
    found = [
        *_counts(root, info, episodes),
        *_episode_order(episodes),
        *_rows(root, info, episodes),
        *_video_times(info, episodes),
    ]
    return found or list(_video_sizes(root, info))


STOPPING = (
    "missing_file",
    "unreadable_file",
    "missing_column",
    "missing_rows",
    "counts",
    "video_size",
)
"""After these LeRobot is not asked: it would look for the rest on the Hub, or make room for what is not there."""


def _missing(root: Path, info: dict[str, Any]) -> Iterator[Problem]:
    wanted = [STATS_FILE, TASKS_FILE, EPISODES_GLOB, DATA_GLOB]
    wanted += [f"videos/{key}/*/*.mp4" for key in camera_keys(info, "video")]
    for pattern in wanted:
        if not any(root.glob(pattern)):
            yield Problem(
                check="missing_file",
                where=pattern,
                detail="is missing; the dataset was not finalized or not copied whole",
            )


def _unreadable(root: Path) -> Iterator[Problem]:
    for path in [
        root / TASKS_FILE,
        *sorted(root.glob(EPISODES_GLOB)),
        *sorted(root.glob(DATA_GLOB)),
    ]:
        try:
            pq.read_metadata(path)
        except (pa.ArrowException, OSError) as error:
            words = str(error).splitlines()[0][:150]
            yield Problem(
                check="unreadable_file",
                where=_name(root, path),
                detail=f"is no whole parquet file ({words}); its writer was killed or the copy was cut",
            )
    if json_or_none(root / STATS_FILE) is None:
        yield Problem(check="unreadable_file", where=STATS_FILE, detail="is no JSON")


def _missing_parts(root: Path, info: dict[str, Any], episodes: pa.Table) -> Iterator[Problem]:
    """Yield columns and files that the tables name and that are not there."""
    wanted = ["episode_index", "tasks", "length", "dataset_from_index", "dataset_to_index"]
    wanted += ["data/chunk_index", "data/file_index"]
    parts = ("chunk_index", "file_index", "from_timestamp", "to_timestamp")
    wanted += [f"videos/{key}/{part}" for key in camera_keys(info, "video") for part in parts]
    absent = [name for name in wanted if name not in episodes.column_names]
    if absent:
        yield Problem(
            check="missing_column", where="meta/episodes", detail=f"lacks {', '.join(absent)}"
        )
        return
    files = {
        data_path(info, int(c), int(f))
        for c, f in zip(
            column(episodes, "data/chunk_index"), column(episodes, "data/file_index"), strict=True
        )
    }
    for key in camera_keys(info, "video"):
        pairs = zip(
            column(episodes, f"videos/{key}/chunk_index"),
            column(episodes, f"videos/{key}/file_index"),
            strict=True,
        )
        files |= {video_path(info, key, int(c), int(f)) for c, f in pairs}
    for name in sorted(files):
        if not (root / name).is_file():
            yield Problem(
                check="missing_file", where=name, detail="is missing, and episodes name it"
            )


def data_path(info: dict[str, Any], chunk: int, file: int) -> str:
    """Return where a data file lies, beneath the dataset."""
    pattern = info.get("data_path") or DATA_PATH
    return str(pattern).format(chunk_index=chunk, file_index=file)


def video_path(info: dict[str, Any], key: str, chunk: int, file: int) -> str:
    """Return where a video file lies, beneath the dataset."""
    pattern = info.get("video_path") or VIDEO_PATH
    return str(pattern).format(video_key=key, chunk_index=chunk, file_index=file)


def column(table: pa.Table, name: str) -> np.ndarray:
    """Return one column of numbers."""
    return table.column(name).to_numpy()


def row_spans(of_row: np.ndarray) -> dict[int, tuple[int, int]]:
    """Return per episode the first row and the number of rows, which lie together, of a file's `episode_index`."""
    numbers, first, count = np.unique(of_row, return_index=True, return_counts=True)
    return {int(k): (int(a), int(n)) for k, a, n in zip(numbers, first, count, strict=True)}


def _counts(root: Path, info: dict[str, Any], episodes: pa.Table) -> Iterator[Problem]:
    lengths = column(episodes, "length")
    noted = int(info["total_episodes"]), int(info["total_frames"])
    true = len(lengths), int(lengths.sum())
    if noted != true:
        yield Problem(
            check="counts",
            where=INFO_FILE,
            detail=f"names {noted} episodes and frames, the episode table {true}",
        )
    rows = sum(pq.read_metadata(path).num_rows for path in sorted(root.glob(DATA_GLOB)))
    if rows != true[1]:
        yield Problem(
            check="counts", where="data", detail=f"holds {rows} rows, the episode table {true[1]}"
        )
    tasks = tasks_of(root)
    if int(info.get("total_tasks", len(tasks))) != len(tasks):
        yield Problem(
            check="counts",
            where=INFO_FILE,
            detail=f"names {info['total_tasks']} tasks, {TASKS_FILE} holds {len(tasks)}",
        )
    numbers = column(pq.read_table(root / TASKS_FILE), "task_index")
    if not np.array_equal(numbers, np.arange(len(numbers))):
        yield Problem(
            check="index",
            where=TASKS_FILE,
            detail="tasks are not in the order of their numbers, so LeRobot takes one for another",
        )


def _episode_order(episodes: pa.Table) -> Iterator[Problem]:
    numbers = column(episodes, "episode_index")
    if not np.array_equal(numbers, np.arange(len(numbers))):
        yield Problem(
            check="index",
            where="meta/episodes",
            detail="episode numbers have a gap or are out of order; LeRobot finds episodes by position "
            "and takes one for another",
        )
    ends = np.cumsum(column(episodes, "length"))
    starts = column(episodes, "dataset_from_index"), column(episodes, "dataset_to_index")
    wrong = np.flatnonzero((starts[1] != ends) | (starts[0] != ends - column(episodes, "length")))
    if len(wrong):
        yield Problem(
            check="index",
            where=f"episode {wrong[0]}",
            detail=f"its rows are noted as {starts[0][wrong[0]]} to {starts[1][wrong[0]]}, which "
            "its place and length contradict",
        )


def _rows(root: Path, info: dict[str, Any], episodes: pa.Table) -> Iterator[Problem]:
    """Yield what is wrong with which rows lie in which file."""
    where_is: dict[int, set[str]] = {}
    counted: dict[int, int] = {}
    said = episodes.column("tasks").to_pylist()
    tasks = np.array(tasks_of(root))
    in_tables = [k for k, f in info["features"].items() if f.get("dtype") != "video"]
    numbers = {
        k: int(np.prod(f["shape"]))
        for k, f in info["features"].items()
        if f["dtype"].startswith(("float", "int", "uint", "bool"))
    }
    for path in sorted(root.glob(DATA_GLOB)):
        name = _name(root, path)
        absent = [c for c in in_tables if c not in pq.read_schema(path).names]
        if absent:
            yield Problem(check="missing_column", where=name, detail=f"lacks {', '.join(absent)}")
            return
        table = pq.read_table(path, columns=list(numbers))
        for key, per_row in numbers.items():
            if not _holds_numbers(table.column(key), per_row):
                detail = f"does not hold {per_row} numbers in each row of {key}"
                yield Problem(check="missing_column", where=name, detail=detail)
                return
        of_row, shown = column(table, "episode_index"), column(table, "task_index")
        if len(shown) and not 0 <= shown.min() <= shown.max() < len(tasks):
            detail = f"names task {shown.max()} of {len(tasks)}"
            yield Problem(check="task", where=name, detail=detail)
            return
        for k, (first, count) in row_spans(of_row).items():
            named = set(tasks[shown[first : first + count]].tolist())
            if k < len(said) and not named <= set(said[k]):
                rows, stated = "; ".join(sorted(named)), "; ".join(said[k])
                detail = f"its rows show the task {rows!r}, the episode table {stated!r}"
                yield Problem(check="task", where=f"episode {k}", detail=detail)
        for number, rows in zip(*np.unique(of_row, return_counts=True), strict=True):
            where_is.setdefault(int(number), set()).add(name)
            counted[int(number)] = counted.get(int(number), 0) + int(rows)
    for k, length in enumerate(column(episodes, "length")):
        if counted.get(k, 0) == 0:
            yield Problem(
                check="missing_rows", where=f"episode {k}", detail="has no rows in data/"
            )
        elif counted[k] != length:
            yield Problem(
                check="length", where=f"episode {k}", detail=f"has {counted[k]} rows, not {length}"
            )
    named = [
        data_path(info, int(c), int(f))
        for c, f in zip(
            column(episodes, "data/chunk_index"), column(episodes, "data/file_index"), strict=True
        )
    ]
    for k, name in enumerate(named):
        if where_is.get(k, {name}) != {name}:
            yield Problem(
                check="index",
                where=f"episode {k}",
                detail=f"is noted in {name} and lies in {', '.join(sorted(where_is[k]))}",
            )


def _holds_numbers(values: pa.ChunkedArray, per_row: int) -> bool:
    """Return whether each row of a column holds so many numbers, none of which is missing."""
    count = len(values)
    while not values.null_count and hasattr(values.type, "value_type"):
        values = pc.call_function("list_flatten", [values])
    kinds = (pa.types.is_floating, pa.types.is_integer, pa.types.is_boolean)
    return (
        not values.null_count
        and len(values) == count * per_row
        and any(k(values.type) for k in kinds)
    )


def _video_times(info: dict[str, Any], episodes: pa.Table) -> Iterator[Problem]:
    """Yield episodes whose part of the video is of another length, or overlaps another's."""
    fps = float(info["fps"])
    seconds = column(episodes, "length") / fps
    for key in camera_keys(info, "video"):
        start = column(episodes, f"videos/{key}/from_timestamp")
        end = column(episodes, f"videos/{key}/to_timestamp")
        wrong = np.flatnonzero(np.abs(end - start - seconds) > FRAME_SLACK / fps)
        for k in wrong:
            yield Problem(
                check="video_times",
                where=f"episode {k}",
                detail=f"{key}: {end[k] - start[k]:.3f} s of video for {seconds[k]:.3f} s of rows",
            )
        files = np.stack(
            [column(episodes, f"videos/{key}/{p}_index") for p in ("chunk", "file")], axis=1
        )
        order = np.lexsort((start, files[:, 1], files[:, 0]))
        for a, b in itertools.pairwise(order):
            if (files[a] == files[b]).all() and start[b] < end[a] - FRAME_SLACK / fps:
                yield Problem(
                    check="video_times",
                    where=f"episode {b}",
                    detail=f"{key}: begins in the video before episode {a} ends there",
                )


def _video_sizes(root: Path, info: dict[str, Any]) -> Iterator[Problem]:
    """Yield videos of other pictures than the dataset says; what no player opens is left to LeRobot."""
    from lerobot.datasets.video_utils import av  # LeRobot's module is this room's door to video

    for key in camera_keys(info, "video"):
        shape = tuple(info["features"][key]["shape"])
        for path in sorted(root.glob(f"videos/{key}/*/*.mp4")):
            size = shape[:2]
            with suppress(av.FFmpegError, LookupError, ValueError), av.open(str(path)) as video:
                size = video.streams.video[0].height, video.streams.video[0].width
            if size not in (shape[:2], shape[1:]):
                yield Problem(
                    check="video_size",
                    where=_name(root, path),
                    detail=f"has pictures of {size[1]} x {size[0]} px, {INFO_FILE} names {shape}",
                )


def _words(error: Exception) -> str:
    return f"{type(error).__name__}: {' '.join(str(error).split())[:150]}"


def _name(root: Path, path: Path) -> str:
    return str(path.relative_to(root))

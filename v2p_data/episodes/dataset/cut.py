"""Episodes are taken out of a dataset without touching a pixel of the others.

LeRobot's own `delete_episodes` encodes a video file anew wherever it holds kept and dropped episodes; of
lossy video that alters every picture, and after a merge of unlike encoders it takes LeRobot's defaults. Each
episode was encoded by itself, so its packets can be copied as they are.
"""

import json
import logging
import shutil
from collections.abc import Sequence
from fractions import Fraction
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq

from v2p_data.episodes.dataset.episode_stats import rows_stats
from v2p_data.episodes.dataset.tables import (
    DATA_PATH,
    INFO_FILE,
    STATS_FILE,
    TASKS_FILE,
    VIDEO_PATH,
    camera_keys,
    column,
    data_path,
    episodes_of,
    read_info,
    row_spans,
    tasks_of,
    video_path,
)

logger = logging.getLogger(__name__)

EPISODES_FILE = "meta/episodes/chunk-000/file-000.parquet"
SHIFTED = ("min", "max", "mean", "q01", "q10", "q50", "q90", "q99")


def write_without(root: Path, kept: Sequence[int], out: Path) -> list[str]:
    """Write the episodes `kept` of the dataset at `root` as a dataset at `out`, renumbered from 0.

    Returns:
        A sentence per video file that could not be cut and was copied whole.
    """
    info = read_info(root)
    (out / "meta").mkdir(parents=True)
    source = episodes_of(root, with_stats=True)
    order = pa.array(list(kept))
    episodes = source.take(order)
    tasks, numbers = _kept_tasks(root, episodes)
    columns, rows = _write_data(root, info, episodes, numbers, out)
    notes: list[str] = []
    for key in camera_keys(info, "video"):
        more, said = _write_videos(root, info, key, source, episodes, out)
        columns |= more
        notes += said
    columns |= _shifted_stats(episodes, columns, rows)
    write_episodes(out, replaced(episodes, columns))
    pq.write_table(tasks, out / TASKS_FILE)
    info |= {
        "total_episodes": len(episodes),
        "total_frames": int(column(episodes, "length").sum()),
        "total_tasks": len(tasks),
        "splits": {"train": f"0:{len(episodes)}"},
        "data_path": DATA_PATH,
        "video_path": VIDEO_PATH if camera_keys(info, "video") else None,
    }
    (out / INFO_FILE).write_text(json.dumps(info, indent=4, ensure_ascii=False))
    write_stats(out)
    return notes


def write_episodes(out: Path, episodes: pa.Table) -> None:
    """Write the episode table as one file that says of itself where it is."""
    here = {f"meta/episodes/{part}_index": [0] * len(episodes) for part in ("chunk", "file")}
    path = out / EPISODES_FILE
    for stale in sorted(out.glob("meta/episodes/*/*.parquet")):
        stale.unlink()
    path.parent.mkdir(parents=True, exist_ok=True)
    pq.write_table(replaced(episodes, here), path)


def write_stats(out: Path) -> None:
    """Write `meta/stats.json`: of numbers from all rows, of pictures LeRobot's sum over the episodes.

    LeRobot looks at a sample of an episode's pictures. Their mean and deviation add up; their quantiles are averages.
    """
    from lerobot.datasets.compute_stats import aggregate_stats

    info = read_info(out)
    episodes = episodes_of(out, with_stats=True)
    cameras = camera_keys(info)
    names = [n for n in episodes.column_names if n.startswith(tuple(f"stats/{c}/" for c in cameras))]  # fmt: skip
    per_episode: list[dict[str, dict[str, np.ndarray]]] = [{} for _ in range(len(episodes))]
    for name in names:
        feature, stat = name.removeprefix("stats/").rsplit("/", 1)
        for k, value in enumerate(episodes.column(name).to_pylist()):
            per_episode[k].setdefault(feature, {})[stat] = np.asarray(value)
    found = aggregate_stats(per_episode) | dict(rows_stats(out, info["features"]))
    plain = {
        f: {s: np.asarray(v).tolist() for s, v in found[f].items()}
        for f in info["features"]
        if f in found
    }
    (out / STATS_FILE).write_text(json.dumps(plain, indent=4))


def replaced(table: pa.Table, columns: dict[str, list[Any]]) -> pa.Table:
    """Return the table with these columns' values, of the types they had."""
    for name, values in columns.items():
        if name in table.column_names:
            field = table.schema.field(name)
            table = table.set_column(
                table.column_names.index(name), field, pa.array(values, type=field.type)
            )
    return table


def _kept_tasks(root: Path, episodes: pa.Table) -> tuple[pa.Table, dict[int, int]]:
    """Return the tasks that are left, and the new number of each old one."""
    said = {task for tasks in episodes.column("tasks").to_pylist() for task in tasks}
    left = [k for k, task in enumerate(tasks_of(root)) if task in said]
    table = pq.read_table(root / TASKS_FILE).take(pa.array(left))
    numbers = {int(old): new for new, old in enumerate(column(table, "task_index"))}
    return replaced(table, {"task_index": list(range(len(table)))}), numbers


def _write_data(
    root: Path, info: dict[str, Any], episodes: pa.Table, numbers: dict[int, int], out: Path
) -> tuple[dict[str, list[Any]], list[np.ndarray]]:
    """Write the rows into files of the same numbers.

    Returns:
        The episode table's new columns, and each episode's new task numbers.
    """
    old = column(episodes, "episode_index")
    lengths = column(episodes, "length")
    starts = np.cumsum(lengths) - lengths
    files = list(zip(column(episodes, "data/chunk_index"), column(episodes, "data/file_index"), strict=True))  # fmt: skip
    rows: list[np.ndarray] = [np.zeros(0, int)] * len(episodes)
    for chunk, file in dict.fromkeys(files):
        table = pq.read_table(root / data_path(info, int(chunk), int(file)))
        spans = row_spans(column(table, "episode_index"))
        path = out / DATA_PATH.format(chunk_index=chunk, file_index=file)
        path.parent.mkdir(parents=True, exist_ok=True)
        # A row group per episode, as LeRobot writes it, so that one is read without the others.
        with pq.ParquetWriter(path, table.schema) as writer:
            for k in [k for k, where in enumerate(files) if where == (chunk, file)]:
                part = table.slice(*spans[int(old[k])])
                tasks = np.array([numbers[int(t)] for t in column(part, "task_index")])
                rows[k] = tasks
                new = {
                    "episode_index": [k] * len(part),
                    "index": list(range(int(starts[k]), int(starts[k]) + len(part))),
                    "task_index": tasks.tolist(),
                }
                writer.write_table(replaced(part, new))
    count = range(len(episodes))
    return {
        "episode_index": list(count),
        "dataset_from_index": [int(s) for s in starts],
        "dataset_to_index": [int(s + n) for s, n in zip(starts, lengths, strict=True)],
    }, rows


def _shifted_stats(
    episodes: pa.Table, new: dict[str, list[Any]], tasks: list[np.ndarray]
) -> dict[str, list[Any]]:
    """Return the statistics of the columns that were renumbered."""
    columns: dict[str, list[Any]] = {}
    moved = np.asarray(new["dataset_from_index"]) - column(episodes, "dataset_from_index")
    renumbered = np.asarray(new["episode_index"]) - column(episodes, "episode_index")
    for feature, by in (("index", moved), ("episode_index", renumbered)):
        for stat in SHIFTED:
            name = f"stats/{feature}/{stat}"
            if name in episodes.column_names:
                values = episodes.column(name).to_pylist()
                columns[name] = [_plus(v, float(d)) for v, d in zip(values, by, strict=True)]
    for stat in (*SHIFTED, "std"):
        name = f"stats/task_index/{stat}"
        if name in episodes.column_names:
            how = {"min": np.min, "max": np.max, "mean": np.mean, "std": np.std}.get(
                stat, lambda t, share=stat[1:]: np.quantile(t, float(share) / 100)
            )
            values = episodes.column(name).to_pylist()
            columns[name] = [
                _plus(v, float(how(t)), keep=0.0) for v, t in zip(values, tasks, strict=True)
            ]
    return columns


def _plus(nested: Any, by: float, keep: float = 1.0) -> Any:
    if isinstance(nested, list):
        return [_plus(v, by, keep) for v in nested]
    value = keep * nested + by
    return round(value) if isinstance(nested, int) else value


def _write_videos(
    root: Path, info: dict[str, Any], key: str, source: pa.Table, episodes: pa.Table, out: Path
) -> tuple[dict[str, list[Any]], list[str]]:
    """Write one camera's files; return the episode table's new columns, and what could not be cut."""
    fps = float(info["fps"])
    parts = ("chunk_index", "file_index")
    begin = f"videos/{key}/from_timestamp", f"videos/{key}/to_timestamp"
    starts, ends = ([float(t) for t in column(episodes, name)] for name in begin)
    lengths = column(episodes, "length")
    of = list(zip(*(column(episodes, f"videos/{key}/{p}") for p in parts), strict=True))
    all_of = list(zip(*(column(source, f"videos/{key}/{p}") for p in parts), strict=True))
    notes: list[str] = []
    for file in dict.fromkeys(of):
        old = video_path(info, key, int(file[0]), int(file[1]))
        new = out / VIDEO_PATH.format(video_key=key, chunk_index=file[0], file_index=file[1])
        new.parent.mkdir(parents=True, exist_ok=True)
        mine = sorted((k for k, where in enumerate(of) if where == file), key=lambda k: starts[k])
        spans = [(round(starts[k] * fps), round(starts[k] * fps) + int(lengths[k])) for k in mine]
        if len(mine) == all_of.count(file) or not _cut(root / old, spans, fps, new):
            shutil.copyfile(root / old, new)
            if len(mine) != all_of.count(file):
                notes.append(f"{old} holds pictures of dropped episodes still: its episodes cannot be cut apart without encoding them anew")  # fmt: skip
            continue
        done = 0
        for k, (first, last) in zip(mine, spans, strict=True):
            starts[k], ends[k] = done / fps, (done + last - first) / fps
            done += last - first
    return {begin[0]: starts, begin[1]: ends}, notes


def _cut(path: Path, spans: list[tuple[int, int]], fps: float, out: Path) -> bool:
    """Copy the packets of some spans of frames `[first, last)`, one after the other.

    Returns:
        False where a span does not begin with a key frame or its packets are mixed with others'.
    """
    from lerobot.datasets.video_utils import av  # LeRobot's module is this room's door to video

    with av.open(str(path)) as video:
        stream = video.streams.video[0]
        base = stream.time_base or Fraction(1, 90_000)
        ticks = 1 / (Fraction(fps).limit_denominator(1001) * base)
        packets = [p for p in video.demux(stream) if p.dts is not None]
        frame_of = [round((p.pts or 0) / ticks) for p in packets]
        chosen: list[tuple[Any, int]] = []
        done = 0
        for first, last in spans:
            mine = [i for i, f in enumerate(frame_of) if first <= f < last]
            whole = len(mine) == last - first and mine == list(range(mine[0], mine[0] + len(mine)))
            if not whole or not packets[mine[0]].is_keyframe or frame_of[mine[0]] != first:
                return False
            chosen += [(packets[i], round((done - first) * ticks)) for i in mine]
            done += last - first
        with av.open(str(out), "w", options={"movflags": "faststart"}) as made:
            into = made.add_stream_from_template(stream, opaque=True)
            into.time_base = base
            for packet, shift in chosen:
                packet.pts += shift
                packet.dts += shift
                packet.stream = into
                made.mux(packet)
    return True

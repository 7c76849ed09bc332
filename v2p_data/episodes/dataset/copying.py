"""Episodes of finished datasets of ours become a new dataset without a pixel encoded anew.

Each episode was encoded by itself, so its packets are copied as they are. LeRobot's own tools encode a video file anew
where it holds kept and dropped episodes, which alters the pictures of lossy video.
"""

import itertools
import json
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq

from v2p_data.episodes.dataset import encoding
from v2p_data.episodes.dataset.episode_stats import number_stats
from v2p_data.episodes.dataset.features import (
    COLUMNS,
    EPISODE_COLUMN,
    INTERVENTION_KEY,
    SUCCESS_KEY,
)
from v2p_data.episodes.dataset.layout import (
    CHUNK_FILES,
    VIDEO_FILE_MB,
    RowFiles,
    file_in,
    replaced,
    write_episodes,
    write_stats,
)
from v2p_data.episodes.dataset.tables import (
    DATA_GLOB,
    INFO_FILE,
    VIDEO_PATH,
    camera_keys,
    column,
    data_path,
    episodes_of,
    row_spans,
    video_path,
)
from v2p_data.errors import V2PError


@dataclass(frozen=True, kw_only=True)
class Part:
    """Episodes of one dataset that go into a new one."""

    root: Path
    info: dict[str, Any]
    kept: Sequence[int]
    """Their numbers there."""

    @property
    def has_actors(self) -> bool:
        """It has the column that says who acted."""
        return INTERVENTION_KEY in self.info["features"]


def write_parts(parts: Sequence[Part], entries: Sequence[dict[str, Any]], out: Path) -> None:
    """Write the episodes of all parts, in order, as a LeRobot dataset at `out`, renumbered from 0.

    Args:
        parts: datasets of ours with the same columns, less the one that says who acted.
        entries: what `meta/v2p.json` says of each episode.
        out: must not exist.

    Raises:
        V2PError: a video file was encoded anew, so that its episodes cannot be told apart.
    """
    from lerobot.datasets.io_utils import write_tasks
    from pandas import DataFrame, Index

    (out / "meta").mkdir(parents=True)
    whole = next((part for part in parts if part.has_actors), parts[0])
    tables = [_episodes(part, whole) for part in parts]
    episodes = pa.concat_tables(tables, promote_options="default")
    tasks = list(
        dict.fromkeys(task for words in episodes.column("tasks").to_pylist() for task in words)
    )
    write_tasks(DataFrame({"task_index": range(len(tasks))}, index=Index(tasks, name="task")), out)
    columns = _write_rows(parts, whole, tasks, episodes, out)
    for key in camera_keys(whole.info):
        columns |= _write_videos(parts, key, tables, out)
    entries_column = {EPISODE_COLUMN: [json.dumps(entry) for entry in entries]}
    write_episodes(out, replaced(episodes, columns | entries_column))
    info = whole.info | {
        "total_episodes": len(episodes),
        "total_frames": int(column(episodes, "length").sum()),
        "total_tasks": len(tasks),
        "splits": {"train": f"0:{len(episodes)}"},
    }
    (out / INFO_FILE).write_text(json.dumps(info, indent=4, ensure_ascii=False), encoding="utf-8")
    write_stats(out)


def _episodes(part: Part, whole: Part) -> pa.Table:
    """Return the part's rows of the table of episodes, with the columns of `whole`."""
    table = episodes_of(part.root, with_stats=True).take(pa.array(list(part.kept)))
    if part.has_actors == whole.has_actors:
        return table
    acted = {INTERVENTION_KEY: COLUMNS[INTERVENTION_KEY].feature}
    found = [
        number_stats({INTERVENTION_KEY: np.ones(int(n), bool)}, acted)
        for n in column(table, "length")
    ]
    for stat in found[0][INTERVENTION_KEY]:
        like = table.schema.field(f"stats/{SUCCESS_KEY}/{stat}")
        values = [stats[INTERVENTION_KEY][stat].tolist() for stats in found]
        table = table.append_column(
            f"stats/{INTERVENTION_KEY}/{stat}", pa.array(values, type=like.type)
        )
    return table


def _write_rows(
    parts: Sequence[Part], whole: Part, tasks: Sequence[str], episodes: pa.Table, out: Path
) -> dict[str, list[Any]]:
    """Write all rows, renumbered; return the new columns of the table of episodes."""
    names = ("episode_index", "index", "task_index")
    features = {name: whole.info["features"][name] for name in names}
    numbers = {task: k for k, task in enumerate(tasks)}
    instructions = episodes.column("tasks").to_pylist()
    files = RowFiles(out, pq.read_schema(min(whole.root.glob(DATA_GLOB))))
    columns: dict[str, list[Any]] = {}
    for k, rows in enumerate(_rows(parts)):
        count = len(rows)
        new = {
            "episode_index": np.full(count, k),
            "index": np.arange(files.rows, files.rows + count),
            "task_index": np.full(count, numbers[instructions[k][0]]),
        }
        if INTERVENTION_KEY not in rows.column_names and whole.has_actors:
            rows = rows.append_column(INTERVENTION_KEY, pa.array(np.ones(count, bool)))
        rows = replaced(rows, {name: values.tolist() for name, values in new.items()})
        place: dict[str, Any] = {"episode_index": k, **files.add(rows.select(files.schema.names))}
        for name, stats in number_stats(new, features).items():
            place |= {f"stats/{name}/{stat}": value.tolist() for stat, value in stats.items()}
        for name, value in place.items():
            columns.setdefault(name, []).append(value)
    files.close()
    return columns


def _rows(parts: Sequence[Part]) -> Iterator[pa.Table]:
    """Yield the rows of each episode; a file is read once for all episodes on end in it."""
    for part in parts:
        episodes = episodes_of(part.root)
        where = zip(*(column(episodes, f"data/{n}_index") for n in ("chunk", "file")), strict=True)
        paths = [part.root / data_path(part.info, int(chunk), int(file)) for chunk, file in where]
        last, table, spans = None, pa.table({}), {}
        for k in part.kept:
            if paths[k] != last:
                last, table = paths[k], pq.read_table(paths[k])
                spans = row_spans(column(table, "episode_index"))
            yield table.slice(*spans[k])


def _write_videos(
    parts: Sequence[Part], key: str, tables: Sequence[pa.Table], out: Path
) -> dict[str, list[Any]]:
    """Write one camera's files; return the new columns of the table of episodes."""
    columns: dict[str, list[Any]] = {}
    group: list[encoding.Encoded] = []
    number = frames = size = 0

    def write_group() -> None:
        path = out / file_in(VIDEO_PATH, number, video_key=key)
        path.parent.mkdir(parents=True, exist_ok=True)
        encoding.join(group, path)

    for stream in _streams(parts, key, tables):
        is_full = size + len(stream.mp4) > VIDEO_FILE_MB * 2**20
        # Files of unlike encoders stay apart: a decoder is set up by the first packets of a file.
        if group and (is_full or encoding.decoder_of(stream) != encoding.decoder_of(group[0])):
            write_group()
            number, frames, size, group = number + 1, 0, 0, []
        chunk, file = divmod(number, CHUNK_FILES)
        place = {"chunk_index": chunk, "file_index": file, "from_timestamp": frames / encoding.FPS}
        frames, size = frames + stream.num_frames, size + len(stream.mp4)
        for name, value in (place | {"to_timestamp": frames / encoding.FPS}).items():
            columns.setdefault(f"videos/{key}/{name}", []).append(value)
        group.append(stream)
    write_group()
    return columns


def _streams(
    parts: Sequence[Part], key: str, tables: Sequence[pa.Table]
) -> Iterator[encoding.Encoded]:
    """Yield one camera's video of each episode."""
    for part, table in zip(parts, tables, strict=True):
        names = ("chunk_index", "file_index", "from_timestamp")
        where = zip(
            *(column(table, f"videos/{key}/{n}") for n in names),
            column(table, "length"),
            strict=True,
        )
        for (chunk, file), spans in _by_file(where):
            path = part.root / video_path(part.info, key, chunk, file)
            try:
                yield from encoding.cut(path, spans)
            except ValueError as error:
                raise V2PError(
                    f"{path} {error}: another tool encoded it anew; merge and cut this dataset with that tool "
                    "(lerobot-edit-dataset)"
                ) from error


def _by_file(
    where: Iterator[tuple[Any, ...]],
) -> Iterator[tuple[tuple[int, int], list[tuple[int, int]]]]:
    """Yield each video file with the spans of frames of the episodes on end in it."""
    for file, rows in itertools.groupby(where, key=lambda row: (int(row[0]), int(row[1]))):
        firsts = [
            (round(float(start) * encoding.FPS), int(length)) for _, _, start, length in rows
        ]
        yield file, [(first, first + length) for first, length in firsts]

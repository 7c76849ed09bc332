"""The files of a dataset that is being written: rows, the table of episodes, statistics."""

import json
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq

from v2p_data.episodes.dataset.episode_stats import rows_stats
from v2p_data.episodes.dataset.tables import (
    DATA_PATH,
    STATS_FILE,
    camera_keys,
    episodes_of,
    read_info,
)

EPISODES_FILE = "meta/episodes/chunk-000/file-000.parquet"
CHUNK_FILES = 1_000
"""LeRobot's number of files in a folder."""
VIDEO_FILE_MB = 200
"""LeRobot's own limit, for us and for its tools when they add to the dataset; 400,000 frames of masks."""
DATA_FILE_FRAMES = 400_000
"""Rows per file, 40 MB; each episode is a row group of its own, as LeRobot writes it."""


@dataclass(frozen=True, kw_only=True)
class NewDataset:
    """A finished dataset."""

    root: Path
    repo_id: str
    num_episodes: int
    num_frames: int
    tasks: tuple[str, ...]


class RowFiles:
    """The files of rows, which grow by an episode at a time.

    Args:
        root: the dataset.
        schema: of the rows.
    """

    def __init__(self, root: Path, schema: pa.Schema) -> None:
        self.root, self.schema = root, schema
        self.number, self.rows, self.rows_before = -1, 0, 0
        self.writer: pq.ParquetWriter | None = None

    def add(self, table: pa.Table) -> dict[str, int]:
        """Append an episode; return where it lies, as the table of episodes says it."""
        if self.writer is None or self.rows - self.rows_before + len(table) > DATA_FILE_FRAMES:
            self.close()
            self.number, self.rows_before = self.number + 1, self.rows
            path = self.root / file_in(DATA_PATH, self.number)
            path.parent.mkdir(parents=True, exist_ok=True)
            self.writer = pq.ParquetWriter(path, self.schema)
        self.writer.write_table(table.cast(self.schema))
        first, self.rows = self.rows, self.rows + len(table)
        chunk, file = divmod(self.number, CHUNK_FILES)
        return {
            "data/chunk_index": chunk,
            "data/file_index": file,
            "dataset_from_index": first,
            "dataset_to_index": self.rows,
        }

    def close(self) -> None:
        """Finish the file in hand."""
        if self.writer is not None:
            self.writer.close()
            self.writer = None


def file_in(pattern: str, number: int, **fields: str) -> str:
    """Return where the file of this number lies, beneath the dataset."""
    chunk, file = divmod(number, CHUNK_FILES)
    return pattern.format(chunk_index=chunk, file_index=file, **fields)


def write_episodes(root: Path, episodes: pa.Table) -> None:
    """Write the table of episodes as one file that says of itself where it is."""
    here = {f"meta/episodes/{part}_index": [0] * len(episodes) for part in ("chunk", "file")}
    path = root / EPISODES_FILE
    path.parent.mkdir(parents=True, exist_ok=True)
    pq.write_table(replaced(episodes, here), path)


def replaced(table: pa.Table, columns: dict[str, list[Any]]) -> pa.Table:
    """Return the table with these columns' values, of the types they had; columns that it lacks are left out."""
    for name, values in columns.items():
        if name in table.column_names:
            field = table.schema.field(name)
            at = table.column_names.index(name)
            table = table.set_column(at, field, pa.array(values, type=field.type))
    return table


def write_stats(root: Path) -> None:
    """Write `meta/stats.json`: of numbers from all rows, of pictures LeRobot's sum over the episodes.

    LeRobot looks at a sample of an episode's pictures. Their mean and deviation add up; their quantiles are averages.
    """
    from lerobot.datasets.compute_stats import aggregate_stats

    info = read_info(root)
    episodes = episodes_of(root, with_stats=True)
    prefixes = tuple(f"stats/{camera}/" for camera in camera_keys(info))
    per_episode: list[dict[str, dict[str, np.ndarray]]] = [{} for _ in range(len(episodes))]
    for name in episodes.column_names:
        if name.startswith(prefixes):
            feature, stat = name.removeprefix("stats/").rsplit("/", 1)
            for k, value in enumerate(episodes.column(name).to_pylist()):
                per_episode[k].setdefault(feature, {})[stat] = np.asarray(value)
    found = aggregate_stats(per_episode) | dict(rows_stats(root, info["features"]))
    plain = {
        f: {s: np.asarray(v).tolist() for s, v in found[f].items()}
        for f in info["features"]
        if f in found
    }
    (root / STATS_FILE).write_text(json.dumps(plain, indent=4), encoding="utf-8")

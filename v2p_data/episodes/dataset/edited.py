"""What was done to a dataset of ours since it was made: LeRobot's own edits are told from damage.

LeRobot's tools change certain files together, and leave the numbers of every frame as they were.
"""

import hashlib
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow.parquet as pq

from v2p_data.episodes.dataset.about import read_about
from v2p_data.episodes.dataset.episode_stats import rows_stats
from v2p_data.episodes.dataset.features import actions_in
from v2p_data.episodes.dataset.intake import INFO_FILE, STATS_FILE, demand_bounded
from v2p_data.episodes.dataset.tables import (
    BOOKKEEPING,
    DATA_GLOB,
    READING_ERRORS,
    TASKS_FILE,
    column,
    episodes_of,
    layout_problems,
    read_info,
    row_spans,
    tasks_of,
)
from v2p_data.errors import V2PError
from v2p_data.json_files import json_or_none
from v2p_data.pipeline.artifact import read_record
from v2p_data.pipeline.contents import Damage, damages, demand_no

DATA, EPISODES, VIDEOS = "data", "meta/episodes", "videos"
RENAMED = {TASKS_FILE, DATA, EPISODES}
"""What `modify_tasks` writes anew, all of it."""
STATS_NEAR = 1e-3
"""LeRobot sums in 32 bits."""


@dataclass(frozen=True, kw_only=True)
class Changed:
    """Files that are not as the record of a dataset of ours lists them."""

    edited: tuple[str, ...] = ()
    """Kinds of files that LeRobot's tools changed."""
    damaged: tuple[Damage, ...] = ()


def changed_files(root: Path, memory: Path | None = None) -> Changed:
    """Return what changed in a dataset since it was made; others have no record.

    Args:
        root: a dataset that `demand_bounded` let pass.
        memory: file that remembers what was compared, see `contents.damages`.

    Raises:
        UnusableError: the record is damaged.
    """
    record = read_record(root)
    found = damages(root, (record.files if record else None) or {}, memory=memory)
    kinds = {_kind(d.path.relative_to(root)) for d in found}
    explained: set[str] = RENAMED | {INFO_FILE} if kinds >= RENAMED else set()
    if {INFO_FILE, VIDEOS} <= kinds:  # `reencode_dataset`
        explained |= {INFO_FILE, VIDEOS}
    explained |= {STATS_FILE}  # `recompute_stats`
    try:
        is_edit = (
            kinds <= explained and all(d.path.is_file() for d in found) and _is_sound(root, kinds)
        )
    except READING_ERRORS:
        is_edit = False
    return Changed(edited=tuple(sorted(kinds))) if is_edit else Changed(damaged=tuple(found))


def demand_sound(root: Path, memory: Path | None = None) -> Changed:
    """Return what changed in a dataset; raise if it cannot be read, or LeRobot's tools do not change it like this.

    Raises:
        V2PError: says what is wrong where, and what to do.
    """
    try:
        read_info(root)
    except V2PError:
        demand_no(list(changed_files(root, memory).damaged), root)
        raise
    demand_bounded(root)
    changed = changed_files(root, memory)
    demand_no(list(changed.damaged), root)
    read_about(root)
    return changed


def is_like_ours(root: Path) -> bool:
    """Return whether a dataset has the actions of ours: LeRobot's tools keep the columns and their names."""
    return actions_in(read_info(root)) is not None


def number_digests(root: Path, info: dict[str, Any], count: int) -> list[str]:
    """Return a digest of each episode's numbers; empty where there are none to tell episodes apart by."""
    keys = [
        k for k, f in info["features"].items() if f["dtype"].startswith("float") and k not in BOOKKEEPING
    ]  # fmt: skip
    found = [hashlib.sha256() for _ in range(count)]
    for path in sorted(root.glob(DATA_GLOB)) if keys else []:
        table = pq.read_table(path, columns=[*keys, "episode_index"])
        spans = row_spans(column(table, "episode_index"))
        for key in keys:
            values = np.asarray(table.column(key).to_pylist(), np.float64)
            for number, (first, count) in spans.items():
                found[number].update(values[first : first + count].tobytes())
    return [d.hexdigest() if keys else "" for d in found]


def number_digest(columns: Sequence[np.ndarray]) -> str:
    """Return the digest of an episode's columns of fractions, in the order of the features."""
    digest = hashlib.sha256()
    for values in columns:
        digest.update(np.asarray(values, np.float64).tobytes())
    return digest.hexdigest()


def _kind(path: Path) -> str:
    kind = "/".join(path.parts[:2]) if path.parts[0] == "meta" else path.parts[0]
    return kind if kind in (DATA, EPISODES, VIDEOS) else path.as_posix()


def _is_sound(root: Path, kinds: set[str]) -> bool:
    """Return whether the tables agree with each other, and the numbers with what was noted of them."""
    info = read_info(root)
    if not kinds or layout_problems(root, info):
        return False
    episodes, about = episodes_of(root), read_about(root)
    said = {task for tasks in episodes.column("tasks").to_pylist() for task in tasks}
    noted = [e.get("numbers") for e in (about or {}).get("episodes", ())]
    if DATA in kinds and all(noted) and noted != number_digests(root, info, len(episodes)):
        return False
    return said == set(tasks_of(root)) and (STATS_FILE not in kinds or _are_near(root, info))


def _are_near(root: Path, info: dict[str, Any]) -> bool:
    """Return whether `meta/stats.json` tells of the data, quantiles aside: LeRobot averages these."""
    said = json_or_none(root / STATS_FILE) or {}
    for key, true in rows_stats(root, info["features"]):
        scale = STATS_NEAR * (1 + np.abs([true["min"], true["max"]]).max())
        for name in ("min", "max", "mean", "std"):
            value = np.asarray(said.get(key, {}).get(name, np.nan), np.float64).reshape(-1)
            if key not in BOOKKEEPING and not np.allclose(value, true[name].reshape(-1), 0, scale):
                return False
    return True

"""Who acted in which frame: what `meta/v2p.json` tells of it, and the column for datasets that were made without.

In a handover a student acts and the expert takes over. In a demonstration the expert acts throughout, so there
the column `intervention` is true throughout: false means to LeRobot that a policy acted.
"""

import json
import shutil
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq

from v2p_data.episodes.dataset.cut import write_stats
from v2p_data.episodes.dataset.episode_stats import number_stats
from v2p_data.episodes.dataset.features import (
    DEMONSTRATION,
    HANDOVER,
    INTERVENTION_FEATURE,
    INTERVENTION_KEY,
    SUCCESS_KEY,
)
from v2p_data.episodes.dataset.tables import (
    DATA_GLOB,
    EPISODES_GLOB,
    INFO_FILE,
    TASKS_FILE,
    column,
)


@dataclass(frozen=True, kw_only=True)
class Acted:
    """How much of some episodes the expert and students acted."""

    num_demonstrations: int
    num_handovers: int
    demonstration_frames: int
    taken_over_frames: int
    """Of handovers, in which the expert acted."""
    student_frames: int


def who_acted(episodes: Sequence[dict[str, Any]]) -> Acted:
    """Return it for entries of `meta/v2p.json`; those that say nothing of it are demonstrations."""
    handovers = [e for e in episodes if e.get("source") == HANDOVER]
    student = sum(int(e["student_frames"]) for e in handovers)
    frames = sum(int(e["length"]) for e in handovers)
    return Acted(
        num_demonstrations=len(episodes) - len(handovers),
        num_handovers=len(handovers),
        demonstration_frames=sum(int(e["length"]) for e in episodes) - frames,
        taken_over_frames=frames - student,
        student_frames=student,
    )


def info_with_column(info: dict[str, Any]) -> dict[str, Any]:
    """Return `meta/info.json` of a dataset of demonstrations as it is with the column."""
    features: dict[str, Any] = {}
    for key, feature in info["features"].items():
        features[key] = feature
        if key == SUCCESS_KEY:
            features[INTERVENTION_KEY] = json.loads(json.dumps(INTERVENTION_FEATURE))
    return info | {"features": features}


def about_with_sources(about: dict[str, Any]) -> dict[str, Any]:
    """Return `meta/v2p.json` of a dataset of demonstrations as it is with the column."""
    told = {"source": DEMONSTRATION, "student_frames": 0}
    return about | {"episodes": [e | told for e in about["episodes"]]}


def write_with_column(root: Path, info: dict[str, Any], out: Path) -> None:
    """Write the tables of the demonstrations at `root` with the column at `out`; videos are linked to.

    Args:
        root: a dataset of ours without the column.
        info: what `info_with_column` returned for it.
        out: must not exist; holds what LeRobot merges, and nothing of ours.
    """
    from lerobot.datasets.feature_utils import get_hf_features_from_features

    # LeRobot knows single numbers by the shape (1,), which JSON has as a list.
    features = {k: f | {"shape": tuple(f["shape"])} for k, f in info["features"].items()}
    schema: pa.Schema = get_hf_features_from_features(features).arrow_schema
    for path in sorted(root.glob(DATA_GLOB)):
        table = pq.read_table(path)
        acted = pa.array(np.ones(len(table), bool))
        table = table.append_column(INTERVENTION_KEY, acted).select(schema.names).cast(schema)
        target = _made(out / path.relative_to(root))
        with pq.ParquetWriter(target, schema) as writer:  # a row group per episode
            ends = np.flatnonzero(np.diff(column(table, "episode_index"))) + 1
            for first, last in zip([0, *ends], [*ends, len(table)], strict=True):
                writer.write_table(table.slice(first, last - first))
    for path in sorted(root.glob(EPISODES_GLOB)):
        pq.write_table(_episodes(pq.read_table(path)), _made(out / path.relative_to(root)))
    shutil.copyfile(root / TASKS_FILE, out / TASKS_FILE)
    (out / INFO_FILE).write_text(json.dumps(info, indent=4, ensure_ascii=False))
    write_stats(out)
    (out / "videos").symlink_to((root / "videos").resolve())


def _episodes(table: pa.Table) -> pa.Table:
    """Return the episode table with the column's statistics, of the types of the other column of truths."""
    features = {INTERVENTION_KEY: INTERVENTION_FEATURE}
    found = [
        number_stats({INTERVENTION_KEY: np.ones(int(n), bool)}, features)[INTERVENTION_KEY]
        for n in column(table, "length")
    ]
    for stat in found[0]:
        like = table.schema.field(f"stats/{SUCCESS_KEY}/{stat}")
        values = pa.array([f[stat].tolist() for f in found], type=like.type)
        table = table.append_column(f"stats/{INTERVENTION_KEY}/{stat}", values)
    return table


def _made(path: Path) -> Path:
    path.parent.mkdir(parents=True, exist_ok=True)
    return path

"""`meta/v2p.json` of a dataset, read with suspicion: what this engine says of each episode and of how it was made."""

import json
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

import pyarrow as pa
import pyarrow.parquet as pq

from v2p_data.episodes.dataset.features import (
    ACTION_KEY,
    EPISODE_COLUMN,
    METADATA_FILE,
    METADATA_SCHEMA,
    STATE_KEY,
)
from v2p_data.episodes.dataset.intake import MAX_JSON_BYTES
from v2p_data.episodes.dataset.tables import (
    EPISODES_GLOB,
    READING_ERRORS,
    Found,
    episodes_of,
    read_info,
)
from v2p_data.errors import V2PError
from v2p_data.json_files import json_or_none
from v2p_data.sim.render.masks import PALETTE

CARRIED_TASKS = Path("v2p/tasks")
"""Of a dataset: the tasks that its episodes were made in, a folder each."""
TASK_PARTS = ("task.json", "task.py", "scene/scene.json")
_KINDS: dict[str, type] = {
    "repo_id": str, "palette": dict, "episodes": list, "provenance": dict,
}  # fmt: skip
_KINDS_OF_ENTRY: dict[str, type] = {
    "id": str, "item": str, "task": str, "seed": int, "length": int, "labels": dict, "params": dict,
}  # fmt: skip


def read_about(root: Path) -> dict[str, Any] | None:
    """Return a dataset's `meta/v2p.json`, or what the table of episodes holds of it, None where there is neither.

    Raises:
        V2PError: it is damaged, or a newer version wrote it.
    """
    path = root / METADATA_FILE
    if not path.exists(follow_symlinks=False):
        about = _from_table(root)
        if about is None:
            return None
    else:
        about = json_or_none(path, max_bytes=MAX_JSON_BYTES[METADATA_FILE])
    if not isinstance(about, dict):
        raise V2PError(f"{path} is damaged: it is no JSON object; {_remedy(root)}")
    schema = about.get("schema", METADATA_SCHEMA)
    if isinstance(schema, int) and schema > METADATA_SCHEMA:
        raise V2PError(
            f"{path} was written by a newer version of v2p (schema {schema}, this one reads up to {METADATA_SCHEMA}); "
            "use that version"
        )
    wrong = _wrong(about, _KINDS)
    if wrong is None:
        for k, entry in enumerate(about["episodes"]):
            wrong = _wrong(entry, _KINDS_OF_ENTRY) or _no_label(entry["labels"])
            if wrong is not None:
                wrong = f"{wrong} of episode {k}"
                break
    if wrong is not None:
        raise V2PError(
            f"{path} is damaged: {wrong} is missing or of another kind; {_remedy(root)}"
        )
    return about


def as_in_table(about: dict[str, Any], episodes: pa.Table) -> dict[str, Any]:
    """Return `about` with the instructions and lengths of the table of episodes, which LeRobot's tools change."""
    told = zip(
        about["episodes"],
        episodes.column("tasks").to_pylist(),
        episodes.column("length").to_pylist(),
        strict=True,
    )
    return about | {
        "episodes": [e | {"task": "; ".join(tasks), "length": n} for e, tasks, n in told]
    }


def _from_table(root: Path) -> dict[str, Any] | None:
    """Return what the table of episodes tells, None where it has no such column or not of every episode."""
    files = sorted(root.glob(EPISODES_GLOB))
    try:
        if not files or any(EPISODE_COLUMN not in pq.read_schema(path).names for path in files):
            return None
        episodes, names = episodes_of(root), read_info(root)["features"]
        entries = [
            json.loads(text) for text in episodes.column(EPISODE_COLUMN).to_pylist() if text
        ]
    except READING_ERRORS:
        return None
    if len(entries) != len(episodes) or not all(isinstance(e, dict) for e in entries):
        return None
    return as_in_table(
        {
            "schema": METADATA_SCHEMA,
            "repo_id": f"local/{root.resolve().name}",
            "palette": {str(label): grey for label, grey in enumerate(PALETTE)},
            "state": names.get(STATE_KEY, {}).get("names"),
            "action": names.get(ACTION_KEY, {}).get("names"),
            "episodes": entries,
            "provenance": {},
        },
        episodes,
    )


def about_problems(
    root: Path, about: Mapping[str, Any], tasks: Sequence[Sequence[str]], lengths: Sequence[int]
) -> Iterator[Found]:
    """Yield where `meta/v2p.json` contradicts the episode table or itself, and tasks that should be there.

    Args:
        root: the dataset.
        about: what `read_about` returned.
        tasks: instructions per episode, from the table.
        lengths: frames per episode, from the table.
    """
    entries = about["episodes"]
    if len(entries) != len(lengths):
        yield Found(
            check="about", where=METADATA_FILE,
            detail=f"tells of {len(entries)} episodes, the episode table of {len(lengths)}",
        )  # fmt: skip
    for k, (entry, words, length) in enumerate(zip(entries, tasks, lengths, strict=False)):
        if (entry["length"], [entry["task"]]) != (length, list(words)):
            yield Found(
                check="about", where=f"episode {k}",
                detail=f"{METADATA_FILE} says {entry['length']} frames of '{entry['task']}', the episode table {length} "
                f"of '{'; '.join(words)}'",
            )  # fmt: skip
        unknown = [label for label in entry["labels"] if label not in about["palette"]]
        if unknown:
            yield Found(
                check="about", where=f"episode {k}",
                detail=f"{METADATA_FILE} gives no grey for label {', '.join(unknown)}",
            )  # fmt: skip
    if len({e["id"] for e in entries}) != len(entries):
        yield Found(check="about", where=METADATA_FILE, detail="names an episode twice")
    if about["provenance"].get("items") or (root / CARRIED_TASKS).is_dir():
        for item in dict.fromkeys(e["item"] for e in entries):
            for part in TASK_PARTS:
                if not (root / CARRIED_TASKS / item / part).is_file():
                    yield Found(
                        check="missing_file", where=str(CARRIED_TASKS / item / part),
                        detail=f"is missing, and episodes were made in task '{item}'",
                    )  # fmt: skip


def _wrong(data: Any, kinds: Mapping[str, type]) -> str | None:
    """Return the first key that is missing or of another kind, None where all is well."""
    if not isinstance(data, dict):
        return "an object"
    for key, kind in kinds.items():
        value = data.get(key)
        if not isinstance(value, kind) or isinstance(value, bool):
            return f"'{key}'"
    return None


def _no_label(labels: dict[str, Any]) -> str | None:
    """Return the first key of `labels` that is none, None where all are: masks hold bytes."""
    return next((f"label {k[:20]!r}" for k in labels if not (k.isdecimal() and len(k) < 4)), None)


def _remedy(root: Path) -> str:
    return f"delete {root} and make the dataset again, or copy it anew"

"""`meta/v2p.json` of a dataset, read with suspicion: what this engine says of each episode and of how it was made."""

from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

from v2p_data.episodes.dataset.features import METADATA_FILE, METADATA_SCHEMA
from v2p_data.episodes.dataset.intake import MAX_JSON_BYTES, demand_bounded
from v2p_data.episodes.dataset.tables import Problem
from v2p_data.errors import UnusableError, V2PError
from v2p_data.json_files import json_or_none
from v2p_data.pipeline.artifact import read_record
from v2p_data.pipeline.contents import Damage, damages, demand_no
from v2p_data.scene.files import is_plain_path

CARRIED_TASKS = Path("v2p/tasks")
"""Of a dataset: the tasks that its episodes were made in, a folder each."""
TASK_PARTS = ("task.json", "task.py", "scene/scene.json")
_KINDS: dict[str, type] = {
    "repo_id": str,
    "palette": dict,
    "episodes": list,
    "provenance": dict,
}
_KINDS_OF_ENTRY: dict[str, type] = {
    "id": str,
    "item": str,
    "task": str,
    "seed": int,
    "length": int,
    "labels": dict,
    "params": dict,
}


def read_about(root: Path) -> dict[str, Any] | None:
    """Return a dataset's `meta/v2p.json`, None where there is none.

    Raises:
        V2PError: it is damaged, or a newer version wrote it.
    """
    path = root / METADATA_FILE
    if not path.exists(follow_symlinks=False):
        return None
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
            if wrong is None and not (is_plain_path(entry["item"]) and "/" not in entry["item"]):
                wrong = "'item', the plain name of a folder,"
            if wrong is not None:
                wrong = f"{wrong} of episode {k}"
                break
    if wrong is not None:
        raise V2PError(
            f"{path} is damaged: {wrong} is missing or of another kind; {_remedy(root)}"
        )
    return about


def demand_ours(root: Path, memory: Path | None = None) -> dict[str, Any]:
    """Return `meta/v2p.json` of a dataset of ours that can be read in bounded memory.

    Args:
        root: folder of the dataset.
        memory: file that remembers which files were compared, see `contents.damages`.

    Raises:
        V2PError: it is another tool's, cannot be read, or is not as it was made.
    """
    try:
        demand_bounded(root)
    except V2PError:
        _demand_unchanged(root, memory)  # which says more where there is a record
        raise
    _demand_unchanged(root, memory)
    return demand_about(root)


def _demand_unchanged(root: Path, memory: Path | None) -> None:
    try:
        demand_no(changed_files(root, memory), root)
    except UnusableError as error:
        raise V2PError(
            f"{error}; where another tool changed it on purpose, go on with that tool "
            "(lerobot-edit-dataset, lerobot-train)"
        ) from error


def demand_about(root: Path) -> dict[str, Any]:
    """Return `meta/v2p.json` of a dataset.

    Raises:
        V2PError: there is none, it is damaged, or a newer version wrote it.
    """
    about = read_about(root)
    if about is None:
        raise V2PError(
            f"{root / METADATA_FILE} is missing, so v2p did not make this dataset, or another tool changed it; "
            "lerobot-edit-dataset merges and cuts any LeRobot dataset, lerobot-dataset-viz shows it"
        )
    return about


def changed_files(root: Path, memory: Path | None = None) -> list[Damage]:
    """Return the files of a dataset that are not as its record lists them; a dataset without a record has none.

    Raises:
        UnusableError: the record is damaged.
    """
    record = read_record(root)
    return damages(root, (record.files if record else None) or {}, memory=memory)


def about_problems(
    root: Path, about: Mapping[str, Any], tasks: Sequence[Sequence[str]], lengths: Sequence[int]
) -> Iterator[Problem]:
    """Yield where `meta/v2p.json` contradicts the episode table or itself, and tasks that should be there.

    Args:
        root: the dataset.
        about: what `read_about` returned.
        tasks: instructions per episode, from the table.
        lengths: frames per episode, from the table.
    """
    entries = about["episodes"]
    if len(entries) != len(lengths):
        yield Problem(
            check="about",
            where=METADATA_FILE,
            detail=f"tells of {len(entries)} episodes, the episode table of {len(lengths)}",
        )
    for k, (entry, words, length) in enumerate(zip(entries, tasks, lengths, strict=False)):
        if (entry["length"], [entry["task"]]) != (length, list(words)):
            yield Problem(
                check="about",
                where=f"episode {k}",
                detail=f"{METADATA_FILE} says {entry['length']} frames of '{entry['task']}', the "
                f"episode table {length} "
                f"of '{'; '.join(words)}'",
            )
        unknown = [label for label in entry["labels"] if label not in about["palette"]]
        if unknown:
            yield Problem(
                check="about",
                where=f"episode {k}",
                detail=f"{METADATA_FILE} gives no grey for label {', '.join(unknown)}",
            )
    if len({e["id"] for e in entries}) != len(entries):
        yield Problem(check="about", where=METADATA_FILE, detail="names an episode twice")
    if about["provenance"].get("items") or (root / CARRIED_TASKS).is_dir():
        for item in dict.fromkeys(e["item"] for e in entries):
            for part in TASK_PARTS:
                if not (root / CARRIED_TASKS / item / part).is_file():
                    yield Problem(
                        check="missing_file",
                        where=str(CARRIED_TASKS / item / part),
                        detail=f"is missing, and episodes were made in task '{item}'",
                    )


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

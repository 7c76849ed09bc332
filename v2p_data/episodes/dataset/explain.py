"""Where a dataset, one of its episodes, or any result of a run comes from, in words; and what sets two apart.

A dataset says it in `meta/v2p.json` (per task the recipes and counts of every stage, per episode what was drawn)
and in the tasks that it carries; a result of a run in its `record.json`.
"""

import hashlib
from collections import Counter
from collections.abc import Iterator
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

from v2p_data.episodes.dataset.about import CARRIED_TASKS, read_about
from v2p_data.episodes.dataset.features import METADATA_FILE
from v2p_data.episodes.dataset.handovers import who_acted
from v2p_data.episodes.dataset.intake import demand_bounded
from v2p_data.episodes.dataset.tables import (
    INFO_FILE,
    READING_ERRORS,
    damage_told,
    episodes_of,
    read_info,
)
from v2p_data.errors import V2PError
from v2p_data.json_files import json_or_none
from v2p_data.pipeline.artifact import RECORD_FILE, read_record
from v2p_data.pipeline.contents import damaged

STAGES = ("scene", "task", "reward", "expert", "episodes")
ABSENT = "(absent)"
LONGEST = 100
UNTOLD = ("time", "machine", "argv", "seconds")
"""Differences in these are no differences in what was made."""


@dataclass(frozen=True, kw_only=True)
class Difference:
    """One field that differs."""

    field: str
    first: Any
    second: Any


def explain(path: Path, episode: int | None = None) -> list[str]:
    """Return how a dataset, one of its episodes, or a result of a run came about, a line each.

    Raises:
        V2PError: there is neither at `path`, or no such episode.
    """
    if (path / INFO_FILE).is_file():
        read_info(path)
        demand_bounded(path)
        with damage_told(path):
            return _episode(path, episode) if episode is not None else _dataset(path)
    if read_record(path) is None:
        raise V2PError(
            f"{path} is neither a LeRobot dataset ({INFO_FILE}) nor a result of a run ({RECORD_FILE})"
        )
    if episode is not None:
        raise V2PError(f"{path} is no dataset, so it has no episode {episode}")
    try:
        return _record(path)
    except READING_ERRORS as error:
        raise damaged(path, f"{path / RECORD_FILE} holds no record of ours") from error


def differences(first: Path, second: Path) -> list[Difference]:
    """Return the fields in which two datasets, or two results of a run, differ.

    Raises:
        V2PError: one of them is neither, or they are of different kinds.
    """
    with damage_told(first):
        a = _told(first)
    with damage_told(second):
        b = _told(second)
    if ("recipe" in a) != ("recipe" in b):
        raise V2PError(
            f"{first} and {second} are of different kinds: one is a dataset, one a result of a run"
        )
    one, two = dict(_flat(a)), dict(_flat(b))
    return [
        Difference(field=key, first=one.get(key, ABSENT), second=two.get(key, ABSENT))
        for key in dict.fromkeys([*one, *two])
        if one.get(key, ABSENT) != two.get(key, ABSENT)
    ]


def told_as_json(path: Path, episode: int | None = None) -> dict[str, Any]:
    """Return what `explain` tells as data."""
    with damage_told(path):
        return _told(path) if episode is None else _entry(path, episode)


def _dataset(root: Path) -> list[str]:
    info = read_info(root)
    about = read_about(root)
    lines = [
        f"{root.name}: LeRobot dataset, {info['total_episodes']} episodes, {info['total_frames']} frames at "
        f"{info['fps']} frames a second, robot {info.get('robot_type')}",
    ]
    if about is None:
        return [*lines, f"It holds no {METADATA_FILE}, so nothing is known of how it was made."]
    provenance: dict[str, Any] = about.get("provenance", {})
    lines += [f"repository  {about['repo_id']}", *_made_with(provenance)]
    for edit in provenance.get("edits", []):
        lines.append("edited      " + _edit(edit))
    keys = dict.fromkeys(e.get("history", e["item"]) for e in about["episodes"])
    for key in keys:
        mine = [e for e in about["episodes"] if e.get("history", e["item"]) == key]
        lines += ["", *_task(root, key, mine, provenance.get("items", {}).get(key, {}))]
    return lines


def _made_with(provenance: dict[str, Any]) -> Iterator[str]:
    if provenance.get("commit"):
        yield f"commit      {provenance['commit']}"
    if provenance.get("packages"):
        versions = ", ".join(f"{k} {v}" for k, v in sorted(provenance["packages"].items()))
        yield f"versions    Python {provenance.get('python', '?')}, {versions}"
    if provenance.get("time"):
        yield f"made        {provenance['time']} on {provenance.get('machine', '?')}"
    if provenance.get("argv"):
        yield f"command     {' '.join(map(str, provenance['argv']))}"


def _edit(edit: dict[str, Any]) -> str:
    if edit["operation"] == "merge":
        return "merged from " + ", ".join(
            f"{s['repo_id']} ({s['episodes']} episodes)" for s in edit["sources"]
        )
    return f"{edit['episodes']} episodes dropped from {edit['source']}: {'; '.join([*edit['tasks'], *map(str, edit.get('numbers', []))])}"


def _task(
    root: Path, key: str, episodes: list[dict[str, Any]], history: dict[str, Any]
) -> Iterator[str]:
    tasks = ", ".join(f"'{t}' ({n})" for t, n in Counter(e["task"] for e in episodes).items())
    item = episodes[0]["item"]
    yield f"{key}: {len(episodes)} episodes, {sum(e['length'] for e in episodes)} frames of {tasks}"
    seeds = sorted({e["seed"] for e in episodes})
    yield f"  seeds     {', '.join(map(str, seeds[:6]))}{' ...' if len(seeds) > 6 else ''}"
    yield f"  labels    {', '.join(f'{k} {name}' for k, name in episodes[0]['labels'].items())}"
    acted = who_acted(episodes)
    if acted.num_handovers:
        yield (
            f"  acted     {acted.num_handovers} handovers: a student in {acted.student_frames} frames and the expert in "
            f"{acted.taken_over_frames}; the expert alone in {acted.num_demonstrations} demonstrations"
        )
    carried = root / CARRIED_TASKS / item
    scene = json_or_none(carried / "scene/scene.json") or {}
    if scene:
        objects = ", ".join(f"{o['label']} ({o['shape']})" for o in scene.get("objects", []))
        yield f"  video     {scene.get('video', '?')}: {objects}"
    if (carried / "task.py").is_file():
        code = (carried / "task.py").read_text()
        digest = hashlib.sha256(code.encode()).hexdigest()[:12]
        yield f"  task code {CARRIED_TASKS / item / 'task.py'}: {len(code.splitlines())} lines, sha256 {digest}, its reward included"
    for stage, node in _stages(history).items():
        counts = ", ".join(f"{k} {_short(v)}" for k, v in (node.get("counts") or {}).items())
        yield f"  {stage:<9} {node.get('folder', '?')}" + (f": {counts}" if counts else "")
    video = _stages(history).get("scene", {}).get("recipe", {}).get("sources", {}).get("video")
    if video:
        yield f"  video sha256 begins with {video}"
    spans: dict[str, list[float]] = {}
    for e in episodes:
        for name, value in _flat(e.get("params", {})):
            if isinstance(value, int | float) and not isinstance(value, bool):
                spans.setdefault(name, []).append(float(value))
    for name, values in sorted(spans.items()):
        yield f"  drawn     {name}: {min(values):.4g} to {max(values):.4g}"


def _stages(history: dict[str, Any]) -> dict[str, dict[str, Any]]:
    """Return the node of each stage in the tree of what a result came from."""
    found: dict[str, dict[str, Any]] = {}
    open_nodes = [history]
    while open_nodes:
        node = open_nodes.pop()
        if node.get("stage"):
            found.setdefault(node["stage"], node)
        open_nodes += [n for n in (node.get("inputs") or {}).values() if isinstance(n, dict)]
    return {stage: found[stage] for stage in (*STAGES, *found) if stage in found}


def _entry(root: Path, episode: int) -> dict[str, Any]:
    info = read_info(root)
    if not 0 <= episode < int(info["total_episodes"]):
        raise V2PError(
            f"{root} has no episode {episode}; they are numbered 0 to {int(info['total_episodes']) - 1}"
        )
    row = episodes_of(root).slice(episode, 1).to_pylist()[0]
    about = read_about(root)
    entry: dict[str, Any] = {
        "episode": episode,
        "task": "; ".join(row["tasks"]),
        "length": row["length"],
    }
    entry["rows"] = [row["dataset_from_index"], row["dataset_to_index"]]
    entry["data"] = f"chunk {row['data/chunk_index']}, file {row['data/file_index']}"
    for name in row:
        if name.startswith("videos/") and name.endswith("/from_timestamp"):
            key = name.removesuffix("/from_timestamp")
            entry[key] = (
                f"chunk {row[f'{key}/chunk_index']}, file {row[f'{key}/file_index']}, "
                f"{row[name]:.2f} s to {row[f'{key}/to_timestamp']:.2f} s"
            )
    if about is not None:
        entry |= about["episodes"][episode]
    return entry


def _episode(root: Path, episode: int) -> list[str]:
    entry = _entry(root, episode)
    about = read_about(root)
    lines = [f"{key:<24} {_short(value)}" for key, value in _flat(entry)]
    if about is not None:
        items = about.get("provenance", {}).get("items", {})
        for stage, node in _stages(items.get(entry.get("history", entry["item"]), {})).items():
            lines.append(f"{stage:<24} {node.get('folder', '?')}")
    return lines


def _record(folder: Path) -> list[str]:
    record = read_record(folder)
    assert record is not None  # looked at by the caller
    lines = [
        f"{folder.name}: stage {record.stage} of {record.item}, version {record.version}, {record.seconds:.0f} s",
        *_made_with(record.provenance),
    ]
    if record.rejected:
        lines.append(f"rejected    {record.rejected['reason']}: {record.rejected['detail']}")
    lines += [f"input       {name}: {source}" for name, source in record.inputs.items()]
    lines += [f"count       {name}: {_short(v)}" for name, v in _flat(record.counts)]
    lines += [
        f"recipe      {name}: {_short(v)}" for name, v in _flat(record.recipe.get("config", {}))
    ]
    lines += [
        f"source      {name}: {_short(v)}" for name, v in _flat(record.recipe.get("sources", {}))
    ]
    return lines


def _told(path: Path) -> dict[str, Any]:
    """Return what sets one dataset, or one result, apart from another, as one tree."""
    if (path / INFO_FILE).is_file():
        info = read_info(path)
        demand_bounded(path)
        told: dict[str, Any] = {
            "info": {
                k: v for k, v in info.items() if k not in ("splits", "data_path", "video_path")
            }
        }
        about = read_about(path)
        if about is not None:
            told |= {k: v for k, v in about.items() if k != "episodes"}
            told["episodes"] = {e["id"]: e for e in about["episodes"]}
            told["task code"] = {
                p.parent.name: hashlib.sha256(p.read_bytes()).hexdigest()[:12]
                for p in sorted((path / CARRIED_TASKS).glob("*/task.py"))
            }
        return told
    record = read_record(path)
    if record is None:
        raise V2PError(
            f"{path} is neither a LeRobot dataset ({INFO_FILE}) nor a result of a run ({RECORD_FILE})"
        )
    return asdict(record)


def _flat(value: Any, name: str = "") -> Iterator[tuple[str, Any]]:
    """Yield the leaves of JSON with their dotted names; what does not tell results apart is left out."""
    if isinstance(value, dict) and value:
        for key, inner in value.items():
            if key not in UNTOLD:
                yield from _flat(inner, f"{name}.{key}" if name else str(key))
    elif isinstance(value, list) and any(isinstance(v, dict) for v in value):
        for k, inner in enumerate(value):
            yield from _flat(inner, f"{name}[{k}]")
    else:
        yield name, value


def _short(value: Any) -> str:
    if isinstance(value, dict):
        return "{" + ", ".join(f"{k} {_short(v)}" for k, v in value.items()) + "}"
    text = f"{value:.6g}" if isinstance(value, float) else str(value)
    return text if len(text) <= LONGEST else text[: LONGEST - 3] + "..."

"""Where a dataset, one of its episodes, or a result of a run comes from, and in which fields two differ.

A dataset holds the records of everything it came from in `meta/v2p.json`; beside a result of a run they lie in the run.
"""

from collections.abc import Iterator
from pathlib import Path
from typing import Any

from v2p_data.episodes.dataset.about import demand_about
from v2p_data.episodes.dataset.intake import demand_bounded
from v2p_data.episodes.dataset.tables import INFO_FILE, damage_named, read_info
from v2p_data.errors import V2PError
from v2p_data.pipeline.artifact import RECORD_FILE, history, read_record

LONGEST = 100
CIRCUMSTANCES = ("time", "machine", "argv", "seconds")
"""Differences in these are no differences in what was made."""


def records_of(path: Path, episode: int | None = None) -> dict[str, Any]:
    """Return what is recorded of a dataset, of one of its episodes, or of a result of a run, with all it came from.

    Raises:
        V2PError: there is neither at `path`, it is damaged, or there is no such episode.
    """
    if (path / INFO_FILE).is_file():
        return _of_dataset(path, episode)
    if read_record(path) is None:
        raise V2PError(
            f"{path} is neither a LeRobot dataset ({INFO_FILE}) nor a result of a run ({RECORD_FILE})"
        )
    if episode is not None:
        raise V2PError(f"{path} is no dataset, so it has no episode {episode}")
    with damage_named(path):
        return history(path, path.resolve().parent.parent)


def _of_dataset(root: Path, episode: int | None) -> dict[str, Any]:
    info = read_info(root)
    demand_bounded(root)
    about = demand_about(root)
    entries: list[dict[str, Any]] = about["episodes"]
    if episode is None:
        counts = {"episodes": info["total_episodes"], "frames": info["total_frames"]}
        return {"info": counts, **about, "episodes": {e["id"]: e for e in entries}}
    if not 0 <= episode < len(entries):
        raise V2PError(
            f"{root} has no episode {episode}; they are numbered 0 to {len(entries) - 1}"
        )
    entry, items = entries[episode], about["provenance"].get("items", {})
    return entry | {"made in": items.get(entry.get("history", entry["item"]), {})}


def explain(records: dict[str, Any]) -> list[str]:
    """Return a tree of records in words, a line each: a result, how much is in it, and below it what it came from."""
    if "stage" in records:
        recipe = [f"  {name}: {_short(v)}" for name, v in leaves(records["recipe"])]
        return [*_tree(records), "recipe", *recipe]
    elsewhere = ("provenance.items", "episodes.", "made in")
    own = (pair for pair in leaves(records) if not pair[0].startswith(elsewhere))
    lines = [f"{name}: {_short(v)}" for name, v in own]
    nodes = records.get("provenance", {}).get("items", {}) or {"": records.get("made in", {})}
    for item, node in nodes.items():
        lines += [f"{item}:" if item else "made in:", *_tree(node, depth=1)]
    return lines


def differences(first: Path, second: Path) -> list[tuple[str, Any, Any]]:
    """Return the fields in which two datasets, or two results of a run, differ, with both values.

    None where one has none.
    """
    one, two = dict(leaves(records_of(first))), dict(leaves(records_of(second)))
    return [
        (key, one.get(key), two.get(key))
        for key in dict.fromkeys([*one, *two])
        if one.get(key) != two.get(key)
    ]


def leaves(value: Any, name: str = "") -> Iterator[tuple[str, Any]]:
    """Yield the leaves of JSON with their dotted names, without the circumstances in which something was made."""
    if isinstance(value, dict) and value:
        for key, inner in value.items():
            if key not in CIRCUMSTANCES:
                yield from leaves(inner, f"{name}.{key}" if name else str(key))
    elif isinstance(value, list) and any(isinstance(v, dict) for v in value):
        for k, inner in enumerate(value):
            yield from leaves(inner, f"{name}[{k}]")
    else:
        yield name, value


def _tree(node: dict[str, Any], depth: int = 0) -> Iterator[str]:
    counts = ", ".join(f"{k} {_short(v)}" for k, v in (node.get("counts") or {}).items())
    yield f"{'  ' * depth}{node.get('stage', '?')} {node.get('folder', '?')}: {counts}"
    for source in (node.get("inputs") or {}).values():
        yield from _tree(source, depth + 1)


def _short(value: Any) -> str:
    text = f"{value:.6g}" if isinstance(value, float) else str(value)
    return text if len(text) <= LONGEST else text[: LONGEST - 3] + "..."

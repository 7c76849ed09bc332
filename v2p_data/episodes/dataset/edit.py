"""Datasets of ours are put together, and tasks or episodes are taken out of them.

What is written is a new dataset, compared frame by frame with what it was made from and then
renamed into place. Nothing is overwritten.
"""

import shutil
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from v2p_data.episodes.dataset.about import CARRIED_TASKS, demand_ours
from v2p_data.episodes.dataset.card import write_card
from v2p_data.episodes.dataset.copying import Part, write_parts
from v2p_data.episodes.dataset.features import DEMONSTRATION, INTERVENTION_KEY, METADATA_FILE
from v2p_data.episodes.dataset.language import write_language
from v2p_data.episodes.dataset.layout import NewDataset
from v2p_data.episodes.dataset.repo_id import check_repo_id
from v2p_data.episodes.dataset.tables import demand_sound, layout_problems, read_info
from v2p_data.episodes.dataset.verify import difference_of_frames
from v2p_data.errors import V2PError, did_you_mean
from v2p_data.pipeline.artifact import write_json_atomically
from v2p_data.scene.files import copy_folder

AGREEING = ("schema", "palette", "state", "action")
"""Entries of `meta/v2p.json` that must be the same in datasets that go together."""
Progress = Callable[[float, str], None]


@dataclass(frozen=True, kw_only=True)
class _Source:
    root: Path
    info: dict[str, Any]
    about: dict[str, Any]

    @property
    def entries(self) -> list[dict[str, Any]]:
        return self.about["episodes"]

    @property
    def provenance(self) -> dict[str, Any]:
        return self.about["provenance"]


def merge(
    roots: Sequence[Path],
    repo_id: str,
    out: Path,
    *,
    language: bool = False,
    on_progress: Progress = lambda share, words: None,
) -> NewDataset:
    """Write the episodes of several datasets of ours, in this order, as one at `out`; of one as a copy.

    Where one of them has handovers, the others get the column `intervention` too, true throughout.

    Args:
        roots: folders of the datasets.
        repo_id: `user/name`.
        out: where it shall lie; must not exist.
        language: write LeRobot's language columns, too (`language.py`).
        on_progress: is called with the share that is done and a few words.

    Raises:
        V2PError: there is something at `out`, one is no sound dataset of ours, or they do not go together.
    """
    check_repo_id(repo_id)
    if not roots:
        raise V2PError("there is no dataset to merge; name one at least")
    sources = [_read(root) for root in roots]
    for other in sources[1:]:
        _demand_alike(sources[0], other)
    _demand_no_doubles(sources)
    with _in_place(out, roots) as partial:
        about = _merged_about(sources, repo_id, partial)
        parts = [Part(root=s.root, info=s.info, kept=range(len(s.entries))) for s in sources]
        return _write(parts, about, partial, out, on_progress, language=language)


def drop(
    root: Path,
    tasks: Sequence[str],
    out: Path,
    repo_id: str | None = None,
    *,
    episodes: Sequence[int] = (),
    on_progress: Progress = lambda share, words: None,
) -> NewDataset:
    """Write the dataset of ours at `root` without the episodes of some tasks, and without some by number, at `out`.

    Args:
        root: folder of the dataset.
        tasks: instructions, or items, the names of the videos they were made from.
        out: where it shall lie; must not exist.
        repo_id: `user/name`; the old one by default.
        episodes: numbers of episodes, from 0.
        on_progress: is called with the share that is done and a few words.

    Raises:
        V2PError: there is something at `out`, no sound dataset at `root`, no such task, or nothing is left.
    """
    source = _read(root)
    repo_id = repo_id or str(source.about["repo_id"])
    check_repo_id(repo_id)
    count = len(source.entries)
    if unknown := [k for k in episodes if not 0 <= k < count]:
        raise V2PError(f"{root} has no episode {unknown[0]}; they are numbered 0 to {count - 1}")
    gone = {*episodes, *(_episodes_of_tasks(source, tasks) if tasks or not episodes else ())}
    kept = [k for k in range(count) if k not in gone]
    if not kept:
        raise V2PError(f"{root} would be left without an episode; delete the folder instead")
    edit = {
        "operation": "drop",
        "source": source.about["repo_id"],
        "tasks": list(tasks),
        "numbers": sorted(set(episodes)),
        "episodes": len(gone),
    }
    with _in_place(out, [root]) as partial:
        about = _about_without(source, kept, edit, repo_id, partial)
        part = Part(root=root, info=source.info, kept=kept)
        return _write([part], about, partial, out, on_progress)


def _read(root: Path) -> _Source:
    about = demand_ours(root)
    info = read_info(root)
    demand_sound(root, info)
    if len(about["episodes"]) != info["total_episodes"]:
        raise V2PError(
            f"{root / METADATA_FILE} names {len(about['episodes'])} episodes, there are {info['total_episodes']}"
        )
    return _Source(root=root, info=info, about=about)


def _demand_alike(a: _Source, b: _Source) -> None:
    def demand_equal(what: str, one: Any, two: Any) -> None:
        if one != two:
            raise V2PError(
                f"{a.root} and {b.root} do not go together: {what} is {one} in the first and {two} in the second"
            )

    for name in ("fps", "robot_type"):
        demand_equal(name, a.info.get(name), b.info.get(name))
    one, two = (s.info["features"] for s in (a, b))
    missing = (sorted({*x} - {*y, INTERVENTION_KEY}) for x, y in ((one, two), (two, one)))
    demand_equal("the list of columns, less what both have,", *missing)
    for key in [key for key in one if key in two]:
        for part in ("names", "dtype", "shape"):
            demand_equal(f"{part} of {key}", one[key].get(part), two[key].get(part))
    for name in AGREEING:
        demand_equal(f"the {name} in {METADATA_FILE}", a.about.get(name), b.about.get(name))


def _demand_no_doubles(sources: Sequence[_Source]) -> None:
    seen: dict[str, str] = {}
    for source in sources:
        for k, entry in enumerate(source.entries):
            here, numbers = f"episode {k} of {source.root}", entry.get("numbers")
            if numbers in seen:
                raise V2PError(
                    f"{here} is {seen[numbers]} once more; merge datasets of different episodes, or drop its task first"
                )
            if numbers:
                seen[numbers] = here


def _merged_about(sources: Sequence[_Source], repo_id: str, partial: Path) -> dict[str, Any]:
    """Return `meta/v2p.json` of all together, and copy their tasks."""
    abouts = [source.about for source in sources]
    has_actors = any(INTERVENTION_KEY in s.info["features"] for s in sources)
    histories: dict[str, Any] = {}
    episodes: list[dict[str, Any]] = []
    edits: list[dict[str, Any]] = []
    facts: list[dict[str, Any]] = []
    for source in sources:
        names = _copied_tasks(source.root, partial)
        keys: dict[str, str] = {}
        for item, history in source.provenance.get("items", {}).items():
            name = _free(str(names.get(item, item)), lambda n, h=history: histories.get(n, h) == h)
            histories[name] = history
            keys[item] = name
        for entry in source.entries:
            item = names.get(entry["item"], entry["item"])
            key = keys.get(entry.get("history", entry["item"]), item)
            renamed = {k: v for k, v in entry.items() if k != "history"} | {"item": item}
            if has_actors:
                renamed.setdefault("source", DEMONSTRATION)
                renamed.setdefault("student_frames", 0)
            renamed.setdefault("from", source.about["repo_id"])
            episodes.append(renamed | ({"history": key} if key != item else {}))
        edits += source.provenance.get("edits", [])
        facts.append({k: v for k, v in source.provenance.items() if k not in ("items", "edits")})
    merged = [
        {"repo_id": s.about["repo_id"], "episodes": len(s.entries), **f}
        for s, f in zip(sources, facts, strict=True)
    ]
    common = {k: v for k, v in facts[0].items() if all(f.get(k) == v for f in facts[1:])}
    edits.append({"operation": "merge", "sources": merged})
    return {
        **{k: v for k, v in abouts[0].items() if all(a.get(k) == v for a in abouts[1:])},
        "repo_id": repo_id,
        "episodes": episodes,
        "provenance": {**common, "items": histories, "edits": edits},
    }


def _copied_tasks(root: Path, partial: Path) -> dict[str, str]:
    """Copy the tasks that a dataset carries; return the new name of each."""
    names: dict[str, str] = {}
    into = partial / CARRIED_TASKS
    for folder in sorted((root / CARRIED_TASKS).glob("*/")):

        def is_free(name: str, folder: Path = folder) -> bool:
            return not (into / name).exists() or _same_files(folder, into / name)

        name = names[folder.name] = _free(folder.name, is_free)
        if not (into / name).exists():
            copy_folder(folder, into / name)
    return names


def _free(name: str, is_free: Callable[[str], bool]) -> str:
    number, found = 2, name
    while not is_free(found):
        found = f"{name}-{number}"
        number += 1
    return found


def _same_files(a: Path, b: Path) -> bool:
    files = [
        sorted((p.relative_to(root), p.read_bytes()) for p in root.rglob("*") if p.is_file())
        for root in (a, b)
    ]
    return files[0] == files[1]


def _episodes_of_tasks(source: _Source, tasks: Sequence[str]) -> set[int]:
    """Return the numbers of the episodes that show one of `tasks`."""
    names = [{entry["task"], entry["item"]} for entry in source.entries]
    known = sorted(set().union(*names))
    if not tasks:
        raise V2PError(
            f"say which tasks to drop with --tasks, or which --episodes; there are: {'; '.join(known)}"
        )
    for task in tasks:
        if task not in known:
            raise V2PError(f"{source.root} has no task '{task}'.{did_you_mean(task, known)}")
    return {k for k, mine in enumerate(names) if mine & set(tasks)}


def _about_without(
    source: _Source, kept: Sequence[int], edit: dict[str, Any], repo_id: str, partial: Path
) -> dict[str, Any]:
    """Return `meta/v2p.json` of the episodes that are kept, and copy their tasks."""
    episodes = [source.entries[k] for k in kept]
    for item in dict.fromkeys(entry["item"] for entry in episodes):
        if (source.root / CARRIED_TASKS / item).is_dir():
            copy_folder(source.root / CARRIED_TASKS / item, partial / CARRIED_TASKS / item)
    left = {entry.get("history", entry["item"]) for entry in episodes}
    items = source.provenance.get("items", {})
    provenance = source.provenance | {
        "items": {k: v for k, v in items.items() if k in left},
        "edits": [*source.provenance.get("edits", []), edit],
    }
    return source.about | {"repo_id": repo_id, "episodes": episodes, "provenance": provenance}


@contextmanager
def _in_place(out: Path, sources: Sequence[Path]) -> Iterator[Path]:
    """Give a folder to work in that becomes `out` when `_write` renames it, and is removed otherwise."""
    for source in sources:
        if out.resolve().is_relative_to(source.resolve()):
            raise V2PError(
                f"--out {out} lies in {source}, which is to stay as it is; choose a folder outside of it"
            )
    if out.exists():
        raise V2PError(f"{out} exists already; nothing is overwritten, choose another --out")
    partial = out.with_name(out.name + ".partial")
    try:
        if partial.exists():
            shutil.rmtree(partial)  # of a run that was killed
        partial.parent.mkdir(parents=True, exist_ok=True)
        yield partial
    except OSError as error:
        raise V2PError(
            f"cannot write {out} ({error.strerror or error}): nothing is left of it, the datasets it was to be made "
            "of are as they were; make room or choose another --out"
        ) from error
    finally:
        shutil.rmtree(partial, ignore_errors=True)


def _write(
    parts: Sequence[Part],
    about: dict[str, Any],
    partial: Path,
    out: Path,
    on_progress: Progress,
    *,
    language: bool = False,
) -> NewDataset:
    """Write the dataset at `partial`, compare it with its sources and rename it to `out`."""
    on_progress(0.0, "copying")
    write_parts(parts, about["episodes"], partial)
    write_json_atomically(partial / METADATA_FILE, about)
    if language:
        on_progress(0.45, "writing the language columns")
        write_language(partial, about)
    on_progress(0.5, "comparing every frame")
    info = read_info(partial)
    problems = [f"{p.where}: {p.detail}" for p in layout_problems(partial, info)]
    wrong = (
        problems[0]
        if problems
        else difference_of_frames(partial, [(p.root, p.kept) for p in parts])
    )
    if wrong:
        raise V2PError(
            f"what was to become {out} is not what it was made of, so it is not kept: {wrong}"
        )
    write_card(partial, about["repo_id"])
    partial.rename(out)
    return NewDataset(
        root=out,
        repo_id=about["repo_id"],
        num_episodes=len(about["episodes"]),
        num_frames=int(info["total_frames"]),
        tasks=tuple(dict.fromkeys(entry["task"] for entry in about["episodes"])),
    )

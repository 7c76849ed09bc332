"""Datasets are put together, and tasks taken out of them.

What is written is a new dataset, checked and then renamed into place. Merging is LeRobot's `aggregate_datasets`, which is right where its inputs are alike. What it does not look at
is looked at here first: palettes, joint names, doubles, files of unlike encoders (whose packets it would
put into one file that no player can read), the numbers of its own metadata files. Nothing is
overwritten, and every pixel of the result is compared with where it came from.
"""

import json
import logging
import shutil
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import pyarrow as pa

from v2p_data.episodes.dataset.about import as_in_table, read_about
from v2p_data.episodes.dataset.alike import common_features, first_difference, write_retold
from v2p_data.episodes.dataset.card import write_card
from v2p_data.episodes.dataset.cut import write_episodes, write_stats, write_without
from v2p_data.episodes.dataset.edited import is_like_ours, number_digests
from v2p_data.episodes.dataset.features import (
    EPISODE_COLUMN,
    INTERVENTION_KEY,
    METADATA_FILE,
    actions_in,
)
from v2p_data.episodes.dataset.handovers import (
    about_with_sources,
    info_with_column,
    write_with_column,
)
from v2p_data.episodes.dataset.intake import demand_bounded
from v2p_data.episodes.dataset.language import write_language
from v2p_data.episodes.dataset.repo_id import check_repo_id
from v2p_data.episodes.dataset.tables import (
    DATA_PATH,
    VIDEO_PATH,
    camera_keys,
    column,
    episodes_of,
    layout_problems,
    read_info,
)
from v2p_data.episodes.dataset.verify import frames_differ
from v2p_data.errors import V2PError, did_you_mean
from v2p_data.pipeline.artifact import write_json_atomically
from v2p_data.scene.files import copy_folder, is_plain_path

logger = logging.getLogger(__name__)

TASKS_FOLDER = Path("v2p/tasks")
AGREEING = ("schema", "palette", "state", "action")
"""Entries of `meta/v2p.json` that must be the same in datasets that go together."""
Progress = Callable[[float, str], None]


@dataclass(frozen=True, kw_only=True)
class Edited:
    """A finished dataset."""

    root: Path
    repo_id: str
    num_episodes: int
    num_frames: int
    tasks: tuple[str, ...]
    notes: tuple[str, ...] = ()


@dataclass(frozen=True, kw_only=True)
class _Source:
    root: Path
    info: dict[str, Any]
    about: dict[str, Any] | None
    lengths: list[int]
    tasks_of_episodes: list[list[str]]
    digests: list[str] = field(repr=False)
    lacks_column: bool = False
    """`info` and `about` tell of a column that is to be written yet: who acted."""
    tasks_root: Path | None = None
    """Where the carried tasks lie, if not in `root`."""
    is_retold: bool = False
    """`info` says in other words than its file what the columns are."""

    @property
    def repo_id(self) -> str:
        return str((self.about or {}).get("repo_id") or f"local/{self.root.resolve().name}")


def merge(
    roots: Sequence[Path],
    repo_id: str,
    out: Path,
    *,
    original: Path | None = None,
    language: bool = False,
    on_progress: Progress = lambda share, words: None,
) -> Edited:
    """Write the episodes of several LeRobot v3 datasets, in this order, as one at `out`; of one as a copy with exact statistics.

    Where one of them has handovers, demonstrations of ours get the column `intervention` too, true throughout.

    Args:
        roots: folders of the datasets.
        repo_id: `user/name`.
        out: where it shall lie; must not exist.
        original: the dataset of ours that LeRobot's tools made some of these from; what they left out is taken from it.
        language: write LeRobot's language columns, too (`language.py`).
        on_progress: told the share that is done and a few words.

    Raises:
        V2PError: there is something at `out`, one is no sound dataset, or they do not go together.
    """
    check_repo_id(repo_id)
    if not roots:
        raise V2PError("there is no dataset to merge; name one at least")
    read = [_read(root) for root in roots]
    if original is not None:
        whole = _read(original)
        read = [_restored(source, whole) for source in read]
    sources = _all_with_column(read)
    for other in sources[1:]:
        _check_alike(sources[0], other)
    _check_doubles(sources)
    sources = _in_one_wording(sources)
    with _in_place(out, roots) as partial:
        on_progress(0.0, "starting LeRobot")
        with _tables(sources, partial) as folders:
            _aggregate(sources, folders, repo_id, partial)
        on_progress(0.4, "gathering tasks and provenance")
        about = _merged_about(sources, repo_id, partial)
        if language:
            on_progress(0.45, "writing the language columns")
            write_language(partial, about)
        return _finish(
            partial, out, repo_id, about,
            [(s.root, range(len(s.lengths))) for s in sources], on_progress,
        )  # fmt: skip


def drop(
    root: Path,
    tasks: Sequence[str],
    out: Path,
    repo_id: str | None = None,
    *,
    episodes: Sequence[int] = (),
    on_progress: Progress = lambda share, words: None,
) -> Edited:
    """Write the dataset at `root` without the episodes of some tasks, and without some by number, at `out`.

    Args:
        root: any LeRobot v3 dataset.
        tasks: instructions, or (in datasets of ours) items, the names of the videos they were made from.
        out: where it shall lie; must not exist.
        repo_id: `user/name`; the old one by default.
        episodes: numbers of episodes, from 0.
        on_progress: told the share that is done and a few words.

    Raises:
        V2PError: there is something at `out`, no sound dataset at `root`, no such task, or nothing is left.
    """
    source = _read(root)
    repo_id = repo_id or source.repo_id
    check_repo_id(repo_id)
    if unknown := [k for k in episodes if not 0 <= k < len(source.lengths)]:
        raise V2PError(
            f"{root} has no episode {unknown[0]}; they are numbered 0 to {len(source.lengths) - 1}"
        )
    gone = set(episodes)
    if tasks or not episodes:
        gone |= _episodes_of_tasks(source, tasks)
    kept = [k for k in range(len(source.lengths)) if k not in gone]
    if not kept:
        raise V2PError(f"{root} would be left without an episode; delete the folder instead")
    with _in_place(out, [root]) as partial:
        on_progress(0.0, "starting LeRobot")
        notes = write_without(root, kept, partial)
        about = _about_without(source, kept, list(tasks), sorted(set(episodes)), repo_id, partial)
        return _finish(partial, out, repo_id, about, [(root, kept)], on_progress, notes)


def _read(root: Path) -> _Source:
    info = read_info(root)
    demand_bounded(root)
    problems = layout_problems(root, info)
    if problems:
        first = problems[0]
        raise V2PError(
            f"{root} is not sound ({first.where}: {first.detail}); 'v2p verify {root}' tells everything"
        )
    episodes = episodes_of(root)
    about = read_about(root)
    lengths = [int(n) for n in column(episodes, "length")]
    if about is not None and len(about["episodes"]) != len(lengths):
        raise V2PError(
            f"{root / METADATA_FILE} tells of {len(about['episodes'])} episodes, there are {len(lengths)}"
        )
    about = about and as_in_table(about, episodes)
    for entry in about["episodes"] if about is not None else ():
        if (
            not isinstance(item := entry.get("item"), str)
            or not is_plain_path(item)
            or "/" in item
        ):
            raise V2PError(
                f"{root / METADATA_FILE} has an episode of the item {str(item)[:100]!r}; an item is the plain name of a "
                f"folder in {TASKS_FOLDER}"
            )
    return _Source(
        root=root,
        info=info,
        about=about,
        lengths=lengths,
        tasks_of_episodes=[list(t) for t in episodes.column("tasks").to_pylist()],
        digests=number_digests(root, info, len(lengths)),
    )


def _restored(source: _Source, original: _Source) -> _Source:
    """Return a source with what our own file says of its episodes in the dataset that it was made from."""
    if source.about is not None and (source.root / METADATA_FILE).is_file():
        return source
    if original.about is None:
        raise V2PError(
            f"{original.root} holds no {METADATA_FILE} itself; give the dataset that v2p made with --from"
        )
    both = {k: f for k, f in source.info["features"].items() if k in original.info["features"]}
    known, digests = (
        number_digests(s.root, {"features": both}, len(s.lengths)) for s in (original, source)
    )
    numbers = {digest: k for k, digest in enumerate(known) if digest}
    unknown = [k for k, digest in enumerate(digests) if digest not in numbers]
    if unknown:
        raise V2PError(
            f"episode {unknown[0]} of {source.root} is none of {original.root} by its states and actions "
            f"({len(unknown)} of {len(digests)} are not); give the dataset that it was made from with --from"
        )
    entries = [original.about["episodes"][numbers[digest]] for digest in digests]
    about = original.about | {"episodes": entries}
    return replace(
        source, about=as_in_table(about, episodes_of(source.root)), tasks_root=original.root
    )


def _check_alike(a: _Source, b: _Source) -> None:
    def differ(what: str, one: Any, two: Any) -> None:
        if one != two:
            raise V2PError(
                f"{a.root} and {b.root} do not go together: {what} is {one} in the first and {two} in the second"
            )

    said = [actions_in(source.info) for source in (a, b)]
    if None not in said and said[0] != said[1]:
        raise V2PError(
            f"the actions of {a.root} are '{said[0]}' and those of {b.root} '{said[1]}': a dataset has actions of one kind;"
            " collect the episodes of one of them anew with the other's --episodes.actions"
        )
    if difference := first_difference(a.info, b.info):
        differ(*difference)
    for source in (a, b):
        if (source.info.get("data_path"), source.info.get("video_path") or VIDEO_PATH) != (
            DATA_PATH,
            VIDEO_PATH,
        ):
            raise V2PError(f"{source.root} names its files otherwise than LeRobot 0.6 does")
    for source in (a, b) if (a.about is None) != (b.about is None) else ():
        if source.about is None and is_like_ours(source.root):
            raise V2PError(
                f"{source.root} has our columns, but what v2p knew of its episodes was left out by another tool; name the "
                "dataset that it was made from with --from"
            )
    differ("'made by v2p'", a.about is not None, b.about is not None)
    if a.about is not None and b.about is not None:
        for name in AGREEING:
            differ(f"the {name} in {METADATA_FILE}", a.about.get(name), b.about.get(name))


def _check_doubles(sources: list[_Source]) -> None:
    seen: dict[str, str] = {}
    for source in sources:
        for k, digest in enumerate(source.digests):
            here = f"episode {k} of {source.root}"
            if digest and digest in seen:
                raise V2PError(
                    f"{here} is {seen[digest]} once more; merge datasets of different episodes, or drop its task first"
                )
            seen[digest] = here


def _all_with_column(sources: list[_Source]) -> list[_Source]:
    """Return the sources, all with the column that says who acted, or none."""
    having = [s for s in sources if INTERVENTION_KEY in s.info["features"]]
    if not having:
        return sources
    told: list[_Source] = []
    for source in sources:
        if INTERVENTION_KEY in source.info["features"]:
            told.append(source)
        elif source.about is None or having[0].about is None:
            raise V2PError(
                f"{having[0].root} has the column {INTERVENTION_KEY} and {source.root} has not: nothing tells who acted "
                "there, so they do not go together"
            )
        else:
            told.append(
                replace(
                    source,
                    info=info_with_column(source.info),
                    about=about_with_sources(source.about),
                    lacks_column=True,
                )
            )
    return told


def _in_one_wording(sources: list[_Source]) -> list[_Source]:
    """Return the sources with one feature table: LeRobot compares notes that mean nothing, too."""
    features = common_features([source.info for source in sources])
    return [
        replace(
            source,
            info=source.info | {"features": told},
            is_retold=told != source.info["features"],
        )
        for source, told in zip(sources, features, strict=True)
    ]


@contextmanager
def _tables(sources: list[_Source], partial: Path) -> Iterator[list[Path]]:
    """Give the folders that LeRobot is to merge: the sources, or copies of their tables with the column or other words."""
    folder = partial.with_name(f"{partial.name}.tables")
    shutil.rmtree(folder, ignore_errors=True)  # of a run that was killed
    try:
        folders: list[Path] = []
        for k, source in enumerate(sources):
            is_copied = source.lacks_column or source.is_retold
            if source.lacks_column:
                write_with_column(source.root, source.info, folder / str(k))
            elif source.is_retold:
                write_retold(source.root, source.info, folder / str(k))
            folders.append(folder / str(k) if is_copied else source.root)
        yield folders
    finally:
        shutil.rmtree(folder, ignore_errors=True)


def _aggregate(sources: list[_Source], folders: list[Path], repo_id: str, partial: Path) -> None:
    from lerobot.datasets.aggregate import aggregate_datasets

    def told(name: str) -> list[int]:
        return [int(s.info[name]) for s in sources if s.info.get(name)]

    try:
        aggregate_datasets(
            repo_ids=[s.repo_id for s in sources],
            aggr_repo_id=repo_id,
            roots=folders,
            aggr_root=partial,
            data_files_size_in_mb=min(told("data_files_size_in_mb"), default=None),
            # The largest: LeRobot can stream the pictures of a camera's first file only.
            video_files_size_in_mb=max(told("video_files_size_in_mb"), default=None),
            chunk_size=min(told("chunks_size"), default=None),
            concatenate_videos=_one_encoder(sources),
        )
    except ValueError as error:
        raise V2PError(f"LeRobot cannot merge these: {error}") from error
    # LeRobot's sum is of the statistics before renumbering, and its rows name files that they are not in.
    write_episodes(partial, episodes_of(partial, with_stats=True))
    write_stats(partial)


def _one_encoder(sources: list[_Source]) -> bool:
    """Whether the packets of all files of a camera may share one file: their decoders start out alike."""
    from lerobot.datasets.video_utils import av

    for key in camera_keys(sources[0].info, "video"):
        seen: set[bytes] = set()
        for source in sources:
            for path in source.root.glob(f"videos/{key}/*/*.mp4"):
                with av.open(str(path)) as video:
                    stream = video.streams.video[0]
                    seen.add(bytes(stream.codec_context.extradata or b""))
        if len(seen) > 1:
            return False
    return True


def _merged_about(sources: list[_Source], repo_id: str, partial: Path) -> dict[str, Any] | None:
    """Return `meta/v2p.json` of all together, and copy their tasks."""
    if sources[0].about is None:
        return None
    abouts = [s.about for s in sources if s.about is not None]
    histories: dict[str, Any] = {}
    episodes: list[dict[str, Any]] = []
    edits: list[dict[str, Any]] = []
    for source, about in zip(sources, abouts, strict=True):
        provenance = about.get("provenance", {})
        names = _copied_tasks(source.tasks_root or source.root, partial)
        keys: dict[str, str] = {}
        for item, history in provenance.get("items", {}).items():
            name = _free(str(names.get(item, item)), lambda n, h=history: histories.get(n, h) == h)
            histories[name] = history
            keys[item] = name
        for entry in about["episodes"]:
            item = names.get(entry["item"], entry["item"])
            key = keys.get(entry.get("history", entry["item"]), item)
            more = {"history": key} if key != item else {}
            told = {k: v for k, v in entry.items() if k != "history"}
            episodes.append(
                told | {"item": item, "from": entry.get("from", source.repo_id)} | more
            )
        edits += provenance.get("edits", [])
    told = [{k: v for k, v in a.get("provenance", {}).items() if k not in ("items", "edits")} for a in abouts]  # fmt: skip
    merged = {"operation": "merge", "sources": [
        {"repo_id": s.repo_id, "episodes": len(s.lengths), **t} for s, t in zip(sources, told, strict=True)
    ]}  # fmt: skip
    common = {k: v for k, v in told[0].items() if all(t.get(k) == v for t in told[1:])}
    return {
        **{k: v for k, v in abouts[0].items() if all(a.get(k) == v for a in abouts[1:])},
        "repo_id": repo_id,
        "episodes": episodes,
        "provenance": {**common, "items": histories, "edits": [*edits, merged]},
    }


def _copied_tasks(root: Path, partial: Path) -> dict[str, str]:
    """Copy the tasks that a dataset carries; return the new name of each that had to be renamed or not."""
    names: dict[str, str] = {}
    for folder in sorted((root / TASKS_FOLDER).glob("*/")):
        into = partial / TASKS_FOLDER

        def is_free(name: str, folder: Path = folder, into: Path = into) -> bool:
            return not (into / name).exists() or _same_files(folder, into / name)

        name = _free(folder.name, is_free)
        names[folder.name] = name
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
    items = [e["item"] for e in source.about["episodes"]] if source.about else []
    names = [
        {*said, *items[k : k + 1]} for k, said in enumerate(source.tasks_of_episodes)
    ]  # fmt: skip
    known = sorted(set().union(*names))
    if not tasks:
        raise V2PError(
            f"say which tasks to drop with --tasks, or which --episodes; there are: {'; '.join(known)}"
        )
    for task in tasks:
        if task not in known:
            raise V2PError(f"{source.root} has no task '{task}'.{did_you_mean(task, known)}")
    return {k for k, said in enumerate(names) if said & set(tasks)}


def _about_without(
    source: _Source,
    kept: list[int],
    tasks: list[str],
    numbers: list[int],
    repo_id: str,
    partial: Path,
) -> dict[str, Any] | None:
    if source.about is None:
        return None
    episodes = [source.about["episodes"][k] for k in kept]
    for item in dict.fromkeys(e["item"] for e in episodes):
        if (source.root / TASKS_FOLDER / item).is_dir():
            copy_folder(source.root / TASKS_FOLDER / item, partial / TASKS_FOLDER / item)
    provenance = source.about.get("provenance", {})
    left = {e.get("history", e["item"]) for e in episodes}
    edit = {
        "operation": "drop",
        "source": source.repo_id,
        "tasks": tasks,
        "numbers": numbers,
        "episodes": len(source.lengths) - len(kept),
    }
    return source.about | {
        "repo_id": repo_id,
        "episodes": episodes,
        "provenance": provenance
        | {
            "items": {k: v for k, v in provenance.get("items", {}).items() if k in left},
            "edits": [*provenance.get("edits", []), edit],
        },
    }


@contextmanager
def _in_place(out: Path, sources: Sequence[Path]) -> Iterator[Path]:
    """Give a folder to work in that becomes `out` when `_finish` renames it, and is removed otherwise."""
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


def _finish(
    partial: Path,
    out: Path,
    repo_id: str,
    about: dict[str, Any] | None,
    sources: Sequence[tuple[Path, Sequence[int]]],
    on_progress: Progress,
    notes: Sequence[str] = (),
) -> Edited:
    if about is not None:
        write_json_atomically(partial / METADATA_FILE, about)
        table = episodes_of(partial, with_stats=True)
        if EPISODE_COLUMN in table.column_names:
            table = table.drop_columns(EPISODE_COLUMN)
        told = pa.array([json.dumps(entry) for entry in about["episodes"]])
        write_episodes(partial, table.append_column(EPISODE_COLUMN, told))
    on_progress(0.5, "comparing every frame")
    problems = layout_problems(partial, read_info(partial))
    said = f"{problems[0].where}: {problems[0].detail}" if problems else frames_differ(partial, sources)  # fmt: skip
    if said:
        raise V2PError(f"what was to become {out} is not what it was made of, so it is not kept: {said}")  # fmt: skip
    if about is not None:
        write_card(partial, repo_id)
    info = read_info(partial)
    tasks = dict.fromkeys(
        t for said in episodes_of(partial).column("tasks").to_pylist() for t in said
    )
    partial.rename(out)
    for note in notes:
        logger.warning("%s", note)
    return Edited(
        root=out,
        repo_id=repo_id,
        num_episodes=int(info["total_episodes"]),
        num_frames=int(info["total_frames"]),
        tasks=tuple(tasks),
        notes=tuple(notes),
    )

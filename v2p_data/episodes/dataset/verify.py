"""A dataset, reopened with LeRobot and looked at frame by frame.

The tables are read first, without LeRobot (`tables`); then every frame is read the way a training would read
it. With the staged episodes at hand each mask, state and action is compared with what was recorded. Any LeRobot
v3 dataset is welcome: what holds for all is checked, what holds for ours only is left out elsewhere, and
the report says what was left out and why.
"""

import re
from collections.abc import Callable, Iterator, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

from v2p_data.episodes.dataset.about import CARRIED_TASKS, about_problems, as_in_table, read_about
from v2p_data.episodes.dataset.edited import changed_files
from v2p_data.episodes.dataset.features import INTERVENTION_KEY, METADATA_FILE
from v2p_data.episodes.dataset.frame_checks import Checks, Said
from v2p_data.episodes.dataset.intake import demand_bounded
from v2p_data.episodes.dataset.reading import Rows, same
from v2p_data.episodes.dataset.tables import (
    STOPPING,
    Found,
    episodes_of,
    layout_problems,
    read_info,
)
from v2p_data.episodes.staging import Episode
from v2p_data.errors import UnusableError, V2PError
from v2p_data.pipeline.artifact import RECORD_FILE

Problem = Found
SHOWN_PROBLEMS = 5
RENUMBERED = ("index", "episode_index", "task_index")


@dataclass(frozen=True, kw_only=True)
class VerifyReport:
    """What was read and what is wrong with it."""

    root: Path
    num_episodes: int
    num_frames: int
    is_ours: bool
    """Written by this engine, so that its own rules apply."""
    is_compared: bool
    """Every frame was compared with what was recorded."""
    problems: tuple[Problem, ...]
    notes: tuple[Problem, ...] = ()
    """Oddities that no training suffers from."""
    skipped: tuple[str, ...] = ()
    """What was not checked, and why."""

    @property
    def is_good(self) -> bool:
        return not self.problems

    def summary(self) -> str:
        """Return one sentence."""
        read = f"{self.num_episodes} episodes, {self.num_frames} frames"
        if self.is_good:
            same = ", all equal to what was recorded" if self.is_compared else ""
            return f"{read}: no problem found{same}"
        kinds = list(_kinds(self.problems))
        shown = "; ".join(f"{where}: {p.detail}" for p, where in kinds[:SHOWN_PROBLEMS])
        more = len(kinds) - SHOWN_PROBLEMS
        return f"{read}: {len(self.problems)} problems: {shown}" + (
            f"; and {more} more kinds" if more > 0 else ""
        )

    def lines(self) -> list[str]:
        """Return it for people, a line for each kind."""
        return [
            *(f"problem  {p.check:<16} {where}: {p.detail}" for p, where in _kinds(self.problems)),
            *(f"note     {p.check:<16} {where}: {p.detail}" for p, where in _kinds(self.notes)),
            *(f"skipped  {words}" for words in self.skipped),
        ]

    def as_json(self) -> dict[str, Any]:
        """Return it for JSON."""
        return asdict(self) | {"root": str(self.root), "is_good": self.is_good}


def _kinds(found: Sequence[Found]) -> Iterator[tuple[Found, str]]:
    """Yield the first finding of each kind, and where it is; of a kind are those that differ in their numbers only."""
    kinds: dict[tuple[str, ...], list[Found]] = {}
    for one in found:
        words = (re.sub(r"\d+", "#", words) for words in (one.where, one.detail))
        kinds.setdefault((one.check, *words), []).append(one)
    for first, *more in kinds.values():
        yield first, f"{first.where} and {len(more)} more like it" if more else first.where


def verify(
    root: Path,
    staged: Sequence[Path] | None = None,
    *,
    on_progress: Callable[[float, str], None] = lambda share, words: None,
) -> VerifyReport:
    """Read every frame of the LeRobot dataset at `root` and list what is wrong.

    Args:
        root: folder of a finished dataset.
        staged: the episodes it was packed from, in order, to compare with.
        on_progress: told the share that is done and a few words.

    Raises:
        V2PError: there is no LeRobot v3 dataset at `root`, or none that can be read in bounded memory.
    """
    info = read_info(root)
    demand_bounded(root)
    said = Said()
    said.problems += [*_changed_files(root, said), *layout_problems(root, info)]
    about = _about(root, said)
    checks = Checks(info=info, about=about, said=said)
    if any(p.check in STOPPING for p in said.problems):
        return _report(root, checks, 0, 0, is_compared=False)
    if about is not None:
        table = episodes_of(root)
        if said.notes and len(table) == len(about["episodes"]):  # edited
            told, about = about, as_in_table(about, table)
            pairs = zip(told["episodes"], about["episodes"], strict=True)
            if renamed := sum(a["task"] != b["task"] for a, b in pairs):
                said.note("edited", "meta/episodes", f"{renamed} of {len(table)} episodes have another instruction than when they were packed")  # fmt: skip
        tasks, lengths = (table.column(name).to_pylist() for name in ("tasks", "length"))
        said.problems += about_problems(root, about, tasks, lengths)
    leftovers = sorted(p.name for p in [root / "images", *root.glob("tmp*")] if p.exists())
    if leftovers:
        said.note("leftovers", ", ".join(leftovers), "LeRobot's temporary files; a push of its own uploads tmp*")  # fmt: skip
    repo_id = str((about or {}).get("repo_id", "local/dataset"))
    on_progress(0.0, "starting LeRobot")
    return _read(root, checks, repo_id, staged, on_progress)


def _changed_files(root: Path, said: Said) -> Iterator[Found]:
    """Yield what is not as the record of a dataset of ours lists it; others have no record."""
    try:
        changed = changed_files(root)
    except UnusableError as error:
        yield Found(check="record", where=RECORD_FILE, detail=error.detail)
        return
    if changed.edited:
        said.note("edited", ", ".join(changed.edited), "changed since packing, as LeRobot's tools change them")  # fmt: skip
    for damage in changed.damaged:
        where = damage.path.relative_to(root).as_posix()
        yield Found(check="changed_file", where=where, detail=f"{damage.what}, says {RECORD_FILE}")


def _about(root: Path, said: Said) -> dict[str, Any] | None:
    """Return what our own metadata says; what is wrong with it is a finding."""
    try:
        about = read_about(root)
    except V2PError as error:
        said.add("unreadable_about", METADATA_FILE, str(error))
        return None
    if not (root / METADATA_FILE).is_file():
        if (root / CARRIED_TASKS).is_dir():
            said.add(
                "missing_file", METADATA_FILE, "is missing, and the dataset carries tasks of ours"
            )
        elif about is not None:
            said.note("edited", METADATA_FILE, "was left out by LeRobot's tools; meta/episodes holds what it said of each episode")  # fmt: skip
    return about


def _read(
    root: Path,
    checks: Checks,
    repo_id: str,
    staged: Sequence[Path] | None,
    on_progress: Callable[[float, str], None],
) -> VerifyReport:
    try:
        rows = Rows(root, repo_id)
    except Exception as error:  # noqa: BLE001 - whatever LeRobot stumbles over is the finding
        checks.said.add("does_not_open", str(root), f"{type(error).__name__}: {error}")
        return _report(root, checks, 0, 0, is_compared=False)
    lengths = [int(n) for n in episodes_of(root).column("length").to_pylist()]
    if staged is not None and len(staged) != len(lengths):
        checks.said.add(
            "counts", "dataset", f"holds {len(lengths)} episodes, {len(staged)} were recorded"
        )
    start = 0
    for k, length in enumerate(lengths):
        recorded = Episode.load(staged[k]) if staged is not None and k < len(staged) else None
        episode = checks.episode(k, start, length, recorded)
        try:
            for row in rows.episode(start, length):
                episode.look_at(row)
        except Exception as error:  # noqa: BLE001 - whatever LeRobot stumbles over is the finding
            words = str(error).strip().splitlines()[:1] or [""]
            checks.said.add("does_not_read", f"episode {k}", f"after frame {len(episode.tasks)}: {type(error).__name__}: {words[0][:200]}")  # fmt: skip
        else:
            episode.finish()
        start += length
        on_progress((k + 1) / len(lengths), f"read {k + 1} episodes")
    checks.statistics(rows.dataset.meta.stats or {})
    return _report(root, checks, len(lengths), start, is_compared=staged is not None)


def _report(
    root: Path, checks: Checks, num_episodes: int, num_frames: int, *, is_compared: bool
) -> VerifyReport:
    return VerifyReport(
        root=root,
        num_episodes=num_episodes,
        num_frames=num_frames,
        is_ours=checks.is_ours,
        is_compared=is_compared,
        problems=tuple(checks.said.problems),
        notes=tuple(checks.said.notes),
        skipped=tuple(checks.skipped()),
    )


def frames_differ(
    root: Path, sources: Sequence[tuple[Path, Sequence[int]]], keys: Sequence[str] | None = None
) -> str:
    """Return how the dataset at `root` differs from episodes of other datasets, frame by frame.

    Of a source without the column that says who acted the expert did throughout. One without words says nothing of them.

    Args:
        root: the dataset; its episodes are those of `sources`, in order.
        sources: folders of datasets, each with the numbers of its episodes.
        keys: columns to compare; all but the numbering by default.

    Returns:
        A sentence, empty where all pixels and numbers are equal.
    """
    made = Rows(root)
    absent = {INTERVENTION_KEY: True}
    columns = [*(keys or (k for k in made.dataset.meta.features if k not in RENUMBERED)), "task"]
    told = [key for key in columns if key.startswith("language_")]
    at = 0
    for folder, numbers in sources:
        source = Rows(folder)
        for number in numbers:
            entry = source.dataset.meta.episodes[number]
            start, length = int(entry["dataset_from_index"]), int(entry["length"])
            if at + length > len(made):
                return f"{root} ends before episode {number} of {folder}"
            pairs = zip(source.episode(start, length), made.episode(at, length), strict=True)
            for t, (old, new) in enumerate(pairs):
                absent |= {key: new[key] for key in told}
                wrong = [
                    key for key in columns if not same(old.get(key, absent.get(key)), new[key])
                ]
                if wrong:
                    return f"row {at + t} differs from frame {t} of episode {number} of {folder} in {', '.join(wrong)}"  # fmt: skip
            at += length
    return "" if at == len(made) else f"{root} holds {len(made)} rows, {at} were to be in it"

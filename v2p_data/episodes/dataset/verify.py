"""A dataset of ours, reopened with LeRobot and looked at frame by frame.

The tables are read first, without LeRobot (`tables`); then every frame is read the way a training would read it.
With the staged episodes at hand each mask, state and action is compared with what was recorded.
"""

import re
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

from v2p_data.episodes.dataset.about import about_problems, changed_files, demand_about
from v2p_data.episodes.dataset.features import INTERVENTION_KEY
from v2p_data.episodes.dataset.frame_checks import DatasetChecks, EpisodeCheck
from v2p_data.episodes.dataset.intake import demand_bounded
from v2p_data.episodes.dataset.reading import Rows, same
from v2p_data.episodes.dataset.tables import (
    STOPPING,
    Problem,
    episodes_of,
    layout_problems,
    read_info,
)
from v2p_data.episodes.staging import Episode
from v2p_data.errors import UnusableError
from v2p_data.pipeline.artifact import RECORD_FILE

SHOWN_PROBLEMS = 5
RENUMBERED = ("index", "episode_index", "task_index")


@dataclass(frozen=True, kw_only=True)
class VerifyReport:
    """What was read and what is wrong with it."""

    root: Path
    num_episodes: int = 0
    num_frames: int = 0
    is_compared: bool = False
    """Every frame was compared with what was recorded."""
    problems: tuple[Problem, ...]

    @property
    def is_good(self) -> bool:
        return not self.problems

    def summary(self) -> str:
        """Return one sentence."""
        read = f"{self.num_episodes} episodes, {self.num_frames} frames"
        if self.is_good:
            same = ", all equal to what was recorded" if self.is_compared else ""
            return f"{read}: no problem found{same}"
        kinds = self._kinds()
        shown = "; ".join(f"{where}: {p.detail}" for p, where in kinds[:SHOWN_PROBLEMS])
        more = len(kinds) - SHOWN_PROBLEMS
        return f"{read}: {len(self.problems)} problems: {shown}" + (
            f"; and {more} more kinds" if more > 0 else ""
        )

    def lines(self) -> list[str]:
        """Return it for people, a line for each kind of problem."""
        return [f"problem  {p.check:<16} {where}: {p.detail}" for p, where in self._kinds()]

    def as_json(self) -> dict[str, Any]:
        """Return it for JSON."""
        return asdict(self) | {"root": str(self.root), "is_good": self.is_good}

    def _kinds(self) -> list[tuple[Problem, str]]:
        """Return the first problem of each kind and where it is; those of a kind differ in their numbers only."""
        kinds: dict[tuple[str, ...], list[Problem]] = {}
        for one in self.problems:
            words = (re.sub(r"\d+", "#", words) for words in (one.where, one.detail))
            kinds.setdefault((one.check, *words), []).append(one)
        return [
            (first, f"{first.where} and {len(more)} more like it" if more else first.where)
            for first, *more in kinds.values()
        ]


def verify(
    root: Path,
    staged: Sequence[Path] | None = None,
    *,
    on_progress: Callable[[float, str], None] = lambda share, words: None,
) -> VerifyReport:
    """Read every frame of the dataset of ours at `root` and list what is wrong.

    Args:
        root: folder of a finished dataset.
        staged: the episodes it was packed from, in order, to compare with.
        on_progress: is called with the share that is done and a few words.

    Raises:
        V2PError: there is no dataset of ours at `root`, or none that can be read in bounded memory.
    """
    info = read_info(root)
    demand_bounded(root)
    about = demand_about(root)
    problems = [*_changed(root), *layout_problems(root, info)]
    if any(p.check in STOPPING for p in problems):
        return VerifyReport(root=root, problems=tuple(problems))
    table = episodes_of(root)
    lengths = [int(n) for n in table.column("length").to_pylist()]
    problems += about_problems(root, about, table.column("tasks").to_pylist(), lengths)
    on_progress(0.0, "starting LeRobot")
    try:
        rows = Rows(root, str(about["repo_id"]))
    except Exception as error:  # noqa: BLE001 - whatever LeRobot stumbles over is the finding
        words = f"{type(error).__name__}: {error}"
        problems.append(Problem(check="does_not_open", where=str(root), detail=words))
        return VerifyReport(root=root, problems=tuple(problems))
    checks = DatasetChecks(info, about, problems)
    if staged is not None and len(staged) != len(lengths):
        checks.add(
            "counts", "dataset", f"holds {len(lengths)} episodes, {len(staged)} were recorded"
        )
    start = 0
    for k, length in enumerate(lengths):
        recorded = Episode.load(staged[k]) if staged is not None and k < len(staged) else None
        _check_episode(checks, rows, k, start, length, recorded)
        start += length
        on_progress((k + 1) / len(lengths), f"read {k + 1} episodes")
    if all(p.check != "does_not_read" for p in problems):  # statistics are of all rows
        checks.statistics(rows.dataset.meta.stats or {})
    return VerifyReport(
        root=root,
        num_episodes=len(lengths),
        num_frames=start,
        is_compared=staged is not None,
        problems=tuple(problems),
    )


def _changed(root: Path) -> list[Problem]:
    """Return what is not as the record of the dataset lists it."""
    try:
        changed = changed_files(root)
    except UnusableError as error:
        return [Problem(check="record", where=RECORD_FILE, detail=error.detail)]
    return [
        Problem(
            check="changed_file",
            where=damage.path.relative_to(root).as_posix(),
            detail=f"{damage.what}, says {RECORD_FILE}",
        )
        for damage in changed
    ]


def _check_episode(
    checks: DatasetChecks, rows: Rows, k: int, start: int, length: int, recorded: Episode | None
) -> None:
    episode = EpisodeCheck(checks, k, start, length, recorded)
    try:
        for row in rows.episode(start, length):
            episode.look_at(row)
        episode.finish()
    except Exception as error:  # noqa: BLE001 - whatever LeRobot stumbles over is the finding
        words = (str(error).strip().splitlines() or [""])[0][:200]
        where = f"after frame {len(episode.tasks)}"
        checks.add("does_not_read", f"episode {k}", f"{where}: {type(error).__name__}: {words}")


def difference_of_frames(root: Path, sources: Sequence[tuple[Path, Sequence[int]]]) -> str:
    """Return how the dataset at `root` differs from episodes of other datasets, frame by frame.

    Of a source without the column that says who acted the expert did throughout. One without words
    says nothing of them.

    Args:
        root: the dataset; its episodes are those of `sources`, in order.
        sources: folders of datasets, each with the numbers of its episodes.

    Returns:
        A sentence, empty where all pixels and numbers are equal.
    """
    made = Rows(root)
    columns = [*(k for k in made.dataset.meta.features if k not in RENUMBERED), "task"]
    words = [key for key in columns if key.startswith("language_")]
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
                absent = {INTERVENTION_KEY: True} | {key: new[key] for key in words}
                wrong = [k for k in columns if not same(old.get(k, absent.get(k)), new[k])]
                if wrong:
                    return (
                        f"row {at + t} differs from frame {t} of episode {number} of {folder} in "
                        f"{', '.join(wrong)}"
                    )
            at += length
    return "" if at == len(made) else f"{root} holds {len(made)} rows, {at} were to be in it"

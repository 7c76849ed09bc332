"""Commands that make datasets of datasets."""

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

import tyro

from v2p_data.cli import parse
from v2p_data.commands.display import telling
from v2p_data.episodes.dataset.repo_id import check_repo_id

if TYPE_CHECKING:
    from v2p_data.episodes.dataset.layout import NewDataset


@dataclass(frozen=True, kw_only=True)
class Merge:
    datasets: tyro.conf.Positional[tuple[Path, ...]]
    """Folders of datasets that v2p made; their episodes stay in this order."""
    out: Path
    """Where the new dataset shall lie; must not exist."""
    repo_id: str
    """USER/NAME, under which it will be pushed."""
    language: bool = False
    """Write LeRobot's language columns as well: subtasks, motions and questions with exact times."""


@dataclass(frozen=True, kw_only=True)
class Drop:
    dataset: tyro.conf.Positional[Path]
    """Folder of a dataset that v2p made, which stays as it is."""
    tasks: tuple[str, ...] = ()
    """Instructions, or names of the videos that tasks were made from."""
    episodes: tuple[int, ...] = ()
    """Numbers of episodes, from 0."""
    out: Path
    """Where the new dataset shall lie; must not exist."""
    repo_id: str | None = None
    """USER/NAME, under which it will be pushed; the old one by default."""


def merge_command(argv: list[str]) -> int:
    from v2p_data.episodes.dataset.edit import merge

    args = parse(Merge, argv, "merge")
    check_repo_id(args.repo_id)
    with telling("merge") as progress:
        made = merge(
            args.datasets, args.repo_id, args.out, language=args.language, on_progress=progress
        )
    return _tell(made)


def drop_command(argv: list[str]) -> int:
    from v2p_data.episodes.dataset.edit import drop

    args = parse(Drop, argv, "drop")
    if args.repo_id is not None:
        check_repo_id(args.repo_id)
    with telling("drop") as progress:
        made = drop(
            args.dataset,
            args.tasks,
            args.out,
            args.repo_id,
            episodes=args.episodes,
            on_progress=progress,
        )
    return _tell(made)


def _tell(made: "NewDataset") -> int:
    lines = [
        f"Made {made.root}: {made.num_episodes} episodes, {made.num_frames} frames of {len(made.tasks)} tasks, "
        "every frame equal to where it came from",
        f"Next: v2p push {made.root} --repo-id {made.repo_id}",
    ]
    print("\n".join(lines))  # noqa: T201
    return 0

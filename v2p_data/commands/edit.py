"""Commands that make datasets of datasets."""

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

import tyro

from v2p_data.cli import parse
from v2p_data.episodes.repo_id import check_repo_id

if TYPE_CHECKING:
    from v2p_data.episodes.edit import Edited


@dataclass(frozen=True, kw_only=True)
class Merge:
    datasets: tyro.conf.Positional[tuple[Path, ...]]
    """Folders of LeRobot v3 datasets; their episodes stay in this order. One is copied, with exact statistics."""
    out: Path
    """Where the new dataset shall lie; must not exist."""
    repo_id: str
    """USER/NAME, under which it will be pushed."""


@dataclass(frozen=True, kw_only=True)
class Drop:
    dataset: tyro.conf.Positional[Path]
    """Folder of a LeRobot v3 dataset, which stays as it is."""
    tasks: tuple[str, ...]
    """Instructions, or names of the videos that tasks were made from."""
    out: Path
    """Where the new dataset shall lie; must not exist."""
    repo_id: str | None = None
    """USER/NAME, under which it will be pushed; the old one by default."""


def merge_command(argv: list[str]) -> int:
    from v2p_data.episodes.edit import merge

    args = parse(Merge, argv, "merge")
    check_repo_id(args.repo_id)
    for dataset in args.datasets:
        _demand_sound(dataset)
    return _tell(merge(args.datasets, args.repo_id, args.out))


def drop_command(argv: list[str]) -> int:
    from v2p_data.episodes.edit import drop

    args = parse(Drop, argv, "drop")
    if args.repo_id is not None:
        check_repo_id(args.repo_id)
    _demand_sound(args.dataset)
    return _tell(drop(args.dataset, args.tasks, args.out, args.repo_id))


def _demand_sound(dataset: Path) -> None:
    """Raise if a dataset of ours is not as it was made."""
    from v2p_data.episodes.about import read_about
    from v2p_data.pipeline.artifact import demand_whole

    demand_whole(dataset)
    read_about(dataset)


def _tell(made: "Edited") -> int:
    lines = [
        f"Made {made.root}: {made.num_episodes} episodes, {made.num_frames} frames of {len(made.tasks)} tasks, "
        "every frame equal to where it came from",
        *made.notes,
        f"Next: v2p push {made.root} --repo-id {made.repo_id}",
    ]
    print("\n".join(lines))  # noqa: T201
    return 0

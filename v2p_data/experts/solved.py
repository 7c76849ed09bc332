"""Experts that earlier runs finished, as starting points for tasks that no program solves.

A folder of runs holds `expert/<item>-<fingerprint>` with a record that names its task, and the task beside it in
`task/`, or in `reward/` where its reward was searched. What is there is part of the recipe of an expert that may start from it: see `solved_digests`.
"""

from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path

from policies.ppo.policy import EXPERT_FILE, WEIGHTS_FILE
from v2p_data.errors import V2PError
from v2p_data.json_files import read_object
from v2p_data.pipeline.artifact import demand_whole, read_record
from v2p_data.pipeline.contents import damaged
from v2p_data.pipeline.fingerprint import file_digest
from v2p_data.task.likeness import likeness
from v2p_data.task.task import TaskBundle


@dataclass(frozen=True, kw_only=True)
class Solved:
    """An expert that exists, and its task."""

    bundle: TaskBundle
    folder: Path
    obs_dim: int
    """Length of the observation it was trained on."""


def find_solved(runs: Path) -> list[Solved]:
    """Return the experts in a folder of runs that were finished and not rejected.

    Raises:
        V2PError: there is none, or one of them, or its task, is not as it was made.
    """
    found: list[Solved] = []
    for folder in sorted(runs.glob("expert/*")):
        record = read_record(folder)
        if record is None or record.rejected is not None:
            continue
        if (record.counts.get("learning") or {}).get("kept") == "program":
            continue  # it has no weights to start from
        places = (runs / stage / record.inputs.get("task", "") for stage in ("task", "reward"))
        task = next((place for place in places if place.is_dir()), None)
        if task is None:
            continue  # cleared away: what the expert can do is not known any more
        demand_whole(folder, runs)
        demand_whole(task, runs)
        try:
            obs_dim = int(read_object(folder / EXPERT_FILE, "train it anew")["obs_dim"])
        except (V2PError, ValueError, LookupError, TypeError) as error:
            raise damaged(folder, f"{folder / EXPERT_FILE} cannot be read") from error
        found.append(Solved(bundle=TaskBundle.load(task), folder=folder, obs_dim=obs_dim))
    if not found:
        raise V2PError(
            f"there is no finished expert in {runs}; --expert.warm-start names a folder of runs, "
            "with experts in `expert/` and their tasks in `task/`"
        )
    return found


def solved_digests(runs: Path | None) -> dict[str, str]:
    """Return what identifies all experts that might be started from, by folder: another one is another recipe."""
    if runs is None:
        return {}
    return {
        f"solved {s.folder.name}": file_digest(s.folder / WEIGHTS_FILE) for s in find_solved(runs)
    }


def rank_solved(bundle: TaskBundle, obs_dim: int, solved: Iterable[Solved]) -> list[Solved]:
    """Return the experts whose weights fit a task, the most alike first; equals in the order of their folders' names.

    Experts for another arm, with another observation or another size of motion do not fit: in them the same
    number means something else.
    """
    arm = bundle.arm
    fitting = [
        s
        for s in solved
        if s.obs_dim == obs_dim
        and s.bundle.arm == arm
        and s.bundle.motion_scale == bundle.motion_scale
    ]
    return sorted(fitting, key=lambda s: (-likeness(bundle, s.bundle), s.folder.name))

"""Who is judged in `v2p eval`, in which tasks, and the rates in words."""

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

from v2p_data.episodes.dataset.repo_id import is_repo_id
from v2p_data.errors import V2PError
from v2p_data.evaluation.judging import PROGRAMS, Contestant, contestant, task_folders
from v2p_data.pipeline.artifact import read_record
from v2p_data.policy.training import sources_of
from v2p_data.stages import ROOT_OF_TASKS, demand_whole_part
from v2p_data.task.task import TASK_FILE


def contestant_at(policy: Path) -> Contestant:
    """Return who lies at a path, or the policy that is on the Hub by this name.

    Raises:
        V2PError: there is neither.
    """
    repo_id = policy.as_posix()
    if policy.exists() or not is_repo_id(repo_id):
        demand_whole_part(policy.resolve())
        return contestant(policy)
    from v2p_data.episodes.hub.hub import fetch_policy

    try:
        return replace(contestant(fetch_policy(repo_id)), repo_id=repo_id)
    except V2PError as error:
        raise V2PError(f"there is no folder {policy}, and {error}") from error


def seen_tasks(who: Contestant) -> list[tuple[str, Path]]:
    """Return the tasks of a policy's dataset, or the one that an expert learned, as far as its run has them."""
    if who.kind == "programs" or who.repo_id:
        return []
    root = home_of(who, ())
    record = read_record(who.folder.parent if who.kind == "policy" else who.folder)
    if record is not None and (who.kind, record.stage) == ("policy", "policy"):
        named = (record.recipe.get("sources") or {}).get("dataset")
        for dataset in sorted((root / "dataset").glob(str(named))):
            # The run's own tasks first: those in the dataset do not say where the file of another arm lies.
            own = [(source.item, source.task) for source in sources_of(dataset, root)]
            return own or task_folders(dataset / ROOT_OF_TASKS)
    if record is not None and (who.kind, record.stage) == ("expert", "expert"):
        for stage, folder in record.inputs.items():
            if (root / stage / folder / TASK_FILE).is_file():
                return [(record.item, root / stage / folder)]
    return []


def home_of(who: Contestant, tasks: Sequence[Path]) -> Path:
    """Return the run folder that a policy or an expert lies in; of the programs, the one that the tasks lie in.

    What is judged by its name on the Hub gets a run folder of its own.

    Raises:
        V2PError: the programs' tasks are not named.
    """
    if who.kind == "programs":
        if not tasks:
            raise V2PError(f"the scripted programs need tasks: v2p eval {PROGRAMS} --tasks FOLDER")
        return task_folders(tasks[0])[0][1].resolve().parent.parent
    if who.repo_id:
        return Path("outputs") / who.repo_id.split("/")[-1]
    return who.folder.parent.parent.parent if who.kind == "policy" else who.folder.parent.parent


def rate_lines(rows: Sequence[dict[str, Any]]) -> list[str]:
    """Return one line per task: seen or unseen, the rate and its interval."""
    width = max(len(str(r["task"])) for r in rows)
    return [
        f"  {r['task']!s:<{width}}  {'seen  ' if r['seen'] else 'unseen'}  {r['successes']}/{r['trials']}"
        f" = {r['rate']:.0%}, 95 % interval {r['low']:.0%} to {r['high']:.0%}{_more(r)}"
        for r in rows
    ]


def _more(row: dict[str, Any]) -> str:
    """Return how often success was still there at the end, and what went wrong most often."""
    words = ""
    if row.get("at_end"):
        words += f"; at the end {row['at_end']['rate']:.0%}"
    if row.get("own_reset"):
        words += f"; from the task's own starts {row['own_reset']['rate']:.0%}"
    failures = [f"{kind.replace('_', ' ')} {n}" for kind, n in row.get("failures", {}).items()]
    return words + (f"; failures: {', '.join(failures)}" if failures else "")

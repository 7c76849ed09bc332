"""`v2p show`: a task's code and what the audit said of it, and what a reward search tried."""

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import tyro

from v2p_data.cli import parse
from v2p_data.commands import reward
from v2p_data.errors import V2PError
from v2p_data.pipeline.artifact import demand_whole
from v2p_data.task.task import TASK_FILE, TaskBundle


@dataclass(frozen=True, kw_only=True)
class Show:
    path: tyro.conf.Positional[Path]
    """Folder of a task or of a reward search; of a run: all of its tasks and searches."""


def show_command(argv: list[str]) -> int:
    args = parse(Show, argv, "show")
    parts = [shown(folder) for folder in tasks_in(args.path)]
    parts += [reward.shown(search) for search in reward.searches_in(args.path)]
    if not parts:
        raise V2PError(
            f"{args.path} holds neither a task nor a reward search; make them with 'v2p task VIDEOS' and "
            "'v2p reward search TASK'"
        )
    print("\n\n\n".join(parts))  # noqa: T201
    return 0


def tasks_in(folder: Path) -> list[Path]:
    """Return the task folders at or below a folder."""
    if (folder / TASK_FILE).is_file():
        return [folder]
    return sorted(p.parent for p in folder.glob(f"task/*/{TASK_FILE}"))


def shown(folder: Path) -> str:
    """Return a task in words: caption, audit table, code."""
    demand_whole(folder)
    bundle = TaskBundle.load(folder)
    return "\n".join(
        [
            f"{bundle.title}: {bundle.description} ({bundle.kind}), {folder}",
            f"{bundle.horizon_steps} control steps an episode",
            "",
            *audit_lines(bundle.audit),
            "",
            bundle.code.rstrip(),
        ]
    )


def audit_lines(audit: dict[str, Any]) -> list[str]:
    """Return the audit as a table, one question a line."""
    if not audit:
        return ["not audited"]
    verdict = "acceptable" if audit["acceptable"] else "not acceptable"
    lines = [f"audit: {verdict}, score {audit['score']:.2f}"]
    if audit["vetoed"]:
        lines.append(f"  vetoed: {audit['vetoed']}")
    for check in audit["checks"]:
        said = "yes" if check["passed"] else "NO "
        veto = ", a veto" if check["is_veto"] else ""
        lines.append(
            f"  {said}  {check['asks']}  ({check['name']}: {check['share']:.2f}, weight {check['weight']:g}{veto})"
        )
    if audit.get("true_from_pose") is not None:
        lines.append(f"  true from tracked pose {audit['true_from_pose']} on")
    if audit.get("threshold_m") is not None:
        lines.append(f"  becomes true after {audit['threshold_m'] * 100:.1f} cm of the motion")
    return [*lines, *[f"  note: {n}" for n in audit.get("notes", ())]]

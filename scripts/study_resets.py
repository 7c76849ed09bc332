"""Resets that make a task easier: the question of the paper's table 9 on our terms. `docs/lab/success.md` has the results.

    python scripts/study_resets.py --out outputs/resets.jsonl
    python scripts/study_resets.py --out outputs/resets.jsonl --table

Each benchmark task gets `reset_objects_states` of eight kinds, seven of them cheats. A cheat can be found by the audit before training, or
by the simulator, which refuses tasks that start solved. What neither finds may inflate a success rate: the same scripted programs play the same
seeds from the task's own starts and from the environment's (`--evaluation.reset=base`), judged by the same referee.
"""

import argparse
import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from v2p_data.errors import ItemRejectedError
from v2p_data.evaluation.config import EvaluationConfig
from v2p_data.evaluation.judging import PROGRAMS, Contestant, judge_task, play_of
from v2p_data.pipeline.artifact import provenance
from v2p_data.pipeline.runner import Runtime
from v2p_data.scene.scene import Scene
from v2p_data.seeds import rng_for, seed_for
from v2p_data.task.benchmark import benchmark_names, load_benchmark
from v2p_data.task.generate import TaskConfig, generate_task
from v2p_data.task.task import TaskBundle

BASE = "return super().reset_objects_states(env_ids)"
RESETS: dict[str, str] = {
    "honest: other random numbers": "poses[{thing!r}][:, :2] += 0.01 * torch.sin(100.0 * poses[{thing!r}][:, :2])",
    "at the goal": "poses[{thing!r}][:, :2] = {goal} + torch.tensor({offset})",
    "four fifths of the way": "poses[{thing!r}][:, :2] += 0.8 * ({goal} + torch.tensor({offset}) - poses[{thing!r}][:, :2])",
    "a third of the way": "poses[{thing!r}][:, :2] += 0.33 * ({goal} + torch.tensor({offset}) - poses[{thing!r}][:, :2])",
    "always in one place": "poses[{thing!r}][:] = torch.tensor({first})",
    "in the air": "poses[{thing!r}][:, 2] += 0.12",
    "turned as at the end": "poses[{thing!r}][:, 3:] = torch.tensor({last})[3:]",
    "out of reach": "poses[{thing!r}][:, 0] += 0.6",
}
"""Statements on `poses`, the environment's own layouts. The first is no cheat: what is said of it is a false alarm."""


def main() -> None:
    """Read the command line, measure what is missing, show what is there."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").split("\n")[0])
    parser.add_argument("--out", type=Path, default=Path("outputs/resets.jsonl"))
    parser.add_argument("--tasks", nargs="*", default=benchmark_names())
    parser.add_argument("--episodes", type=int, default=100)
    parser.add_argument("--table", action="store_true", help="show what is there and stop")
    args = parser.parse_args()
    args.out.parent.mkdir(parents=True, exist_ok=True)
    rows = [json.loads(line) for line in args.out.read_text().splitlines()] if args.out.is_file() else []  # fmt: skip
    done = {(row["task"], row["reset"]) for row in rows}
    for name in () if args.table else args.tasks:
        for reset in RESETS:
            if (name, reset) not in done:
                rows.append(measured(load_benchmark(name), reset, args.episodes))
                with args.out.open("a") as stream:
                    stream.write(json.dumps(rows[-1]) + "\n")
    print(table(rows))


def with_reset(bundle: TaskBundle, reset: str) -> TaskBundle:
    """Return the task with another `reset_objects_states`."""
    scene = bundle.scene
    first, last = scene.manipulated.poses_world[0], scene.manipulated.last_pose
    other = scene.others[0] if scene.others else None
    away = np.asarray(last[:2]) - (other.last_pose if other else first)[:2]
    words = {
        "thing": scene.manipulated.name,
        "goal": f"poses[{(other or scene.manipulated).name!r}][:, :2]",
        "offset": [float(x) for x in away],
        "first": [0.5, 0.0, *(float(x) for x in first[2:])],
        "last": [float(x) for x in last],
    }
    lines = ("poses = super().reset_objects_states(env_ids)", RESETS[reset].format(**words), "return poses")  # fmt: skip
    code = bundle.code.replace(BASE, "\n        ".join(lines), 1)
    assert code != bundle.code
    return replace(bundle, code=code)


def measured(bundle: TaskBundle, reset: str, episodes: int) -> dict[str, Any]:
    """Return what the audit and the simulator say of one reset, and the programs' success from both starts."""
    task = with_reset(bundle, reset)
    found = audited(task.scene, task.code)
    play = play_of(Contestant(kind="programs", folder=Path(PROGRAMS)), 0, "cpu")
    rates: dict[str, Any] = {}
    for start in ("task", "base"):
        cfg = EvaluationConfig(episodes=episodes, reset=start)
        try:
            judged = judge_task(play, task, cfg, seed_for(0, "study_resets", task.title) % 2**31, Runtime(root=Path()), lambda share: None)  # fmt: skip
            rates[start] = float(judged.successes.mean())
        except ItemRejectedError as error:
            rates[start] = error.reason
    return {
        "task": task.title,
        "reset": reset,
        "audit": found,
        "success": rates,
        "episodes": episodes,
        "commit": provenance()["commit"][:12],
    }


def audited(scene: Scene, code: str) -> list[str]:
    """Return why the audit does not accept the code; empty if it does."""
    try:
        made = generate_task(scene, TaskConfig(), seed_for(0, "task", scene.title), sources=[code])
    except ItemRejectedError as error:
        return [error.detail.partition("fault is that ")[2].partition(". Look")[0] or error.detail]
    return [] if made.samples[0].audit.is_acceptable else ["not acceptable"]


def table(rows: list[dict[str, Any]]) -> str:
    """Return the table as Markdown."""
    lines = [
        "| reset | tasks | found by the audit | by the simulator | by neither | of these, success from own starts - from the environment's (95 %) |",
        "|---|---|---|---|---|---|",
    ]
    for reset in RESETS:
        some = [row for row in rows if row["reset"] == reset]
        audit = [row for row in some if row["audit"]]
        simulator = [row for row in some if not row["audit"] and isinstance(row["success"]["task"], str)]  # fmt: skip
        missed = [row for row in some if row not in audit and row not in simulator]
        more = [row["success"]["task"] - row["success"]["base"] for row in missed]
        lines.append(f"| {reset} | {len(some)} | {len(audit)} | {len(simulator)} | {len(missed)} | {_mean(more)} |")  # fmt: skip
    return "\n".join(lines)


def _mean(values: list[float]) -> str:
    if not values:
        return "-"
    rng = rng_for(0, "study_resets", "bootstrap")
    means = np.mean(rng.choice(values, (2000, len(values))), axis=1)
    low, high = np.percentile(means, [2.5, 97.5])
    return f"{np.mean(values):+.3f} ({low:+.3f} to {high:+.3f})"


if __name__ == "__main__":
    main()

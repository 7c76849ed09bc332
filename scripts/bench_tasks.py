"""Learn the benchmark tasks and judge the experts: the table of `docs/experts.md`.

Each task of `v2p_data/task/paper_tasks` is learned with the engine's defaults, once per seed, and judged by the
independent referee on fresh episodes at the fine time step. Results are appended to a JSON-lines file, so that a
stopped run goes on where it was; `--table` prints what is there.

    python scripts/bench_tasks.py --out outputs/bench_tasks --tasks lift_up insert --seeds 0 1 2
"""

import argparse
import json
import logging
import os
import time
from collections import defaultdict
from dataclasses import replace
from pathlib import Path

import numpy as np

from paper_tables import success
from policies.evaluation.rate import wilson
from policies.ppo.policy import Expert
from studies.results import append_result, results_in
from v2p_data.episodes.collect import judge_expert
from v2p_data.experts.config import ExpertConfig
from v2p_data.experts.learning import Worlds, learn
from v2p_data.report.sheet import write_contact_sheet
from v2p_data.seeds import seed_for
from v2p_data.task.benchmark import benchmark_names, load_benchmark


def main() -> None:
    """Read the command line, learn, judge, print the table."""
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("--out", type=Path, default=Path("outputs/bench_tasks"))
    parser.add_argument("--tasks", nargs="*", default=benchmark_names())
    parser.add_argument("--seeds", nargs="*", type=int, default=[0, 1, 2])
    parser.add_argument("--episodes", type=int, default=100)
    parser.add_argument("--total-steps", type=int, default=600_000, help="of PPO")
    parser.add_argument("--max-seconds", type=float, default=300.0, help="of PPO")
    parser.add_argument("--teacher", choices=["programs", "none"], default="programs")
    parser.add_argument("--threads", type=int, default=2)
    parser.add_argument("--table", action="store_true", help="print the results so far and stop")
    args = parser.parse_args()
    logging.basicConfig(level=logging.WARNING)
    args.out.mkdir(parents=True, exist_ok=True)
    if not args.table:
        for seed in args.seeds:
            for task in args.tasks:
                if (task, seed, args.teacher) not in {_key(r) for r in results_in(args.out)}:
                    _one(task, seed, args)
    print(table(results_in(args.out)))


def _one(task: str, seed: int, args: argparse.Namespace) -> None:
    bundle = load_benchmark(task)
    folder = args.out / f"{task}-{args.teacher}-{seed}"
    base = ExpertConfig(teacher=args.teacher)
    cfg = replace(
        base,
        ppo=replace(base.ppo, total_steps=args.total_steps, max_seconds=args.max_seconds),
    )
    started, cpu = time.monotonic(), time.process_time()
    worlds = Worlds(
        bundle=bundle, seed=seed_for(seed, "benchmark", task), num_threads=args.threads
    )
    learned = learn(worlds, cfg, folder)
    wall, cpu = time.monotonic() - started, time.process_time() - cpu
    judged = judge_expert(
        bundle,
        Expert.load(folder).act,
        episodes=args.episodes,
        seed=seed_for(seed, "benchmark-judge", task),
        num_threads=args.threads,
    )
    write_contact_sheet(bundle, judged, folder / "sheet.png")
    result = {
        "task": task,
        "seed": seed,
        "teacher": args.teacher,
        "successes": int(judged.successes.sum()),
        "task_successes": int(judged.task_successes.sum()),
        "episodes": args.episodes,
        "wall_seconds": round(wall, 1),
        "cpu_seconds": round(cpu, 1),
        "load": round(os.getloadavg()[0], 2),
        "learned": learned.as_dict(),
    }
    append_result(args.out, result)
    print(json.dumps({k: v for k, v in result.items() if k != "learned"}), flush=True)


def _key(result: dict) -> tuple[str, int, str]:
    return result["task"], result["seed"], result["teacher"]


def table(results: list[dict]) -> str:
    """Return one Markdown row per task: success over all seeds with its interval, cost per seed."""
    groups: dict[tuple[str, str], list[dict]] = defaultdict(list)
    for result in results:
        groups[result["task"], result["teacher"]].append(result)
    lines = [
        "| task | teacher | success (referee, fine step) | per seed | program alone | steps (M) | wall s | CPU s | paper |",
        "|---|---|---|---|---|---|---|---|---|",
    ]
    for (task, teacher), group in sorted(groups.items()):
        rate = wilson(sum(r["successes"] for r in group), sum(r["episodes"] for r in group))
        trials = [t["success"] for r in group for t in r["learned"]["trials"]
                  if t["name"] == r["learned"]["teacher"]]  # fmt: skip
        lines.append(
            f"| {task} | {teacher} | {rate} | "
            + " ".join(f"{r['successes'] / r['episodes']:.2f}" for r in group)
            + f" | {np.mean(trials):.2f} | " * bool(trials)
            + " | - | " * (not trials)
            + " | ".join(
                _range([scale * f(r) for r in group], form)
                for f, scale, form in (
                    (lambda r: r["learned"]["steps"], 1e-6, ".2f"),
                    (lambda r: r["wall_seconds"], 1, ".0f"),
                    (lambda r: r["cpu_seconds"], 1, ".0f"),
                )
            )
            + f" | {success(task)} |"
        )
    return "\n".join(lines)


def _range(values: list[float], form: str) -> str:
    low, high = format(min(values), form), format(max(values), form)
    return low if low == high else f"{low}-{high}"


if __name__ == "__main__":
    main()

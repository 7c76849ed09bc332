"""Learn the benchmark tasks and judge the experts: the tables of `docs/experts.md`.

Each task of `v2p_data/task/paper_tasks` is learned with the engine's defaults, once per seed. The
scripted program, the taught policy, PPO's and the expert play the same fresh episodes at the fine
time step; the independent referee judges them. Results are appended to a JSON-lines file, so that
a stopped run goes on where it was; `--table` prints what is there.

    python scripts/bench_tasks.py --out outputs/bench_tasks --tasks lift_up insert --seeds 0 1 2
"""

import argparse
import logging
import os
import shutil
import time
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from paper_tables import success
from policies.evaluation.paired import median_difference, success_difference
from policies.evaluation.rate import wilson
from policies.ppo.config import PPOConfig
from policies.ppo.curve import CURVE_FILE, read_rows
from policies.ppo.policy import Expert
from studies.results import append_result, commit, results_in
from v2p_data.episodes.collect import judge_expert
from v2p_data.episodes.rollouts import Lesson, Rollouts
from v2p_data.experts.actors import ProgramActor
from v2p_data.experts.config import ExpertConfig
from v2p_data.experts.learning import TAUGHT_FOLDER, Worlds, learn
from v2p_data.play import Actor, StateActor
from v2p_data.report.sheet import write_contact_sheet
from v2p_data.seeds import seed_for
from v2p_data.sim.robot.robot import FINE
from v2p_data.task.benchmark import benchmark_names, load_benchmark
from v2p_data.task.task import TaskBundle

CONTROL_DT_S = FINE.control_dt_s


def main() -> None:
    """Read the command line, learn, judge, print the table."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").split("\n")[0])
    parser.add_argument("--out", type=Path, default=Path("outputs/bench_tasks"))
    parser.add_argument(
        "--tasks",
        nargs="*",
        default=benchmark_names(),
        help="of the benchmark, or folders of tasks",
    )
    parser.add_argument("--seeds", nargs="*", type=int, default=[0, 1, 2])
    parser.add_argument("--episodes", type=int, default=100)
    parser.add_argument("--total-steps", type=int, default=500_000, help="of PPO")
    parser.add_argument("--max-seconds", type=float, default=36_000.0, help="of PPO")
    parser.add_argument(
        "--target-success", type=float, default=PPOConfig().target_success, help="see PPOConfig"
    )
    parser.add_argument(
        "--taught-bonus-factor",
        type=float,
        default=ExpertConfig().taught_bonus_factor,
        help="see ExpertConfig",
    )
    parser.add_argument("--start", choices=["program", "none", "pretrained"], default="program")
    parser.add_argument("--threads", type=int, default=2)
    parser.add_argument("--table", action="store_true", help="print the results so far and stop")
    args = parser.parse_args()
    logging.basicConfig(level=logging.WARNING)
    args.out.mkdir(parents=True, exist_ok=True)
    if not args.table:
        for seed in args.seeds:
            for task in args.tasks:
                if (Path(task).name, seed, args.start, args.taught_bonus_factor) not in {
                    _key(r) for r in results_in(args.out)
                }:
                    _one(task, seed, args)
    print(table(results_in(args.out)))


def _one(task: str, seed: int, args: argparse.Namespace) -> None:
    bundle = TaskBundle.load(Path(task)) if Path(task).is_dir() else load_benchmark(task)
    task = Path(task).name
    folder = args.out / f"{task}-{args.start}-{args.taught_bonus_factor:g}-{seed}"
    if args.start == "program":  # a half-made training is not gone on with after imitation anew
        shutil.rmtree(folder, ignore_errors=True)
    base = ExpertConfig(start=args.start, taught_bonus_factor=args.taught_bonus_factor)
    cfg = replace(
        base,
        ppo=replace(
            base.ppo,
            total_steps=args.total_steps,
            max_seconds=args.max_seconds,
            target_success=args.target_success,
        ),
    )
    started, cpu = time.monotonic(), time.process_time()
    worlds = Worlds(
        bundle=bundle, seed=seed_for(seed, "benchmark", task), num_threads=args.threads
    )
    learned = learn(worlds, cfg, folder)
    wall, cpu = time.monotonic() - started, time.process_time() - cpu
    actors: dict[str, Actor] = {"expert": StateActor(Expert.load(folder).act)}
    if learned.teacher:
        actors["taught"] = StateActor(Expert.load(folder / TAUGHT_FOLDER).act)
        actors["program"] = ProgramActor(seed, learned.teacher)
    judged = {
        who: judge_expert(
            Lesson(bundle=bundle, expert=actor),
            episodes=args.episodes,
            seed=seed_for(seed, "benchmark-judge", task),
            num_threads=args.threads,
        )
        for who, actor in actors.items()
    }
    write_contact_sheet(bundle, judged["expert"], folder / "sheet.png")
    result = {
        "task": task,
        "seed": seed,
        "start": args.start,
        "taught_bonus_factor": args.taught_bonus_factor,
        "commit": commit(),
        "judged": {who: _judged(rollouts) for who, rollouts in judged.items()},
        "episodes": args.episodes,
        "wall_seconds": round(wall, 1),
        "cpu_seconds": round(cpu, 1),
        "load": round(os.getloadavg()[0], 2),
        "learned": learned.as_dict(),
        "curve": _curve(folder),
    }
    append_result(args.out, result)
    rates = {who: f"{r.successes.mean():.2f}" for who, r in judged.items()}
    print(task, seed, rates, learned.made_by, f"{cpu:.0f} CPU s", flush=True)


def _judged(rollouts: Rollouts) -> dict[str, Any]:
    """Return the referee's verdicts, a letter per episode, and the control steps until the task's success was held."""
    return {
        "success": "".join("1" if s else "0" for s in rollouts.successes),
        "steps": (rollouts.held_at + 1).tolist(),
    }


def _curve(folder: Path, points: int = 12) -> list[list[float | None]]:
    """Return evenly spread moments of a training: million steps, deterministic and exploring success."""
    rows = read_rows(folder / CURVE_FILE)
    at = np.linspace(0, len(rows) - 1, points).astype(int) if rows else []
    keys = ("success_deterministic", "success_stochastic")
    return [
        [
            rows[k]["steps"] / 1e6,
            *(None if np.isnan(rows[k][key]) else rows[k][key] for key in keys),
        ]
        for k in at
    ]


def _key(result: dict) -> tuple[str, int, str, float]:
    return result["task"], result["seed"], result["start"], result["taught_bonus_factor"]


def table(results: list[dict[str, Any]]) -> str:
    """Return one Markdown row per task: how often each actor succeeds over all seeds, what PPO gained, what it took."""
    lines = [
        "| task | program | taught | taught + PPO | PPO gains | PPO saves (s) | PPO kept | "
        "gradient steps | moved | steps (M) | CPU s "
        "| reward alone | its steps (M) | paper |",
        "|" + "---|" * 14,
    ]
    names = benchmark_names()
    tasks = sorted(
        {r["task"] for r in results},
        key=lambda t: (names.index(t) if t in names else len(names), t),
    )
    for task in tasks:
        by_start = {
            start: [r for r in results if (r["task"], r["start"]) == (task, start)]
            for start in ("program", "none")
        }
        lines.append(
            f"| {task} | {_taught_cells(by_start['program'])} | "
            f"{_alone_cells(by_start['none'])} | {success(task) if task in names else '-'} |"
        )
    return "\n".join(lines)


def _taught_cells(group: list[dict[str, Any]]) -> str:
    """Return the cells from `program` to `CPU s`."""
    if not group:
        return " | ".join("-" * 10)
    learned = [r["learned"] for r in group]
    pairs = [r for r in group if "taught" in r["judged"]]
    gain = saved = None
    if pairs:
        expert, taught = (_successes(pairs, who) for who in ("expert", "taught"))
        both = expert & taught
        gain = success_difference(expert, taught)
        saved = median_difference(
            CONTROL_DT_S * _steps(pairs, "taught")[both],
            CONTROL_DT_S * _steps(pairs, "expert")[both],
        )
    return " | ".join(
        (
            *(_rate(group, who) for who in ("program", "taught", "expert")),
            f"{gain.value:+.3f} ({gain.low:+.3f} to {gain.high:+.3f})" if gain else "-",
            f"{saved.value:+.2f} ({saved.low:+.2f} to {saved.high:+.2f})" if saved else "-",
            f"{sum(one['kept'] == 'ppo' for one in learned)} of {len(group)}",
            _range([one["actor_updates"] for one in learned], ",.0f"),
            _range([(one["comparison"] or {"moved": 0.0})["moved"] for one in learned], ".3f"),
            _range([1e-6 * one["steps"] for one in learned], ".2f"),
            _range([r["cpu_seconds"] for r in group], ".0f"),
        )
    )


def _alone_cells(group: list[dict[str, Any]]) -> str:
    """Return the cells of PPO from nothing."""
    if not group:
        return "- | -"
    return f"{_rate(group, 'expert')} | {_range([1e-6 * r['learned']['steps'] for r in group], '.2f')}"


def _rate(group: list[dict[str, Any]], who: str) -> str:
    """Return a success rate over all seeds with its interval, and each seed's."""
    if any(who not in r["judged"] for r in group):
        return "-"
    successes = _successes(group, who)
    rate = wilson(int(successes.sum()), len(successes))
    seeds = " ".join(
        f"{r['judged'][who]['success'].count('1') / r['episodes']:.2f}" for r in group
    )
    return f"{rate.value:.3f} ({rate.low:.3f}-{rate.high:.3f}; {seeds})"


def _successes(group: list[dict[str, Any]], who: str) -> np.ndarray:
    return np.array([letter == "1" for r in group for letter in r["judged"][who]["success"]])


def _steps(group: list[dict[str, Any]], who: str) -> np.ndarray:
    return np.concatenate([r["judged"][who]["steps"] for r in group])


def _range(values: list[float], form: str) -> str:
    low, high = format(min(values), form), format(max(values), form)
    return low if low == high else f"{low}-{high}"


if __name__ == "__main__":
    main()

"""Compare what V2P, Eureka, RoboGen and Code-as-Policies come to, offline: the table of `docs/rewards_table.md`.

Every method gets the same task, worlds, PPO recipe and control steps per candidate (`v2p_data/reward/methods.py` says in
what they differ), and its final policy is judged by `v2p_data/task/referee.py`, which no training sees, on fresh episodes
at the fine time step. Candidates go on from a policy that a short imitation of a scripted program left half
taught; with `--start nothing` they start as in the paper, which takes a hundred times the steps. Results are
appended to a JSON-lines file: a stopped run goes on, `--table` prints what is there.

    python scripts/compare_reward_methods.py --out outputs/reward_methods
"""

import argparse
import json
import shutil
import time
from collections import defaultdict
from pathlib import Path
from typing import Any

import numpy as np

from policies.evaluation.rate import wilson
from policies.ppo.policy import Expert
from studies.programs import ProgramPolicy
from studies.results import append_result, results_in
from v2p_data.play import Actor, StateActor, View, play
from v2p_data.reward.candidate import DONE_FILE
from v2p_data.reward.config import RewardConfig
from v2p_data.reward.jobs import Jobs
from v2p_data.reward.search import TAUGHT_FOLDER, How, search_reward
from v2p_data.seeds import seed_for
from v2p_data.sim.env import ranges
from v2p_data.sim.env.batch_env import BatchEnv, SimConfig
from v2p_data.sim.env.verdict import RefereeRecord
from v2p_data.task.benchmark import load_benchmark
from v2p_data.task.task import TaskBundle

METHODS = ("v2p", "eureka", "robogen", "code_as_policy")
TAUGHT_ROUNDS = {"lift_up": 2, "uncover": 2, "throw_into": 8}
"""Rounds of imitation that leave something to be learned."""


def main() -> None:
    """Read the command line, search, judge, print the table."""
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("--out", type=Path, default=Path("outputs/reward_methods"))
    parser.add_argument("--tasks", nargs="*", default=["lift_up", "uncover", "throw_into"])
    parser.add_argument("--methods", nargs="*", default=list(METHODS), choices=METHODS)
    parser.add_argument("--seeds", nargs="*", type=int, default=[0, 1, 2])
    parser.add_argument("--start", choices=["taught", "nothing"], default="taught")
    parser.add_argument("--iterations", type=int, default=2)
    parser.add_argument("--candidates", type=int, default=2)
    parser.add_argument("--steps", type=int, default=16_384, help="of one candidate")
    parser.add_argument("--num-envs", type=int, default=128)
    parser.add_argument("--episodes", type=int, default=100)
    parser.add_argument("--workers", type=int, default=1)
    parser.add_argument("--table", action="store_true", help="print the results so far and stop")
    args = parser.parse_args()
    args.out.mkdir(parents=True, exist_ok=True)
    if not args.table:
        with Jobs(workers=args.workers) as jobs:
            for seed in args.seeds:
                for task in args.tasks:
                    for method in args.methods:
                        if (task, method, seed) not in {_key(r) for r in results_in(args.out)}:
                            _one(task, method, seed, args, jobs)
    print(table(results_in(args.out)))


def _one(task: str, method: str, seed: int, args: argparse.Namespace, jobs: Jobs) -> None:
    bundle = load_benchmark(task)
    began = time.monotonic()
    found: dict[str, Any] = {}
    judge_seed = seed_for(seed, "method-judge", task)
    if method == "code_as_policy":
        successes = judge(bundle, ProgramPolicy(), args.episodes, judge_seed)
    else:
        cfg = RewardConfig(
            method=method,
            iterations=args.iterations,
            candidates=args.candidates,
            steps=args.steps,
            rungs=(0.5, 1.0),
            start=args.start,
            taught_rounds=TAUGHT_ROUNDS.get(task, 3),
            num_envs=args.num_envs,
            eval_worlds=48,
            evaluations=2,
            target_success=0.99,
            confirm_seeds=1,
        )
        out = args.out / f"{task}-{method}-{seed}"
        taught = args.out / f"{task}-v2p-{seed}" / TAUGHT_FOLDER
        if not (out / TAUGHT_FOLDER).exists() and (taught / DONE_FILE).is_file():
            shutil.copytree(taught, out / TAUGHT_FOLDER)  # all methods start from the same policy
        result = search_reward(
            bundle,
            cfg,
            out,
            seed=seed_for(seed, "reward-methods", task),
            how=How(workers=args.workers),
            jobs=jobs,
        )
        found = result.as_dict()
        successes = judge(
            bundle, StateActor(Expert.load(result.policy).act), args.episodes, judge_seed
        )
    row = {
        "task": task,
        "method": method,
        "seed": seed,
        "successes": successes,
        "episodes": args.episodes,
        "seconds": round(time.monotonic() - began, 1),
        "found": found,
    }
    append_result(args.out, row)
    print(json.dumps({k: v for k, v in row.items() if k != "found"}), flush=True)


def judge(bundle: TaskBundle, actor: Actor, episodes: int, seed: int) -> int:
    """Return how many fresh episodes the referee calls a success.

    Sources of randomness are those of recorded episodes.
    """
    sim = SimConfig(fine=True, randomization=ranges.recording())
    env = BatchEnv(bundle, sim, num_envs=episodes, seed=seed, num_threads=1)
    env.reset(np.arange(episodes))
    record = RefereeRecord(env)
    play(View(env), actor, [record.note])
    return int(record.verdict().sum())


def _key(result: dict[str, Any]) -> tuple[str, str, int]:
    return result["task"], result["method"], result["seed"]


def table(results: list[dict[str, Any]]) -> str:
    """Return one Markdown row per task and method: success over all seeds with its interval, and what it took."""
    groups: dict[tuple[str, str], list[dict[str, Any]]] = defaultdict(list)
    for result in results:
        groups[result["task"], result["method"]].append(result)
    tasks = list(dict.fromkeys(r["task"] for r in results))
    lines = [
        "| task | method | success (referee) | 95 % interval | per seed | training says | control steps | s per seed |",
        "|---|---|---|---|---|---|---|---|",
    ]
    for task in tasks:
        for method in METHODS:
            group = groups.get((task, method), [])
            if group:
                lines.append(_row(task, method, group))
    return "\n".join(lines)


def _row(task: str, method: str, group: list[dict[str, Any]]) -> str:
    rate = wilson(sum(r["successes"] for r in group), sum(r["episodes"] for r in group))
    seeds = " ".join(f"{r['successes'] / r['episodes']:.2f}" for r in group)
    found = [r["found"] for r in group if r["found"]]
    says = " ".join(f"{f['success']:.2f}" for f in found) or "-"
    steps = [f["trained_steps"] + f["evaluated_steps"] + f["taught_steps"] for f in found]
    taken = f"{np.mean(steps) / 1000:.0f} k" if steps else "0"
    seconds = np.mean([r["seconds"] for r in group])
    return (
        f"| {task} | {method} | {rate.value:.2f} | {rate.low:.2f}-{rate.high:.2f} | {seeds} | {says} | "
        f"{taken} | {seconds:.0f} |"
    )


if __name__ == "__main__":
    main()

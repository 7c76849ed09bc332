"""Compare what V2P, Eureka, RoboGen and Code-as-Policies come to, and V2P without one of its parts, offline: `docs/rewards_table.md`.

Every arm gets the same task, worlds, PPO recipe and control steps per candidate (`v2p_data/reward/methods.py` says in
what they differ), and its policies are judged by `v2p_data/task/referee.py`, which no training sees, on fresh episodes
at the fine time step. Candidates go on from a policy that a short imitation of a scripted program left half
taught; with `--start nothing` they start as in the paper, which takes a hundred times the steps. Results are
appended to a JSON-lines file: a stopped run goes on, `--table` prints what is there.

    python scripts/compare_reward_methods.py --out outputs/reward_methods

`--arms` takes parts of V2P away, as in the paper's tables 3 and 7; `docs/lab/reward_parts.md` has the command.
"""

import argparse
import json
import shutil
import time
from collections import defaultdict
from dataclasses import replace
from itertools import zip_longest
from pathlib import Path
from typing import Any, get_args

import numpy as np
from jaxtyping import Float
from matplotlib.figure import Figure

from policies.evaluation.rate import wilson
from policies.ppo.policy import Expert
from studies.programs import ProgramPolicy
from studies.results import append_result, mean_over_seeds, results_in
from v2p_data.play import Actor, StateActor, View, play
from v2p_data.reward.candidate import DONE_FILE, TRAIN_FOLDER, load_candidates
from v2p_data.reward.config import Part, RewardConfig
from v2p_data.reward.jobs import Jobs
from v2p_data.reward.methods import prepare
from v2p_data.reward.search import TAUGHT_FOLDER, How, search_reward, standings
from v2p_data.seeds import rng_for, seed_for
from v2p_data.sim.env import ranges
from v2p_data.sim.env.batch_env import BatchEnv, SimConfig
from v2p_data.sim.env.verdict import RefereeRecord
from v2p_data.task.benchmark import load_benchmark
from v2p_data.task.task import TaskBundle

METHODS = ("v2p", "eureka", "robogen", "code_as_policy")
PARTS = tuple(f"without_{part}" for part in get_args(Part))
FIRST_REWARDS = "first_rewards"
"""As many rewards as a search has in all, all of them first ones, as the paper's 16 samples without later rounds."""
ARMS = (*METHODS, *PARTS, FIRST_REWARDS)


def main() -> None:
    """Read the command line, search, judge, print the table."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").split("\n")[0])
    parser.add_argument("--out", type=Path, default=Path("outputs/reward_methods"))
    parser.add_argument("--tasks", nargs="*", default=["lift_up", "uncover", "throw_into"])
    parser.add_argument(
        "--taught-rounds", nargs="*", type=int, default=[2, 2, 8], help="of imitation, per task"
    )
    parser.add_argument("--arms", nargs="*", default=list(METHODS), choices=ARMS)
    parser.add_argument("--seeds", nargs="*", type=int, default=[0, 1, 2])
    parser.add_argument("--start", choices=["taught", "nothing"], default="taught")
    parser.add_argument("--iterations", type=int, default=2)
    parser.add_argument("--candidates", type=int, default=2)
    parser.add_argument("--steps", type=int, default=16_384, help="of one candidate")
    parser.add_argument("--rungs", nargs="*", type=float, default=[0.5, 1.0])
    parser.add_argument("--num-envs", type=int, default=128)
    parser.add_argument("--episodes", type=int, default=100)
    parser.add_argument("--workers", type=int, default=1)
    parser.add_argument("--table", action="store_true", help="print the results so far and stop")
    parser.add_argument("--figure", type=Path, help="draw success by round into this file")
    args = parser.parse_args()
    if len(args.tasks) != len(args.taught_rounds):
        parser.error(f"--taught-rounds takes a number for each of {', '.join(args.tasks)}")
    args.out.mkdir(parents=True, exist_ok=True)
    if not args.table:
        with Jobs(workers=args.workers) as jobs:
            for seed in args.seeds:
                for task, rounds in zip(args.tasks, args.taught_rounds, strict=True):
                    for arm in args.arms:
                        if (task, arm, seed) not in {_key(r) for r in results_in(args.out)}:
                            _one(task, rounds, arm, seed, args, jobs)
    results = results_in(args.out)
    if args.figure:
        draw_by_round([r for r in results if r["task"] in args.tasks], args.figure)
    print(table(results))


def _one(
    task: str, taught_rounds: int, arm: str, seed: int, args: argparse.Namespace, jobs: Jobs
) -> None:
    bundle = load_benchmark(task)
    began = time.monotonic()
    found: dict[str, Any] = {}
    judge_seed = seed_for(seed, "method-judge", task)
    if arm == "code_as_policy":
        by_round = [judge(bundle, ProgramPolicy(), args.episodes, judge_seed)]
    else:
        cfg = config_of(arm, taught_rounds, args)
        out = args.out / f"{task}-{arm}-{seed}"
        taught = args.out / f"{task}-v2p-{seed}" / TAUGHT_FOLDER
        search_seed = seed_for(seed, "reward-methods", task)
        is_taught = (out / TAUGHT_FOLDER).exists() or not (taught / DONE_FILE).is_file()
        if not is_taught and starts_from(taught, bundle, cfg, search_seed):
            shutil.copytree(taught, out / TAUGHT_FOLDER)  # all arms start from the same policy
        result = search_reward(
            bundle,
            cfg,
            out,
            seed=search_seed,
            how=How(jobs=jobs),
        )
        found = result.as_dict()
        policies = best_by_round(out, cfg)
        actors = {p: StateActor(Expert.load(p).act) for p in policies}
        judged = {p: judge(bundle, a, args.episodes, judge_seed) for p, a in actors.items()}
        by_round = [judged[p] for p in policies]
    row = {
        "task": task,
        "arm": arm,
        "seed": seed,
        "successes": by_round[-1],
        "by_round": by_round,
        "episodes": args.episodes,
        "seconds": round(time.monotonic() - began, 1),
        "found": found,
    }
    append_result(args.out, row)
    print(json.dumps({k: v for k, v in row.items() if k != "found"}), flush=True)


def config_of(arm: str, taught_rounds: int, args: argparse.Namespace) -> RewardConfig:
    """Return what an arm searches: the same for all but what it stands for."""
    cfg = RewardConfig(
        iterations=args.iterations,
        candidates=args.candidates,
        steps=args.steps,
        rungs=tuple(args.rungs),
        start=args.start,
        taught_rounds=taught_rounds,
        num_envs=args.num_envs,
        eval_worlds=48,
        evaluations=2,
        target_success=0.99,
        confirm_seeds=1,
    )
    if arm == FIRST_REWARDS:
        return replace(cfg, iterations=1, candidates=cfg.iterations * cfg.candidates)
    without = tuple(part for part in get_args(Part) if arm == f"without_{part}")
    return replace(cfg, without=without, method="v2p" if without else arm)


def starts_from(taught: Path, bundle: TaskBundle, cfg: RewardConfig, seed: int) -> bool:
    """Return whether an arm's code observes what a taught policy does; where not, the arm is taught its own start."""
    own = prepare(bundle, cfg, rng_for(seed, "first rewards")).bundle
    policy = Expert.load(taught / TRAIN_FOLDER)
    return BatchEnv(own, num_envs=1, seed=0, num_threads=1).obs_dim == policy.model.obs_dim


def best_by_round(out: Path, cfg: RewardConfig) -> list[Path]:
    """Return the policy of the best candidate so far after each round of a search."""
    candidates = load_candidates(out)
    rounds = range(1 + max(c.iteration for c in candidates))
    so_far = [standings([c for c in candidates if c.iteration <= k], cfg) for k in rounds]
    return [ordered[0].candidate.policy_folder() for ordered in so_far]


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
    return result["task"], result["arm"], result["seed"]


def table(results: list[dict[str, Any]]) -> str:
    """Return one Markdown row per task and arm: success over all seeds with its interval, by round, and what it took."""
    groups: dict[tuple[str, str], list[dict[str, Any]]] = defaultdict(list)
    for result in results:
        groups[result["task"], result["arm"]].append(result)
    lines = [
        "| task | arm | success (referee) | 95 % interval | per seed | after each round | training says | less than v2p, paired (95 %) | control steps | s per seed |",
        "|---|---|---|---|---|---|---|---|---|---|",
    ]
    for task in dict.fromkeys(r["task"] for r in results):
        whole = {r["seed"]: r["successes"] / r["episodes"] for r in groups[task, "v2p"]}
        lines += [_row(task, arm, group, whole) for arm in ARMS if (group := groups[task, arm])]
    return "\n".join(lines)


def _row(task: str, arm: str, group: list[dict[str, Any]], whole: dict[int, float]) -> str:
    rate = wilson(sum(r["successes"] for r in group), sum(r["episodes"] for r in group))
    rates = {r["seed"]: r["successes"] / r["episodes"] for r in group}
    by_round = " ".join(f"{m:.2f}" for m in rates_by_round(group).mean(1))
    found = [r["found"] for r in group if r["found"]]
    says = " ".join(f"{f['success']:.2f}" for f in found) or "-"
    less = "-"
    if arm != "v2p" and (pairs := whole.keys() & rates.keys()):
        less = "{} ({})".format(*mean_over_seeds(whole[s] - rates[s] for s in sorted(pairs)))
    steps = [f["trained_steps"] + f["evaluated_steps"] + f["taught_steps"] for f in found]
    taken = f"{np.mean(steps) / 1000:.0f} k" if steps else "0"
    seconds = np.mean([r["seconds"] for r in group])
    return (
        f"| {task} | {arm} | {rate.value:.2f} | {rate.low:.2f}-{rate.high:.2f} | "
        f"{' '.join(f'{r:.2f}' for r in rates.values())} | {by_round} | {says} | {less} | {taken} | {seconds:.0f} |"
    )


def rates_by_round(group: list[dict[str, Any]]) -> Float[np.ndarray, "round seed"]:
    """Return the success of the best policy so far after each round.

    A search that reached its target has no further rounds: its last policy stays the best so far.
    """
    rounds = zip_longest(*(r["by_round"] for r in group))
    return np.array(
        [
            [
                (r["successes"] if s is None else s) / r["episodes"]
                for r, s in zip(group, k, strict=True)
            ]
            for k in rounds
        ]
    )


def draw_by_round(results: list[dict[str, Any]], path: Path) -> None:
    """Draw success after each round, the mean over seeds as a line and each seed as a point; a panel per task."""
    tasks = list(dict.fromkeys(r["task"] for r in results))
    figure = Figure(figsize=(4.5 * len(tasks), 3.6), layout="constrained")
    for axes, task in zip(figure.subplots(1, len(tasks), squeeze=False)[0], tasks, strict=True):
        groups = {
            arm: [r for r in results if (r["task"], r["arm"]) == (task, arm)] for arm in ARMS
        }
        shown = [arm for arm in ARMS if groups[arm]]
        for at, arm in enumerate(shown):
            rates = rates_by_round(groups[arm])
            x = 1 + np.arange(len(rates)) + 0.03 * (at - (len(shown) - 1) / 2)
            axes.plot(
                x,
                rates.mean(1),
                "o-",
                color=f"C{ARMS.index(arm)}",
                label=f"{arm} ({rates.shape[1]})",
            )
            axes.plot(x, rates, ".", color=f"C{ARMS.index(arm)}", alpha=0.4)
        axes.set(title=task, xlabel="round", ylim=(0, 1), xticks=[1, 2, 3])
        axes.legend(fontsize="x-small", title="arm (seeds)", title_fontsize="x-small")
    figure.supylabel("success (referee)")
    path.parent.mkdir(parents=True, exist_ok=True)
    figure.savefig(path, metadata={"Date": None} if path.suffix == ".svg" else None)


if __name__ == "__main__":
    main()

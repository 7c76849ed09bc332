"""What successive halving costs, what it loses, and whether later rounds beat the first one at equal steps.

    python scripts/bench_reward_search.py --quick          # under a minute on an idle core; a mechanism, not a result
    python scripts/bench_reward_search.py --task lift_up   # five rounds of eight, as in the paper: hours
    python scripts/bench_reward_search.py --first-round --tasks lift_up uncover throw_into --seeds 0 1 2 3 4 --out outputs/rounds

First the search runs. Then every candidate that it stopped goes on from its checkpoint to the end, which is what training all
of them would have come to, step for step. The final policy of the search's choice and that of the best of all are
played on the same fresh episodes, which decided nothing. A candidate that has no result at all counts for neither.

Among the lines are `cost_share: X` (control steps, evaluations included, of the search and its confirmation over those of
all to the end), `cost_share_at_most: X` (what halving allows, however the candidates do), `success_lost_at_most: X` (what
the choice lacks to 100 %; with `--bound` the end, for nothing trains after the search) and, last, `success_lost: X`.

With `--first-round` every task and seed is searched, and the control steps of its later rounds, evaluations included, are
spent on the first round instead, in two ways: its best reward trains on from its checkpoint (`longer`), or the round has
more first rewards (`wider`). All final policies are judged by the referee on the same fresh episodes at the fine time
step. No target ends anything early. Each arm is a line of `results.jsonl` with its episodes' outcomes in order; what is
there is not done again, and a search that was stopped goes on. Last comes a table of paired differences over seeds.
"""

import json
import shutil
import tempfile
import time
from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import tyro

from policies.evaluation.rate import Rate, wilson
from policies.ppo.policy import Expert
from studies.results import Row, append_result, letters_of, mean_over_seeds, results_in
from v2p_data.episodes.collect import judge_expert
from v2p_data.episodes.rollouts import Lesson
from v2p_data.experts.teacher import try_out
from v2p_data.play import StateActor
from v2p_data.reward.candidate import (
    LAST_POLICY,
    TRAIN_FOLDER,
    Candidate,
    Training,
    load_candidates,
)
from v2p_data.reward.config import RewardConfig
from v2p_data.reward.jobs import REQUEST_FILE, Job, Jobs
from v2p_data.reward.search import Found, How, search_reward, standings
from v2p_data.seeds import seed_for
from v2p_data.sim.env.batch_env import BatchEnv
from v2p_data.task.benchmark import load_benchmark
from v2p_data.task.task import TaskBundle

QUICK = RewardConfig(
    iterations=2,
    candidates=3,
    steps=8_192,
    rungs=(0.25, 1.0),
    start="taught",
    taught_rounds=2,
    num_envs=128,
    eval_worlds=16,
    evaluations=2,
    confirm_seeds=1,
    target_success=1.01,
)
FULL = RewardConfig(iterations=5)
ARMS = ("search", "first", "longer", "wider")


@dataclass(frozen=True, kw_only=True)
class Settings:
    """What is measured."""

    task: str = "lift_up"
    """A benchmark task."""
    first_round: bool = False
    """Compare later rounds with more of the first one instead."""
    tasks: tuple[str, ...] = ("lift_up", "uncover", "throw_into")
    """Benchmark tasks of that comparison."""
    seeds: tuple[int, ...] = (0, 1, 2, 3, 4)
    """Of that comparison."""
    quick: bool = False
    """Two rounds of three and few steps."""
    iterations: int | None = None
    candidates: int | None = None
    steps: int | None = None
    """Of one candidate."""
    start: str | None = None
    """`nothing` or `taught`, see `RewardConfig.start`."""
    taught_rounds: int | None = None
    confirm_seeds: int | None = None
    target_success: float | None = None
    """Above 1, no round ends early: all rounds take place."""
    seed: int = 0
    workers: int = 1
    episodes: int = 128
    """Fresh ones, per policy."""
    bound: bool = False
    """Train nothing after the search: what it lost is then only bounded, by what its choice lacks to 100 %."""
    out: Path | None = None
    """Folder of the search or of the comparison, to go on with it later; by default a temporary one."""


def main() -> None:
    """Search, train all to the end, compare."""
    settings = tyro.cli(Settings, description=(__doc__ or "").split("\n")[0])
    given = {
        name: value
        for name in (
            "iterations",
            "candidates",
            "steps",
            "start",
            "taught_rounds",
            "confirm_seeds",
            "target_success",
        )
        if (value := getattr(settings, name)) is not None
    }
    cfg = replace(QUICK if settings.quick else FULL, **given)
    with (
        tempfile.TemporaryDirectory(prefix="v2p-bench-") as folder,
        Jobs(workers=settings.workers) as jobs,
    ):
        out = settings.out or Path(folder)
        if settings.first_round:
            cfg = replace(cfg, target_success=2.0, confirm_seeds=1)
            for task in settings.tasks:
                for seed in settings.seeds:
                    for row in compare_rounds(
                        load_benchmark(task), cfg, out, jobs, settings, seed
                    ):
                        print(json.dumps(row), flush=True)
            print(differences(results_in(out)))
            return
        bundle = load_benchmark(settings.task)
        for line in measure(bundle, cfg, out, jobs, settings):
            print(line, flush=True)


def measure(
    bundle: TaskBundle, cfg: RewardConfig, out: Path, jobs: Jobs, settings: Settings
) -> Iterator[str]:
    """Yield the comparison, line by line."""
    seed = settings.seed
    found = search_reward(bundle, cfg, out, seed=seed, how=How(jobs=jobs))
    yield json.dumps({k: v for k, v in found.as_dict().items() if k != "per_seed"})
    worlds = BatchEnv(
        bundle,
        num_envs=settings.episodes,
        seed=seed_for(seed, "bench reward search"),
        num_threads=1,
    )
    candidates = load_candidates(out)
    chosen = next(c for c in candidates if c.number == found.chosen)
    rate = _rate(worlds, chosen)
    yield f"search chose {chosen.number}: {rate} on fresh episodes"
    yield f"cost_share: {found.cost_share:.3f}"
    yield f"cost_share_at_most: {cfg.steps_at_most() / cfg.steps_without_halving():.3f}"
    yield f"success_lost_at_most: {1 - rate.value:.3f}"
    if settings.bound:
        return
    stopped = [c for c in candidates if c.training().fault is None]
    jobs.run([_to_the_end(c, cfg.marks[-1]) for c in stopped])
    ended = [c for c in stopped if c.training().fault is None]
    best = max(ended, key=lambda c: (c.training().rank(cfg.evaluations), -c.number))
    for c in ended:
        success = c.training().success(cfg.evaluations)
        yield f"candidate {c.number:2d}, round {c.iteration + 1}, {c.origin}: {success:.2f} at the end"
    best_rate = _rate(worlds, best)
    yield f"best of all at the end {best.number}: {best_rate} on fresh episodes"
    yield f"success_lost: {best_rate.value - rate.value:.3f}"


# --- later rounds against the first one ----------------------------------------------------------------------------


def compare_rounds(
    bundle: TaskBundle,
    cfg: RewardConfig,
    out: Path,
    jobs: Jobs,
    settings: Settings,
    seed: int,
) -> Iterator[Row]:
    """Yield the lines of one task and seed that are not in `out` yet, and write them there."""
    out.mkdir(parents=True, exist_ok=True)
    there = {r["arm"] for r in results_in(out) if (r["task"], r["seed"]) == (bundle.title, seed)}
    if there >= set(ARMS):
        return
    place, how = out / f"{bundle.title}-{seed}", How(jobs=jobs)
    began = time.monotonic()
    found = search_reward(bundle, cfg, place / "search", seed=seed, how=how)
    steps = _spent(found)
    first = [c for c in load_candidates(place / "search") if c.iteration == 0]
    best = standings(first, cfg)[0].candidate
    first_steps = sum(_steps_of(c.training(), cfg) for c in first)
    policies: dict[str, tuple[Path, int]] = {
        "search": (found.policy, steps),
        "first": (best.policy_folder(), first_steps),
    }
    for arm in ARMS:
        if arm in there:
            continue
        if arm == "longer":
            more = (steps - first_steps) // _steps_per_mark(bundle, cfg)
            longer = _trained_on(best, more, place / "longer", jobs)
            spent = first_steps + _steps_of(longer, cfg) - _steps_of(best.training(), cfg)
            policies[arm] = (longer.folder / TRAIN_FOLDER / LAST_POLICY, spent)
        if arm == "wider":
            wider = _as_wide_as(cfg, steps, bundle)
            made = search_reward(bundle, wider, place / "wider", seed=seed, how=how)
            policies[arm] = (made.policy, _spent(made))
        policy, spent = policies[arm]
        judged = judge_expert(
            Lesson(bundle=bundle, expert=StateActor(Expert.load(policy).act)),
            episodes=settings.episodes,
            seed=seed_for(seed, "later rounds", bundle.title),
        )
        row: Row = {
            "task": bundle.title,
            "seed": seed,
            "arm": arm,
            "success": float(judged.successes.mean()),
            "episodes": letters_of(judged.successes),
            "control_steps": spent,
            "origin": found.origin if arm == "search" else "",
            "chosen_round": _round_of(found, place / "search") if arm == "search" else 0,
            "seconds": round(time.monotonic() - began, 1),
        }
        began = time.monotonic()
        append_result(out, row)
        yield row


def differences(rows: list[Row]) -> str:
    """Return per task and arm how much more the search succeeds: mean over seeds with its 95 % t-interval."""
    lines = ["| task | search minus | seeds | mean difference | 95 % interval | steps of the arm / search |", "|---|---|---|---|---|---|"]  # fmt: skip
    by_arm = {(r["task"], r["seed"], r["arm"]): r for r in rows}
    for task in dict.fromkeys(r["task"] for r in rows):
        for arm in ARMS[1:]:
            seeds = sorted(
                s for t, s, a in by_arm if (t, a) == (task, arm) and (task, s, "search") in by_arm
            )
            pairs = [(by_arm[task, s, "search"], by_arm[task, s, arm]) for s in seeds]
            apart = [a["success"] - b["success"] for a, b in pairs]
            cost = np.mean([b["control_steps"] / a["control_steps"] for a, b in pairs])
            mean, interval = mean_over_seeds(apart)
            lines.append(f"| {task} | {arm} | {len(apart)} | {mean} | {interval} | {cost:.2f} |")
    return "\n".join(lines)


def _spent(found: Found) -> int:
    return found.trained_steps + found.evaluated_steps


def _steps_of(training: Training, cfg: RewardConfig) -> int:
    per_mark = round(cfg.steps * cfg.rungs[0])
    return sum(per_mark + e.control_steps for e in training.evaluations)


def _steps_per_mark(bundle: TaskBundle, cfg: RewardConfig) -> int:
    return round(cfg.steps * cfg.rungs[0]) + cfg.eval_worlds * bundle.horizon_steps


def _trained_on(best: Candidate, more: int, place: Path, jobs: Jobs) -> Training:
    """Return a copy of a candidate's training after so many more evaluations' worth of steps."""
    if not place.is_dir():
        shutil.copytree(best.training_folder(), place.with_suffix(".partial"), dirs_exist_ok=True)
        place.with_suffix(".partial").rename(place)
    mark = best.training().done + more
    jobs.run([Job(folder=place, mark=mark, request=_request(best))])
    return Training.load(place)


def _as_wide_as(cfg: RewardConfig, steps: int, bundle: TaskBundle) -> RewardConfig:
    """Return one round of as many rewards as take at most so many control steps, evaluations included."""
    share = _steps_per_mark(bundle, cfg) / round(cfg.steps * cfg.rungs[0])
    wide = replace(cfg, iterations=1)
    while replace(wide, candidates=wide.candidates + 1).steps_at_most() * share <= steps:
        wide = replace(wide, candidates=wide.candidates + 1)
    return wide


def _round_of(found: Found, search: Path) -> int:
    return next(c.iteration for c in load_candidates(search) if c.number == found.chosen)


# --- halving ---------------------------------------------------------------------------------------------------


def _to_the_end(candidate: Candidate, mark: int) -> Job:
    return Job(folder=candidate.training_folder(), mark=mark, request=_request(candidate))


def _request(candidate: Candidate) -> dict[str, Any]:
    return json.loads((candidate.training_folder() / REQUEST_FILE).read_text())


def _rate(worlds: BatchEnv, candidate: Candidate) -> Rate:
    worlds.seed(0)
    at_end = try_out(worlds, StateActor(Expert.load(candidate.policy_folder()).act)).at_end
    return wilson(int(at_end.sum()), len(at_end))


if __name__ == "__main__":
    main()

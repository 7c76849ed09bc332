"""What successive halving costs, and what it loses: the same rewards, raced against each other and all trained to the end.

    python scripts/bench_reward_search.py --quick          # under a minute on an idle core; a mechanism, not a result
    python scripts/bench_reward_search.py --task lift_up   # five rounds of eight, as in the paper: hours

First the search runs. Then every candidate that it stopped goes on from its checkpoint to the end, which is what training all
of them would have come to, step for step. The final policy of the search's choice and that of the best of all are
played on the same fresh episodes, which decided nothing. A candidate that has no result at all counts for neither.

Among the lines are `cost_share: X` (control steps, evaluations included, of the search and its confirmation over those of
all to the end), `cost_share_at_most: X` (what halving allows, however the candidates do), `success_lost_at_most: X` (what
the choice lacks to 100 %; with `--bound` the end, for nothing trains after the search) and, last, `success_lost: X`.
"""

import json
import tempfile
from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path

import tyro

from policies.evaluation.rate import Rate, wilson
from policies.ppo.policy import Expert
from v2p_data.experts.teacher import play
from v2p_data.reward.candidate import Candidate, load_candidates
from v2p_data.reward.config import RewardConfig
from v2p_data.reward.jobs import REQUEST_FILE, Job, Jobs
from v2p_data.reward.search import How, search_reward
from v2p_data.seeds import seed_for
from v2p_data.sim.batch_env import BatchEnv
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


@dataclass(frozen=True, kw_only=True)
class Settings:
    """What is measured."""

    task: str = "lift_up"
    """A benchmark task."""
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
    """Folder of the search, to go on with it later; by default a temporary one."""


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
    bundle = load_benchmark(settings.task)
    with (
        tempfile.TemporaryDirectory(prefix="v2p-bench-") as folder,
        Jobs(workers=settings.workers) as jobs,
    ):
        out = settings.out or Path(folder)
        for line in measure(bundle, cfg, out, jobs, settings):
            print(line, flush=True)


def measure(
    bundle: TaskBundle, cfg: RewardConfig, out: Path, jobs: Jobs, settings: Settings
) -> Iterator[str]:
    """Yield the comparison, line by line."""
    seed = settings.seed
    found = search_reward(bundle, cfg, out, seed=seed, how=How(workers=jobs.workers), jobs=jobs)
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


def _to_the_end(candidate: Candidate, mark: int) -> Job:
    folder = candidate.training_folder()
    return Job(folder=folder, mark=mark, request=json.loads((folder / REQUEST_FILE).read_text()))


def _rate(worlds: BatchEnv, candidate: Candidate) -> Rate:
    worlds.seed(0)
    at_end = play(worlds, Expert.load(candidate.policy_folder()).act).at_end
    return wilson(int(at_end.sum()), len(at_end))


if __name__ == "__main__":
    main()

"""What a step of success should earn: PPO from nothing with several ratios of its bonus to a full reward, at equal steps.

    python scripts/bench_bonus_ratio.py --tasks lift_up push_left --seeds 0 1 2 --out outputs/bonus_ratio

One JSON line per training, appended to results.jsonl: lines that are there are not trained again. The ratios take turns within a seed.
Nothing stops a training early; the policy at its end is judged by the referee on fresh episodes, the same for all ratios.
"""

import csv
import json
import tempfile
import time
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import tyro

from policies.ppo.policy import Expert
from policies.ppo.train import train_expert
from studies.results import append_result, commit, results_in
from v2p_data.episodes.collect import judge_expert
from v2p_data.episodes.rollouts import Lesson
from v2p_data.play import StateActor
from v2p_data.reward.candidate import LAST_POLICY
from v2p_data.reward.worker import ppo_config
from v2p_data.seeds import seed_for
from v2p_data.sim.env.batch_env import BatchEnv, SimConfig
from v2p_data.sim.wrappers.torchrl_env import TorchRLEnv
from v2p_data.task.benchmark import load_benchmark


@dataclass(frozen=True, kw_only=True)
class Settings:
    """What is measured."""

    tasks: tuple[str, ...] = ("lift_up", "push_left")
    """Benchmark tasks."""
    ratios: tuple[float, ...] = (1.0, 10.0, 100.0)
    """Of the bonus for a step of success to a full reward."""
    seeds: tuple[int, ...] = (0, 1, 2)
    steps: int = 400_000
    """Control steps of each training."""
    num_envs: int = 256
    episodes: int = 64
    """That judge each policy."""
    out: Path = Path("outputs/bonus_ratio")
    """Folder of the lines."""


def main() -> None:
    """Train what has no line yet."""
    settings = tyro.cli(Settings, description=(__doc__ or "").split("\n")[0])
    settings.out.mkdir(parents=True, exist_ok=True)
    done = {(r["task"], r["ratio"], r["seed"]) for r in results_in(settings.out)}
    for task in settings.tasks:
        for seed in settings.seeds:
            for ratio in settings.ratios:
                if (task, ratio, seed) not in done:
                    row = measured(task, ratio, seed, settings)
                    append_result(settings.out, row)
                    print(json.dumps(row), flush=True)


def measured(task: str, ratio: float, seed: int, settings: Settings) -> dict[str, object]:
    """Return one training's line: success in its course and at its end."""
    bundle = load_benchmark(task)
    env = BatchEnv(
        bundle,
        SimConfig(bonus_ratio=ratio),
        num_envs=settings.num_envs,
        seed=seed_for(seed, "bonus ratio", task),
    )
    with tempfile.TemporaryDirectory(prefix="v2p-bonus-") as place:
        folder, cpu = Path(place), time.process_time()
        train_expert(
            TorchRLEnv(env),
            ppo_config(settings.num_envs, settings.steps),
            folder,
            seed=seed_for(seed, "bonus ratio training") % 2**63,
            draws=False,
        )
        cpu = time.process_time() - cpu
        actor = StateActor(Expert.load(folder / LAST_POLICY).act)
        judged = judge_expert(
            Lesson(bundle=bundle, expert=actor),
            episodes=settings.episodes,
            seed=seed_for(seed, "bonus ratio judge", task),
        )
        with (folder / "curve.csv").open(newline="") as stream:
            rows = list(csv.DictReader(stream))
    curve = [(int(r["steps"]), float(r["success_deterministic"] or "nan")) for r in rows]
    known = [s for _, s in curve if np.isfinite(s)]
    return {
        "task": task,
        "ratio": ratio,
        "seed": seed,
        "steps": curve[-1][0],
        "episodes": settings.episodes,
        "successes": int(judged.successes.sum()),
        "task_successes": int(judged.task_successes.sum()),
        "mean_success_in_training": round(sum(known) / len(curve), 4),
        "steps_to_half": next((n for n, s in curve if s >= 0.5), None),
        "cpu_seconds": round(cpu, 1),
        "commit": commit(),
    }


if __name__ == "__main__":
    main()

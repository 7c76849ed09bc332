"""Measure what choosing among eight task codes gains: the table of `docs/lab/pick.md`.

    python scripts/bench_pick.py --out outputs/pick.jsonl

In each benchmark task scripted programs play at the fine time step: those that are meant and those that are not, with
action noise of several strengths that ends a second before the episode does, some of them stopped half-way, and a robot
that does nothing. The states are kept, and all eight success functions are asked about the same states: is success
held at the end? The independent referee, which no audit sees, says what is right. Balanced accuracy is the mean of the
shares of the referee's successes and of its failures on which a success function agrees.
"""

import argparse
import json
import time
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
from jaxtyping import Bool

from v2p_data.experts.teacher import Teacher
from v2p_data.kinds import KINDS
from v2p_data.seeds import rng_for, seed_for
from v2p_data.sim.env import task_code
from v2p_data.sim.env.batch_env import BatchEnv, SimConfig
from v2p_data.sim.env.task_code import HELD_STEPS
from v2p_data.sim.env.verdict import RefereeRecord
from v2p_data.task.benchmark import benchmark_names, load_benchmark
from v2p_data.task.generate import TaskConfig, generate_task
from v2p_data.task.sandbox.sandbox import class_name

NOISES = (0.0, 0.3, 0.6, 1.0)
"""Standard deviations of the noise on actions in [-1, 1]."""
IDLE_SHARE, STOPPED_SHARE, MEANT_SHARE = 0.1, 0.3, 0.5
"""Of the worlds: nobody acts; the robot stops half-way; the program is the one that the task's words mean."""
QUIET_STEPS = 20
"""Control steps (1 s) without noise at the end, so that stillness alone does not decide."""
Moments = list[dict[str, torch.Tensor]]


def main() -> None:
    """Read the command line, play, judge, print the table."""
    parser = argparse.ArgumentParser(description=str(__doc__).split("\n")[0])
    parser.add_argument("--out", type=Path, default=Path("outputs/pick.jsonl"))
    parser.add_argument("--tasks", nargs="*", default=benchmark_names())
    parser.add_argument("--episodes", type=int, default=160, help="per task")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--threads", type=int, default=1)
    args = parser.parse_args()
    args.out.parent.mkdir(parents=True, exist_ok=True)
    rows = []
    with args.out.open("w") as stream:
        for name in args.tasks:
            rows.append(measured(name, args.episodes, args.seed, args.threads))
            stream.write(json.dumps(rows[-1]) + "\n")
            stream.flush()
    print(table(rows))


def measured(name: str, episodes: int, seed: int, threads: int) -> dict[str, Any]:
    """Return how well each of a task's eight success functions agrees with the referee."""
    start = time.process_time()
    bundle = load_benchmark(name)
    made = generate_task(bundle.scene, TaskConfig(), seed_for(seed, "task", name))
    env = BatchEnv(
        bundle,
        SimConfig(fine=True),
        num_envs=episodes,
        seed=seed_for(seed, "bench_pick", name),
        num_threads=threads,
    )
    last, right = _played(env, rng_for(seed, "bench_pick", "noise", name))
    agreements = []
    for sample in made.samples:
        said = held(env, sample.code, last)
        if said is None:
            raise SystemExit(f"error: sample {len(agreements)} of {name} does not run")
        agreements.append(
            {
                "balanced": balanced_accuracy(said, right),
                "missed": float(np.mean(~said[right])) if right.any() else None,
                "wrongly_true": float(np.mean(said[~right])) if not right.all() else None,
                "score": sample.score,
                "acceptable": sample.audit.is_acceptable,
                "vetoed": sample.audit.vetoed,
            }
        )
    each = [a["balanced"] for a in agreements]
    return {
        "task": name,
        "episodes": episodes,
        "seed": seed,
        "referee_successes": int(right.sum()),
        "picked": made.picked,
        "balanced_picked": each[made.picked],
        "balanced_first": each[0],
        "balanced_mean": float(np.mean(each)),
        "balanced_best": max(each),
        "samples": agreements,
        "cpu_seconds": round(time.process_time() - start, 1),
    }


def _played(env: BatchEnv, rng: np.random.Generator) -> tuple[Moments, Bool[np.ndarray, "env"]]:
    """Play one episode in every world; return the last moments, and what the referee says."""
    n, horizon = env.num_envs, env.horizon
    teacher, referee = Teacher(env), RefereeRecord(env)
    names = list(teacher.programs)
    meant = [k for k, name in enumerate(names) if name.startswith(KINDS[env.bundle.kind].programs)]
    program = np.where(
        rng.random(n) < MEANT_SHARE, rng.choice(meant, n), rng.integers(len(names), size=n)
    )
    noise = rng.choice(NOISES, n)
    is_idle = rng.random(n) < IDLE_SHARE
    stop = np.where(rng.random(n) < STOPPED_SHARE, rng.uniform(0.3, 1.0, n), np.inf) * horizon
    stop = np.where(is_idle, -1, stop)
    env.reset(np.arange(n))
    referee.restart()
    last: Moments = []
    for step in range(horizon):
        moment = teacher.moment()
        wanted = np.stack([act(moment) for act in teacher.programs.values()])
        action = wanted[program, np.arange(n)]
        if step < horizon - QUIET_STEPS:
            action = action + noise[:, None] * rng.normal(size=action.shape)
        action[step > stop] = 0.0
        env.step(action)
        referee.note()
        if step >= horizon - HELD_STEPS:
            last.append({key: value.clone() for key, value in env.states().items()})
    return last, referee.verdict()


def held(env: BatchEnv, code: str, last: Moments) -> Bool[np.ndarray, "env"] | None:
    """Return where a code's success is true at all of the last moments, None where it does not run."""
    try:
        task = task_code.load(
            replace(env.bundle, code=code, class_name=class_name(code)), env, None
        )
        answers = [
            task.succeeds(lambda moment=moment: {k: v.clone() for k, v in moment.items()})
            for moment in last
        ]
    except Exception:  # noqa: BLE001 - whatever the code raises, it does not run
        return None
    return torch.stack(answers).all(dim=0).numpy()


def balanced_accuracy(said: Bool[np.ndarray, "env"], right: Bool[np.ndarray, "env"]) -> float:
    """Return the mean of the shares of true and of false cases that are told right; of one kind, where there is one only."""
    shares = [
        np.mean(said[right == value] == value) for value in (True, False) if (right == value).any()
    ]
    return float(np.mean(shares))


def table(rows: list[dict[str, Any]]) -> str:
    """Return the results as Markdown."""
    lines = [
        "| task | referee's successes | picked | sample 0 | mean of 8 | best | pick | refused |",
        "|---|---|---|---|---|---|---|---|",
    ]
    for row in rows:
        refused = [str(k) for k, s in enumerate(row["samples"]) if not s["acceptable"]]
        lines.append(
            f"| {row['task']} | {row['referee_successes']} of {row['episodes']} | {row['balanced_picked']:.3f}"
            f" | {row['balanced_first']:.3f} | {row['balanced_mean']:.3f} | {row['balanced_best']:.3f}"
            f" | {row['picked']} | {', '.join(refused)} |"
        )
    means = [
        float(np.mean([r[f"balanced_{what}"] for r in rows])) for what in ("picked", "first", "mean", "best")
    ]  # fmt: skip
    lines.append("| **mean** | | " + " | ".join(f"{m:.3f}" for m in means) + " | | |")
    return "\n".join(lines)


if __name__ == "__main__":
    main()

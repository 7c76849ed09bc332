"""Success functions against the referee: the paper's figure 10 and table 8 on our terms. `docs/lab/success.md` has the results.

    python scripts/study_success.py --out outputs/success.jsonl
    python scripts/study_success.py --out outputs/success.jsonl --table --figure outputs/success.png

*Figure 10.* In each benchmark task ten policies of spread ability play 100 episodes each at the fine time step: the task's own
program with action noise of eight strengths, another program, and a robot that does nothing. The last moments are kept, and
every success function is asked about the same ones. A point is a policy in a task: the referee's rate and the function's. Writers
are templates that see all that the video says, that do not see how things moved, and that see the caption alone.

*Table 8.* A writer that makes faults (`studies/faults.py`) writes eight codes: a quarter does not run, three in twenty run and
are wrong. A code is a hallucination if it does not run, or if its balanced accuracy on the episodes above is 0.05 below that
of the same code without the fault. The share is given of all codes, of the first that runs, and of what the audit picks.
"""

import argparse
import json
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Bool

from studies.blind_faults import WRONG_BLIND
from studies.faults import NOT_RUNNABLE, WRONG, with_fault
from studies.success_functions import Moments, balanced_accuracy, held, play_programs
from v2p_data.errors import ItemRejectedError
from v2p_data.experts.teacher import Teacher
from v2p_data.kinds import KINDS
from v2p_data.pipeline.artifact import provenance
from v2p_data.reward.config import Part, RewardConfig
from v2p_data.reward.methods import what_the_writer_sees
from v2p_data.seeds import rng_for, seed_for
from v2p_data.sim.env.batch_env import BatchEnv, SimConfig
from v2p_data.task.benchmark import benchmark_names, load_benchmark
from v2p_data.task.generate import TaskConfig, generate_task
from v2p_data.task.templates.write import write_samples

NOISES = (0.0, 0.15, 0.3, 0.45, 0.6, 0.8, 1.0, 1.3)
"""Standard deviations of the noise on actions in [-1, 1], a policy each."""
WRITERS: dict[str, tuple[Part, ...]] = {"video": (), "no tracking": ("tracking",), "caption only": ("visual", "tracking")}  # fmt: skip
FAULT_SHARES = (0.25, 0.15)
"""Of codes that do not run, and that run and are wrong: the paper's first answers (table 8)."""
WORSE = 0.05
OPERATORS = {"ours": WRONG, "blind": WRONG_BLIND}


def main() -> None:
    """Read the command line, measure what is missing, show what is there."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").split("\n")[0])
    parser.add_argument("--out", type=Path, default=Path("outputs/success.jsonl"))
    parser.add_argument("--tasks", nargs="*", default=benchmark_names())
    parser.add_argument("--seeds", nargs="*", type=int, default=[0, 1, 2, 3, 4], help="of table 8")
    parser.add_argument("--episodes", type=int, default=100, help="of each policy")
    parser.add_argument("--table", action="store_true", help="show what is there and stop")
    parser.add_argument("--figure", type=Path)
    args = parser.parse_args()
    args.out.parent.mkdir(parents=True, exist_ok=True)
    rows = [json.loads(line) for line in args.out.read_text().splitlines()] if args.out.is_file() else []  # fmt: skip
    for name in () if args.table else args.tasks:
        if all(row["task"] != name for row in rows):
            rows.append(measured(name, args.episodes, args.seeds))
            with args.out.open("a") as stream:
                stream.write(json.dumps(rows[-1]) + "\n")
    print(table(rows))
    if args.figure:
        write_figure(rows, args.figure)


def measured(name: str, episodes: int, seeds: list[int]) -> dict[str, Any]:
    """Return both experiments' results of one task."""
    bundle = load_benchmark(name)
    count = len(NOISES) + 2
    env = BatchEnv(bundle, SimConfig(fine=True), num_envs=count * episodes, seed=seed_for(0, "study_success", name), num_threads=1)  # fmt: skip
    last, right = _played(env, episodes, rng_for(0, "study_success", "noise", name))
    points: dict[str, Any] = {}
    for writer, hidden in WRITERS.items():
        seen = what_the_writer_sees(bundle.scene, RewardConfig(without=hidden))
        said = held(env, write_samples(seen, 1)[0], last)
        points[writer] = None if said is None else _rates(said, count)
    picked = generate_task(bundle.scene, TaskConfig(), seed_for(0, "task", name))
    said = held(env, picked.bundle.code, last)
    assert said is not None
    points["video, picked of eight"] = _rates(said, count)
    return {
        "task": name,
        "episodes": episodes,
        "referee": _rates(right, count),
        "functions": points,
        "picks": [
            {"seed": seed, "operators": which, **pick(env, last, right, seed, which)}
            for which in OPERATORS
            for seed in seeds
        ],
        "commit": provenance()["commit"][:12],
    }


def _played(
    env: BatchEnv, episodes: int, rng: np.random.Generator
) -> tuple[Moments, Bool[np.ndarray, "env"]]:
    names = list(Teacher(env).programs)
    meant = [k for k, name in enumerate(names) if name.startswith(KINDS[env.bundle.kind].programs)]
    others = [k for k in range(len(names)) if k not in meant] or meant
    which = np.repeat(np.arange(len(NOISES) + 2), episodes)
    is_other, is_idle = which == len(NOISES), which == len(NOISES) + 1
    program = np.where(is_other, rng.choice(others, len(which)), meant[0])
    noise = np.append(NOISES, (0.0, 0.0))[which]
    return play_programs(env, program, noise, np.where(is_idle, -1.0, np.inf), rng)


def _rates(said: Bool[np.ndarray, "env"], policies: int) -> list[float]:
    return said.reshape(policies, -1).mean(1).round(4).tolist()


def pick(
    env: BatchEnv, last: Moments, right: Bool[np.ndarray, "env"], seed: int, operators: str
) -> dict[str, Any]:
    """Return which of eight codes with faults are hallucinations, and which of them are picked."""
    scene = env.bundle.scene
    rng = rng_for(seed, "study_success", "faults", operators, env.bundle.title)
    sources, faults = [], []
    for code in write_samples(scene, TaskConfig().num_samples):
        kind = rng.choice(3, p=[*FAULT_SHARES, 1 - sum(FAULT_SHARES)])
        made = None if kind == 2 else with_fault(code, (NOT_RUNNABLE, OPERATORS[operators])[kind], rng)  # fmt: skip
        text, fault = made or (code, "")
        said, meant = held(env, text, last), held(env, code, last)
        assert meant is not None
        loss = 1.0 if said is None else balanced_accuracy(meant, right) - balanced_accuracy(said, right)  # fmt: skip
        sources.append(text)
        faults.append({"fault": fault, "runs": said is not None, "loss": round(loss, 4)})
    try:
        made = generate_task(scene, TaskConfig(), seed_for(seed, "task", scene.title), sources=sources)  # fmt: skip
    except ItemRejectedError:
        return {"codes": faults, "picked": None}
    return {
        "codes": [f | {"acceptable": s.audit.is_acceptable} for f, s in zip(faults, made.samples, strict=True)],
        "picked": made.picked,
    }  # fmt: skip


def is_hallucination(code: dict[str, Any]) -> bool:
    return code["loss"] > WORSE


def table(rows: list[dict[str, Any]]) -> str:
    """Return both tables as Markdown."""
    lines = [
        "| writer | points | Pearson (95 %) | mean of function - referee |",
        "|---|---|---|---|",
    ]
    for writer in [*WRITERS, "video, picked of eight"]:
        pairs = [(row["referee"], row["functions"][writer]) for row in rows]
        x, y = (np.concatenate([p[k] for p in pairs if p[1] is not None]) for k in (0, 1))
        low, high = pearson_interval(pairs)
        lines.append(f"| {writer} | {len(x)} | {np.corrcoef(x, y)[0, 1]:.2f} ({low:.2f}-{high:.2f}) | {np.mean(y - x):+.3f} |")  # fmt: skip
    lines += ["", "| operators | codes | hallucinations | the first that runs | the audit's pick | nothing picked |", "|---|---|---|---|---|---|"]  # fmt: skip
    for which in OPERATORS:
        picks = [p for row in rows for p in row["picks"] if p["operators"] == which]
        codes = [c for p in picks for c in p["codes"]]
        first = [next((c for c in p["codes"] if c["runs"]), None) for p in picks]
        chosen = [p["codes"][p["picked"]] for p in picks if p["picked"] is not None]
        shares = [f"{sum(map(is_hallucination, some))} of {len(some)}" for some in (codes, [c for c in first if c], chosen)]  # fmt: skip
        lines.append(f"| {which} | {len(codes)} | {' | '.join(shares)} | {len(picks) - len(chosen)} of {len(picks)} |")  # fmt: skip
    return "\n".join(lines)


def pearson_interval(pairs: list[tuple[Any, Any]]) -> tuple[float, float]:
    """Return the 95 % interval of the coefficient when tasks are drawn anew with replacement."""
    rng, known = rng_for(0, "study_success", "bootstrap"), [p for p in pairs if p[1] is not None]
    drawn = []
    for _ in range(2000):
        some = [known[k] for k in rng.integers(len(known), size=len(known))]
        x, y = (np.concatenate([p[k] for p in some]) for k in (0, 1))
        drawn.append(np.corrcoef(x, y)[0, 1])
    low, high = np.nanpercentile(drawn, [2.5, 97.5])
    return float(low), float(high)


def write_figure(rows: list[dict[str, Any]], path: Path) -> None:
    """Draw each writer's rates over the referee's."""
    import matplotlib.pyplot as plt

    figure, axes = plt.subplots(1, len(WRITERS), figsize=(12, 4), sharey=True, layout="constrained")  # fmt: skip
    for axis, writer in zip(axes, WRITERS, strict=True):
        for row in rows:
            if row["functions"][writer] is not None:
                axis.plot(row["referee"], row["functions"][writer], "o", ms=4, label=row["task"])
        axis.plot([0, 1], [0, 1], color="grey", lw=0.8)
        axis.set(title=writer, xlabel="success by the referee")
    axes[0].set_ylabel("success by the written function")
    axes[-1].legend(fontsize=7, loc="upper left", bbox_to_anchor=(1.02, 1))
    figure.savefig(path, dpi=110)


if __name__ == "__main__":
    main()

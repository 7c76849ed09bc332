"""What a policy's success depends on, at equal training time: the tables of `docs/policies.md`.

From a finished run (`make demo`), each variant learns some of its tasks in the same seconds of training on one core,
distillation included, and is judged by the referee on fresh episodes. Results are appended to a JSON-lines file, so
that a stopped study goes on where it was; `--table` prints what is there.

    python scripts/study_policy.py --run outputs/demo --tasks lift_red_box --variants small
    no_distillation --seeds 0 1 2
"""

import argparse
import json
import logging
import os
import time
from collections import defaultdict
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import torch

from policies.bc.configuration_v2p_bc import V2PBCConfig
from policies.bc.frames import FrameTable
from policies.bc.student import DatasetPlace, Student
from policies.bc.trainer import TrainerConfig
from policies.evaluation.rate import wilson
from policies.ppo.policy import Expert
from studies.results import append_result, results_in
from v2p_data.distillation.config import DistillationConfig
from v2p_data.distillation.rounds import Course, distill
from v2p_data.episodes.rollouts import Lesson
from v2p_data.evaluation.batch import judge
from v2p_data.evaluation.config import EvaluationConfig
from v2p_data.pipeline.artifact import read_record
from v2p_data.play import StateActor, VisionActor
from v2p_data.policy.training import ACTION_LIMIT, recorded_under, sources_of
from v2p_data.seeds import seed_for
from v2p_data.task.task import TaskBundle

SHARES = (0.15, 0.2)
"""Of the training time: before the first round, before each further one; the rest is the last training."""
CALIBRATION_STEPS = 10


@dataclass(frozen=True, kw_only=True)
class Variant:
    """One way to make a policy."""

    network: dict[str, Any]
    rounds: int = 2
    batch_size: int = 256


SMALL: dict[str, Any] = {"preset": "small"}
RESNET: dict[str, Any] = {
    "encoder": "resnet18",
    "input_size_px": 64,
    "pretrained_backbone_weights": None,
}
VARIANTS = {
    "small": Variant(network=SMALL),
    "one_round": Variant(network=SMALL, rounds=1),
    "three_rounds": Variant(network=SMALL, rounds=3),
    "no_distillation": Variant(network=SMALL, rounds=0),
    "regression": Variant(network={"encoder": "none", "head": "regression", "optimizer_lr": 1e-3}),
    "regression_no_distillation": Variant(
        network={"encoder": "none", "head": "regression", "optimizer_lr": 1e-3}, rounds=0
    ),
    "state_7": Variant(network=SMALL | {"state_entries": 7}),
    "one_frame": Variant(network=SMALL | {"n_obs_steps": 1}),
    "four_frames": Variant(network=SMALL | {"n_obs_steps": 4}),
    "chunk_4_do_1": Variant(network=SMALL | {"chunk_size": 4}),
    "chunk_4_do_2": Variant(network=SMALL | {"chunk_size": 4, "n_action_steps": 2}),
    "head_256": Variant(network=SMALL | {"head_dim": 256}),
    "batch_64": Variant(network=SMALL, batch_size=64),
    "resnet18": Variant(network=RESNET | {"mask_moments": False}, batch_size=64),
    "resnet18_and_moments": Variant(network=RESNET, batch_size=64),
    "resnet18_papers": Variant(
        network=RESNET | {"mask_moments": False, "head": "regression"}, rounds=0, batch_size=64
    ),
}


def main() -> None:
    """Read the command line, train, judge, print the table."""
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("--run", type=Path, default=Path("outputs/demo"))
    parser.add_argument("--out", type=Path, default=Path("outputs/study_policy"))
    parser.add_argument("--tasks", nargs="+", default=["lift_red_box"])
    parser.add_argument("--variants", nargs="*", default=list(VARIANTS))
    parser.add_argument("--seeds", nargs="*", type=int, default=[0, 1, 2])
    parser.add_argument("--train-seconds", type=float, default=60.0, help="of training in all")
    parser.add_argument("--handovers", type=int, default=256, help="episodes a task and round")
    parser.add_argument("--episodes", type=int, default=100, help="that judge each task")
    parser.add_argument("--threads", type=int, default=1)
    parser.add_argument("--table", action="store_true", help="print the results so far and stop")
    args = parser.parse_args()
    os.environ.setdefault("OMP_WAIT_POLICY", "PASSIVE")
    logging.basicConfig(level=logging.WARNING)
    args.out.mkdir(parents=True, exist_ok=True)
    if not args.table:
        for seed in args.seeds:
            for name in args.variants:
                done = {
                    (r["variant"], r["seed"], tuple(r["trained_on"])) for r in results_in(args.out)
                }
                if (name, seed, tuple(args.tasks)) not in done:
                    _one(name, seed, args)
    print(table(results_in(args.out)))


def _one(name: str, seed: int, args: argparse.Namespace) -> None:
    variant = VARIANTS[name]
    datasets = [f for f in (args.run / "dataset").glob("*") if read_record(f)]
    dataset = max(datasets, key=lambda f: f.stat().st_mtime)
    sources = [s for s in sources_of(dataset, args.run) if s.item in args.tasks]
    bundles = {s.item: TaskBundle.load(s.task) for s in sources}
    folder = args.out / f"{name}-{'-'.join(args.tasks)}-{seed}"
    record = read_record(dataset)
    assert record is not None
    started = time.monotonic()
    place = DatasetPlace(
        folder=dataset,
        repo_id=str(record.counts["repo_id"]),
        cache=args.out / "cache" / name,
    )
    student = Student.of_dataset(
        place,
        V2PBCConfig(device="cpu", **variant.network, num_labels=3),
        seed=seed_for(seed, "weights") % 2**63,
        num_threads=args.threads,
        action_limit=ACTION_LIMIT,
    )
    student.table = of_tasks(student.table, [b.description for b in bundles.values()])
    rate = _samples_per_s(student, variant.batch_size, folder / "calibration")
    shares = [SHARES[0] if k == 0 else SHARES[1] for k in range(variant.rounds)]
    shares.append(1 - sum(shares))
    steps = [
        max(1, round(share * args.train_seconds * rate / variant.batch_size)) for share in shares
    ]
    trained_s: list[float] = []

    def train(count: int, out: Path, seed: int, progress: Any) -> None:
        cfg = TrainerConfig(steps=count, batch_size=variant.batch_size)
        trained = student.train(cfg, out, seed=seed, on_progress=progress)
        trained_s.append(trained.seconds)

    if variant.rounds:
        experts = {s.item: StateActor(Expert.load(s.expert).act) for s in sources}
        course = Course(
            lessons={
                item: Lesson(bundle=bundles[item], expert=expert)
                for item, expert in experts.items()
            },
            cfg=DistillationConfig(
                rounds=variant.rounds,
                episodes=args.handovers,
                first_steps=steps[0],
                round_steps=steps[1] if variant.rounds > 1 else 1,
            ),
            episodes=recorded_under(sources[0]),
            seed=seed_for(seed, "study"),
            num_threads=args.threads,
        )
        distill(course, student, train, folder)
    train(steps[-1], folder / "last", seed_for(seed, "last") % 2**63, lambda share, words: None)
    student.save(folder / "policy")
    made_s = time.monotonic() - started
    rows = {item: _judged(student, bundle, seed, args) for item, bundle in bundles.items()}
    result = {
        "variant": name,
        "seed": seed,
        "trained_on": args.tasks,
        "samples": sum(steps) * variant.batch_size,
        "samples_per_s": round(rate),
        "frames": len(student.table),
        "train_s": round(sum(trained_s), 1),
        "wall_s": round(made_s, 1),
        "tasks": rows,
    }
    append_result(args.out, result)
    print(json.dumps(result), flush=True)


def of_tasks(table: FrameTable, words: Sequence[str]) -> FrameTable:
    """Return the frames of some tasks, named in words."""
    wanted = torch.tensor([task in words for task in table.tasks])[table.task]
    place = wanted.cumsum(0) - 1
    return FrameTable(
        pictures={
            key: {name: value[wanted] for name, value in prepared.items()}
            for key, prepared in table.pictures.items()
        },
        vectors={key: value[wanted] for key, value in table.vectors.items()},
        action=table.action[wanted],
        task=table.task[wanted],
        tasks=table.tasks,
        first=place[table.first[wanted]],
        last=place[table.last[wanted]],
    )


def _samples_per_s(student: Student, batch_size: int, folder: Path) -> float:
    """Return the training speed, measured on a copy of the student."""
    import copy

    probe = replace(student, policy=copy.deepcopy(student.policy))
    probe.train(TrainerConfig(steps=2, batch_size=batch_size), folder, seed=0)
    trained = probe.train(
        TrainerConfig(steps=CALIBRATION_STEPS, batch_size=batch_size), folder, seed=0
    )
    return trained.samples_per_s


def _judged(student: Student, bundle: TaskBundle, seed: int, args: argparse.Namespace) -> Any:
    """Judge the student on fresh episodes of a task."""
    judged = judge(
        bundle,
        VisionActor(student.for_task(bundle.description)),
        first_seed=seed_for(seed, "study-judge", bundle.title) % 2**31,
        cfg=EvaluationConfig(episodes=args.episodes),
        num_threads=args.threads,
    )
    at_end = judged.at_end
    assert at_end is not None
    soon = (judged.success_step >= 0) & (judged.success_step < bundle.horizon_steps)
    return {
        "episodes": args.episodes,
        "once": int(judged.successes.sum()),
        "once_in_one_horizon": int(soon.sum()),
        "at_end": int(at_end.sum()),
        "failures": judged.failure_counts(),
        "median_success_s": judged.median_success_s,
        "judge_s": round(judged.seconds["all"], 1),
    }


def table(results: list[dict[str, Any]]) -> str:
    """Return the results as a Markdown table: success once, within one horizon, and at the end, seeds pooled."""
    groups: dict[tuple[str, ...], list[dict[str, Any]]] = defaultdict(list)
    for result in results:
        for item in result["tasks"]:
            groups[(result["variant"], "+".join(result["trained_on"]), item)].append(result)
    lines = [
        "| variant | trained on | judged on | once, 95 % interval | per seed | within one horizon "
        "| at the end | samples | training s | wall s |",
        "|---|---|---|---|---|---|---|---|---|---|",
    ]
    for (variant, trained, item), found in groups.items():
        rows = [r["tasks"][item] for r in found]
        n = sum(r["episodes"] for r in rows)
        once = wilson(sum(r["once"] for r in rows), n)
        seeds = " ".join(f"{r['once'] / r['episodes']:.2f}" for r in rows)
        soon = sum(r["once_in_one_horizon"] for r in rows) / n
        end = sum(r["at_end"] for r in rows) / n
        mean = {k: float(np.mean([r[k] for r in found])) for k in ("samples", "train_s", "wall_s")}
        lines.append(
            f"| {variant} | {trained} | {item} | {once.value:.3f} "
            f"({once.low:.2f}-{once.high:.2f}) | {seeds} | {soon:.3f}"
            f" | {end:.3f} | {mean['samples']:,.0f} | {mean['train_s']:.0f} | {mean['wall_s']:.0f} |"
        )
    return "\n".join(lines)


if __name__ == "__main__":
    main()

"""Policies of the benchmark tasks, each learned alone: expert, demonstrations, distillation, last training, referee.

The stages are those of `v2p demo`, with its settings; only the task comes from `configs/benchmark` instead of a video.
A stopped run goes on where it was; `--table` prints what is there.

    python scripts/bench_policies.py --out outputs/bench_policies --tasks lift_up insert --threads 1
"""

import argparse
import json
import os
from collections.abc import Mapping
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

from policies.evaluation.rate import Rate, wilson
from studies.results import append_result, results_in
from v2p_data.evaluation.judging import contestant
from v2p_data.pipeline.artifact import Record, read_record
from v2p_data.pipeline.runner import Outcome, Runtime, Stage
from v2p_data.pipeline.settings import load_settings
from v2p_data.pipeline.workers import run_stages
from v2p_data.policy.training import sources_of
from v2p_data.stages import (
    POLICY_FOLDER,
    EngineConfig,
    dataset_stage,
    episodes_stage,
    evaluation_stage,
    expert_stage,
    policy_stage,
)
from v2p_data.task.benchmark import benchmark_names, load_benchmark

SETTINGS = Path(__file__).parents[1] / "configs" / "demo.yaml"


def main() -> None:
    """Read the command line, learn, judge, print the table."""
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("--out", type=Path, default=Path("outputs/bench_policies"))
    parser.add_argument("--tasks", nargs="*", default=benchmark_names())
    parser.add_argument("--seeds", nargs="*", type=int, default=[0])
    parser.add_argument("--episodes", type=int, default=100, help="that judge each policy")
    parser.add_argument("--config", type=Path, default=SETTINGS, help="settings of all stages")
    parser.add_argument("--threads", type=int, default=1)
    parser.add_argument("--table", action="store_true", help="print the results so far and stop")
    args = parser.parse_args()
    os.environ.setdefault("OMP_WAIT_POLICY", "PASSIVE")
    args.out.mkdir(parents=True, exist_ok=True)
    if not args.table:
        for seed in args.seeds:
            for task in args.tasks:
                if (task, seed) not in {(r["task"], r["seed"]) for r in results_in(args.out)}:
                    _one(task, seed, args)
    print(table(results_in(args.out)))


def make_benchmark_task(
    cfg: Any, inputs: Mapping[str, Path], out: Path, runtime: Runtime, *, name: str
) -> dict[str, Any]:
    """Write one benchmark task, as the task stage writes a video's."""
    del cfg, inputs, runtime
    bundle = load_benchmark(name)
    scene = replace(bundle.scene, folder=out / "of_benchmark")
    scene.folder.mkdir()
    scene.save(scene.folder)
    replace(bundle, scene=scene).save(out)
    return {"kind": bundle.kind}


def _one(task: str, seed: int, args: argparse.Namespace) -> None:
    cfg = replace(load_settings(args.config, EngineConfig), seed=seed)
    cfg = replace(cfg, evaluation=replace(cfg.evaluation, episodes=args.episodes))
    root = args.out / "run"
    runtime = Runtime(root=root, num_threads=args.threads)
    made = Stage(name="task", item=task, config={}, make=partial(make_benchmark_task, name=task))
    expert = expert_stage(made, cfg)
    dataset = dataset_stage([episodes_stage(made, expert, cfg)], f"v2p/{task}")
    result: dict[str, Any] = {"task": task, "seed": seed, "episodes": args.episodes}
    failed = _run(dataset, runtime)
    if failed is None:
        folder = dataset.folder(root)
        policy = policy_stage(folder, _record(folder), cfg, sources_of(folder, root))
        failed = _run(policy, runtime)
    if failed is not None:
        result["failed"] = f"{failed.stage}: {failed.detail}"
    else:
        tasks = {task: made.folder(root)}
        who = contestant(policy.folder(root) / POLICY_FOLDER)
        evaluation = evaluation_stage(who, tasks, cfg, seen=[task])
        assert _run(evaluation, runtime) is None
        result |= {
            "expert": _record(expert.folder(root)).counts["success"],
            "frames": _record(folder).counts["frames"],
            "row": _record(evaluation.folder(root)).counts["rows"][0],
            "seconds": {
                stage.name: _record(stage.folder(root)).seconds
                for stage in (expert, dataset, *policy.inputs.values(), policy, evaluation)
            },
        }
    append_result(args.out, result)
    print(json.dumps(result), flush=True)


def _run(stage: Stage, runtime: Runtime) -> Outcome | None:
    """Make a stage and what it needs; return what failed, if anything did."""
    outcomes = run_stages([stage], runtime, lambda event: None).values()
    return next((o for o in outcomes if o.status in ("failed", "rejected")), None)


def _record(folder: Path) -> Record:
    record = read_record(folder)
    assert record is not None, folder
    return record


def table(results: list[dict[str, Any]]) -> str:
    """Return one Markdown row per task, seeds pooled: the policy's success once and at the end, what failed, the time."""
    lines = [
        "| task | expert | policy, once | at the end | most frequent failures | minutes |",
        "|---|---|---|---|---|---|",
    ]
    for task in sorted({r["task"] for r in results}):
        found = [r for r in results if r["task"] == task]
        rows = [r["row"] for r in found if "row" in r]
        if not rows:
            lines.append(f"| {task} | - | - | - | {found[0]['failed']} | - |")
            continue
        kinds: dict[str, int] = {}
        for row in rows:
            for kind, count in row["failures"].items():
                kinds[kind] = kinds.get(kind, 0) + count
        worst = sorted(kinds.items(), key=lambda pair: -pair[1])[:2]
        ends = sum(round(row["at_end"]["rate"] * row["trials"]) for row in rows)
        trials = sum(row["trials"] for row in rows)
        minutes = sum(sum(r["seconds"].values()) for r in found if "row" in r) / len(rows) / 60
        lines.append(
            f"| {task} | {_percent(found[0]['expert']['rate'])} | {_rate(wilson(sum(row['successes'] for row in rows), trials))}"
            f" | {_percent(ends / trials)} | {', '.join(f'{k} {n}' for k, n in worst) or '-'} | {minutes:.1f} |"
        )
    return "\n".join(lines)


def _rate(rate: Rate) -> str:
    return f"{rate.value:.0%} ({rate.low:.0%}-{rate.high:.0%})"


def _percent(share: float) -> str:
    return f"{share:.0%}"


if __name__ == "__main__":
    main()

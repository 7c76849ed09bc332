"""Rates of a policy, an expert or the scripted programs in the training simulator and in the twin, on paired seeds.

    python scripts/bench_twin.py TASK_FOLDER --who programs
    python scripts/bench_twin.py TASK_FOLDER --who EXPERT_OR_POLICY_FOLDER --episodes 50 --workers 2
    python scripts/bench_twin.py TASK_FOLDER --who POLICY_FOLDER --change command_latency_s 0.3

Everything here is sim-to-sim: the twin is a second simulator, no real arm. Policies see true masks in both. `--change`
replaces single numbers of the nominal twin. The last line, `sim_to_sim_drop: N`, is the difference of the rates.
"""

import json
import time
from collections import Counter
from dataclasses import dataclass, field
from pathlib import Path

import tyro

from policies.evaluation.rate import wilson
from v2p_data.deployment.view import allowing_for_place
from v2p_data.errors import V2PError
from v2p_data.evaluation.batch import judge
from v2p_data.evaluation.config import EvaluationConfig
from v2p_data.evaluation.judging import Contestant, contestant, play_of
from v2p_data.task.task import TaskBundle
from v2p_data.twin.judge import TwinJudged, TwinSetup, judge_in_twin, true_labels
from v2p_data.twin.parameters import TwinParameters, changed


@dataclass(frozen=True, kw_only=True)
class BenchConfig:
    """What is compared."""

    task: tyro.conf.Positional[Path]
    """Task folder."""
    who: Path
    """Folder of a policy or an expert, or `programs`."""
    episodes: int = 30
    first_seed: int = 1_000_000
    """Disjoint from the seeds of training and recording."""
    workers: int = 1
    """Processes for the twin."""
    at_end: bool = True
    """Episodes go on after their first success."""
    change: dict[str, float] = field(default_factory=dict[str, float])
    """Names and values of the twin's parameters."""
    allow_for_camera: bool = True
    """Labels are carried over to the training camera by the calibrated pose, as `v2p deploy` does."""
    wait_for_gripper: bool = True
    """The arm of a policy waits while the gripper travels, as in `v2p deploy`."""
    out: Path | None = None
    """JSON file with every episode's outcome."""


@dataclass(frozen=True, kw_only=True)
class Loader:
    """Makes the contestant; picklable."""

    who: Contestant
    seed: int

    def __call__(self, bundle: TaskBundle):  # noqa: ANN204 - as `Play`
        return play_of(self.who, self.seed, "cpu")(bundle)


def main(cfg: BenchConfig) -> None:
    """Judge in both and print."""
    who = contestant(cfg.who)
    bundle = TaskBundle.load(cfg.task)
    parameters = changed(cfg.change)
    load = Loader(who=who, seed=cfg.first_seed)
    how = EvaluationConfig(episodes=cfg.episodes, at_end=cfg.at_end)
    print(
        f"sim-to-sim: {who.kind} in '{bundle.title}', seeds {cfg.first_seed} to {cfg.first_seed + cfg.episodes - 1}"
    )

    actor, size_px = load(bundle)
    start = time.perf_counter()
    trained_in = judge(bundle, actor, first_seed=cfg.first_seed, cfg=how, size_px=size_px)
    _tell(
        "training simulator", trained_in.successes, trained_in.at_end, time.perf_counter() - start
    )

    start = time.perf_counter()
    seeds = range(cfg.first_seed, cfg.first_seed + cfg.episodes)
    setup = TwinSetup(
        parameters=parameters,
        look=allowing_for_place if cfg.allow_for_camera else true_labels,
        waits=cfg.wait_for_gripper and who.kind == "policy",
    )
    twin = judge_in_twin(cfg.task, load, seeds=seeds, cfg=how, setup=setup, workers=cfg.workers)
    _tell("twin", twin.successes, twin.at_end if cfg.at_end else None, time.perf_counter() - start)
    failures = Counter(sorted(kind for kind in twin.failures if kind))
    print(f"failures in the twin: {dict(failures)}")
    here, there = twin.successes, trained_in.successes
    print(
        f"paired: both {(here & there).sum()}, twin only {(here & ~there).sum()}, "
        f"training simulator only {(~here & there).sum()}, neither {(~here & ~there).sum()}"
    )
    if cfg.out is not None:
        _write(cfg, parameters, trained_in.success_step.tolist(), twin)
    print(f"sim_to_sim_drop: {trained_in.successes.mean() - twin.successes.mean():.3f}")


def _tell(where: str, once, at_end, seconds: float) -> None:  # noqa: ANN001 - arrays of bool
    def rate(flags) -> str:  # noqa: ANN001
        return str(wilson(int(flags.sum()), len(flags)))

    rates = f"once {rate(once)}" + ("" if at_end is None else f", at end {rate(at_end)}")
    print(f"{where}: {rates}; {seconds:.0f} s")


def _write(
    cfg: BenchConfig, parameters: TwinParameters, trained_in: list[int], twin: TwinJudged
) -> None:
    assert cfg.out is not None
    data = {
        "title": "sim-to-sim",
        "task": str(cfg.task.name),
        "who": str(cfg.who.name),
        "first_seed": cfg.first_seed,
        "twin": {"digest": parameters.digest(), **parameters.as_dict()},
        "success_step": {"training": trained_in, "twin": twin.success_step.tolist()},
        "twin_at_end": twin.at_end.tolist(),
        "twin_failures": list(twin.failures),
    }
    cfg.out.write_text(json.dumps(data, indent=1), encoding="utf-8")


if __name__ == "__main__":
    try:
        main(tyro.cli(BenchConfig))
    except V2PError as error:
        raise SystemExit(f"error: {error}") from error

"""How good a shipped expert is on random tasks and scanned objects that neither taught nor chose it, by the referee."""

from pathlib import Path
from typing import Any

from policies.evaluation.rate import wilson
from studies.results import commit
from v2p_data.episodes.collect import judge_expert
from v2p_data.episodes.rollouts import Lesson
from v2p_data.experts.actors import ProgramActor
from v2p_data.experts.labeller import network_actor
from v2p_data.experts.pretrained import pretrained_for
from v2p_data.kinds import Kind
from v2p_data.seeds import seed_for
from v2p_data.task.benchmark import benchmark_names, load_benchmark

from .learning import JUDGED, solvable_tasks


def judge_kind(kind: Kind, out: Path, *, tasks: int, episodes: int, seed: int) -> dict[str, Any]:
    """Return a line of results: the expert and each task's program on the same starts."""
    found = solvable_tasks(kind, JUDGED, tasks, seed, out / "tasks")
    counts: dict[str, list[int]] = {"expert": [], "program": []}
    for task in found:
        expert = pretrained_for(task.bundle)
        assert expert is not None, f"no expert is shipped for {kind}"
        actors = {"expert": network_actor(expert), "program": ProgramActor(seed, task.program)}
        for who, actor in actors.items():
            judged = judge_expert(
                Lesson(bundle=task.bundle, expert=actor),
                episodes=episodes,
                seed=seed_for(seed, "pretraining-judge", task.bundle.title),
            )
            counts[who].append(int(judged.successes.sum()))
    rates = {who: wilson(sum(n), episodes * len(found)) for who, n in counts.items()}
    paper = _of_the_paper(kind, seed) if kind in benchmark_names() else None
    print(
        kind, {who: str(rate) for who, rate in rates.items()}, "paper's scene", paper, flush=True
    )
    return {
        "kind": kind,
        "seed": seed,
        "commit": commit(),
        "episodes": episodes,
        "tasks": [task.bundle.title for task in found],
        "successes": counts,
        "paper_scene": paper,
    }


def _of_the_paper(kind: Kind, seed: int) -> int:
    """Return the shipped expert's successes in 100 episodes of the paper's scene of this kind."""
    bundle = load_benchmark(kind)
    expert = pretrained_for(bundle)
    assert expert is not None, f"no expert is shipped for {kind}"
    lesson = Lesson(bundle=bundle, expert=network_actor(expert))
    judged = judge_expert(lesson, episodes=100, seed=seed_for(seed, "pretraining-judge", kind))
    return int(judged.successes.sum())

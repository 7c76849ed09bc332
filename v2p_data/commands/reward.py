"""Commands on rewards: search for a task's reward, and say what a search did and why."""

import shlex
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import tyro

from v2p_data.cli import parse
from v2p_data.pipeline.artifact import demand_whole
from v2p_data.pipeline.runner import Runtime
from v2p_data.report.rewards import SEARCH_FILE, RewardView, reward_view
from v2p_data.reward.config import RewardConfig
from v2p_data.stages import reward_stage, scene_stage, task_stage
from v2p_data.task.benchmark import benchmark_names, load_benchmark
from v2p_data.task.task import REWARD_SEARCH_FOLDER, TaskBundle


@dataclass(frozen=True, kw_only=True)
class Search:
    task: tyro.conf.Positional[Path]
    """Folder of a task, e.g. RUN/task/NAME-1a2b3c4d; or the name of a benchmark task, e.g. lift_up."""
    out: Path
    """Folder of the search; the same command goes on with one that was stopped."""
    seed: int = 0
    """All random streams derive from it."""
    workers: int = 1
    """Candidates that train at the same time."""
    reward: RewardConfig = field(default_factory=RewardConfig)


def reward_command(argv: list[str]) -> int:
    from v2p_data.commands.run import _up_to

    return _up_to("reward", argv, _stage_of, "expert")


def _stage_of(video: Any, cfg: Any) -> Any:
    if cfg.reward.iterations < 1:
        cfg = replace(cfg, reward=replace(cfg.reward, iterations=5))
    return reward_stage(task_stage(scene_stage(video, cfg), cfg), cfg)


def search_command(argv: list[str]) -> int:
    args = parse(Search, argv, "reward search")
    last = ""

    def tell(share: float, words: str) -> None:
        nonlocal last
        if words != last:
            last = words
            print(f"{share:4.0%}  {words}", flush=True)  # noqa: T201

    runtime = Runtime(root=args.out, num_threads=args.workers, progress=tell)
    from v2p_data.reward.search import RewardSearch

    search = RewardSearch(_task(args.task), args.reward, args.out, seed=args.seed, runtime=runtime)
    best = search.run()
    print(  # noqa: T201
        f"\nMade {args.out / SEARCH_FILE}\nCandidate {best.number} of {len(search.candidates)} succeeds in "
        f"{best.success:.0%}\nNext: v2p show {shlex.quote(str(args.out))}"
    )
    return 0


def searches_in(folder: Path) -> list[RewardView]:
    """Return the searches at a folder, or of the run that it is."""
    below = sorted(folder.glob(f"reward/*/{REWARD_SEARCH_FOLDER}"))
    places = [folder, folder / REWARD_SEARCH_FOLDER, *below]
    views = [reward_view(place) for place in places if (place / SEARCH_FILE).is_file()]
    return [view for view in views if view is not None]


def shown(view: RewardView) -> str:
    """Return a search in words: its candidates, what the best one's policy did, and its code."""
    lines = [view.title]
    for row in view.rows.values():
        origin = row.author if row.parent is None else f"{row.author}, from {row.parent}"
        rates = ", ".join(f"{rate:.0%}" for rate in row.rates)
        lines.append(
            f"{row.number:3}  round {row.iteration + 1}  {origin}  {row.state}  {rates}  {'; '.join(row.why)}"
        )
    if view.leader is None:
        return "\n".join([*lines, "No candidate has succeeded so far."])
    what = "chosen" if view.is_chosen else "not finished; the best so far"
    return "\n".join([*lines, "", f"{what}: {view.leader.number}", *view.facts, view.leader.code])


def _task(task: Path) -> TaskBundle:
    if not task.exists() and str(task) in benchmark_names():
        return load_benchmark(str(task))
    demand_whole(task)
    return TaskBundle.load(task)

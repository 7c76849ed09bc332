"""Commands on rewards: search for a task's reward, and look at what a search did and why."""

import difflib
import math
import shlex
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import tyro

from v2p_data.cli import parse
from v2p_data.errors import V2PError
from v2p_data.json_files import json_or_none
from v2p_data.pipeline.artifact import demand_whole
from v2p_data.reward.candidate import (
    CANDIDATE_FILE,
    FEEDBACK_FILE,
    TRAIN_FOLDER,
    Candidate,
    load_candidates,
)
from v2p_data.reward.config import Limits, RewardConfig
from v2p_data.reward.feedback import Feedback
from v2p_data.reward.methods import reward_text, writes_success
from v2p_data.reward.search import SEARCH_FILE, How, search_reward
from v2p_data.stages import reward_stage, scene_stage, task_stage
from v2p_data.task.generate import AUDIT_FILE
from v2p_data.task.task import REWARD_SEARCH_FOLDER, TaskBundle

BARS = "▁▂▃▄▅▆▇█"
CURVE_WIDTH = 40


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
    threads: int = 1
    """Threads of one candidate."""
    reward: RewardConfig = field(default_factory=lambda: RewardConfig(iterations=5))
    limits: Limits = field(default_factory=Limits)


def reward_command(argv: list[str]) -> int:
    from v2p_data.commands.run import _up_to

    return _up_to("reward", argv, _stage_of, "expert")


def _stage_of(video: Any, cfg: Any) -> Any:
    if cfg.reward.iterations < 1:
        cfg = replace(cfg, reward=replace(cfg.reward, iterations=5))
    return reward_stage(task_stage(scene_stage(video, cfg), cfg), cfg)


def search_command(argv: list[str]) -> int:
    args = parse(Search, argv, "reward search")
    bundle = _task(args.task)
    if writes_success(args.reward) and _is_by_model(args.task):
        raise V2PError(
            f"a model wrote {args.task}, and what was asked for needs another success function of its hand, which this "
            "command cannot ask for; run 'v2p reward VIDEOS --task.writer=vlm' with the same --reward settings"
        )
    last = ""

    def tell(share: float, words: str) -> None:
        nonlocal last
        if words != last:
            last = words
            print(f"{share:4.0%}  {words}", flush=True)  # noqa: T201

    found = search_reward(
        bundle,
        args.reward,
        args.out,
        seed=args.seed,
        how=How(workers=args.workers, num_threads=args.threads, limits=args.limits),
        on_progress=tell,
    )
    seeds = ", ".join(f"{s:.0%}" for s in found.per_seed)
    lost = ", ".join(f"{count} {kind}" for kind, count in found.faults.items())
    print(  # noqa: T201
        f"\nMade {args.out / SEARCH_FILE}\nCandidate {found.chosen} succeeds in {found.success:.0%} (per seed {seeds}); "
        f"the search took {found.cost_share:.0%} of the steps of training every candidate to the end"
        f"{f'; without a result: {lost}' if lost else ''}\nNext: v2p show {shlex.quote(str(args.out))}"
    )
    return 0


def _is_by_model(task: Path) -> bool:
    about = json_or_none(task / AUDIT_FILE)
    return isinstance(about, dict) and about.get("writer") == "vlm"


def shown(run: Path, number: int | None) -> str:
    """Return a search in words: its table, and of one candidate curves, analysis, difference to its parent and code."""
    if (run / CANDIDATE_FILE).is_file():
        run, number = run.parents[1], Candidate.load(run).number
    searches = searches_in(run)
    if not searches:
        raise V2PError(
            f"{run} holds neither a task nor a reward search; make them with 'v2p task VIDEOS' and 'v2p reward search TASK'"
        )
    return "\n\n\n".join(_search(search, number) for search in searches)


def searches_in(run: Path) -> list[Path]:
    """Return the searches at or below a folder."""
    places = [
        run,
        run / REWARD_SEARCH_FOLDER,
        *sorted(run.glob(f"reward/*/{REWARD_SEARCH_FOLDER}")),
        *sorted(run.glob(f"*/{SEARCH_FILE}")),
    ]
    found = [p.parent if p.name == SEARCH_FILE else p for p in places]
    return [p for p in dict.fromkeys(found) if (p / SEARCH_FILE).is_file()]


def _search(search: Path, number: int | None) -> str:
    table: dict[str, Any] = json_or_none(search / SEARCH_FILE) or {}
    found = table.get("found") or {}
    parts = [f"{table.get('title', '')}: {table.get('method', '')}, {search}", *_table(table)]
    if found:
        seeds = ", ".join(f"{s:.0%}" for s in found["per_seed"])
        parts.append(
            f"chosen: {found['chosen']}, success {found['success']:.0%} (per seed {seeds}), stopped by {found['stopped_by']}, "
            f"{found['cost_share']:.0%} of the steps of training all to the end"
        )
    else:
        parts.append("not finished; the same command goes on with it")
    candidates = {c.number: c for c in load_candidates(search)}
    shown_number = number if number is not None else found.get("chosen")
    if shown_number is None:
        return "\n".join(parts)
    if shown_number not in candidates:
        known = ", ".join(map(str, candidates))
        raise V2PError(f"{search} has no candidate {shown_number}; it has {known}")
    candidate = candidates[shown_number]
    parent = candidates.get(candidate.parent) if candidate.parent is not None else None
    return "\n".join([*parts, "", *_candidate(candidate, parent)])


def _table(table: dict[str, Any]) -> list[str]:
    rows = [
        (
            str(row["number"]),
            str(row["round"] + 1),
            "-" if row["parent"] is None else str(row["parent"]),
            row["origin"],
            row["state"],
            f"{row['success']:.0%}" if row["marks"] else "-",
            bars(row["successes"], low=0.0, high=1.0),
            (row["why"] or "; ".join(row["reasons"]))[:100],
        )
        for row in table.get("candidates", [])
    ]
    head = ("no", "round", "parent", "origin", "state", "success", "curve", "why")
    widths = [max(len(r[i]) for r in [head, *rows]) for i in range(len(head) - 1)] + [0]
    return [
        "  ".join(word.ljust(w) for word, w in zip(row, widths, strict=True)).rstrip()
        for row in [head, *rows]
    ]


def _candidate(candidate: Candidate, parent: Candidate | None) -> list[str]:
    training = candidate.training()
    lines = [f"candidate {candidate.number}, {candidate.origin}"]
    if training.fault is not None:
        lines.append(f"no result ({training.fault.kind}): {training.fault.reason}")
    if candidate.reasons:
        lines += ["", "why it was written:", *[f"  - {r}" for r in candidate.reasons]]
    curves = curve_lines(training.folder / TRAIN_FOLDER / "curve.csv")
    if curves:
        lines += ["", "curves of training:", *curves]
    data = json_or_none(training.folder / FEEDBACK_FILE)
    if isinstance(data, dict):
        lines += ["", "what its policy did:", *_indented(Feedback.from_dict(data).text())]
    if parent is not None:
        lines += ["", f"difference to its parent {parent.number}:"]
        lines += difference(parent.code, candidate.code)
    return [*lines, "", "reward:", *_indented(reward_text(candidate.code))]


def difference(old: str, new: str) -> list[str]:
    """Return the lines in which two rewards differ, with a line around them."""
    diff = difflib.unified_diff(
        reward_text(old).splitlines(), reward_text(new).splitlines(), n=1, lineterm=""
    )
    return [f"  {line}" for line in list(diff)[2:]] or ["  none"]


def curve_lines(path: Path) -> list[str]:
    """Return a training's success, return and components as small bar charts, each from its lowest to its highest."""
    from policies.ppo.curve import read_rows

    rows = read_rows(path)
    names = [
        n
        for n in (rows[0] if rows else {})
        if n in {"success_deterministic", "return"} or n.startswith("reward_")
    ]
    width = max(map(len, names), default=0)
    lines: list[str] = []
    for name in names:
        values = [float(row[name]) for row in rows]
        known = [v for v in values if math.isfinite(v)]
        if known:
            low, high = min(known), max(known)
            lines.append(
                f"  {name:<{width}}  {bars(values, low=low, high=high)}  {low:.3g} to {high:.3g}"
            )
    return lines


def bars(values: Sequence[float], *, low: float, high: float) -> str:
    """Return values as characters of rising height, thinned to fit a line; unknown ones are blanks."""
    step = max(1, math.ceil(len(values) / CURVE_WIDTH))
    made = ""
    for k in range(0, len(values), step):
        known = [v for v in values[k : k + step] if math.isfinite(v)]
        if not known:
            made += " "
            continue
        share = (sum(known) / len(known) - low) / (high - low) if high > low else 0.0
        made += BARS[min(len(BARS) - 1, max(0, int(share * len(BARS))))]
    return made


def _indented(text: str) -> list[str]:
    return [f"  {line}" for line in text.splitlines()]


def _task(task: Path) -> TaskBundle:
    from v2p_data.task.benchmark import benchmark_names, load_benchmark

    if not task.exists() and str(task) in benchmark_names():
        return load_benchmark(str(task))
    demand_whole(task)
    return TaskBundle.load(task)

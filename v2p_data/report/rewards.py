"""A reward search as part of the page: each round's candidates, and of the best one training, audit, origin and code.

Text and numbers only. A search of five rounds of eight adds about 50 kB to a page whose media may take 22 MB.
"""

import difflib
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
from markupsafe import Markup

from v2p_data.report.audits import AuditView, audit_view
from v2p_data.report.chart import NUM_STYLES, Line, line_chart
from v2p_data.report.reading import as_dict, as_dicts, number, read_curve
from v2p_data.report.searches import (
    MAX_TEXT_CHARS,
    Candidate,
    Search,
    Trial,
    read_feedback,
    read_search,
    training_curve,
)
from v2p_data.report.training import training_charts
from v2p_data.report.words import NO_BREAK, percent

UNTRAINED = {"prescreened": "turned away untrained", "refused": "refused untrained"}
FAULTS = {
    "crashed": "crashed",
    "hang": "hung",
    "out_of_time": "ran out of time",
    "out_of_memory": "ran out of memory",
    "not_finite": "was not finite",
    "unbounded": "knew no bounds",
    "error": "failed with an error",
} | UNTRAINED
AUTHORS = {
    "given": "the task's own",
    "template": "a template",
    "reflection": "rules",
    "model": "a language model",
}
"""Who wrote a reward, by `Candidate.origin`."""
MAX_PARTS = 30
MAX_NAME_CHARS = 100
DIFF_CONTEXT = 1


@dataclass(frozen=True, kw_only=True)
class CandidateView:
    """One line of a round."""

    number: int
    parent: int | None
    author: str
    mark: str
    """Colour of its state, one of the page's."""
    state: str
    rates: tuple[float, ...]
    """Success of each evaluation."""
    success: float | None
    why: list[str]
    """What went wrong, or the reasons for which it was written."""
    seconds: float | None
    is_leader: bool


@dataclass(frozen=True, kw_only=True)
class RoundView:
    """Candidates that were trained against each other."""

    number: int
    """From 1."""
    candidates: list[CandidateView]
    chart: Markup


@dataclass(frozen=True, kw_only=True)
class PartView:
    """What one component of the reward did."""

    name: str
    share: float | None
    means: tuple[float | None, float | None, float | None]
    """Over all, over successful and over failed trajectories."""
    correlations: tuple[float | None, float | None]
    """With success, per step and per episode."""
    saturated: tuple[float | None, float | None]
    """Share of steps near its maximum and its minimum."""
    is_dead: bool


@dataclass(frozen=True, kw_only=True)
class StepView:
    """How one reward was made from another."""

    number: int
    parent: int
    author: str
    reasons: tuple[str, ...]
    difference: str


@dataclass(frozen=True, kw_only=True)
class RewardView:
    """A search, and the candidate that leads it."""

    method: str
    without: str
    num_candidates: int
    rounds: list[RoundView]
    leader: int | None
    author: str
    """Who wrote the leader's reward."""
    is_chosen: bool
    """The search is finished; otherwise its leader is only the best so far."""
    success: float | None
    per_seed: tuple[float, ...]
    stopped_by: str
    cost_share: float | None
    charts: list[Markup] = field(default_factory=list[Markup])
    facts: list[str] = field(default_factory=list[str])
    """What the leader's policy did, one sentence each."""
    parts: list[PartView] = field(default_factory=list[PartView])
    audit: AuditView
    lineage: list[StepView] = field(default_factory=list[StepView])
    """The leader's origin first, then its parent's, back to the first round."""
    code: str = ""


def reward_view(folder: Path) -> RewardView | None:
    """Return a search for the page, None where none has begun.

    Args:
        folder: of the search, finished or not.
    """
    search = read_search(folder)
    if search is None:
        return None
    leader, choice = search.leader, search.choice
    view = RewardView(
        method=search.method,
        without=", ".join(search.without),
        num_candidates=len(search.candidates),
        rounds=_rounds(search, leader),
        leader=None if leader is None else leader.number,
        author="" if leader is None else _author(leader),
        is_chosen=leader is not None and choice is not None,
        success=choice.success if choice else search.success(leader) if leader else None,
        per_seed=choice.per_seed if choice else (),
        stopped_by=choice.stopped_by if choice else "",
        cost_share=choice.cost_share if choice else None,
        audit=audit_view(search.audit),
        code=leader.code if leader else "",
    )
    if leader is not None:
        _add_training(view, search, leader)
        line = search.lineage(leader)
        for child, parent in pairwise(line):
            view.lineage.append(_step(child, parent))
    return view


# --- rounds --------------------------------------------------------------------------------------------------


def _rounds(search: Search, leader: Candidate | None) -> list[RoundView]:
    iterations = sorted({c.iteration for c in search.candidates.values()})
    views: list[RoundView] = []
    for iteration in iterations:
        members = [c for c in search.candidates.values() if c.iteration == iteration]
        # A single evaluation makes no line; its number is in the table.
        longest = sorted(members, key=lambda c: (-len(c.first.successes), c.number))
        drawn = {c.number for c in longest[:NUM_STYLES]}
        lines = [
            _line(search, c.first, f"candidate {c.number}")
            for c in members
            if c.number in drawn and len(c.first.successes) > 1
        ]
        chart = line_chart(
            lines,
            title=f"Success of round {iteration + 1}'s candidates in evaluations",
            x_label="control steps",
            y_range=(0.0, 1.0),
        )
        candidates = [_candidate(search, c, c is leader) for c in members]
        views.append(RoundView(number=iteration + 1, candidates=candidates, chart=chart))
    return views


def _candidate(search: Search, candidate: Candidate, is_leader: bool) -> CandidateView:
    trial = candidate.first
    mark, state = _state(search, candidate)
    return CandidateView(
        number=candidate.number,
        parent=candidate.parent,
        author=_author(candidate),
        mark=mark,
        state=state,
        rates=trial.successes,
        success=search.success(candidate),
        why=[trial.why] if trial.why else list(candidate.reasons),
        seconds=trial.seconds,
        is_leader=is_leader,
    )


def _author(candidate: Candidate) -> str:
    return AUTHORS.get(candidate.origin, candidate.origin)


def _state(search: Search, candidate: Candidate) -> tuple[str, str]:
    """Return the page's mark and the words for how far a candidate came."""
    trial, rungs = candidate.first, search.rungs
    done = len(trial.successes)
    if trial.fault:
        return "rejected", FAULTS.get(trial.fault, trial.fault.replace("_", " "))
    if trial.is_ended:
        return "made", f"reached the target after {done} of {rungs[-1]} evaluations"
    if done >= rungs[-1]:
        return "made", "trained to the end"
    if candidate.iteration in search.ended_rounds:
        rung = sum(mark < done for mark in rungs) + 1
        return "none", f"stopped at rung {rung} of {len(rungs)}"
    return "unfinished", f"under way, {done} of {rungs[-1]} evaluations" if done else "waits"


def _line(search: Search, trial: Trial, name: str) -> Line:
    steps = search.steps_per_evaluation * np.arange(1, len(trial.successes) + 1)
    return Line(name=name, x=steps, y=np.array(trial.successes, float))


# --- the leader ----------------------------------------------------------------------------------------------


def _add_training(view: RewardView, search: Search, leader: Candidate) -> None:
    seeds = [
        _line(search, trial, f"seed {k}")
        for k, trial in enumerate(leader.trials)
        if len(trial.successes) > 1
    ]
    by_seed = line_chart(
        seeds[:NUM_STYLES],
        title=f"Success of candidate {leader.number} in evaluations"
        + (", on each seed" if len(seeds) > 1 else ""),
        x_label="control steps",
        y_range=(0.0, 1.0),
    )
    curve = training_curve(leader.first)
    others = training_charts(read_curve(curve)) if curve is not None else []
    view.charts.extend(chart for chart in (by_seed, *others) if chart)
    feedback = read_feedback(leader.first)
    view.facts.extend(_facts(feedback))
    rows = as_dicts(feedback.get("components"))[:MAX_PARTS]
    view.parts.extend(_part(row) for row in (*rows, as_dict(feedback.get("reward"))) if row)


def _facts(feedback: dict[str, Any]) -> list[str]:
    """Return the analysis of a policy's episodes in sentences; what is missing is left out."""
    episodes, successes = number(feedback.get("num_episodes")), number(feedback.get("num_successes"))  # fmt: skip
    facts: list[str] = []
    if episodes and successes is not None:
        facts.append(
            f"Of {episodes:.0f} episodes of its last policy {successes:.0f} succeeded"
            + _if(
                feedback.get("ever_success"), lambda x: f"; {percent(x)} had success at some step"
            )
            + _if(
                feedback.get("time_to_success_s"),
                lambda x: f"; it took {x:.1f}{NO_BREAK}s (median)",
            )
            + _if(feedback.get("episode_s"), lambda x: f", in episodes of {x:.1f}{NO_BREAK}s")
            + "."
        )
    words = "A successful episode earned more generated reward than a failed one with probability"
    facts.append(_if(feedback.get("reward_ranks"), lambda x: f"{words} {x:.2f}; chance is 0.50."))
    for obj in as_dicts(feedback.get("objects"))[:MAX_PARTS]:
        shares = [
            f"{name} in {percent(known)}"
            for name in ("reached", "touched", "grasped", "raised")
            if (known := number(obj.get(name))) is not None
        ]
        name = str(obj.get("name"))[:MAX_NAME_CHARS].replace("_", " ")
        moved = _if(obj.get("moved_m"), lambda x: f"; moved by {100 * x:.1f}{NO_BREAK}cm (median)")
        facts.append(f"{name}: {', '.join(shares)} of episodes{moved}.")
    return [fact for fact in facts if fact]


def _part(row: dict[str, Any]) -> PartView:
    def mean(name: str) -> float | None:
        return number(as_dict(row.get(name)).get("mean"))

    return PartView(
        name=str(row.get("name") or "")[:MAX_NAME_CHARS],
        share=number(row.get("share")),
        means=(mean("overall"), mean("successful"), mean("failed")),
        correlations=(number(row.get("step_correlation")), number(row.get("episode_correlation"))),
        saturated=(number(row.get("saturated_high")), number(row.get("saturated_low"))),
        is_dead=row.get("is_dead") is True,
    )


def _step(child: Candidate, parent: Candidate) -> StepView:
    return StepView(
        number=child.number,
        parent=parent.number,
        author=_author(child),
        reasons=child.reasons,
        difference=difference(parent.code.splitlines(), child.code.splitlines()),
    )


def difference(old: Sequence[str], new: Sequence[str]) -> str:
    """Return the lines in which two texts differ as a unified diff without its head, empty where they are the same."""
    lines = list(difflib.unified_diff(old, new, n=DIFF_CONTEXT, lineterm=""))[2:]
    return "\n".join(lines)[:MAX_TEXT_CHARS]


def _if(value: Any, words: Callable[[float], str]) -> str:
    known = number(value)
    return "" if known is None else words(known)

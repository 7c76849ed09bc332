"""A reward search as part of the page, finished or not: candidates by round, and the best one.

Text and numbers only. Trainings were written by processes that ran generated code, so their files are read as a
stranger's: small, inside the search's folder, and never trusted to be whole.
"""

import difflib
from collections.abc import Sequence
from contextlib import suppress
from dataclasses import dataclass, field
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
from markupsafe import Markup

from v2p_data.errors import V2PError
from v2p_data.json_files import MAX_BYTES, json_or_none
from v2p_data.report.chart import Line, line_chart, training_charts
from v2p_data.report.reading import as_dict, as_dicts, as_list, number, read_curve
from v2p_data.report.words import NO_BREAK, percent
from v2p_data.scene.files import own_file

SEARCH_FILE = "search.json"
AUTHORS = {"given": "the task's own", "template": "a template", "model": "a language model"}
"""Who wrote a reward, by its `origin`."""
MAX_CANDIDATES = 200
MAX_CODE_CHARS, MAX_SENTENCE_CHARS, MAX_NAME_CHARS = 20_000, 500, 100
MAX_PARTS = 30


@dataclass(frozen=True, kw_only=True)
class RewardRow:
    """One reward that was tried."""

    number: int
    iteration: int
    """Its round, from 0."""
    parent: int | None
    author: str
    mark: str
    """Colour of its state, one of the page's."""
    state: str
    rates: tuple[float, ...]
    """Success after each rung."""
    why: list[str]
    """What went wrong, or the reasons for which it was written."""
    seconds: float | None
    folder: str
    """Name of its last rung's folder."""
    code: str = field(repr=False)

    @property
    def success(self) -> float | None:
        return self.rates[-1] if self.rates else None


@dataclass(frozen=True, kw_only=True)
class RewardView:
    """A search, and the candidate that leads it."""

    title: str
    rows: dict[int, RewardRow]
    """By number, in the order in which they were written."""
    leader: RewardRow | None
    is_chosen: bool
    """The search is finished; otherwise its leader is only the best so far."""
    stopped_by: str
    steps: float | None
    """Control steps of training that it took."""
    by_round: Markup
    """The paper's figure 4: success of the best reward of each round, and of the best so far."""
    charts: list[Markup]
    """Of the leader's training."""
    facts: list[str]
    """What the leader's policy did, one sentence each."""
    parts: list[dict[str, Any]]
    """What each component of the reward did."""
    lineage: list[tuple[RewardRow, RewardRow, str]]
    """The leader, its parent and the difference of their codes; then the parent's, back to the first round."""

    @property
    def rounds(self) -> list[list[RewardRow]]:
        """Return the candidates that were trained against each other."""
        iterations = sorted({row.iteration for row in self.rows.values()})
        return [[row for row in self.rows.values() if row.iteration == i] for i in iterations]


def reward_view(folder: Path) -> RewardView | None:
    """Return a search for the page, None where none has begun.

    Args:
        folder: of the search, finished or not.
    """
    if not folder.is_dir():
        return None
    table = as_dict(json_or_none(folder / SEARCH_FILE))
    found, rungs = as_dict(table.get("found")), len(as_list(table.get("rungs")))
    entries = as_dicts(table.get("candidates"))[:MAX_CANDIDATES]
    last = max((e["iteration"] for e in entries if isinstance(e.get("iteration"), int)), default=0)
    made = [_row(entry, rungs, last if not found else last + 1) for entry in entries]
    rows = {row.number: row for row in made if row is not None}
    able = [row for row in rows.values() if row.success]
    best = max(able, key=lambda row: (row.success or 0.0, -row.number), default=None)
    chosen = found.get("chosen")
    leader = rows.get(chosen, best) if isinstance(chosen, int) else best
    place = f"candidate/{leader.folder}" if leader and leader.folder else ""
    record = _own_file(folder, f"{place}/record.json")
    feedback = as_dict(
        as_dict(as_dict(record and json_or_none(record)).get("counts")).get("feedback")
    )
    curve = _own_file(folder, f"{place}/train/curve.csv")
    parts = [*as_dicts(feedback.get("components"))[:MAX_PARTS], as_dict(feedback.get("reward"))]
    return RewardView(
        title=str(table.get("title") or "")[:MAX_NAME_CHARS],
        rows=rows,
        leader=leader,
        is_chosen=bool(found) and leader is not None,
        stopped_by=str(found.get("stopped_by") or ""),
        steps=number(found.get("steps")),
        by_round=_success_by_round(list(rows.values())),
        charts=training_charts(read_curve(curve)) if curve else [],
        facts=_facts(feedback),
        parts=[_part(row) for row in parts if row],
        lineage=_lineage(rows, leader),
    )


def _row(entry: dict[str, Any], rungs: int, at_work: int) -> RewardRow | None:
    """Return a candidate's line; rounds before `at_work` have ended."""
    index, iteration, parent = entry.get("number"), entry.get("iteration"), entry.get("parent")
    if not isinstance(index, int) or not isinstance(iteration, int):
        return None
    results = as_dicts(entry.get("results"))
    rates = [number(r.get("success")) for r in results]
    done, why = len(results), str(entry.get("why") or "")[:MAX_SENTENCE_CHARS]
    if why:
        mark, state = "rejected", "failed"
    elif done == rungs:
        mark, state = "made", "trained to the end"
    elif entry.get("is_finished") is True:
        mark, state = "made", f"reached the target at rung {done} of {rungs}"
    elif iteration < at_work:
        mark, state = "none", f"stopped at rung {done} of {rungs}"
    else:
        mark, state = "unfinished", f"under way, {done} of {rungs} rungs" if done else "waits"
    seconds = [s for r in results if (s := number(r.get("seconds"))) is not None]
    origin = str(entry.get("origin") or "unknown")[:MAX_SENTENCE_CHARS]
    reasons = [str(r)[:MAX_SENTENCE_CHARS] for r in as_list(entry.get("reasons"))[:20]]
    return RewardRow(
        number=index,
        iteration=iteration,
        parent=parent if isinstance(parent, int) else None,
        author=AUTHORS.get(origin, origin),
        mark=mark,
        state=state,
        rates=tuple(min(1.0, max(0.0, rate)) for rate in rates if rate is not None),
        why=[why] if why else reasons,
        seconds=sum(seconds) if seconds else None,
        folder=Path(str(results[-1].get("folder") or "")).name if results else "",
        code=str(entry.get("code") or "")[:MAX_CODE_CHARS],
    )


def _success_by_round(rows: Sequence[RewardRow]) -> Markup:
    """Return the curve over the rounds, nothing for a single one."""
    rounds = sorted({row.iteration for row in rows})
    best = [max((r.success or 0.0 for r in rows if r.iteration == i), default=0.0) for i in rounds]
    if len(rounds) < 2:
        return Markup("")
    x = np.array(rounds, float) + 1
    lines = [
        Line(name="best so far", x=x, y=np.maximum.accumulate(best)),
        Line(name="best of the round", x=x, y=np.array(best)),
    ]
    return line_chart(lines, title="Success after each round", x_label="round", y_range=(0.0, 1.0))


def _lineage(
    rows: dict[int, RewardRow], leader: RewardRow | None
) -> list[tuple[RewardRow, RewardRow, str]]:
    """Return how the leader came about, the newest step first."""
    line = [leader] if leader else []
    # A parent is always older; a file that says otherwise must not lead in circles.
    while line and (parent := line[-1].parent) is not None and parent < line[-1].number:
        if parent not in rows:
            break
        line.append(rows[parent])
    return [
        (child, parent, difference(parent.code, child.code)) for child, parent in pairwise(line)
    ]


def difference(old: str, new: str) -> str:
    """Return the lines in which two texts differ as a unified diff without its head, empty where they are the same."""
    lines = difflib.unified_diff(old.splitlines(), new.splitlines(), n=1, lineterm="")
    return "\n".join(list(lines)[2:])[:MAX_CODE_CHARS]


def _facts(feedback: dict[str, Any]) -> list[str]:
    """Return the analysis of a policy's episodes in sentences; what is missing is left out."""
    known = {k: n for k, v in feedback.items() if (n := number(v)) is not None}
    facts: list[str] = []
    if known.get("num_episodes") and "num_successes" in known:
        words = f"Of {known['num_episodes']:.0f} episodes of its last policy {known['num_successes']:.0f} succeeded"
        if "ever_success" in known:
            words += f"; {percent(known['ever_success'])} had success at some step"
        if "time_to_success_s" in known:
            words += f"; it took {known['time_to_success_s']:.1f}{NO_BREAK}s (median)"
        facts.append(f"{words}.")
    if "reward_ranks" in known:
        facts.append(
            "A successful episode earned more generated reward than a failed one with probability "
            f"{known['reward_ranks']:.2f}; chance is 0.50."
        )
    for obj in as_dicts(feedback.get("objects"))[:MAX_PARTS]:
        shares = [
            f"{name} in {percent(share)}"
            for name in ("reached", "touched", "grasped", "raised")
            if (share := number(obj.get(name))) is not None
        ]
        name = str(obj.get("name"))[:MAX_NAME_CHARS].replace("_", " ")
        facts.append(f"{name}: {', '.join(shares)} of episodes.")
    return facts


def _part(row: dict[str, Any]) -> dict[str, Any]:
    """Return means over all, over successful and over failed trajectories, and shares of steps near both ends."""
    return {
        "name": str(row.get("name") or "")[:MAX_NAME_CHARS],
        "share": number(row.get("share")),
        "means": [
            number(as_dict(row.get(k)).get("mean")) for k in ("overall", "successful", "failed")
        ],
        "correlations": [
            number(row.get("step_correlation")),
            number(row.get("episode_correlation")),
        ],
        "saturated": [number(row.get("saturated_high")), number(row.get("saturated_low"))],
        "is_dead": row.get("is_dead") is True,
    }


def _own_file(folder: Path, name: str) -> Path | None:
    """Return a file below the search's folder; None where there is none, it is large, or a link leads out."""
    with suppress(V2PError, OSError):
        return own_file(folder, name, MAX_BYTES)
    return None

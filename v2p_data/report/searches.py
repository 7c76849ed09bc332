"""A reward search as its folder says, finished or not: candidates, how far each came, which one was chosen.

The formats are those of `reward.search` and `reward.candidate`. Trainings were written by processes that ran generated
code, so every file is read as a stranger's: small, inside the search's folder, and never trusted to be whole.
"""

from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from v2p_data.json_files import json_or_none
from v2p_data.report.reading import as_dict, as_dicts, as_list, number

SEARCH_FOLDER = "search"
"""In the result of the stage `reward`."""
MAX_CANDIDATES = 200
MAX_TEXT_CHARS = 20_000
MAX_SENTENCE_CHARS = 500
MAX_SEEDS = 20


@dataclass(frozen=True, kw_only=True)
class Trial:
    """One training of a candidate on one seed."""

    folder: Path
    successes: tuple[float, ...] = ()
    """Share of episodes that succeeded, per evaluation."""
    is_ended: bool = False
    """It stopped at its last evaluation because it succeeds often enough."""
    seconds: float | None = None
    fault: str = ""
    """What kind of failure left it without a result."""
    why: str = ""


@dataclass(frozen=True, kw_only=True)
class Candidate:
    """One reward that was tried."""

    number: int
    iteration: int
    """Its round, from 0."""
    parent: int | None
    origin: str
    reasons: tuple[str, ...]
    code: str = field(repr=False)
    trials: tuple[Trial, ...]
    """One per seed; the first always, the others of the chosen one only."""

    @property
    def first(self) -> Trial:
        """The training by which it is compared with others."""
        return self.trials[0]


@dataclass(frozen=True, kw_only=True)
class Choice:
    """What a finished search came to."""

    number: int
    success: float | None
    per_seed: tuple[float, ...]
    stopped_by: str
    cost_share: float | None
    """Steps of the search over those of training every candidate to the end."""


@dataclass(frozen=True, kw_only=True)
class Search:
    """All of it."""

    method: str
    without: tuple[str, ...]
    candidates: dict[int, Candidate]
    """By number, in the order in which they were written."""
    rungs: tuple[int, ...]
    """Evaluations after which the worse part of a round stops; the last one is the end."""
    steps_per_evaluation: float
    counted: int
    """The last so many evaluations make a candidate's success."""
    num_seeds: int
    ended_rounds: frozenset[int]
    choice: Choice | None
    """None while it goes on."""
    audit: Any
    """Audit of the success that all candidates share."""

    def success(self, candidate: Candidate) -> float | None:
        """Return the mean of a candidate's last evaluations, None without any."""
        last = candidate.first.successes[-self.counted :]
        return sum(last) / len(last) if last else None

    @property
    def leader(self) -> Candidate | None:
        """The chosen candidate; while there is none, the one that succeeds most often so far, if any does."""
        if self.choice is not None and self.choice.number in self.candidates:
            return self.candidates[self.choice.number]
        able = [c for c in self.candidates.values() if not c.first.fault and self.success(c)]
        return max(able, key=lambda c: (self.success(c) or 0.0, -c.number), default=None)

    def lineage(self, candidate: Candidate) -> list[Candidate]:
        """Return a candidate and its ancestors, the oldest last."""
        line = [candidate]
        # A parent is always older; a file that says otherwise must not lead in circles.
        while (parent := line[-1].parent) is not None and parent < line[-1].number:
            if parent not in self.candidates:
                break
            line.append(self.candidates[parent])
        return line


def read_search(folder: Path) -> Search | None:
    """Return what a search's folder says, None where no search has begun."""
    recipe = as_dict(_json(folder / "recipe.json", folder))
    table = as_dict(_json(folder / "search.json", folder))
    config = as_dict(recipe.get("config"))
    num_seeds = min(MAX_SEEDS, _count(config.get("confirm_seeds")) or 1)
    paths = sorted((folder / "candidates").glob("*/candidate.json"))[:MAX_CANDIDATES]
    found = [c for path in paths if (c := _candidate(path.parent, folder, num_seeds)) is not None]
    if not recipe and not found:
        return None
    rows = as_dicts(table.get("candidates"))
    shares = [s for v in as_list(config.get("rungs")) if (s := number(v)) and s > 0]
    rungs = tuple(round(share / shares[0]) for share in shares) or (1,)
    return Search(
        method=str(config.get("method") or table.get("method") or ""),
        without=tuple(str(part) for part in as_list(config.get("without"))),
        candidates={c.number: c for c in found},
        rungs=rungs,
        steps_per_evaluation=(number(config.get("steps")) or 1.0) / rungs[-1],
        counted=_count(config.get("evaluations")) or 1,
        num_seeds=num_seeds,
        ended_rounds=frozenset(row["round"] for row in rows if isinstance(row.get("round"), int)),
        choice=_choice(as_dict(table.get("found"))),
        audit=as_dict(_json(folder / "bundle" / "task.json", folder)).get("audit"),
    )


def read_feedback(trial: Trial) -> dict[str, Any]:
    """Return what its last policy did, as `reward.feedback` writes it; empty where that is missing."""
    return as_dict(_json(trial.folder / "feedback.json", trial.folder))


def training_curve(trial: Trial) -> Path | None:
    """Return the CSV of its training, None where there is none."""
    return _own_file(trial.folder / "train" / "curve.csv", trial.folder)


def _candidate(folder: Path, search: Path, num_seeds: int) -> Candidate | None:
    data = as_dict(_json(folder / "candidate.json", search))
    index, iteration = data.get("number"), data.get("iteration")
    if not isinstance(index, int) or not isinstance(iteration, int):
        return None
    parent = data.get("parent")
    return Candidate(
        number=index,
        iteration=iteration,
        parent=parent if isinstance(parent, int) else None,
        origin=str(data.get("origin") or "unknown")[:MAX_SENTENCE_CHARS],
        reasons=tuple(str(r)[:MAX_SENTENCE_CHARS] for r in as_list(data.get("reasons"))[:20]),
        code=_text(folder / "code.py", search),
        trials=tuple(_trial(folder / f"seed-{k}", search) for k in range(num_seeds)),
    )


def _trial(folder: Path, search: Path) -> Trial:
    is_faulty = _own_file(folder / "fault.json", search) is not None
    fault = as_dict(_json(folder / "fault.json", search))
    done = as_dict(_json(folder / "done.json", search))
    rates = [
        number(e.get("success")) for e in as_dicts(_json(folder / "evaluations.json", search))
    ]
    return Trial(
        folder=folder,
        successes=tuple(min(1.0, max(0.0, rate)) for rate in rates if rate is not None),
        is_ended=done.get("reached") is True,
        seconds=number(done.get("seconds")),
        fault=str(fault.get("kind") or "crashed")[:40] if is_faulty else "",
        why=str(fault.get("reason") or "")[:MAX_SENTENCE_CHARS],
    )


def _choice(found: dict[str, Any]) -> Choice | None:
    if not isinstance(found.get("chosen"), int):
        return None
    rates = [number(rate) for rate in as_list(found.get("per_seed"))]
    return Choice(
        number=found["chosen"],
        success=number(found.get("success")),
        per_seed=tuple(rate for rate in rates if rate is not None),
        stopped_by=str(found.get("stopped_by") or ""),
        cost_share=number(found.get("cost_share")),
    )


def _json(path: Path, inside: Path) -> Any:
    own = _own_file(path, inside)
    return None if own is None else json_or_none(own)


def _text(path: Path, inside: Path) -> str:
    if _own_file(path, inside) is None:
        return ""
    with path.open(errors="replace") as stream:
        return stream.read(MAX_TEXT_CHARS)


def _own_file(path: Path, inside: Path) -> Path | None:
    """Return a path if it is a plain file below a folder, also after following links."""
    try:
        is_own = path.is_file() and path.resolve().is_relative_to(inside.resolve())
    except (OSError, RuntimeError):
        return None
    return path if is_own else None


def _count(data: Any) -> int | None:
    return data if isinstance(data, int) and not isinstance(data, bool) and data > 0 else None

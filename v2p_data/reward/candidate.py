"""One candidate reward as it lies on disk: its code, where it came from, and what its trainings came to.

    candidates/007/code.py, candidate.json          written once
    candidates/007/seed-0/evaluations.json          one entry per mark (a mark is `rungs[0] * steps` control steps)
    candidates/007/seed-0/done.json | fault.json    the mark up to which it is complete, or why it failed
    candidates/007/seed-0/feedback.json, trajectories.npz, train/

What a training wrote was written by a process that ran generated code: it is read as data.
"""

import math
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Literal, get_args

import numpy as np

from v2p_data.errors import V2PError
from v2p_data.json_files import json_or_none
from v2p_data.pipeline.artifact import write_json_atomically

CODE_FILE = "code.py"
CANDIDATE_FILE = "candidate.json"
EVALUATIONS_FILE = "evaluations.json"
DONE_FILE = "done.json"
FAULT_FILE = "fault.json"
FEEDBACK_FILE = "feedback.json"
TRAJECTORIES_FILE = "trajectories.npz"
TRAIN_FOLDER = "train"
LAST_POLICY = "last"
MAX_WORDS = 500
RANKING_WEIGHT = 0.1
"""So much success is made up for by a reward that pays successes more than failures instead of less: three evaluations of
64 episodes tell no smaller difference of success apart (1.96 standard errors of a difference, 0.10)."""

Kind = Literal[
    "crashed",
    "hang",
    "out_of_time",
    "out_of_memory",
    "not_finite",
    "unbounded",
    "error",
    "prescreened",
    "refused",
]
"""Why a candidate has no result. The last two never train."""
KINDS: tuple[Kind, ...] = get_args(Kind)


@dataclass(frozen=True, kw_only=True)
class Fault:
    """Why a candidate has no result."""

    kind: Kind
    reason: str

    def as_dict(self) -> dict[str, str]:
        """Return it for JSON."""
        return {"kind": self.kind, "reason": self.reason}

    @staticmethod
    def read(path: Path) -> "Fault | None":
        """Return what a file says, None where there is no such file."""
        if not path.is_file():
            return None
        data = json_or_none(path)
        said = data.get("kind") if isinstance(data, dict) else None
        kind: Kind
        for kind in KINDS:
            if kind == said:
                return Fault(kind=kind, reason=str(data.get("reason", ""))[:MAX_WORDS])
        return Fault(kind="crashed", reason="its process left no readable reason")


@dataclass(frozen=True, kw_only=True)
class Evaluation:
    """How the policy did at one mark, in worlds that no training sees; all candidates get the same ones."""

    success: float
    """Share of episodes whose success was held at their end."""
    ever: float
    """Share of episodes with success at any step."""
    closeness: float
    """How much of the video's displacement of the manipulated object happened, 0 to 1; 0 where it is not known."""
    touched: float
    """Share of steps at which the gripper touched that object."""
    control_steps: int
    """What the evaluation took, over all worlds."""
    ranking: float | None = None
    """Probability that a success earned more generated reward than a failure; None where there are none of either."""

    @property
    def rank(self) -> float:
        """Success first, then whose reward tells success from failure; where nobody succeeds, who is on the way to it."""
        on_the_way = 0.5 * self.ever + 0.4 * self.closeness + 0.1 * self.touched
        ranking = float(self.success > 0) if self.ranking is None else self.ranking
        return self.success + 0.1 * on_the_way + RANKING_WEIGHT * ranking

    @staticmethod
    def of(data: Any) -> "Evaluation":
        """Read one entry.

        Raises:
            ValueError, TypeError, KeyError: it is none.
        """
        shares = {k: float(data[k]) for k in ("success", "ever", "closeness", "touched")}
        if not all(math.isfinite(v) and 0 <= v <= 1 for v in shares.values()):
            raise ValueError("a share is not between 0 and 1")
        ranking = data.get("ranking")
        if ranking is not None and not 0 <= float(ranking) <= 1:
            raise ValueError("a probability is not between 0 and 1")
        return Evaluation(
            **shares,
            control_steps=max(0, int(data["control_steps"])),
            ranking=None if ranking is None else float(ranking),
        )


@dataclass(frozen=True, kw_only=True)
class Training:
    """One training of a candidate on one seed, as far as it came."""

    folder: Path
    evaluations: tuple[Evaluation, ...] = ()
    done: int = 0
    """Marks that are complete."""
    reached: bool = False
    """It stopped at the last of them because it succeeds often enough."""
    seconds: float = 0.0
    fault: Fault | None = None

    def is_done(self, mark: int) -> bool:
        """Tell whether nothing is left to do up to a mark."""
        return self.fault is not None or self.reached or self.done >= mark

    def success(self, count: int, mark: int | None = None) -> float:
        """Return the mean success of the last `count` evaluations up to a mark, 0 without any."""
        return _mean([e.success for e in self._last(count, mark)])

    def rank(self, count: int, mark: int | None = None) -> float:
        """Return the mean rank of the last `count` evaluations up to a mark, -1 without any."""
        last = self._last(count, mark)
        return _mean([e.rank for e in last]) if last else -1.0

    def _last(self, count: int, mark: int | None) -> tuple[Evaluation, ...]:
        return self.evaluations[:mark][-count:]

    @staticmethod
    def load(folder: Path) -> "Training":
        """Read how far a training came; an empty one where there is nothing."""
        fault = Fault.read(folder / FAULT_FILE)
        try:
            entries = json_or_none(folder / EVALUATIONS_FILE) or []
            done = json_or_none(folder / DONE_FILE) or {}
            evaluations = tuple(Evaluation.of(e) for e in entries)
            mark, reached = int(done.get("mark", 0)), bool(done.get("reached", False))
            seconds = float(done.get("seconds", 0.0))
            mark = min(mark, len(evaluations))
        except (ValueError, TypeError, KeyError, AttributeError) as error:
            return Training(
                folder=folder,
                fault=fault
                or Fault(kind="crashed", reason=f"its results are unreadable: {error}"),
            )
        return Training(
            folder=folder,
            evaluations=evaluations,
            done=mark,
            reached=reached,
            seconds=seconds,
            fault=fault,
        )


@dataclass(frozen=True, kw_only=True)
class Candidate:
    """One reward of the search."""

    folder: Path
    number: int
    iteration: int
    code: str = field(repr=False)
    """Whole task code."""
    parent: int | None = None
    """The candidate it was written from."""
    origin: str = "template"
    """Who wrote its reward: `given` with the task, or else a `template`, rules of `reflection` or a `model`."""
    reasons: tuple[str, ...] = ()

    def save(self) -> None:
        """Write code and origin."""
        self.folder.mkdir(parents=True, exist_ok=True)
        (self.folder / CODE_FILE).write_text(self.code)
        write_json_atomically(
            self.folder / CANDIDATE_FILE,
            {
                "number": self.number,
                "iteration": self.iteration,
                "parent": self.parent,
                "origin": self.origin,
                "reasons": list(self.reasons),
            },
        )

    @staticmethod
    def load(folder: Path) -> "Candidate":
        """Read what `save` wrote.

        Raises:
            V2PError: there is no candidate.
        """
        data = json_or_none(folder / CANDIDATE_FILE)
        if not isinstance(data, dict):
            raise V2PError(f"{folder} holds no candidate of a reward search")
        return Candidate(
            folder=folder,
            number=data["number"],
            iteration=data["iteration"],
            code=(folder / CODE_FILE).read_text(),
            parent=data["parent"],
            origin=data["origin"],
            reasons=tuple(data["reasons"]),
        )

    def training(self, seed: int = 0) -> Training:
        """Return how far its training on one of its seeds came."""
        return Training.load(self.training_folder(seed))

    def training_folder(self, seed: int = 0) -> Path:
        """Return where a training lies."""
        return self.folder / f"seed-{seed}"

    def fail(self, fault: Fault, seed: int = 0) -> None:
        """Write down that it has no result."""
        folder = self.training_folder(seed)
        folder.mkdir(parents=True, exist_ok=True)
        write_json_atomically(folder / FAULT_FILE, fault.as_dict())

    def policy_folder(self, seed: int = 0) -> Path:
        """Return the policy at the end of a training."""
        return self.training_folder(seed) / TRAIN_FOLDER / LAST_POLICY


def load_candidates(search: Path) -> list[Candidate]:
    """Return all candidates of a search, in the order in which they were written."""
    return [
        Candidate.load(path.parent)
        for path in sorted((search / "candidates").glob(f"*/{CANDIDATE_FILE}"))
    ]


def _mean(values: list[float]) -> float:
    return float(np.mean(values)) if values else 0.0

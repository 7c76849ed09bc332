"""Holds a success function against the video it was written for, and against moments that must not count.

The video's own tracked poses become states: success must be false at the first and should be true at the last.
Probes say what else must be false: the reset, a mere touch, an object flung by, carried where it should stand,
off the table. A search over the workspace says whether success can be reached at all. Tracked poses are
noisy, so a success that is false at the last one costs points; a success that is true at the start is vetoed.

The moments are built in `audit_probes` and answered in the child process of `smoke`.
"""

from dataclasses import asdict, dataclass, field
from typing import Any

import numpy as np

from v2p_data.kinds import KINDS
from v2p_data.scene.scene import Scene
from v2p_data.task.audit_probes import AT_END, PATH_END, AuditProbes, hands_of
from v2p_data.task.smoke import SmokeResult

SMALLEST_M = 0.02
"""A success after less displacement is within what tracking and contact jitter give."""
ACCEPTABLE_SCORE = 0.5
VETO_WORDS = {
    "first_pose": "its success is true at the video's first pose already",
    "reset": "its success is true at a reset already",
    "reachable": "its success is true in none of the states that were tried all over the workspace",
}
ALWAYS_TRUE = "its success is always true"


@dataclass(frozen=True, kw_only=True)
class Check:
    """One line of the audit table."""

    name: str
    asks: str
    passed: bool
    share: float
    """Share of its rows for which success was true; for `becomes_true` the displacement [m]."""
    weight: float
    is_veto: bool = False


@dataclass(frozen=True, kw_only=True)
class Audit:
    """The table, and what follows from it."""

    checks: tuple[Check, ...] = ()
    score: float = 0.0
    """0 to 1."""
    vetoed: str = ""
    """The first failed veto, in words."""
    true_from_pose: int | None = None
    """The first tracked pose from which success is true to the end."""
    threshold_m: float | None = None
    """Displacement along the video's motion at which success becomes true."""
    notes: tuple[str, ...] = field(default=())

    @property
    def is_acceptable(self) -> bool:
        return not self.vetoed and self.score >= ACCEPTABLE_SCORE

    def as_dict(self) -> dict[str, Any]:
        """Return it for JSON."""
        return asdict(self) | {"acceptable": self.is_acceptable}


def audit(scene: Scene, probes: AuditProbes, result: SmokeResult) -> Audit:
    """Return the audit table of one sample from what the child said."""
    if not result.runnable:
        return Audit(vetoed=f"it does not run: {result.error}")
    success = np.array(result.probe_success, bool)
    reward = np.array(result.probe_reward)
    answers = {name: success[rows] for name, rows in probes.rows.items()}
    num_hands = len(hands_of(scene))

    def any_hand(name: str) -> Any:
        return np.any(answers[name].reshape(num_hands, -1), axis=0)

    path = any_hand("path")
    begins = int(np.argmax(path)) if path.any() else None
    threshold = probes.path_m[begins] if begins is not None else None
    length = probes.path_m[-1] / PATH_END
    tracked = any_hand("tracked")
    last = bool(any_hand("last").any())
    if (
        KINDS[scene.kind].end == "in_air"
    ):  # true at the highest pose will do: the clip may set it down again
        last = last or bool(tracked.any())

    rises = _reward_rises(probes, reward, num_hands)
    turns = KINDS[scene.kind].end == "on_side"
    threshold_good = threshold is not None and (
        turns or SMALLEST_M <= threshold <= max(1.3 * length, 0.15)
    )
    checks = (
        _must_be_false("first_pose", "false at the video's first pose?", answers["first"], 0.0, veto=True),
        _must_be_false("reset", "false at every reset?", answers["reset"], 0.0, veto=True),
        Check(
            name="reachable",
            asks="true somewhere in the workspace?",
            passed=bool(answers["reachable"].any() or path.any()),
            share=float(answers["reachable"].mean()),
            weight=0.0,
            is_veto=True,
        ),
        Check(
            name="last_pose",
            asks="true at the video's last pose?",
            passed=last,
            share=float(last),
            weight=0.25,
        ),
        Check(
            name="becomes_true",
            asks="true after a plausible displacement?",
            passed=threshold_good,
            share=-1.0 if threshold is None else threshold,
            weight=0.1,
        ),
        _must_be_false("touched", "false when merely touched?", answers["touched"], 0.15),
        _must_be_false("flung", "false when it flies past?", answers["flung"], 0.15),
        _must_be_false("in_the_air", "false where it should stand, or barely lifted?", answers["in_the_air"], 0.15),
        _must_be_false("off_the_table", "false off the table?", answers["off_the_table"], 0.1),
        Check(
            name="reward_rises",
            asks="does the reward rise along the video's motion?",
            passed=rises > 0,
            share=rises,
            weight=0.05,
        ),
        Check(
            name="no_warnings",
            asks="did the trial run go without warnings?",
            passed=not result.warnings,
            share=float(len(result.warnings)),
            weight=0.05,
        ),
    )  # fmt: skip
    failed = [VETO_WORDS[c.name] for c in checks if c.is_veto and not c.passed]
    if success.all():
        failed = [ALWAYS_TRUE]
    total = sum(c.weight for c in checks)
    return Audit(
        checks=checks,
        score=round(sum(c.weight for c in checks if c.passed) / total, 4),
        vetoed=failed[0] if failed else "",
        true_from_pose=_true_from(tracked),
        threshold_m=threshold,
        notes=result.warnings,
    )


def _must_be_false(
    name: str, asks: str, answers: np.ndarray, weight: float, *, veto: bool = False
) -> Check:
    return Check(
        name=name,
        asks=asks,
        passed=not answers.any(),
        share=float(answers.mean()),
        weight=weight,
        is_veto=veto,
    )


def _true_from(answers: np.ndarray) -> int | None:
    """Return the first index from which all are true."""
    wrong = np.flatnonzero(~answers)
    first = int(wrong[-1]) + 1 if len(wrong) else 0
    return first if first < len(answers) else None


def _reward_rises(probes: AuditProbes, reward: np.ndarray, num_hands: int) -> float:
    """Return by how much the best reward over the hands is higher at the video's end than at its start."""
    path = reward[probes.rows["path"]].reshape(num_hands, -1).max(0)
    return float(path[AT_END] - path[0])

"""Holds a success function against the video it was written for, and against moments that must not count.

The score is a margin: by how much of what reconstruction may have got wrong a success still tells the video's end from
its start and from near misses. Poses and sizes are disturbed by half, once, one and a half and twice the measured error
(`audit_probes`); counted is how often the answer stays right, on both sides. A search over the workspace says whether
success can be reached at all.

What no success may do is vetoed: be true at the start, for a mere touch, for an object that flies past, or at a start
of the sample's own reset; and that reset may not begin near the goal, at one place only, or where nothing can lie
(`reset_audit`). A success that hangs on other worlds does not pass the trial run (`smoke`).
"""

from dataclasses import asdict, dataclass, field, replace
from typing import Any

import numpy as np

from v2p_data.kinds import KINDS
from v2p_data.scene.scene import Scene
from v2p_data.task.audit.moments import AT_END, PATH_END, AuditProbes, hands_of
from v2p_data.task.audit.resets import AROUND_VIDEO_M, SPREAD_M, ResetFindings, reset_findings
from v2p_data.task.sandbox.smoke import SmokeResult

SMALLEST_M = 0.02
"""A success after less displacement is within what tracking and contact jitter give."""
ACCEPTABLE_SCORE = 0.5
VETO_WORDS = {
    "first_pose": "its success is true at the video's first pose already",
    "reset": "its success is true at a reset already",
    "reachable": "its success is true in none of the states that were tried all over the workspace",
    "touched": "its success is true when the object is merely touched",
    "flung": "its success is true while the object flies past, held by nobody",
    "starts_false": "its own reset starts it in success",
    "starts_far": "its own reset starts the object near its goal: most of the video's way is done already",
    "starts_upright": "its own reset starts the object turned otherwise than in the video",
    "starts_possible": "its own reset starts objects in the air, in the table, in each other or out of reach",
    "starts_differ": "its own reset starts the object nearly always at the same place",
    "starts_like_video": "its own reset leaves out where the video itself begins",
}
ALWAYS_TRUE = "its success is always true"
FALSE_AT_END = "its success is false at the video's end, where a condition made from the caption's words is true"
LEAST_OF_REFERENCE = 0.5
"""Of the disturbed ends at which a trusted success is true, another one must be true at so many."""


@dataclass(frozen=True, kw_only=True)
class Check:
    """One line of the audit table."""

    name: str
    asks: str
    passed: bool
    share: float
    """Share of its rows for which success was true; for `becomes_true` the displacement [m], for `starts_differ` and
    `starts_like_video` a distance [m]."""
    weight: float
    is_veto: bool = False
    right: float | None = None
    """Share of right answers, where these count in proportion; else all or nothing does."""

    @property
    def earned(self) -> float:
        """What it adds to the score."""
        return self.weight * (float(self.passed) if self.right is None else self.right)


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

    @property
    def end_share(self) -> float:
        """Share of the video's disturbed ends at which success is true."""
        return next((c.share for c in self.checks if c.name == "accepts_end"), 0.0)

    def held_to(self, reference: "Audit") -> "Audit":
        """Return it with a veto where its success is false at ends at which a trusted one is true.

        A trusted success that is false there too says that the video's end was measured wrongly.
        """
        is_false = self.end_share < LEAST_OF_REFERENCE * reference.end_share
        return replace(self, vetoed=FALSE_AT_END) if is_false and not self.vetoed else self

    def as_dict(self) -> dict[str, Any]:
        """Return it for JSON."""
        return asdict(self) | {"acceptable": self.is_acceptable}


MARGINS = {
    "accepts_end": (
        "does it stay true at the video's last pose, disturbed by the error of measurement?",
        0.4,
    ),
    "rejects_start": ("does it stay false at the first pose, disturbed alike?", 0.15),
    "rejects_near_misses": ("does it stay false at near misses, disturbed alike?", 0.2),
}
"""What is asked of disturbed poses, and its weight."""


def audit(scene: Scene, probes: AuditProbes, result: SmokeResult) -> Audit:
    """Return the audit table of one sample from what the child said."""
    if not result.runnable:
        return Audit(vetoed=f"it does not run: {result.error}")
    success = np.array(result.probe_success, bool)
    answers = {name: success[rows] for name, rows in probes.rows.items()}
    num_hands = len(hands_of(scene))

    def any_hand(name: str) -> Any:
        return np.any(answers[name].reshape(num_hands, -1), axis=0)

    path, tracked = any_hand("path"), any_hand("tracked")
    threshold = probes.path_m[int(np.argmax(path))] if path.any() else None
    last = bool(any_hand("last").any())
    if (
        KINDS[scene.kind].end == "in_air"
    ):  # true at the highest pose will do: the clip may set it down again
        last = last or bool(tracked.any())
    disturbed = {
        "accepts_end": any_hand("disturbed_last"),
        "rejects_start": ~any_hand("disturbed_first"),
        "rejects_near_misses": ~answers["near_misses"],
    }
    checks = (
        *_vetoes(answers, can_be_reached=bool(answers["reachable"].any() or path.any())),
        *_of_reset(reset_findings(scene, probes.starts, result)),
        *[_margin(name, right) for name, right in disturbed.items()],
        Check(
            name="last_pose",
            asks="true at the video's last pose?",
            passed=last,
            share=float(last),
            weight=0.0,
        ),
        Check(
            name="becomes_true",
            asks="true after a plausible displacement?",
            passed=_is_plausible(threshold, scene, probes),
            share=-1.0 if threshold is None else threshold,
            weight=0.05,
        ),
        *_minor_checks(
            answers, result, _reward_rises(probes, np.array(result.probe_reward), num_hands)
        ),
    )
    failed = [VETO_WORDS[c.name] for c in checks if c.is_veto and not c.passed]
    if success.all():
        failed = [ALWAYS_TRUE]
    total = sum(c.weight for c in checks)
    return Audit(
        checks=checks,
        score=round(sum(c.earned for c in checks) / total, 4),
        vetoed=failed[0] if failed else "",
        true_from_pose=_true_from(tracked),
        threshold_m=threshold,
        notes=result.warnings,
    )


def _vetoes(answers: dict[str, np.ndarray], *, can_be_reached: bool) -> tuple[Check, ...]:
    """Return the checks each of which refuses a sample by itself."""
    return (
        _must_be_false(
            "first_pose", "false at the video's first pose?", answers["first"], 0.0, veto=True
        ),
        _must_be_false("reset", "false at every reset?", answers["reset"], 0.0, veto=True),
        Check(
            name="reachable",
            asks="true somewhere in the workspace?",
            passed=can_be_reached,
            share=float(answers["reachable"].mean()),
            weight=0.0,
            is_veto=True,
        ),
        _must_be_false(
            "touched", "false when merely touched?", answers["touched"], 0.0, veto=True
        ),
        _must_be_false("flung", "false when it flies past?", answers["flung"], 0.0, veto=True),
    )


def _minor_checks(
    answers: dict[str, np.ndarray], result: SmokeResult, rises: float
) -> tuple[Check, ...]:
    """Return the checks that cost a sample little."""
    return (
        _must_be_false(
            "in_the_air",
            "false where it should stand, or barely lifted?",
            answers["in_the_air"],
            0.05,
        ),
        _must_be_false("off_the_table", "false off the table?", answers["off_the_table"], 0.05),
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
    )


def _is_plausible(threshold_m: float | None, scene: Scene, probes: AuditProbes) -> bool:
    """Return whether success begins after a displacement that the video's motion suggests."""
    if threshold_m is None or KINDS[scene.kind].end == "on_side":
        return threshold_m is not None
    return SMALLEST_M <= threshold_m <= max(1.3 * probes.path_m[-1] / PATH_END, 0.15)


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


def _margin(name: str, right: np.ndarray) -> Check:
    """Return a check of disturbed poses; its share is that of right answers, at all sizes of the error together."""
    asks, weight = MARGINS[name]
    share = float(right.mean()) if len(right) else 1.0
    return Check(name=name, asks=asks, passed=share > 0.5, share=share, weight=weight, right=share)


def _of_reset(found: ResetFindings) -> list[Check]:
    """Return the checks of a sample's own reset, all of them vetoes."""
    table = {
        "starts_false": (
            "false at every start of its own reset?",
            found.solved == 0,
            found.solved,
        ),
        "starts_far": (
            "does its reset leave the way to do?",
            found.near_goal == 0,
            found.near_goal,
        ),
        "starts_upright": (
            "does its reset turn things as in the video?",
            found.leaning <= 0.5,
            found.leaning,
        ),
        "starts_possible": (
            "can things start as its reset says?",
            found.impossible == 0,
            found.impossible,
        ),
        "starts_differ": (
            "does its reset spread the object?",
            found.spread_m >= SPREAD_M,
            found.spread_m,
        ),
        "starts_like_video": (
            "is the video's start among its starts?",
            found.outside_m <= AROUND_VIDEO_M,
            found.outside_m,
        ),
    }
    return [
        Check(name=name, asks=asks, passed=passed, share=share, weight=0.0, is_veto=True)
        for name, (asks, passed, share) in table.items()
    ]


def _true_from(answers: np.ndarray) -> int | None:
    """Return the first index from which all are true."""
    wrong = np.flatnonzero(~answers)
    first = int(wrong[-1]) + 1 if len(wrong) else 0
    return first if first < len(answers) else None


def _reward_rises(probes: AuditProbes, reward: np.ndarray, num_hands: int) -> float:
    """Return by how much the best reward over the hands is higher at the video's end than at its start."""
    path = reward[probes.rows["path"]].reshape(num_hands, -1).max(0)
    return float(path[AT_END] - path[0])

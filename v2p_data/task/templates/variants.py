"""The eight samples of a task: doubts about the video, smoothness, form, extra observations.

Sample 0 has the shapes that were measured to train fastest. The others differ in what a video leaves open: how far is
far enough, given the error of what was measured; how still is still; whether the goal is what the words say or where
the video ended; whether the object must be held, or let go; how it must be turned. Sample 6 is the naive success of the
paper's figure 11, on purpose: the audit must refuse it.
"""

from dataclasses import dataclass
from typing import Literal

POSITION_ERROR_M = 0.015
"""Median distance between a reconstructed and the true position, both ends of a clip: docs/lab/reconstruction.md,
"Measured on drawn clips"."""
SIZE_ERROR_M, SIZE_ERROR_SHARE = 0.0084, 0.11
"""Median error of a reconstructed extent, in metres and as a share of it: same table."""
TOLERANCE_STEP_M = POSITION_ERROR_M / 2
"""A tolerance of a few centimetres changes by this where a way changes by the whole error."""
Asked = Literal["words", "any", "strict"]
"""What success demands: what the words of the kind of task say, nothing, or more."""


@dataclass(frozen=True, kw_only=True)
class Variant:
    """What makes one sample differ from the others."""

    idea: str
    """One sentence; goes into the reward's docstring."""
    slack: float = 0.0
    """Errors of measurement by which success is satisfied with less than what was measured; below 0, asks for more."""
    still_m_s: float = 0.15
    """Success demands that the object is slower than this."""
    still_rad_s: float = 0.0
    """And that it turns slower than this; 0 where it is not asked."""
    goal: Literal["words", "video"] = "words"
    """Whether success is what the words say of the objects, or where the object came to be in the video."""
    holds: Asked = "words"
    """Whether the gripper must have the object at the end, or must have let go."""
    upright: Asked = "words"
    """Whether the object must still stand as at the start."""
    is_naive: bool = False
    """Success looks at the main condition only."""
    kernel: str = "tanh"
    """How nearness falls off with distance: `tanh`, `exp`, `mixed` or `rational`."""
    temperature: float = 8.0
    form: str = "sum"
    """`sum`: all parts at once; `staged`: later parts replace earlier ones; `product`: progress counts when near."""
    reach: float = 0.2
    contact: float = 0.2
    progress: float = 0.6
    speed: float = 0.0
    """Weight of the object's velocity towards the goal."""
    effort: float = 0.005
    step_cost: float = 0.0
    observes: tuple[str, ...] = ()
    """Extra observations: `distance`, `remaining`, `goal`."""


VARIANTS = (
    Variant(idea="Reach, then make progress; all parts add up."),
    Variant(
        idea="As gentle slopes as possible; the policy is told its distance from the object.",
        kernel="tanh",
        temperature=5.0,
        slack=1.0,
        still_m_s=0.1,
        progress=0.8,
        observes=("distance",),
    ),
    Variant(
        idea="A coarse and a fine slope, so that neither far nor near is flat.",
        kernel="mixed",
        goal="video",
        reach=0.3,
        contact=0.1,
        observes=("remaining",),
    ),
    Variant(
        idea="Stages: once in contact, only what follows counts.",
        form="staged",
        slack=-1.0,
        still_rad_s=1.0,
        upright="strict",
        contact=0.3,
        progress=0.8,
    ),
    Variant(
        idea="Progress counts fully only while the gripper is near.",
        form="product",
        slack=0.5,
        holds="any",
        kernel="rational",
        temperature=12.0,
        progress=0.8,
        observes=("distance", "remaining"),
    ),
    Variant(
        idea="Moving towards the goal pays at once; every step costs.",
        kernel="exp",
        temperature=6.0,
        progress=0.4,
        speed=0.3,
        step_cost=0.01,
        goal="video",
        slack=1.0,
        holds="strict",
        observes=("goal",),
    ),
    Variant(
        idea="Only what the words say must be true, and the slopes are steep.",
        is_naive=True,
        temperature=20.0,
        reach=0.3,
        contact=0.0,
        progress=1.0,
        effort=0.0,
    ),
    Variant(
        idea="Nearly sparse: a small pull to the object, the rest must be found.",
        kernel="exp",
        temperature=10.0,
        reach=0.1,
        contact=0.0,
        progress=0.3,
        slack=2.0,
        still_m_s=0.05,
        still_rad_s=0.5,
        upright="any",
        observes=("distance", "goal"),
    ),
)
NUM_VARIANTS = len(VARIANTS)


def way(measured_m: float, v: Variant) -> float:
    """Return a distance that success demands, less the variant's slack [m]."""
    return round(max(measured_m - v.slack * POSITION_ERROR_M, 0.03), 3)


def tolerance(measured_m: float, v: Variant) -> float:
    """Return how far from its goal success allows an object to be, with the variant's slack [m]."""
    return round(max(measured_m + v.slack * TOLERANCE_STEP_M, measured_m / 2), 3)

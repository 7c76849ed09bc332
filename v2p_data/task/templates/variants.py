"""The eight samples of a task: how strict, how smooth, in which form, with which extra observations.

Sample 0 has the shapes that were measured to train fastest, the others are the kinds of alternatives a language
model writes, down to the naive success of the paper's figure 11.
"""

from dataclasses import dataclass


@dataclass(frozen=True, kw_only=True)
class Variant:
    """What makes one sample differ from the others."""

    idea: str
    """One sentence; goes into the reward's docstring."""
    strictness: float = 1.0
    """Factor on the distance that success demands."""
    still_m_s: float = 0.15
    """Success demands that the object is slower than this."""
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
        still_m_s=0.1,
        progress=0.8,
        observes=("distance",),
    ),
    Variant(
        idea="A coarse and a fine slope, so that neither far nor near is flat.",
        kernel="mixed",
        reach=0.3,
        contact=0.1,
        observes=("remaining",),
    ),
    Variant(
        idea="Stages: once in contact, only what follows counts.",
        form="staged",
        strictness=0.85,
        contact=0.3,
        progress=0.8,
    ),
    Variant(
        idea="Progress counts fully only while the gripper is near.",
        form="product",
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
        strictness=1.15,
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
        strictness=1.3,
        still_m_s=0.05,
        observes=("distance", "goal"),
    ),
)
NUM_VARIANTS = len(VARIANTS)

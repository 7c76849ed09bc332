"""What an expert's record says of how it was learned: who made it, and what PPO changed."""

from dataclasses import asdict, dataclass
from typing import Any, Literal

import numpy as np

from policies.evaluation.paired import Difference
from policies.evaluation.rate import Rate, wilson
from v2p_data.experts.teacher import EpisodeOutcomes, ProgramScore


@dataclass(frozen=True, kw_only=True)
class PolicyScore:
    """How one policy did on the episodes that decide which policy is kept."""

    success: Rate
    """The task's own success was held at some time."""
    median_s: float | None
    """Time to success of the successful episodes [s]; None where none is."""
    score: float
    """Mean of `policies.evaluation.paired.score`."""

    @staticmethod
    def of(played: EpisodeOutcomes, dt_s: float) -> "PolicyScore":
        """Return it from episodes with control steps of `dt_s` seconds."""
        once, steps = played.once, played.steps
        return PolicyScore(
            success=wilson(int(once.sum()), len(once)),
            median_s=dt_s * float(np.median(steps[once])) if once.any() else None,
            score=played.score,
        )


@dataclass(frozen=True, kw_only=True)
class Comparison:
    """The taught policy and PPO's on the same episodes."""

    taught: PolicyScore
    ppo: PolicyScore
    success_gain: Difference
    """PPO's success minus the taught policy's."""
    time_saved_s: Difference | None
    """Median over the episodes in which both succeed: the taught policy's time to success minus PPO's."""
    moved: float
    """Mean absolute difference of their actions in the states that the taught policy visits; actions lie in [-1, 1]."""

    @property
    def is_better(self) -> bool:
        """Tell whether PPO's policy is surely better: in success, or in time where it succeeds no less often."""
        is_faster = self.time_saved_s is not None and self.time_saved_s.low > 0
        return self.success_gain.low > 0 or (self.success_gain.value >= 0 and is_faster)


@dataclass(frozen=True, kw_only=True)
class Learned:
    """The sum of all steps; the expert itself is in the folder."""

    steps: int
    """Control steps in all, trials of programs included."""
    seconds: float
    actor_updates: int
    """Gradient steps of PPO that the expert's actor took; 0 for one that imitation alone made."""
    teacher: str
    """The program's name, or nothing."""
    trials: tuple[ProgramScore, ...]
    comparison: Comparison | None
    """Comparison of the taught policy with PPO's; None where nobody taught or PPO changed nothing."""
    stopped_by: str
    is_program: bool = False
    """No network was trained: the program acts itself."""
    is_pretrained: bool = False
    """It started from the package's expert of this kind."""

    @property
    def kept(self) -> Literal["pretrained", "taught", "ppo", "program"]:
        """Who made the expert: the package has it, imitation alone, PPO, or nobody: it is a program."""
        if self.is_program:
            return "program"
        if self.actor_updates:
            return "ppo"
        return "pretrained" if self.is_pretrained else "taught"

    @property
    def made_by(self) -> str:
        """Say who made the expert, in a few words."""
        if self.is_program:
            return f"program: '{self.teacher}' itself, nothing was learned"
        taught = f"imitation of the program '{self.teacher}'" if self.teacher else ""
        if self.is_pretrained:
            taught = "the package's expert of this kind, learned on other objects"
        if self.kept in ("taught", "pretrained"):
            return f"{self.kept}: {taught}"
        ppo = f"{self.actor_updates:,} gradient steps of PPO"
        return f"{taught}, then {ppo}" if taught else ppo

    def as_dict(self) -> dict[str, Any]:
        """Return it for JSON."""
        return {"kept": self.kept, "made_by": self.made_by, **asdict(self)}

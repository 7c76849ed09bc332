"""Settings of an evaluation."""

from dataclasses import dataclass
from typing import Literal

from v2p_data.task.task import POLICY_HORIZON_SCALE


@dataclass(frozen=True, kw_only=True)
class EvaluationConfig:
    """How a policy is judged."""

    episodes: int = 100
    """Episodes per task."""
    worlds: int = 128
    """Episodes at the same time; a policy's network sees their pictures as one batch."""
    horizon_scale: float = POLICY_HORIZON_SCALE
    """An episode lasts at most this multiple of the task's own horizon: experts need about half of theirs."""
    at_end: bool = True
    """Go on after the first success and ask again at the end; else an episode is over with its first success."""

    reset: Literal["task", "base"] = "task"
    """Who says where an episode begins: the task's own code, or the environment, as for a task without a reset of its
    own. With `base`, a task that has its own is judged both ways, and both rates are shown."""

    def __post_init__(self) -> None:
        if self.episodes < 1 or self.worlds < 1:
            raise ValueError(
                f"episodes and worlds must be at least 1, got {self.episodes} and {self.worlds}"
            )
        if self.horizon_scale <= 0:
            raise ValueError(f"horizon_scale must be above 0, got {self.horizon_scale}")

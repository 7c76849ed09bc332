"""Settings of the reward search."""

import math
from dataclasses import dataclass


@dataclass(frozen=True, kw_only=True)
class RewardConfig:
    """What is searched, and with how many control steps."""

    iterations: int = 0
    """Rounds of rewards, 0: no search; the paper takes 5, and 8 for hard tasks. Without a model
    the first is the only one."""
    candidates: int = 8
    """Rewards per round (the paper's number)."""
    steps: int = 400_000
    """Control steps of a candidate that trains to the end: lifting a box takes about so many from nothing."""
    rungs: tuple[float, ...] = (0.1, 0.2, 0.4, 1.0)
    """Shares of `steps` after which a round's candidates are judged and the worse part of them stops."""
    keep: float = 0.5
    """Share of the candidates that goes on after a rung, rounded down, at least one."""
    gate: float = 0.05
    """Only who is at most so far behind the best one of all rounds, at the same step, trains to the end."""
    num_envs: int = 256
    """Worlds in which a candidate trains."""
    eval_worlds: int = 192
    """Episodes that judge a candidate after each rung, the same for all: a standard error of 0.036 at most."""
    target_success: float = 0.95
    """Where a candidate reaches this after a rung, the others stop and the search ends."""
    bonus_ratio: float = 1.0
    """What a step of success earns in training, in full rewards: a reward adds up to 1 just before success, times
    100. Of the experts too. The paper's lambda of 100 is 100 here; docs/rewards.md has the measurement."""

    def __post_init__(self) -> None:
        rising = list(self.rungs) == sorted(set(self.rungs))
        if not self.rungs or not rising or self.rungs[0] <= 0 or self.rungs[-1] != 1.0:
            raise ValueError(f"rungs must rise from above 0 to 1.0, got {self.rungs}")
        for name in ("candidates", "steps", "num_envs", "eval_worlds"):
            if getattr(self, name) < 1:
                raise ValueError(f"{name} must be at least 1, got {getattr(self, name)}")
        if not 0 <= self.bonus_ratio < math.inf:
            raise ValueError(f"bonus_ratio must be 0 or more, got {self.bonus_ratio}")
        if self.iterations < 0 or not 0 < self.keep < 1:
            raise ValueError(
                f"need iterations >= 0 and 0 < keep < 1, got {self.iterations} and {self.keep}"
            )

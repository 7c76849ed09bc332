"""The arm waits while a slow gripper travels.

The gripper of the training simulator closes within 0.2 s and real ones take up to a second. A policy that lifts as soon as it has closed the
training gripper would leave a slow one behind. A held arm makes both look alike.
"""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float


@dataclass(frozen=True, kw_only=True)
class GripperWaitConfig:
    """When the arm waits; openings are shares of the stroke."""

    least_gap: float = 0.1
    """Commanded opening against the reported one; less is a fine adjustment."""
    least_travel: float = 0.008
    """In one step of 50 ms; with less the gripper is at rest: it is done, or it holds something."""
    latency_steps: int = 3
    """A gripper that has just been commanded does not move yet."""
    most_steps: int = 40
    """Then the arm goes on, whatever the gripper does."""


class GripperWait:
    """Holds the arm in one episode.

    Args:
        cfg: when.
    """

    def __init__(self, cfg: GripperWaitConfig | None = None) -> None:
        self.cfg = cfg or GripperWaitConfig()
        self._last: float | None = None
        self._waited = 0

    def is_waiting(self, opening: float, target_opening: float) -> bool:
        """Return whether the arm has to wait in this step.

        Args:
            opening: reported, 0 closed, 1 open.
            target_opening: commanded so far.
        """
        cfg = self.cfg
        travelled = 0.0 if self._last is None else abs(opening - self._last)
        self._last = opening
        if abs(target_opening - opening) <= cfg.least_gap:
            self._waited = 0
            return False
        self._waited += 1
        has_begun = travelled > cfg.least_travel
        return self._waited <= cfg.most_steps and (has_begun or self._waited <= cfg.latency_steps)

    def held(
        self, action: Float[np.ndarray, "7"], opening: float, target_opening: float
    ) -> Float[np.ndarray, "7"]:
        """Return the action, without its motion of the arm where the arm has to wait."""
        if not self.is_waiting(opening, target_opening):
            return action
        return np.concatenate([np.zeros(6), action[6:]])

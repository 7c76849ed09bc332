"""The arm waits while a slow gripper travels.

The gripper of the training simulator closes within 0.2 s and real ones take up to a second. A
policy that lifts as soon as it has closed the training gripper would leave a slow one behind. A
held arm makes both look alike.
"""

import numpy as np
from jaxtyping import Float

LEAST_GAP = 0.1
"""Commanded opening against the reported one, shares of the stroke; less is a fine adjustment."""
LEAST_TRAVEL = 0.008
"""Share of the stroke in one step of 50 ms; with less the gripper is at rest: it is done, or it holds something."""
LATENCY_STEPS = 3
"""A gripper that has just been commanded does not move yet."""
MOST_STEPS = 40
"""Then the arm goes on, whatever the gripper does."""


class GripperWait:
    """Holds the arm in one episode."""

    def __init__(self) -> None:
        self._last: float | None = None
        self._waited = 0

    def is_waiting(self, opening: float, target_opening: float) -> bool:
        """Return whether the arm has to wait in this step.

        Args:
            opening: reported, 0 closed, 1 open.
            target_opening: commanded so far.
        """
        travelled = 0.0 if self._last is None else abs(opening - self._last)
        self._last = opening
        if abs(target_opening - opening) <= LEAST_GAP:
            self._waited = 0
            return False
        self._waited += 1
        has_begun = travelled > LEAST_TRAVEL
        return self._waited <= MOST_STEPS and (has_begun or self._waited <= LATENCY_STEPS)

    def held(
        self, action: Float[np.ndarray, "7"], opening: float, target_opening: float
    ) -> Float[np.ndarray, "7"]:
        """Return the action, without its motion of the arm where the arm has to wait."""
        if not self.is_waiting(opening, target_opening):
            return action
        return np.concatenate([np.zeros(6), action[6:]])

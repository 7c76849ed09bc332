"""What makes a reward useless whatever it was meant for: it is not finite, it never varies, or it knows no bounds."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Float32

from v2p_data.task.task import FULL_REWARD, MAX_REWARD

FLAT_SHARE = 1e-6
"""A reward that differs by less than this part of its size, or of 1, never varies."""


@dataclass(frozen=True, kw_only=True)
class RewardFault:
    """Why nothing can be learned from a reward."""

    reason: str
    """A slug: `not_finite`, `constant` or `unbounded`."""
    words: str
    """How it goes on after "the reward": one sentence."""
    value: float
    """The number that decided."""


def reward_fault(
    rewards: Float[np.ndarray, "n"] | Float32[np.ndarray, "n"], where: str
) -> RewardFault | None:
    """Return what is wrong with the rewards of some moments, None where nothing is.

    Args:
        rewards: at least one.
        where: what the moments are, in words.
    """
    n = len(rewards)
    bad = int((~np.isfinite(rewards)).sum())
    if bad:
        return RewardFault(
            reason="not_finite", words=f"is not finite in {bad} of {n} {where}", value=float(bad)
        )
    largest = float(np.abs(rewards).max())
    if largest > MAX_REWARD:
        return RewardFault(
            reason="unbounded",
            words=f"reaches {largest:.3g} in {n} {where}; a full one is {FULL_REWARD:g}, and beyond {MAX_REWARD:g} "
            "nothing else counts",
            value=largest,
        )
    if float(rewards.max() - rewards.min()) <= FLAT_SHARE * max(1.0, largest):
        return RewardFault(
            reason="constant",
            words=f"is {rewards[0]:.4g} in each of {n} {where}, so that nothing can be learned from it",
            value=float(rewards[0]),
        )
    return None

"""Two policies on the same episodes: by how much one is better, and how far that can be trusted."""

import math
from dataclasses import asdict, dataclass

import numpy as np
from jaxtyping import Bool, Float

Z_95 = 1.959963984540054
"""Two-sided 95 % quantile of the normal distribution."""
LEAST_PAIRS = 6
"""Fewer pairs give no 95 % interval of a median, whatever they are."""
TIME_WEIGHT = 0.1
"""What the time to success counts beside success itself: an episode that succeeds at its very end is worth 0.9."""


@dataclass(frozen=True, kw_only=True)
class Difference:
    """A paired difference with its 95 % interval."""

    value: float
    low: float
    high: float
    pairs: int

    @property
    def is_clear(self) -> bool:
        """Whether the interval leaves out 0."""
        return self.low > 0 or self.high < 0

    def as_dict(self) -> dict[str, float | int]:
        """Return it for JSON."""
        return asdict(self)


def success_difference(ours: Bool[np.ndarray, "n"], theirs: Bool[np.ndarray, "n"]) -> Difference:
    """Return by how much ours succeeds more often than theirs, on the same episodes.

    The interval is the normal one after half a pair was added to each of the four outcomes, so that it does not shrink
    to nothing where no pair differs.

    Source: Agresti & Min 2005, section 2.
    """
    pairs = ours.astype(float) - theirs
    n, net, changed = len(pairs) + 2, pairs.sum(), np.abs(pairs).sum() + 1
    half = Z_95 * math.sqrt(changed - net**2 / n) / n
    return Difference(
        value=float(pairs.mean()),
        low=float(net / n - half),
        high=float(net / n + half),
        pairs=len(pairs),
    )


def median_difference(
    ours: Float[np.ndarray, "n"], theirs: Float[np.ndarray, "n"]
) -> Difference | None:
    """Return the median of ours minus theirs over the same episodes; None for fewer than six.

    The interval is that of order statistics, which asks nothing of the distribution.

    Source: Conover 1999, section 3.2.
    """
    if len(ours) < LEAST_PAIRS:
        return None
    from scipy.stats import quantile_test  # takes a second to import

    pairs = ours - theirs
    interval = quantile_test(pairs, p=0.5).confidence_interval(confidence_level=0.95)
    return Difference(
        value=float(np.median(pairs)),
        low=float(interval.low),
        high=float(interval.high),
        pairs=len(pairs),
    )


def score(success: float, waited: float) -> float:
    """Return what an episode is worth: 0 for a failure, else 1 minus a little for the time to success.

    Args:
        success: 1 for a success, else 0.
        waited: share of the episode before success was first held.
    """
    return success * (1 - TIME_WEIGHT * waited)

"""A success rate and how far it can be trusted."""

import math
from dataclasses import dataclass

Z_95 = 1.959963984540054
"""Two-sided 95 % quantile of the normal distribution."""


@dataclass(frozen=True, kw_only=True)
class Rate:
    """Successes among trials with the Wilson 95 % interval."""

    successes: int
    trials: int
    low: float
    high: float

    @property
    def value(self) -> float:
        return self.successes / self.trials

    def as_dict(self) -> dict[str, float | int]:
        """Return counts, rate and interval, for JSON."""
        return {
            "successes": self.successes,
            "trials": self.trials,
            "rate": self.value,
            "low": self.low,
            "high": self.high,
        }

    def __str__(self) -> str:
        """Return e.g. `90.0 % [59.6, 98.2] (9 of 10)`."""
        return (
            f"{100 * self.value:.1f} % [{100 * self.low:.1f}, {100 * self.high:.1f}] "
            f"({self.successes} of {self.trials})"
        )


def wilson(successes: int, trials: int) -> Rate:
    """Return the rate with its Wilson score interval, which stays honest at 0 %, at 100 % and for few trials.

    Raises:
        ValueError: no trials, or more successes than trials.

    Source: Wilson 1927; Brown, Cai, DasGupta 2001, eq. 4.
    """
    if trials < 1 or not 0 <= successes <= trials:
        raise ValueError(
            f"need trials >= 1 and 0 <= successes <= trials, got {successes} of {trials}"
        )
    p, z2 = successes / trials, Z_95**2
    centre = (p + z2 / (2 * trials)) / (1 + z2 / trials)
    half = Z_95 * math.sqrt(p * (1 - p) / trials + z2 / (4 * trials**2)) / (1 + z2 / trials)
    # At the ends the formula gives 0 and 1 up to rounding.
    low = 0.0 if successes == 0 else centre - half
    high = 1.0 if successes == trials else centre + half
    return Rate(successes=successes, trials=trials, low=low, high=high)

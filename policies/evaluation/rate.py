"""A success rate and how far it can be trusted."""

from dataclasses import dataclass


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
    from scipy.stats import binomtest  # takes a second to import

    interval = binomtest(successes, trials).proportion_ci(confidence_level=0.95, method="wilson")
    return Rate(
        successes=successes, trials=trials, low=float(interval.low), high=float(interval.high)
    )

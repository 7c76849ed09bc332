"""How well success rates of one simulator order and predict those of another.

Conventions: x is the training simulator, y the twin; one value per policy, the mean success over its tasks. MMRV is the mean over
policies i of the largest |y_i - y_j| among those j that x orders otherwise than y does. Ties of x that are none of y, and the
reverse, count as ordered otherwise. Source: Li et al. 2024 (SIMPLER), section 4.2.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float
from scipy import stats

DRAWS = 2000
"""Bootstrap samples."""


@dataclass(frozen=True, kw_only=True)
class Agreement:
    """Of success rates in two places; NaN where all policies have the same rate."""

    pearson: float
    spearman: float
    mmrv: float
    mean_gap: float
    """Mean of x - y."""

    def __getitem__(self, name: str) -> float:
        return float(getattr(self, name))


NAMES = ("pearson", "spearman", "mmrv", "mean_gap")


def agreement(x: Float[np.ndarray, "policy"], y: Float[np.ndarray, "policy"]) -> Agreement:
    """Return how well x predicts y.

    Raises:
        ValueError: fewer than three policies, or another number of them in y.
    """
    if len(x) != len(y) or len(x) < 3:
        raise ValueError(f"need the same three or more policies, got {len(x)} and {len(y)}")
    varied = np.ptp(x) > 0 and np.ptp(y) > 0
    return Agreement(
        pearson=_correlation(x, y) if varied else math.nan,
        spearman=_correlation(stats.rankdata(x), stats.rankdata(y)) if varied else math.nan,
        mmrv=mmrv(x, y),
        mean_gap=float((x - y).mean()),
    )


def _correlation(x: np.ndarray, y: np.ndarray) -> float:
    return float(np.corrcoef(x, y)[0, 1])


def mmrv(x: Float[np.ndarray, "policy"], y: Float[np.ndarray, "policy"]) -> float:
    """Return the mean maximum rank violation: 0 is the same order, 1 the worst."""
    otherwise = (x[:, None] < x) != (y[:, None] < y)
    otherwise |= otherwise.T
    return float((np.abs(y[:, None] - y) * otherwise).max(1).mean())


def leave_one_out(
    x: Float[np.ndarray, "policy"], y: Float[np.ndarray, "policy"]
) -> list[Agreement]:
    """Return the agreement without each policy in turn."""
    return [agreement(np.delete(x, k), np.delete(y, k)) for k in range(len(x))]


def bootstrap(
    x: Sequence[Sequence[Bool[np.ndarray, "episode"]]],
    y: Sequence[Sequence[Bool[np.ndarray, "episode"]]],
    rng: np.random.Generator,
    draws: int = DRAWS,
) -> dict[str, tuple[float, float]]:
    """Return 95 % intervals by name, policies and paired episodes drawn with replacement.

    Args:
        x: per policy and task, whether each episode succeeded in the training simulator.
        y: the same episodes in the twin.
        rng: of the draws.
        draws: how many.
    """
    found: dict[str, list[float]] = {name: [] for name in NAMES}
    for _ in range(draws):
        policies = rng.integers(len(x), size=len(x))
        means = np.array([_resampled(x[k], y[k], rng) for k in policies])
        value = agreement(means[:, 0], means[:, 1])
        for name in NAMES:
            found[name].append(value[name])
    return {
        name: (float(np.nanpercentile(v, 2.5)), float(np.nanpercentile(v, 97.5)))
        if np.isfinite(v).any()
        else (math.nan, math.nan)
        for name, v in found.items()
    }


def _resampled(
    x: Sequence[np.ndarray], y: Sequence[np.ndarray], rng: np.random.Generator
) -> tuple[float, float]:
    means: list[tuple[float, float]] = []
    for mine, theirs in zip(x, y, strict=True):
        chosen = rng.integers(len(mine), size=len(mine))
        means.append((float(mine[chosen].mean()), float(theirs[chosen].mean())))
    here, there = np.mean(means, axis=0)
    return float(here), float(there)

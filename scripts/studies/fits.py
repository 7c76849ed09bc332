"""What the lines of a study say together: rates with intervals, paired differences, and laws of failure against N."""

import math
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from typing import Any, Literal

import numpy as np
from jaxtyping import Float
from scipy.optimize import minimize
from scipy.special import ndtri

from policies.evaluation.rate import Rate, wilson

Row = dict[str, Any]
When = Literal["once", "at_end"]
Group = Literal["all", "shape", "category"]
Z_95 = float(ndtri(0.975))
"""Two-sided 95 % quantile of the normal distribution."""
PARAMETERS = 2
"""Of either law; a fit of as many points says nothing."""


def letters(rows: Iterable[Row], when: When = "once", group: Group = "all") -> str:
    """Return the episodes of some cells, one letter each: `1` for a success."""
    return "".join(
        judged[when]
        for row in rows
        for judged in row["objects"].values()
        if group in ("all", judged["group"])
    )


def rate(rows: Iterable[Row], when: When = "once", group: Group = "all") -> Rate | None:
    """Return the success rate over all episodes of some cells with its interval; None without an episode.

    The interval is that of the episodes: it says nothing of what other training seeds or other objects would give.
    """
    found = letters(rows, when, group)
    return wilson(found.count("1"), len(found)) if found else None


@dataclass(frozen=True, kw_only=True)
class Difference:
    """By how much one arm succeeds more often than another from the same starts."""

    value: float
    low: float
    high: float
    pairs: int
    seeds: tuple[float, ...]
    """Of each seed by itself."""

    def __str__(self) -> str:
        return f"{100 * self.value:+.1f} points ({100 * self.low:+.1f} to {100 * self.high:+.1f}, {self.pairs} pairs)"


def paired(ours: Sequence[Row], others: Sequence[Row], when: When = "once") -> Difference | None:
    """Return the difference of two arms over the seeds and objects that both have; None without any.

    The interval is the normal one after half a pair was added to each of the four outcomes, so that it does not shrink
    to nothing where no pair differs.

    Source: Agresti & Min 2005, section 2.
    """
    theirs = {row["seed"]: row for row in others}
    parts: list[np.ndarray] = []
    for row in ours:
        other = theirs.get(row["seed"])
        if other is None:
            continue
        parts.append(
            np.array(
                [
                    int(a) - int(b)
                    for name, judged in row["objects"].items()
                    for a, b in zip(judged[when], other["objects"][name][when], strict=True)
                ],
                float,
            )
        )
    if not parts:
        return None
    all_of = np.concatenate(parts)
    n, net, changed = len(all_of) + 2, all_of.sum(), np.abs(all_of).sum() + 1
    half = Z_95 * math.sqrt(changed - net**2 / n) / n
    return Difference(
        value=float(all_of.mean()),
        low=float(net / n - half),
        high=float(net / n + half),
        pairs=len(all_of),
        seeds=tuple(float(p.mean()) for p in parts),
    )


@dataclass(frozen=True, kw_only=True)
class Law:
    """Failure as a function of the number of training tasks, fitted to counts by maximum likelihood."""

    name: str
    formula: str
    parameters: tuple[float, float]
    log_likelihood: float
    failure: Callable[[Float[np.ndarray, " n"]], Float[np.ndarray, " n"]]
    num_points: int

    @property
    def is_determined(self) -> bool:
        """More values of N than parameters."""
        return self.num_points > PARAMETERS

    def __str__(self) -> str:
        a, b = self.parameters
        return f"{self.name}: {self.formula.format(a, b)}"


def fit_laws(counts: Sequence[int], rates: Sequence[Rate]) -> list[Law]:
    """Return a power law and a Michaelis-Menten law of failure against N, the likelier first; none for a single N.

    Power law: `failure = a N^-b`. Michaelis-Menten: `success = a N / (b + N)`.
    """
    if len(set(counts)) < PARAMETERS:
        return []
    n = np.asarray(counts, float)
    trials = np.array([r.trials for r in rates], float)
    failed = trials - np.array([r.successes for r in rates], float)

    def power(p: np.ndarray, at: np.ndarray) -> np.ndarray:
        return np.exp(p[0]) * at ** -p[1]

    def saturating(p: np.ndarray, at: np.ndarray) -> np.ndarray:
        return 1 - at / (np.exp(p[1]) + at) / (1 + np.exp(-p[0]))

    def likelihood(law: Callable[..., np.ndarray], p: np.ndarray) -> float:
        f = law(p, n).clip(1e-6, 1 - 1e-6)
        return float((failed * np.log(f) + (trials - failed) * np.log(1 - f)).sum())

    laws: list[Law] = []
    for name, law, starts, formula in (
        ("power law", power, ((-0.5, 0.5), (-1.0, 0.1), (0.5, 1.0)), "failure = {:.3f} N^-{:.3f}"),
        ("Michaelis-Menten", saturating, ((1.0, 1.0), (3.0, 2.0), (6.0, 0.0)), "success = {:.3f} N / ({:.2f} + N)"),
    ):  # fmt: skip
        best = min(
            (
                minimize(lambda p, f=law: -likelihood(f, p), s, method="Nelder-Mead")
                for s in starts
            ),
            key=lambda found: found.fun,
        )
        p = best.x
        told = (
            (float(np.exp(p[0])), float(p[1]))
            if law is power
            else (float(1 / (1 + np.exp(-p[0]))), float(np.exp(p[1])))
        )
        laws.append(
            Law(
                name=name,
                formula=formula,
                parameters=told,
                log_likelihood=-float(best.fun),
                failure=lambda at, f=law, p=p: f(p, np.asarray(at, float)).clip(0, 1),
                num_points=len(set(counts)),
            )
        )
    return sorted(laws, key=lambda law: -law.log_likelihood)


def failure_counts(rows: Iterable[Row]) -> dict[str, int]:
    """Return how many episodes of some cells failed in which way, the most frequent first."""
    total: dict[str, int] = {}
    for row in rows:
        for judged in row["objects"].values():
            for kind, count in judged["failures"].items():
                total[kind] = total.get(kind, 0) + count
    return dict(sorted(total.items(), key=lambda pair: (-pair[1], pair[0])))


def by_count(rows: Iterable[Row], arm: str) -> dict[int, list[Row]]:
    """Return an arm's cells by their number of tasks, smallest first."""
    found: dict[int, list[Row]] = {}
    for row in rows:
        if row["arm"] == arm:
            found.setdefault(row["n"], []).append(row)
    return dict(sorted(found.items()))

"""What the lines of a study say together: rates with intervals, paired differences, and laws of failure against N."""

from collections.abc import Callable, Iterable, Sequence
from dataclasses import asdict, dataclass
from typing import Any, Literal

import numpy as np
from jaxtyping import Float
from scipy.optimize import minimize

from policies.evaluation.paired import success_difference
from policies.evaluation.rate import Rate, wilson

Row = dict[str, Any]
When = Literal["once", "at_end"]
Group = Literal["all", "shape", "category"]
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
    """Return the difference of two arms over the seeds and objects that both have; None without any."""
    theirs = {row["seed"]: row for row in others}
    pairs: list[tuple[np.ndarray, np.ndarray]] = []
    for row in ours:
        other = theirs.get(row["seed"])
        if other is None:
            continue
        both = [
            (a == "1", b == "1")
            for name, judged in row["objects"].items()
            for a, b in zip(judged[when], other["objects"][name][when], strict=True)
        ]
        mine, its = np.array(both, bool).reshape(-1, 2).T
        pairs.append((mine, its))
    if not pairs:
        return None
    difference = success_difference(*(np.concatenate(side) for side in zip(*pairs, strict=True)))
    return Difference(
        **asdict(difference),
        seeds=tuple(float(mine.mean() - its.mean()) for mine, its in pairs),
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

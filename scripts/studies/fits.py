"""What the lines of a study say together: rates with intervals and paired differences."""

from collections.abc import Iterable, Sequence
from dataclasses import asdict, dataclass
from typing import Any, Literal

import numpy as np

from policies.evaluation.paired import success_difference
from policies.evaluation.rate import Rate, wilson

Row = dict[str, Any]
When = Literal["once", "at_end"]
Group = Literal["all", "shape", "category"]


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

"""Results of the sim-to-sim study as Markdown: rates, agreement between the simulators, sweeps."""

import math
from collections.abc import Iterable

import numpy as np

from policies.evaluation.rate import wilson
from v2p_data.seeds import rng_for

from .agreement import NAMES, Agreement, agreement, bootstrap, leave_one_out
from .results import Row
from .sweeps import SWEEPS

FEWEST_POLICIES = 3
LABELS = {
    "pearson": "Pearson r",
    "spearman": "Spearman rho",
    "mmrv": "MMRV",
    "mean_gap": "mean gap (training - twin)",
}


def table(rows: list[Row]) -> str:
    """Return all tables, one after the other; sim-to-sim stands in every title."""
    parts = [rates_table(rows), *(agreement_table(rows, p) for p in ("twin", "tracked"))]
    return "\n\n".join(p for p in (*parts, sweeps_table(rows)) if p)


def names_of(rows: Iterable[Row]) -> list[str]:
    """Return the policies in the order of their first lines."""
    return list(dict.fromkeys(r["policy"] for r in rows))


def flags(row: Row, key: str = "once") -> np.ndarray:
    """Return whether each episode succeeded."""
    return np.array([letter == "1" for letter in row[key]])


def rates_table(rows: list[Row]) -> str:
    """Return success once (and at the end) by policy, task and place."""
    order = ("training", "twin", "twin_hasty", "twin_raw", "tracked")
    places = [p for p in order if any(r["place"] == p for r in rows)]
    lines = [
        "**Sim-to-sim: success once [95 %], at the end in brackets**",
        "",
        "| policy | task | " + " | ".join(places) + " |",
        "|---|---|" + "---|" * len(places),
    ]
    found = {(r["policy"], r["task"], r["place"]): r for r in rows if r["value"] is None}
    for name, task in dict.fromkeys((p, t) for p, t, _ in found):
        cells = [_cell(found.get((name, task, place))) for place in places]
        lines.append(f"| {name} | {task} | " + " | ".join(cells) + " |")
    return "\n".join(lines)


def pairs(
    rows: list[Row], place: str
) -> dict[str, tuple[list[np.ndarray], list[np.ndarray], list[str]]]:
    """Return per policy the flags of its tasks in the training simulator and in a place, and the tasks' titles."""
    by = {(r["policy"], r["task"], r["place"]): r for r in rows if r["value"] is None}
    out: dict[str, tuple[list[np.ndarray], list[np.ndarray], list[str]]] = {}
    for name in names_of(rows):
        tasks = [t for (p, t, q) in by if p == name and q == place and (p, t, "training") in by]
        if tasks:
            out[name] = (
                [flags(by[name, t, "training"]) for t in tasks],
                [flags(by[name, t, place]) for t in tasks],
                tasks,
            )
    return out


def means(found: dict[str, tuple[list[np.ndarray], list[np.ndarray], list[str]]]) -> np.ndarray:
    """Return each policy's mean success over tasks in the training simulator and in the other place."""
    return np.array(
        [
            [np.mean([f.mean() for f in here]), np.mean([f.mean() for f in there])]
            for here, there, _ in found.values()
        ]
    )


def agreement_table(rows: list[Row], place: str) -> str:
    """Return correlations and rank violations, with the range without each policy and the bootstrap's interval."""
    found = pairs(rows, place)
    if len(found) < FEWEST_POLICIES:
        return ""
    x, y = means(found).T
    value = agreement(x, y)
    # Without one policy, two others are no correlation.
    without: list[Agreement] = leave_one_out(x, y) if len(found) > FEWEST_POLICIES else []
    spread = bootstrap(
        [here for here, _, _ in found.values()],
        [there for _, there, _ in found.values()],
        rng_for(0, "sim_to_sim", "bootstrap", place),
    )
    lines = [
        f"**Sim-to-sim: training simulator against {place}, {len(found)} policies**",
        "",
        "| measure | value | without one policy | bootstrap 95 % |",
        "|---|---|---|---|",
    ]
    for name in NAMES:
        ranges = [a[name] for a in without if not math.isnan(a[name])]
        span = f"{min(ranges):.3f} to {max(ranges):.3f}" if ranges else "-"
        low, high = spread[name]
        lines.append(f"| {LABELS[name]} | {value[name]:.3f} | {span} | {low:.3f} to {high:.3f} |")
    return "\n".join(lines)


def sweeps_table(rows: list[Row]) -> str:
    """Return success by quantity and value."""
    swept = [r for r in rows if r["value"] is not None]
    if not swept:
        return ""
    lines = [
        "**Sim-to-sim: one quantity changed in the twin**",
        "",
        "| quantity | policy, task | value: successes of episodes |",
        "|---|---|---|",
    ]
    groups = dict.fromkeys((r["place"], r["policy"], r["task"]) for r in swept)
    for sweep, policy, task in groups:
        mine = [r for r in swept if (r["place"], r["policy"], r["task"]) == (sweep, policy, task)]
        cells = ", ".join(_swept(r) for r in mine)
        quantity = SWEEPS[sweep]
        title = " ".join(quantity.title.split())
        lines.append(f"| {title} [{quantity.unit}] | {policy}, {task} | {cells} |")
    return "\n".join(lines)


def _swept(row: Row) -> str:
    overlap = f" (IoU {row['iou']:.2f})" if "iou" in row else ""
    return f"{row['value']:g}{overlap}: {row['once'].count('1')} of {len(row['once'])}"


def _cell(row: Row | None) -> str:
    if row is None:
        return "-"
    once = wilson(row["once"].count("1"), len(row["once"]))
    end = f" ({row['at_end'].count('1')})" if "at_end" in row else ""
    return f"{once.successes} of {once.trials} [{100 * once.low:.0f}, {100 * once.high:.0f}]{end}"

"""The study's figure: success and failure against the number of tasks, success per object, and kinds of failure."""

from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import NullLocator, PercentFormatter

from paper_tables import papers_value

from .config import ARMS, Arm
from .fits import (
    Row,
    by_count,
    failure_counts,
    fit_laws,
    rate,
)
from .table import is_lifting

COLOURS = (
    "#0072b2",
    "#56b4e9",
    "#d55e00",
    "#009e73",
    "#cc79a7",
    "#e69f00",
    "#555555",
    "#000000",
    "#f0e442",
)
"""Per arm; told apart with any kind of colour blindness (Okabe and Ito)."""
LEAST_FAILURE = 0.003
"""Log axes know no zero."""


def write_figure(rows: list[Row], path: Path) -> None:
    """Write the figure, in the format of the path's ending."""
    figure = Figure(figsize=(12, 9), layout="constrained")
    (success, failure), (objects, kinds) = figure.subplots(2, 2)
    _success(success, rows)
    _failure(failure, rows)
    _objects(objects, rows)
    _kinds(kinds, rows)
    path.parent.mkdir(parents=True, exist_ok=True)
    # No date, so that the same results are the same file.
    figure.savefig(path, dpi=110, metadata={"Date": None} if path.suffix == ".svg" else None)


def _style(arm: Arm) -> dict[str, Any]:
    return {"color": COLOURS[list(ARMS).index(arm)], "label": arm}


def _success(axes: Axes, rows: list[Row]) -> None:
    for arm in ARMS:
        found = by_count(rows, arm)
        if not found:
            continue
        if arm == "cop":
            total = rate(found[0])
            assert total is not None
            axes.axhline(total.value, linestyle=":", **_style(arm))
            continue
        n = np.array(list(found))
        rates = [r for cells in found.values() if (r := rate(cells))]
        value = np.array([r.value for r in rates])
        spread = [value - [r.low for r in rates], [r.high for r in rates] - value]
        axes.errorbar(n, value, yerr=spread, marker="o", capsize=3, **_style(arm))
        end = [r.value for cells in found.values() if (r := rate(cells, "at_end"))]
        axes.plot(n, end, linestyle="--", linewidth=1, color=_style(arm)["color"])
    if is_lifting(rows):
        at = papers_value("recipe/lifting videos"), papers_value("figure 5/BC-V2P")
        axes.plot(*at, "k*", label="paper (other scenes, other robot)")
    axes.set(
        title="Ten unseen objects: once (solid, 95 %), at the end (dashed)",
        xlabel="training tasks N", ylabel="success", ylim=(0, 1.02),
    )  # fmt: skip
    axes.legend(fontsize=8)


def _failure(axes: Axes, rows: list[Row]) -> None:
    counts = sorted({row["n"] for row in rows if row["n"]})
    for arm in ARMS:
        found = {n: r for n, cells in by_count(rows, arm).items() if n and (r := rate(cells))}
        if not found:
            continue
        value = np.array([max(1 - r.value, LEAST_FAILURE) for r in found.values()])
        low = np.array([max(1 - r.high, LEAST_FAILURE) for r in found.values()])
        high = np.array([max(1 - r.low, LEAST_FAILURE) for r in found.values()])
        style = _style(arm)
        axes.errorbar(list(found), value, yerr=[(value - low).clip(0), (high - value).clip(0)], marker="o", linestyle="", capsize=3, **style)  # fmt: skip
        at = np.geomspace(min(found), max(found), 60)
        for law, line in zip(
            fit_laws(list(found), list(found.values())), ("-", ":"), strict=False
        ):
            axes.plot(at, law.failure(at), line, linewidth=1, color=style["color"])
    axes.set(
        title="Failures; likelier law solid, the other dotted",
        xlabel="training tasks N", ylabel="1 - success once", xscale="log", yscale="log",
    )  # fmt: skip
    axes.set_xticks(counts, [str(n) for n in counts])
    axes.xaxis.set_minor_locator(NullLocator())
    axes.yaxis.set_major_formatter(PercentFormatter(1.0))
    axes.yaxis.set_minor_formatter(PercentFormatter(1.0))
    if axes.get_legend_handles_labels()[0]:
        axes.legend(fontsize=8)


def _objects(axes: Axes, rows: list[Row]) -> None:
    names = list(rows[0]["objects"])
    shown: list[tuple[Arm, tuple[int, list[Row]]]] = [
        (arm, list(found.items())[-1]) for arm in ARMS if (found := by_count(rows, arm))
    ]
    width = 0.8 / len(shown)
    for k, (arm, (n, cells)) in enumerate(shown):
        rates = [rate([{"objects": {name: c["objects"][name]}} for c in cells]) for name in names]
        value = np.array([r.value if r else 0.0 for r in rates])
        low = np.array([r.low if r else 0.0 for r in rates])
        high = np.array([r.high if r else 0.0 for r in rates])
        label = f"{arm}, N = {n}" if n else arm
        at = np.arange(len(names)) + (k - (len(shown) - 1) / 2) * width
        axes.bar(
            at,
            value,
            width,
            yerr=[value - low, high - value],
            error_kw={"linewidth": 0.6},
            color=_style(arm)["color"],
            label=label,
        )
    labels = [
        f"{name}{'' if rows[0]['objects'][name]['group'] == 'shape' else ' *'}" for name in names
    ]
    axes.set_xticks(np.arange(len(names)), labels, rotation=40, ha="right", fontsize=8)
    axes.set(title="Per object, largest N (* new category)", ylabel="success once", ylim=(0, 1.18))
    axes.legend(fontsize=7, ncols=5, loc="upper center")


def _kinds(axes: Axes, rows: list[Row]) -> None:
    cells = [(arm, n, found) for arm in ARMS for n, found in by_count(rows, arm).items()]
    kinds = list(failure_counts(rows))
    bottom = np.zeros(len(cells))
    for kind in kinds:
        share = np.array(
            [
                failure_counts(found).get(kind, 0) / r.trials if (r := rate(found)) else 0.0
                for _, _, found in cells
            ]
        )
        axes.bar(np.arange(len(cells)), share, bottom=bottom, label=kind.replace("_", " "))
        bottom += share
    labels = [f"{arm} {n}" if n else arm for arm, n, _ in cells]
    axes.set_xticks(np.arange(len(cells)), labels, rotation=60, ha="right", fontsize=8)
    axes.set(title="What failed, arm and N", ylabel="share of episodes", ylim=(0, 1.02))
    if kinds:
        axes.legend(fontsize=8)

"""The sim-to-sim figure: twin against training simulator, policy by policy, and success against each swept quantity."""

from pathlib import Path

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from policies.evaluation.rate import wilson

from .figure import COLOURS
from .results import Row
from .sim_to_sim import means, pairs
from .sweeps import SWEEPS

COLUMNS = 4
PLACES = {"twin": "o", "tracked": "^"}


def write_figure(rows: list[Row], path: Path) -> None:
    """Write the figure, in the format of the path's ending."""
    swept = [name for name in SWEEPS if any(r["place"] == name for r in rows)]
    count = 1 + len(swept)
    height = -(-count // COLUMNS)
    figure = Figure(figsize=(4 * COLUMNS, 3.6 * height), layout="constrained")
    axes = figure.subplots(height, COLUMNS, squeeze=False).ravel()
    figure.suptitle("sim-to-sim: no real robot")
    _scatter(axes[0], rows)
    for one, name in zip(axes[1:], swept, strict=False):
        _sweep(one, name, [r for r in rows if r["place"] == name])
    for one in axes[count:]:
        one.set_axis_off()
    path.parent.mkdir(parents=True, exist_ok=True)
    figure.savefig(path, dpi=110, metadata={"Date": None} if path.suffix == ".svg" else None)


def _scatter(axes: Axes, rows: list[Row]) -> None:
    axes.plot([0, 1], [0, 1], color="0.8", linewidth=1)
    for (place, marker), colour in zip(PLACES.items(), COLOURS, strict=False):
        found = pairs(rows, place)
        if found:
            x, y = means(found).T
            axes.plot(x, y, marker, color=colour, label=place, alpha=0.8)
    axes.set(
        title="one point a policy", xlabel="success, training simulator", ylabel="success, twin",
        xlim=(-0.03, 1.03), ylim=(-0.03, 1.03),
    )  # fmt: skip
    axes.legend(fontsize=8)


def _sweep(axes: Axes, name: str, rows: list[Row]) -> None:
    sweep = SWEEPS[name]
    groups = dict.fromkeys((r["policy"], r["task"]) for r in rows)
    for (policy, task), colour in zip(groups, COLOURS, strict=False):
        mine = sorted(
            (r for r in rows if (r["policy"], r["task"]) == (policy, task)),
            key=lambda r: r["value"],
        )
        rates = [wilson(r["once"].count("1"), len(r["once"])) for r in mine]
        value = np.array([r.value for r in rates])
        spread = [value - [r.low for r in rates], [r.high for r in rates] - value]
        at = [r["value"] for r in mine]
        axes.errorbar(
            at, value, yerr=np.array(spread).clip(0), marker="o", capsize=3, color=colour,
            label=f"{policy}, {task}",
        )  # fmt: skip
    axes.set(title=sweep.title, xlabel=sweep.unit, ylabel="success once", ylim=(-0.03, 1.05))
    axes.title.set_fontsize(9)
    axes.legend(fontsize=7)

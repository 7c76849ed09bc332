"""Results of the study of randomisations as Markdown and as a figure: rates, and episodes won and lost against `all`."""

from dataclasses import dataclass
from pathlib import Path

import numpy as np
from matplotlib.figure import Figure

from policies.evaluation.rate import Rate, wilson

from .figure import COLOURS
from .randomization import ALL, NONE, PLACES, SETTINGS
from .results import Row

LABELS = {
    ALL: "all on", NONE: "all but the noise", "noise": "action noise", "delay": "delay", "size": "size",
    "mass_friction": "mass and friction", "placement": "objects' places and turns", "camera": "camera",
    "servo": "servo gains", "arm_start": "arm's start",
}  # fmt: skip


@dataclass(frozen=True, kw_only=True)
class Compared:
    """One setting in one place, all seeds together."""

    rate: Rate
    won: int
    """Episodes that succeeded here and failed with all randomisations, of the same seed and start."""
    lost: int
    """Episodes that failed here and succeeded with all randomisations."""


def compared(rows: list[Row], setting: str, place: str) -> Compared | None:
    """Return a setting's successes and what changed against `all`; None where it has no result.

    Seeds without a result of `all` count in the rate only.
    """
    flags = {
        (r["setting"], r["seed"]): np.array([c == "1" for c in r["once"]])
        for r in rows
        if r["place"] == place
    }
    mine = {seed: f for (s, seed), f in flags.items() if s == setting}
    if not mine:
        return None
    pairs = [(f, flags[ALL, seed]) for seed, f in mine.items() if (ALL, seed) in flags]
    every = np.concatenate(list(mine.values()))
    return Compared(
        rate=wilson(int(every.sum()), len(every)),
        won=sum(int((f & ~reference).sum()) for f, reference in pairs),
        lost=sum(int((~f & reference).sum()) for f, reference in pairs),
    )


def table(rows: list[Row]) -> str:
    """Return success once [95 %] and the episodes won and lost against `all`, by setting and place."""
    seeds = sorted({r["seed"] for r in rows})
    lines = [
        f"**Randomisations off in turn: success once [95 %], episodes won and lost against all on; seeds {', '.join(map(str, seeds))}**",
        "",
        "| off | " + " | ".join(f"{p} | won, lost" for p in PLACES) + " |",
        "| --- |" + " --- | --- |" * len(PLACES),
    ]
    for setting in SETTINGS:
        found = [compared(rows, setting, place) for place in PLACES]
        if any(found):
            label = "nothing" if setting == ALL else LABELS[setting]
            lines.append(f"| {label} | " + " | ".join(_cells(c, setting) for c in found) + " |")
    return "\n".join(lines)


def write_figure(rows: list[Row], path: Path) -> None:
    """Write the rates with their intervals, in the format of the path's ending."""
    figure = Figure(figsize=(7, 4.5), layout="constrained")
    axes = figure.subplots()
    settings = [s for s in SETTINGS if any(r["setting"] == s for r in rows)]
    for k, (place, colour) in enumerate(zip(PLACES, COLOURS, strict=False)):
        found = [(i, compared(rows, s, place)) for i, s in enumerate(settings)]
        at = [(i, c.rate) for i, c in found if c is not None]
        value = np.array([r.value for _, r in at])
        spread = np.array([value - [r.low for _, r in at], [r.high for _, r in at] - value])
        axes.errorbar(
            value, [i + 0.25 * k for i, _ in at], xerr=spread.clip(0), fmt="o", capsize=3, color=colour, label=place
        )  # fmt: skip
    axes.set_yticks(
        range(len(settings)), [LABELS[s] if s == ALL else f"{LABELS[s]} off" for s in settings]
    )  # fmt: skip
    axes.invert_yaxis()
    axes.set(xlabel="success once", xlim=(-0.03, 1.03), title="sim-to-sim: no real robot")
    axes.legend()
    path.parent.mkdir(parents=True, exist_ok=True)
    figure.savefig(path, dpi=110, metadata={"Date": None} if path.suffix == ".svg" else None)


def _cells(c: Compared | None, setting: str) -> str:
    if c is None:
        return "- | -"
    rate = (
        f"{c.rate.successes} of {c.rate.trials} [{100 * c.rate.low:.0f}, {100 * c.rate.high:.0f}]"
    )
    return f"{rate} | " + ("-" if setting == ALL else f"+{c.won}, -{c.lost}")

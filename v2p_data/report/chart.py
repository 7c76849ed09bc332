"""Line charts as inline SVG: they take the page's colours, light or dark, and stay sharp on any screen."""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from jaxtyping import Float
from markupsafe import Markup, escape

MAX_POINTS = 400
"""More points than pixels only make the page larger."""
NUM_STYLES = 7
"""Colours and dashes that the page's style sheet knows, `s0` to `s6`."""
_LEFT, _RIGHT, _TOP, _BOTTOM = 42, 18, 10, 34


@dataclass(frozen=True, kw_only=True)
class Line:
    """One named curve."""

    name: str
    x: Float[np.ndarray, " n"]
    y: Float[np.ndarray, " n"]
    """Values that are not finite leave a gap."""


def line_chart(
    lines: Sequence[Line],
    *,
    title: str,
    x_label: str,
    y_range: tuple[float, float] | None = None,
    width_px: int = 360,
    height_px: int = 180,
) -> Markup:
    """Return a chart with its legend, or nothing if there is no finite value to draw.

    Args:
        lines: the curves, at most `NUM_STYLES`.
        title: what the chart shows, for screen readers and as the heading.
        x_label: quantity and unit along x.
        y_range: lowest and highest value shown; taken from the data if not given.
        width_px: of the drawing; on the page it scales with its column.
        height_px: of the drawing.
    """
    finite = [
        (line.x[ok], line.y[ok])
        for line in lines
        if (ok := np.isfinite(line.x) & np.isfinite(line.y)).any()
    ]
    if not finite:
        return Markup("")
    x_low, x_high = _span(np.concatenate([x for x, _ in finite]))
    y_low, y_high = y_range or _span(np.concatenate([y for _, y in finite]))
    plot_w, plot_h = width_px - _LEFT - _RIGHT, height_px - _TOP - _BOTTOM

    def x_px(x: Any) -> Any:
        return _LEFT + plot_w * (x - x_low) / (x_high - x_low)

    def y_px(y: Any) -> Any:
        return _TOP + plot_h * (1 - np.clip((y - y_low) / (y_high - y_low), 0, 1))

    parts: list[str] = []
    for tick in ticks(y_low, y_high, max(2, round(plot_h / 40))):
        y = y_px(tick)
        parts.append(
            f'<line class="grid" x1="{_LEFT}" x2="{width_px - _RIGHT}" y1="{y:.1f}" y2="{y:.1f}"/>'
            f'<text x="{_LEFT - 6}" y="{y + 4:.1f}" text-anchor="end">{_number(tick)}</text>'
        )
    for tick in ticks(x_low, x_high, 5):
        parts.append(
            f'<text x="{x_px(tick):.1f}" y="{height_px - _BOTTOM + 15}" text-anchor="middle">{_number(tick)}</text>'
        )
    parts.append(
        f'<text x="{width_px - _RIGHT}" y="{height_px - 5}" text-anchor="end">{escape(x_label)}</text>'
    )
    for index, line in enumerate(lines):
        step = max(1, math.ceil(len(line.x) / MAX_POINTS))
        for x, y in _unbroken(line.x[::step], line.y[::step]):
            points = " ".join(f"{u:.1f},{v:.1f}" for u, v in zip(x_px(x), y_px(y), strict=True))
            parts.append(f'<polyline class="s{index % NUM_STYLES}" points="{points}"/>')
    return Markup(
        f'<figure class="chart"><figcaption>{escape(title)}</figcaption>'
        f'<svg viewBox="0 0 {width_px} {height_px}" role="img" aria-label="{escape(_in_words(title, lines))}">'
        f"{''.join(parts)}</svg>{_legend(lines)}</figure>"
    )


def training_charts(curve: Mapping[str, np.ndarray]) -> list[Markup]:
    """Return success, return and reward parts over control steps."""
    steps = curve.get("steps")
    if steps is None or not len(steps):
        return []

    def lines(names: Mapping[str, str]) -> list[Line]:
        return [Line(name=words, x=steps, y=curve[k]) for k, words in names.items() if k in curve]

    parts = {
        k: k.removeprefix("reward_").replace("_", " ") for k in curve if k.startswith("reward_")
    }
    charts = [
        line_chart(
            lines({"success_deterministic": "deterministic", "success_stochastic": "exploring"}),
            title="Success while training",
            x_label="control steps",
            y_range=(0.0, 1.0),
        ),
        line_chart(
            lines({"return": "mean return"}), title="Return per episode", x_label="control steps"
        ),
        line_chart(
            lines(parts)[:NUM_STYLES], title="Reward parts, mean per step", x_label="control steps"
        ),
    ]
    return [chart for chart in charts if chart]


def _legend(lines: Sequence[Line]) -> str:
    """Return the list of the curves' names; nothing for one curve: the title says what it is."""
    entries = "".join(
        f'<li><svg class="key" viewBox="0 0 24 8" aria-hidden="true">'
        f'<line class="s{i % NUM_STYLES}" x1="1" x2="23" y1="4" y2="4"/></svg>{escape(line.name)}</li>'
        for i, line in enumerate(lines)
    )
    return f'<ul class="legend">{entries}</ul>' if len(lines) > 1 else ""


def ticks(low: float, high: float, about: int) -> list[float]:
    """Return round numbers between `low` and `high`, `about` of them up to a factor of two."""
    raw = (high - low) / about
    power = 10.0 ** math.floor(math.log10(raw))
    step = next(power * m for m in (1, 2, 5, 10) if power * m >= raw * (1 - 1e-9))
    first = math.ceil(low / step - 1e-9)
    return [k * step for k in range(first, math.floor(high / step + 1e-9) + 1)]


def _span(values: np.ndarray) -> tuple[float, float]:
    low, high = float(values.min()), float(values.max())
    if high - low > 1e-9 * max(1.0, abs(low)):
        return low, high
    return low - 0.5 * max(1.0, abs(low)), high + 0.5 * max(1.0, abs(high))


def _unbroken(x: np.ndarray, y: np.ndarray) -> list[tuple[np.ndarray, np.ndarray]]:
    """Return the stretches without a gap."""
    ok = np.isfinite(x) & np.isfinite(y)
    edges = np.flatnonzero(np.diff(np.concatenate([[False], ok, [False]]).astype(int)))
    return [(x[a:b], y[a:b]) for a, b in zip(edges[::2], edges[1::2], strict=True)]


def _number(value: float) -> str:
    size = abs(value)
    if size >= 1e6:
        return f"{value / 1e6:g} M"
    if size >= 1e3:
        return f"{value / 1e3:g} k"
    return f"{round(value, 6):g}"


def _in_words(title: str, lines: Sequence[Line]) -> str:
    """Return what a person who cannot see the chart should know: where each curve starts and ends."""
    ends = []
    for line in lines:
        y = line.y[np.isfinite(line.y)]
        if len(y):
            ends.append(f"{line.name} from {y[0]:.3g} to {y[-1]:.3g}")
    return f"{title}: {'; '.join(ends)}"

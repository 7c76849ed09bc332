"""The curves of a PPO training as charts."""

from collections.abc import Mapping

import numpy as np
from markupsafe import Markup

from v2p_data.report.chart import NUM_STYLES, Line, line_chart


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

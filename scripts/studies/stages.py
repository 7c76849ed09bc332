"""Stages of a study, made by the engine's workers."""

from collections.abc import Callable, Sequence
from typing import Any

from v2p_data.pipeline.runner import Outcome, Runtime, Stage
from v2p_data.pipeline.workers import run_stages


def run_shown(
    stages: Sequence[Stage], runtime: Runtime, tell: Callable[[str], None]
) -> dict[str, Outcome]:
    """Make stages; return the outcome of each by its folder's name, and tell of each that was not there."""

    def show(event: Any) -> None:
        if event.kind == "ended" and event.outcome.status != "kept":
            o = event.outcome
            tell(f"{o.stage} {o.item}: {o.status} in {o.seconds:.0f} s {o.reason}".rstrip())

    outcomes = run_stages(list(stages), runtime, show)
    return {folder: outcome for (_, folder), outcome in outcomes.items()}

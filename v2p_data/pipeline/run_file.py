"""`run.json`: what became of each result that the last command asked for, in the run folder."""

from collections.abc import Iterable
from typing import Any

from v2p_data.pipeline.runner import Outcome

RUN_FILE = "run.json"


def outcomes_json(outcomes: Iterable[Outcome]) -> list[dict[str, Any]]:
    """Return the outcomes as `run.json` holds them, without paths of this machine."""
    return [
        {
            "stage": o.stage,
            "item": o.item,
            "status": o.status,
            "folder": o.folder.name,
            "seconds": round(o.seconds, 2),
            "reason": o.reason,
            "detail": o.detail,
        }
        for o in outcomes
    ]

"""How far the command at work in a run folder is: counts that it writes as it goes, and what follows from them."""

import contextlib
import os
import time
from collections import Counter
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

from v2p_data.json_files import json_or_none, read_object
from v2p_data.pipeline.artifact import write_json_atomically
from v2p_data.pipeline.at_work import Event, is_at_work
from v2p_data.pipeline.runner import Runtime, Stage, in_order

PROGRESS_FILE = "progress.json"
WRITE_EVERY_S = 2.0
ENDS = ("kept", "made", "rejected", "failed", "blocked")


class Progress:
    """Shows events, counts them, and writes the counts into the run folder; pass it to `run_stages`."""

    def __init__(
        self, runtime: Runtime, stages: Sequence[Stage], show: Callable[[Event], None]
    ) -> None:
        self.path, self.show, self.written = runtime.root / PROGRESS_FILE, show, 0.0
        before = json_or_none(self.path)
        is_ours = isinstance(before, dict) and before.get("pid") == os.getpid()
        self.data: dict[str, Any] = (
            before
            if is_ours
            else {
                "pid": os.getpid(),
                "began": time.time(),
                "stages": {},
            }
        )
        self.data["workers"] = runtime.workers
        planned = Counter(stage.name for stage in in_order(stages))
        self.data["stages"] |= {
            name: {"planned": count} | dict.fromkeys(ENDS, 0) | {"seconds": 0.0, "running": []}
            for name, count in planned.items()
        }

    def __call__(self, event: Event) -> None:
        self.show(event)
        counts = self.data["stages"][event.stage.name]
        if event.kind == "started":
            counts["running"].append(event.stage.item)
        elif event.outcome is not None:
            if event.stage.item in counts["running"]:
                counts["running"].remove(event.stage.item)
            counts[event.outcome.status] += 1
            counts["seconds"] += event.outcome.seconds if event.outcome.status == "made" else 0.0
        if time.monotonic() - self.written > WRITE_EVERY_S:
            self.write()

    def write(self) -> None:
        """Write the counts; a full disk is told of by the stages."""
        self.data["updated"] = time.time()
        with contextlib.suppress(OSError):
            write_json_atomically(self.path, self.data)
        self.written = time.monotonic()


def progress_of(root: Path) -> dict[str, Any]:
    """Return what a run folder's last command did so far, its rates and the seconds left, as far as they are known.

    Raises:
        V2PError: no command left its counts here.
    """
    data = read_object(
        root / PROGRESS_FILE,
        "a command that makes things writes it; 'v2p status' lists what is there",
    )
    at_work = is_at_work(root)
    hours = max(1e-9, (time.time() if at_work else data["updated"]) - data["began"]) / 3600
    for counts in data["stages"].values():
        left = counts["planned"] - sum(counts[end] for end in ENDS)
        each = counts["seconds"] / counts["made"] if counts["made"] else None
        known = each is not None and data["workers"]
        counts |= {
            "left": left,
            "seconds_each": each,
            "made_per_hour": counts["made"] / hours,
            "seconds_left": 0.0 if not left else left * each / data["workers"] if known else None,
        }
        counts["running"] = counts["running"] if at_work else []
    parts = [counts["seconds_left"] for counts in data["stages"].values()]
    return {
        "run": str(root),
        "at_work": at_work,
        **data,
        "seconds_left": None if None in parts else sum(parts),
    }

"""Run the real scheduler with stand-in stages and say what it costs an item, beside the stages' own time.

    python scripts/simulate_scale.py --items=10000            # minutes: three stages an item, each writes one small file
    python scripts/simulate_scale.py --items=100000 --bare    # the scheduler alone: no folders, no processes

Every item is a chain of `scene`, `task` and `episodes`; one of fifty is rejected at its scene. The line that is printed is
JSON: seconds in all, the driver's CPU milliseconds an item, its peak memory, the CPU milliseconds an item that a second run
needs to find all of it done, and those to count the results in the run folder.
"""

import json
import resource
import tempfile
import time
from collections import Counter
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import tyro

from v2p_data.errors import ItemRejectedError
from v2p_data.pipeline import workers
from v2p_data.pipeline.artifact import RECORD_FILE
from v2p_data.pipeline.at_work import Event
from v2p_data.pipeline.runner import Outcome, Runtime, Stage
from v2p_data.pipeline.workers import run_stages

REJECTED_EVERY = 50
"""About as often as a clip that is no good."""


@dataclass(frozen=True, kw_only=True)
class ScaleConfig:
    """How much, and where."""

    items: int = 200
    workers: int = 2
    sleep_s: float = 0.0
    """What a stand-in stage takes."""
    bare: bool = False
    """Stages end at once in the driver: no process, no folder."""
    engine: Literal["local", "ray"] = "local"
    address: str = "auto"
    out: Path | None = None
    """Kept folder; by default one that is deleted."""


def main() -> None:
    """Read the command line, run, print one line."""
    cfg = tyro.cli(ScaleConfig, description=__doc__.split("\n")[0])
    with tempfile.TemporaryDirectory() as folder:
        print(json.dumps(simulate(cfg, cfg.out or Path(folder))))


def simulate(cfg: ScaleConfig, root: Path) -> dict[str, Any]:
    """Run once, and once more when all is done; return the figures."""
    runtime = Runtime(root=root, workers=cfg.workers, engine=cfg.engine, address=cfg.address)
    if cfg.bare:
        workers._engine = lambda runtime, num_pending: AtOnce(root)  # in this process only
    began = time.perf_counter()
    stages = [chain(k, cfg.sleep_s) for k in range(cfg.items)]
    planned = time.perf_counter()
    driver = time.process_time()
    outcomes = run_stages(stages, runtime, lambda event: None)
    ended = time.perf_counter()
    driver = time.process_time() - driver
    counts = Counter(outcome.status for outcome in outcomes.values())
    again = counted = time.process_time()
    if not cfg.bare:
        run_stages(stages, runtime, lambda event: None)
        counted = time.process_time()
        Counter(path.parent.parent.name for path in root.glob(f"*/*/{RECORD_FILE}"))
    slept_s = cfg.sleep_s * sum(counts[s] for s in ("made", "rejected")) / cfg.workers
    return {
        "items": cfg.items,
        "stages": dict(sorted(counts.items())),
        "engine": "none" if cfg.bare else cfg.engine,
        "workers": cfg.workers,
        "seconds": round(ended - began, 2),
        "beside_the_stages_ms_per_item": round(1e3 * (ended - began - slept_s) / cfg.items, 3),
        "plan_ms_per_item": round(1e3 * (planned - began) / cfg.items, 3),
        "driver_cpu_ms_per_item": round(1e3 * driver / cfg.items, 3),
        "driver_peak_mb": resource.getrusage(resource.RUSAGE_SELF).ru_maxrss // 1024,
        "second_run_cpu_ms_per_item": round(1e3 * (counted - again) / cfg.items, 3),
        "count_cpu_ms_per_item": round(1e3 * (time.process_time() - counted) / cfg.items, 3),
    }


def chain(number: int, sleep_s: float) -> Stage:
    """Return the stages of one item."""
    item = f"clip_{number:07d}"
    scene = Stage(
        name="scene", item=item, config={"sleep_s": sleep_s, "number": number}, make=make
    )
    task = Stage(
        name="task", item=item, config={"sleep_s": sleep_s}, inputs={"scene": scene}, make=make
    )
    return Stage(
        name="episodes", item=item, config={"sleep_s": sleep_s}, inputs={"task": task}, make=make
    )  # fmt: skip


def make(
    config: dict[str, Any], inputs: Mapping[str, Path], out: Path, runtime: Runtime
) -> dict[str, Any]:
    """Sleep and write a small file; reject some."""
    del inputs, runtime
    time.sleep(config["sleep_s"])
    if config.get("number", 1) % REJECTED_EVERY == 0:
        raise ItemRejectedError("stand_in", "rejected, as some clips are")
    (out / "text").write_text("x" * 100)
    return {"letters": 100}


class AtOnce:
    """Ends every stage as soon as it is asked for."""

    def __init__(self, root: Path) -> None:
        self.root = root
        self.stages: list[Stage] = []

    @property
    def is_busy(self) -> bool:
        return bool(self.stages)

    @property
    def has_room(self) -> bool:
        return len(self.stages) < 2

    def start(self, stage: Stage) -> None:
        self.stages.append(stage)

    def events(self) -> Iterator[Event]:
        stage = self.stages.pop(0)
        is_good = stage.config.get("number", 1) % REJECTED_EVERY != 0
        outcome = Outcome(
            stage=stage.name, item=stage.item, status="made" if is_good else "rejected",
            folder=stage.folder(self.root),
        )  # fmt: skip
        yield Event(kind="ended", stage=stage, outcome=outcome)

    def close(self) -> None:
        pass


if __name__ == "__main__":
    main()

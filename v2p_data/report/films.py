"""Films of judged episodes: some successes, some failures, each named for what it is."""

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from v2p_data.report.media import write_film
from v2p_data.report.sheet import Judged, draw_rollout
from v2p_data.sim.model.world import World
from v2p_data.sim.render.masks import MaskRenderer
from v2p_data.task.task import TaskBundle

SUCCESS, FAILURE = "success", "failure"


@dataclass(frozen=True, kw_only=True)
class FilmConfig:
    """Which episodes are filmed, and how."""

    successes: int = 2
    failures: int = 2
    size_px: int = 256


def write_films(
    source: TaskBundle | World, judged: Judged, folder: Path, cfg: FilmConfig | None = None
) -> list[Path]:
    """Write `success_0007.mp4` and the like, numbered by the episode; return their paths."""
    cfg = cfg or FilmConfig()
    chosen = [(SUCCESS, k) for k in np.flatnonzero(judged.successes)[: cfg.successes]]
    chosen += [(FAILURE, k) for k in np.flatnonzero(~judged.successes)[: cfg.failures]]
    folder.mkdir(parents=True, exist_ok=True)
    paths: list[Path] = []
    with MaskRenderer(source, cfg.size_px) as renderer:
        for name, world in chosen:
            snapshots = judged.snapshots[: int(judged.num_frames[world])]
            seconds = judged.snapshot_seconds
            fps = 1.0 / (seconds[1] - seconds[0]) if len(seconds) > 1 else 1.0
            path = folder / f"{name}_{world:04d}.mp4"
            write_film(path, draw_rollout(renderer, snapshots, int(world)), fps)
            paths.append(path)
    return paths

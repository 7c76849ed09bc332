"""Measure what it is worth that clips share a camera: each clip alone, then with the camera that all of its stand say together.

Clips are drawn in folders, one person each, with one camera on one stand and different things on one table. They are
reconstructed as `bench_reconstruction.py` does; then what the accepted scenes of a stand say of their camera is put together, as `v2p
scene camera` does, and all its clips are reconstructed once more with that. Stands of the tuning half have even numbers; the odd
ones are kept, and nothing may be tuned on them.

    python scripts/bench_one_camera.py --split tune --stands 12
    python scripts/bench_one_camera.py --split tune --stands 12 --boxes
"""

import argparse
import json
import os
from collections.abc import Iterable
from dataclasses import dataclass, replace
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np

from bench_reconstruction import (
    FPS,
    KINDS,
    commit,
    drawn,
    each,
    reconstructed,
    summarised,
    table,
)
from drawn_clips.clips import MotionKind, VideoSpec, random_spec
from v2p_data.scene.config import SceneConfig
from v2p_data.scene.scale.shared_camera import FEWEST, Filmed, shared_camera
from v2p_data.seeds import rng_for

_TRIES = 100
"""Cameras, until one sees clips of all kinds that its stand is to have."""

Row = dict[str, Any]


@dataclass(frozen=True, kw_only=True)
class StandJob:
    """One of several clips that are filmed from one stand."""

    stand: int
    place: int
    """Among the stand's clips."""
    clips: int
    """Of that stand."""

    @property
    def kind(self) -> MotionKind:
        return KINDS[(self.stand * self.clips // 2 + self.place) % len(KINDS)]

    @property
    def seed(self) -> int:
        return 100 * self.stand + self.place

    @property
    def name(self) -> str:
        return f"stand_{self.stand:03d}_{self.place}_{self.kind}"

    def spec(self) -> VideoSpec:
        """Return all that is drawn."""
        return replace(_filmed_from(self.stand, self.clips)[self.place], name=self.name, fps=FPS)


@cache
def _filmed_from(stand: int, clips: int) -> tuple[VideoSpec, ...]:
    kinds = [StandJob(stand=stand, place=place, clips=clips).kind for place in range(clips)]
    for attempt in range(_TRIES):
        first = random_spec("first", kinds[0], rng_for(stand, "stand", attempt))
        try:
            return tuple(
                random_spec(kind, kind, rng_for(stand, "stand", attempt, place), beside=first)
                for place, kind in enumerate(kinds)
            )
        except ValueError:  # it does not see what one of them needs
            continue
    raise ValueError(f"no camera sees all {clips} clips of stand {stand}")


def main() -> None:
    """Read the command line, draw, reconstruct twice, compare, print."""
    args = _arguments()
    args.out.mkdir(parents=True, exist_ok=True)
    odd = {"tune": 0, "final": 1}[args.split]
    jobs = [
        StandJob(stand=2 * k + odd, place=place, clips=args.clips)
        for k in range(args.stands)
        for place in range(args.clips)
    ]
    folders = drawn(jobs, args)
    given = frozenset({"boxes"} if args.boxes else ())
    name = f"{args.split}{'_boxes' if args.boxes else ''}"

    def rows_of(way: str, cameras: dict[int, SceneConfig | None]) -> list[Row]:
        pictures = args.out / f"pictures_{name}_{way}"
        tasks = [(job, folders[job.name], given, pictures, cameras.get(job.stand)) for job in jobs]
        rows = list(each(args.jobs, reconstructed, tasks, f"reconstructed {way},"))
        return sorted(rows, key=lambda row: row["name"])

    alone = rows_of("alone", {})
    by_stand = {
        job.stand: [row for row in alone if row["seed"] // 100 == job.stand] for job in jobs
    }
    cameras = {stand: camera_of(rows) for stand, rows in by_stand.items()}
    together = rows_of("together", cameras)
    for way, rows in (("alone", alone), ("together", together)):
        summary = summarised(rows)
        result = {"commit": commit(), "jobs": args.jobs, "summary": summary, "rows": rows}
        (args.out / f"{name}_{way}.json").write_text(json.dumps(result, indent=1) + "\n")
        print(f"\n=== each clip {way} ===\n")
        print(table(rows, summary, boxes=args.boxes, jobs=args.jobs))
    print()
    print(compared(alone, together))


def camera_of(rows: Iterable[Row]) -> SceneConfig | None:
    """Return the settings that the accepted scenes among these give together; None where there are too few."""
    clips = [Filmed(**row["camera"]) for row in rows if row["accepted"]]
    if len(clips) < FEWEST:
        return None
    camera = shared_camera(clips)
    return SceneConfig(
        camera_height_m=camera.height_m,
        pitch_rad=camera.pitch_rad,
        fov_rad=camera.fov_rad,
        camera_spread=camera.spread,
    )


def compared(alone: list[Row], together: list[Row]) -> str:
    """Return how many clips are usable in each way, and which changed."""
    better = [a["name"] for a, b in zip(alone, together, strict=True) if b["usable"] > a["usable"]]
    worse = [a["name"] for a, b in zip(alone, together, strict=True) if a["usable"] > b["usable"]]
    lines = []
    for words, rows in (("each alone", alone), ("together", together)):
        s = summarised(rows)
        rate, size, position = s["usable"], s["errors"]["size_share"], s["errors"]["position_m"]
        seen = [row for row in rows if row.get("camera")]
        lines.append(
            f"{words:10}: usable {rate['successes']} of {rate['trials']} = {rate['rate']:.0%} [{rate['low']:.0%}, {rate['high']:.0%}], "
            f"size {size['median']:.1%}, position {100 * position['median']:.2f} cm, camera's height off by {_height_error(seen):.1%} (rms)"
        )
    return "\n".join([*lines, f"won {len(better)}: {better}", f"lost {len(worse)}: {worse}"])


def _height_error(rows: list[Row]) -> float:
    off = np.log([row["height_m"] / row["true_height_m"] for row in rows])
    return float(np.sqrt(np.mean(off**2)))


def _arguments() -> argparse.Namespace:
    parser = argparse.ArgumentParser(description=(__doc__ or "").split("\n")[0])
    parser.add_argument("--split", choices=["tune", "final"], default="tune")
    parser.add_argument("--stands", type=int, default=12)
    parser.add_argument("--clips", type=int, default=5, help="clips of one stand")
    parser.add_argument("--boxes", action="store_true", help="one box per named object as a hint")
    parser.add_argument("--jobs", type=int, default=os.cpu_count() or 1, help="processes at once")
    parser.add_argument(
        "--old-clips",
        action="store_true",
        help="take clips that another version of the drawing code drew",
    )
    parser.add_argument("--out", type=Path, default=Path("outputs/bench_one_camera"))
    args = parser.parse_args()
    if args.stands < 1 or args.jobs < 1 or not FEWEST <= args.clips <= 100:
        parser.error(
            f"--stands and --jobs must be at least 1, and --clips {FEWEST} to 100, as many as a folder has"
        )
    return args


if __name__ == "__main__":
    main()

"""Judged episodes as pictures: contact sheets, a row per episode and a column per moment, and films."""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Protocol, runtime_checkable

import cv2
import numpy as np
from jaxtyping import Bool, Int, UInt8

from v2p_data.errors import V2PError
from v2p_data.report.media import png_bytes, write_film
from v2p_data.sim.model.world import World
from v2p_data.sim.render.masks import MaskRenderer, Moment, labels_to_rgb
from v2p_data.task.task import TaskBundle

GROUND, INK, GOOD, BAD = (250, 249, 246), (40, 44, 50), (26, 112, 66), (176, 50, 42)
SUCCESS, FAILURE = "success", "failure"
_TEXT_SCALE, _TEXT_WIDTH = 0.42, 1


@dataclass(frozen=True, kw_only=True)
class SheetConfig:
    """How a contact sheet is laid out."""

    successes: int = 5
    """Rows of successful episodes, at most."""
    failures: int = 5
    """Rows of failed episodes, at most; they show what is still missing."""
    moments: int = 8
    """Columns."""
    thumbnail_px: int = 160
    label_px: int = 112
    """Width of the words at the left."""
    gap_px: int = 4


@dataclass(frozen=True, kw_only=True)
class FilmConfig:
    """Which episodes are filmed, and how."""

    successes: int = 2
    failures: int = 2
    size_px: int = 256


@dataclass(frozen=True, kw_only=True)
class Row:
    """One episode of a sheet."""

    label: str
    """ASCII; the drawing font knows nothing else."""
    succeeded: bool
    frames: UInt8[np.ndarray, "time h w 3"]
    seconds: tuple[float, ...]
    """Since the start, per frame."""


@runtime_checkable
class Judged(Protocol):
    """Finished episodes of one batch of worlds."""

    @property
    def successes(self) -> Bool[np.ndarray, "env"]: ...

    @property
    def num_frames(self) -> Int[np.ndarray, "env"]:
        """How many of the snapshots belong to each world's episode."""
        ...

    @property
    def snapshots(self) -> Sequence[Moment]:
        """All worlds, at moments in order of time."""
        ...

    @property
    def snapshot_seconds(self) -> Sequence[float]:
        """When each was taken, since the episodes' start."""
        ...


def write_contact_sheet(
    source: TaskBundle | World, judged: Judged, path: Path, cfg: SheetConfig | None = None
) -> None:
    """Draw successful and failed episodes, each from its own start to its own end, and write them as one PNG."""
    cfg = cfg or SheetConfig()
    chosen = [
        *np.flatnonzero(judged.successes)[: cfg.successes],
        *np.flatnonzero(~judged.successes)[: cfg.failures],
    ]
    rows: list[Row] = []
    # Twice the size, then averaged: the renderer does not smooth edges, for the masks' sake.
    with MaskRenderer(source, 2 * cfg.thumbnail_px) as renderer:
        for env in map(int, chosen):
            moments = evenly(int(judged.num_frames[env]), cfg.moments)
            film = draw_rollout(renderer, [judged.snapshots[m] for m in moments], env)
            rows.append(
                Row(
                    label=f"world {env}",
                    succeeded=bool(judged.successes[env]),
                    frames=film,
                    seconds=tuple(judged.snapshot_seconds[m] for m in moments),
                )
            )
    path.write_bytes(png_bytes(contact_sheet(rows, cfg)))


def write_films(
    source: TaskBundle | World, judged: Judged, folder: Path, cfg: FilmConfig | None = None
) -> None:
    """Write `success_0007.mp4` and the like, numbered by the episode."""
    cfg = cfg or FilmConfig()
    chosen = [(SUCCESS, k) for k in np.flatnonzero(judged.successes)[: cfg.successes]]
    chosen += [(FAILURE, k) for k in np.flatnonzero(~judged.successes)[: cfg.failures]]
    folder.mkdir(parents=True, exist_ok=True)
    with MaskRenderer(source, cfg.size_px) as renderer:
        for name, world in chosen:
            snapshots = judged.snapshots[: int(judged.num_frames[world])]
            seconds = judged.snapshot_seconds
            fps = 1.0 / (seconds[1] - seconds[0]) if len(seconds) > 1 else 1.0
            path = folder / f"{name}_{world:04d}.mp4"
            write_film(path, draw_rollout(renderer, snapshots, int(world)), fps)


def draw_rollout(
    renderer: MaskRenderer, snapshots: Sequence[Moment], env: int
) -> UInt8[np.ndarray, "time h w 3"]:
    """Return one world at each snapshot, seen by the camera `view`."""
    return np.stack([draw_moment(renderer, snapshot, env) for snapshot in snapshots])


def draw_moment(renderer: MaskRenderer, snapshot: Moment, env: int) -> UInt8[np.ndarray, "h w 3"]:
    """Return one world in colour, or as its mask where there is no OpenGL."""
    try:
        return renderer.draw_rgb(snapshot, env)
    except V2PError:
        return labels_to_rgb(renderer.draw(snapshot, env))


def contact_sheet(rows: Sequence[Row], cfg: SheetConfig) -> UInt8[np.ndarray, "h w 3"]:
    """Return rows of labelled thumbnails, each with the seconds since its episode's start.

    Of longer films `cfg.moments` frames are shown, first and last among them.
    """
    side, gap = cfg.thumbnail_px, cfg.gap_px
    columns = max((len(evenly(len(row.frames), cfg.moments)) for row in rows), default=0)
    width = cfg.label_px + columns * (side + gap)
    sheet = np.full((max(1, len(rows)) * (side + gap), width, 3), GROUND, np.uint8)
    if not rows:
        _write(sheet, "no episodes", 8, 20, INK)
    for k, row in enumerate(rows):
        top = k * (side + gap)
        words, colour = ("success", GOOD) if row.succeeded else ("failure", BAD)
        cv2.rectangle(sheet, (0, top), (3, top + side - 1), colour, -1)
        _write(sheet, words, 10, top + 20, colour)
        _write(sheet, row.label, 10, top + 38, INK)
        for column, moment in enumerate(evenly(len(row.frames), cfg.moments)):
            left = cfg.label_px + column * (side + gap)
            thumbnail = cv2.resize(row.frames[moment], (side, side), interpolation=cv2.INTER_AREA)
            sheet[top : top + side, left : left + side] = thumbnail
            time = f"{row.seconds[moment]:.1f} s"
            _write(sheet, time, left + 5, top + 15, (0, 0, 0))
            _write(sheet, time, left + 4, top + 14, (255, 255, 255))
    return sheet


def evenly(count: int, wanted: int) -> list[int]:
    """Return up to `wanted` positions among `count`, evenly spread, first and last included."""
    return sorted({round(float(k)) for k in np.linspace(0, count - 1, min(count, wanted))})


def _write(image: np.ndarray, text: str, x: int, y: int, colour: tuple[int, int, int]) -> None:
    cv2.putText(
        image,
        text,
        (x, y),
        cv2.FONT_HERSHEY_SIMPLEX,
        _TEXT_SCALE,
        colour,
        _TEXT_WIDTH,
        cv2.LINE_AA,
    )

"""`v2p scene camera`: what all scenes of a run together say of the one camera that filmed them."""

import shlex
import sys
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import tyro

from v2p_data.cli import command_of, parse
from v2p_data.errors import V2PError, did_you_mean
from v2p_data.pipeline.artifact import Record
from v2p_data.report.reading import records_in
from v2p_data.scene.scale.shared_camera import (
    FEWEST,
    Filmed,
    SharedCamera,
    filmed,
    shared_camera,
)
from v2p_data.scene.scene import Scene

_SETTINGS = ("camera_height_m", "pitch_rad", "fov_rad", "camera_spread")


@dataclass(frozen=True, kw_only=True)
class OneCamera:
    run: tyro.conf.Positional[Path]
    """Run folder, the --out of 'v2p scene' or 'v2p generate', of videos that were all filmed from one stand."""
    without: tuple[str, ...] = ()
    """Names of scenes that were filmed from elsewhere."""


def camera_command(argv: list[str]) -> int:
    args = parse(OneCamera, argv, "scene camera")
    scenes = guessed_scenes(args.run)
    for item in args.without:
        if item not in scenes:
            raise V2PError(
                f"{args.run} holds no scene '{item}'.{did_you_mean(item, list(scenes))}"
            )
    clips = [
        filmed(item, scene.camera, scene.scale_spread)
        for item, (scene, _) in scenes.items()
        if item not in args.without
    ]
    if len(clips) < FEWEST:
        raise V2PError(
            f"{args.run} holds {len(clips)} scenes whose camera was guessed, and it takes at least {FEWEST} to know it"
            " better; make them with 'v2p scene VIDEOS --out RUN', without settings for the camera"
        )
    camera = shared_camera(clips)
    print(table(clips, camera))  # noqa: T201
    for item in camera.strangers:
        print(  # noqa: T201
            f"'{item}' seems to be filmed from elsewhere, or to be misunderstood: look at it, and name it with"
            " --without"
        )
    records = [record.provenance for _, record in scenes.values()]
    again = command_of(records) or ["v2p", "scene", "VIDEOS", "--out", str(args.run)]
    print(f"Next: {shlex.join([*again, *flags(camera)])}")  # noqa: T201
    if args.without:
        print(  # noqa: T201
            "That gives this camera to all videos of the folder: take those of"
            f" {', '.join(args.without)} out of it before"
        )
    return 0


def guessed_scenes(run: Path) -> dict[str, tuple[Scene, Record]]:
    """Return a run's newest scenes, by item, for whose making nobody gave the camera.

    Raises:
        V2PError: the run holds no scenes.
    """
    if not (run / "scene").is_dir():
        raise V2PError(f"{run} holds no scenes; make some with 'v2p scene VIDEOS --out RUN'")
    made: list[tuple[str, Path, Record]] = []
    for folder, record in records_in(run, "scene"):
        if isinstance(record, str):
            print(f"left out: {record}", file=sys.stderr)  # noqa: T201
        elif not record.rejected and not _given(record):
            made.append((str(record.provenance.get("time", "")), folder, record))
    made.sort(key=lambda scene: scene[0])
    newest = {record.item: (folder, record) for _, folder, record in made}
    scenes = {}
    for item in sorted(newest):
        folder, record = newest[item]
        try:
            scenes[item] = Scene.load(folder), record
        except V2PError as error:
            print(f"'{item}' is left out: {error}", file=sys.stderr)  # noqa: T201
    return scenes


def table(clips: Sequence[Filmed], camera: SharedCamera) -> str:
    """Return what each clip says beside what all say, and what all say, in words."""
    width = max(len("clip"), *(len(clip.item) for clip in clips))
    lines = [f"{'clip':<{width}}  lengths  looks down  field of view"]
    for clip, factor in zip(clips, camera.factors, strict=True):
        fov = np.degrees(2 * np.arctan(0.5 / clip.focal_widths))
        lines.append(
            f"{clip.item:<{width}}  {factor - 1:+7.0%}  {np.degrees(clip.pitch_rad):6.0f} deg  {fov:9.0f} deg"
        )
    one = float(np.median([clip.width_sd for clip in clips]))
    lines += [
        f"{len(clips)} clips from one stand: the camera is {camera.height_m:.2f} m above the table, looks "
        f"{np.degrees(camera.pitch_rad):.0f} degrees down and sees {np.degrees(camera.fov_rad):.0f} degrees "
        "from left to right",
        f"all lengths may be off by {camera.spread:.0%} together, instead of {one:.0%} clip by clip",
    ]
    return "\n".join(lines)


def flags(camera: SharedCamera) -> list[str]:
    """Return the settings that tell a camera to `v2p scene` and all that make scenes."""
    values = (camera.height_m, camera.pitch_rad, camera.fov_rad, camera.spread)
    return [
        f"--scene.{name.replace('_', '-')}={value:.3f}"
        for name, value in zip(_SETTINGS, values, strict=True)
    ]


def _given(record: Record) -> bool:
    """Return whether somebody told the camera of a scene."""
    recipe: dict[str, Any] = record.recipe.get("config") or {}
    scene: dict[str, Any] = recipe.get("scene") or {}
    return any(scene.get(name) is not None for name in _SETTINGS[:3])

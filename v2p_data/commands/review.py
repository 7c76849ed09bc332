"""`v2p scene review`: a page to judge a run's scenes on and to mark what was not found."""

import contextlib
import shlex
import threading
from collections import Counter
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any

import tyro

from policies.evaluation.rate import wilson
from v2p_data.cli import command_of, parse
from v2p_data.errors import V2PError
from v2p_data.pipeline.fingerprint import file_digest
from v2p_data.pipeline.runner import Stage
from v2p_data.pipeline.settings import from_values
from v2p_data.pipeline.workers import only_run_in
from v2p_data.report.reading import Result, read_run
from v2p_data.report.review import PAGE_FILE, REVIEW_FILE, Review, StageOf, write_review
from v2p_data.report.review_server import ReviewServer
from v2p_data.scene.config import SceneConfig
from v2p_data.scene.frames.prepare import PreparedClip
from v2p_data.stages import EngineConfig, make_scene, scene_stage
from v2p_data.video.captions import VideoItem, find_videos
from v2p_data.video.decode import VideoConfig


@dataclass(frozen=True, kw_only=True)
class ReviewRun:
    run: tyro.conf.Positional[Path]
    """Run folder, the --out of 'v2p scene' or 'v2p generate'."""
    videos: Path | None = None
    """Folder of the run's videos; by default the one that the run was made from."""
    out: Path | None = None
    """Where the page goes; by default review.html in the run folder."""
    serve: bool = False
    """Serve the page on this machine: marks are saved at once, and each marked clip is rebuilt while you look."""
    port: int = 0
    """Where --serve listens, on 127.0.0.1; 0 takes a free port."""


def review_command(argv: list[str]) -> int:
    args = parse(ReviewRun, argv, "scene review")
    results = read_run(args.run).of_stage("scene") if args.run.is_dir() else []
    folder = args.videos or video_folder(results)
    if args.serve:
        _serve(args, folder, results)
        return 0
    if not results:
        raise V2PError(f"{args.run} holds no scenes; make some with 'v2p scene VIDEOS --out RUN'")
    page = args.out or args.run / PAGE_FILE
    rows = write_review(args.run, find_videos(folder) if folder else [], page)
    print("\n".join([f"Made {page}", *summary_of(rows)]))  # noqa: T201
    if folder is None:
        print("the videos are not where they were; name their folder with --videos")  # noqa: T201
    print(f"Next: v2p scene review {shlex.quote(str(args.run))} --serve   (to mark and to judge)")  # noqa: T201
    return 0


def _serve(args: ReviewRun, folder: Path | None, results: Sequence[Result]) -> None:
    """Serve the page until Ctrl-C."""
    if folder is None:
        raise V2PError(
            f"where the videos of {args.run} are is not known here; name it with --videos"
        )
    with (
        only_run_in(args.run),
        contextlib.closing(Review(args.run, find_videos(folder), scene_stages(results))) as review,
        ReviewServer(review, args.port) as server,
    ):
        print(f"Open {server.address} in a browser of this machine; Ctrl-C ends it", flush=True)  # noqa: T201
        print(f"Marks go into {review.captions}, judgements into {args.run / REVIEW_FILE}")  # noqa: T201
        with contextlib.suppress(KeyboardInterrupt):
            threading.Event().wait()
    records = [r.record.provenance for r in results if r.record is not None]
    argv = command_of(records) if args.videos is None else None
    again = shlex.join(argv or ["v2p", "scene", str(folder), "--out", str(args.run)])
    print(f"\nNext: {again}   (the clips that were rebuilt are kept)")  # noqa: T201


def summary_of(rows: Iterable[Mapping[str, Any]]) -> list[str]:
    """Return in words how many of the page's accepted scenes were judged right, and how many refusals."""
    lines: list[str] = []
    made = [row for row in rows if row["status"] != "not made"]
    for what, good in (("accepted", "right"), ("refused", "rightly so")):
        of_kind = [r for r in made if (r["status"] == "accepted") == (what == "accepted")]
        judged = Counter(r["judgement"] for r in of_kind)
        sure = judged["right"] + judged["wrong"]
        rate = f"{good} {wilson(judged['right'], sure)}, " if sure else ""
        lines.append(f"{len(of_kind)} {what}: {rate}{len(of_kind) - sure} not judged")
    return lines


def video_folder(results: Iterable[Result]) -> Path | None:
    """Return the folder of a run's videos, as its records' command lines name it.

    A word of a command line counts if it is a folder or a video with the very file that the scene was made from.
    """
    for result in results:
        record = result.record
        for word in map(str, record.provenance.get("argv", [])[1:] if record else []):
            path = Path(word)
            with contextlib.suppress(V2PError):
                videos = {} if word.startswith("-") else {v.item: v for v in find_videos(path)}
                sources = (record.recipe.get("sources") or {}) if record else {}
                video = videos.get(result.item)
                if video and sources.get("video") in (None, file_digest(video.path)):
                    return video.path.parent.resolve()
    return None


def scene_stages(results: Iterable[Result]) -> StageOf:
    """Return how scenes are made with the settings of those that there are: made anew they differ by hints alone.

    A video without a scene is made as the newest one was.
    """
    settings: dict[str, EngineConfig] = {}
    newest = ("", EngineConfig())
    for result in results:
        if (cfg := _settings_of(result)) is not None:
            settings[result.item] = cfg
            made = str((result.record.provenance or {}).get("time", "")) if result.record else ""
            newest = max((made, cfg), newest, key=lambda pair: pair[0])

    def stage_of(video: VideoItem, prepared: Callable[[], PreparedClip] | None) -> Stage:
        stage = scene_stage(video, settings.get(video.item, newest[1]))
        return replace(stage, make=partial(make_scene, video=video, prepared=prepared))

    return stage_of


def _settings_of(result: Result) -> EngineConfig | None:
    """Return the settings that a scene was made with; None where they are not known to this version."""
    recipe = result.record.recipe.get("config") if result.record else None
    if not isinstance(recipe, dict):
        return None
    try:
        return EngineConfig(
            video=from_values(VideoConfig, recipe.get("video"), "the record's video"),
            scene=from_values(SceneConfig, recipe.get("scene"), "the record's scene"),
            seed=int(recipe.get("seed", 0)),
        )
    except (V2PError, TypeError, ValueError):
        return None

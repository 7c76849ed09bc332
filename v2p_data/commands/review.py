"""`v2p scene review`: a page to judge a run's scenes on, and what comes back from it."""

import contextlib
import hashlib
import os
import shlex
import threading
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import tyro

from policies.evaluation.rate import wilson
from v2p_data.cli import command_of, parse
from v2p_data.errors import ItemRejectedError, V2PError
from v2p_data.json_files import read_json
from v2p_data.pipeline.fingerprint import file_digest
from v2p_data.pipeline.workers import only_run_in
from v2p_data.report.reading import Result, number, read_run
from v2p_data.report.review_page import ReviewClip, Stills, stills_of, write_review
from v2p_data.video.captions import VideoItem, find_videos, written_captions
from v2p_data.video.hints import check_hints
from v2p_data.video.save_hints import merge_captions, write_captions

PAGE_FILE = "review.html"


@dataclass(frozen=True, kw_only=True)
class Review:
    run: tyro.conf.Positional[Path]
    """Run folder, the --out of 'v2p scene' or 'v2p generate'."""
    videos: Path | None = None
    """Folder of the run's videos; by default the one that the run was made from."""
    out: Path | None = None
    """Where the page goes; by default review.html in the run folder."""
    apply: Path | None = None
    """A captions.json or review.json from the page: its hints go into the captions.json beside the videos."""
    summary: Path | None = None
    """A review.json from the page: print how many of the accepted scenes are right."""
    serve: bool = False
    """Serve a page on this machine instead: marks are saved at once, and each marked clip is rebuilt while you look."""
    port: int = 0
    """Where --serve listens, on 127.0.0.1; 0 takes a free port."""


def review_command(argv: list[str]) -> int:
    args = parse(Review, argv, "scene review")
    if args.apply is not None and args.summary is not None:
        raise V2PError("give either --apply or --summary, not both")
    if args.summary is not None:
        print(summary_of(args.summary))  # noqa: T201
        return 0
    if args.serve:
        _serve(args)
        return 0
    if not (args.run / "scene").is_dir():
        raise V2PError(f"{args.run} holds no scenes; make some with 'v2p scene VIDEOS --out RUN'")
    results = read_run(args.run).of_stage("scene")
    folder = args.videos or video_folder(results)
    if args.apply is not None:
        print(_applied(args, args.apply, folder, results))  # noqa: T201
        return 0
    page = args.out or args.run / PAGE_FILE
    clips = review_clips(results, folder)
    write_review(
        clips,
        page,
        title=args.run.resolve().name,
        store=_store(args.run),
        captions=_captions(folder),
        commands=_commands(args),
    )
    accepted = sum(clip.status == "accepted" for clip in clips)
    blind = sum(not clip.video for clip in clips)
    print(f"Made {page}, {page.stat().st_size / 1e6:.1f} MB")  # noqa: T201
    print(f"{len(clips)} clips: {accepted} accepted, {len(clips) - accepted} not")  # noqa: T201
    if blind:
        print(f"{blind} without their video, so without stills; name its folder with --videos")  # noqa: T201
    print("Next: open it in a browser; press ? there")  # noqa: T201
    return 0


def _serve(args: Review) -> None:
    """Serve the page until Ctrl-C."""
    from v2p_data.commands.live_review import REVIEW_FILE, LiveReview
    from v2p_data.report.review_server import ReviewServer

    results = read_run(args.run).of_stage("scene") if args.run.is_dir() else []
    folder = args.videos or video_folder(results)
    if folder is None:
        raise V2PError(
            f"where the videos of {args.run} are is not known here; name it with --videos"
        )
    with (
        only_run_in(args.run),
        contextlib.closing(LiveReview(args.run, folder)) as session,
        ReviewServer(session, args.run.resolve().name, args.port) as server,
    ):
        print(f"Open {server.address} in a browser of this machine; Ctrl-C ends it", flush=True)  # noqa: T201
        print(f"Marks go into {session.captions}, judgements into {args.run / REVIEW_FILE}")  # noqa: T201
        with contextlib.suppress(KeyboardInterrupt):
            threading.Event().wait()
    again = shlex.join(_made_by(args, session.home, results))
    print(f"\nNext: {again}   (the clips that were rebuilt are kept)")  # noqa: T201


def review_clips(results: Sequence[Result], folder: Path | None) -> list[ReviewClip]:
    """Return what the page shows of each result, the accepted first."""
    videos = {v.item: v for v in find_videos(folder)} if folder else {}
    clips = [
        _clip(result, videos.get(result.item), len(results))
        for result in results
        if result.status in ("made", "rejected", "failed")
    ]
    return sorted(clips, key=lambda clip: (clip.status != "accepted", clip.item))


def video_folder(results: Sequence[Result]) -> Path | None:
    """Return the folder that most of a run's videos came from, as its records' command lines name it.

    A word of the command line counts if it is a folder or a video with the very file that the scene was made from.
    """
    votes: Counter[Path] = Counter()
    known: dict[Path, dict[str, VideoItem]] = {}
    for result in results:
        argv = result.record.provenance.get("argv", []) if result.record else []
        for word in dict.fromkeys(str(a) for a in argv[1:]):
            path = Path(word)
            if word.startswith("-") or not path.exists():
                continue
            home = (path if path.is_dir() else path.parent).resolve()
            if home not in known:
                known[home] = _videos_in(home)
            if result.item in known[home] and _is_source(known[home][result.item], result):
                votes[home] += 1
    return votes.most_common(1)[0][0] if votes else None


def summary_of(path: Path) -> str:
    """Return in words how many accepted scenes were judged right, and which were not.

    Raises:
        V2PError: the file is no review.
    """
    clips = _read_review(path)
    accepted = [c for c in clips if c.get("status") == "accepted"]
    refused = [c for c in clips if c.get("status") != "accepted"]
    lines: list[str] = []
    for what, rows, good in (("accepted", accepted, "right"), ("refused", refused, "rightly so")):
        tally = Counter(c.get("judgement") for c in rows)
        sure = tally["right"] + tally["wrong"]
        rest = f"{tally['unsure']} unsure, {len(rows) - sure - tally['unsure']} not judged"
        rate = f"{good} {wilson(tally['right'], sure)}, " if sure else ""
        lines.append(f"{len(rows)} {what}: {rate}{rest}")
    for clip in clips:
        if clip.get("judgement") == "wrong" or clip.get("note"):
            note = f": {clip['note']}" if clip.get("note") else ""
            lines.append(
                f"  {clip.get('status')} {clip.get('item')}, {clip.get('judgement') or 'not judged'}{note}"
            )
    return "\n".join(lines)


def _clip(result: Result, video: VideoItem | None, num_clips: int) -> ReviewClip:
    recipe: dict[str, Any] = (result.record.recipe.get("config") or {}) if result.record else {}
    trouble = ""
    stills: Stills | None = None
    if video is None:
        trouble = "its video is not in the folder, so no hints can be given"
    elif result.record is not None and not _is_source(video, result):
        trouble, video = (
            f"{video.path.name} is another file now than the scene was made from",
            None,
        )
    else:
        try:
            stills = stills_of(video, num_clips)
        except ItemRejectedError as error:
            trouble = error.detail
    rejected = (result.record.rejected or {}) if result.record else {}
    words: dict[str, Any] = {
        "caption": video.caption if video else str(recipe.get("caption", result.item)),
        "objects": video.objects if video else tuple(map(str, recipe.get("objects") or ())),
    }
    made = str((result.record.provenance or {}).get("time", "")) if result.record else ""
    return ReviewClip(
        item=result.item,
        key=f"{result.folder.name}@{made}",
        status="accepted" if result.status == "made" else "rejected" if result.status == "rejected" else "failed",
        used_hints=tuple(recipe.get("hints") or ()),
        folder=result.folder if result.status == "made" else None,
        reason=result.reason,
        detail=result.detail,
        value=number(rejected.get("value")),
        video=video.path.name if video and stills else "",
        hints=video.hints if video else {},
        stills=stills,
        trouble=trouble,
        **words,
    )  # fmt: skip


def _is_source(video: VideoItem, result: Result) -> bool:
    sources = result.record.recipe.get("sources") or {} if result.record else {}
    return sources.get("video") in (None, file_digest(video.path))


def _videos_in(home: Path) -> dict[str, VideoItem]:
    try:
        return {video.item: video for video in find_videos(home)}
    except V2PError:
        return {}


def _captions(folder: Path | None) -> dict[str, Any]:
    """Return the caption file's content under the names of the videos."""
    if folder is None:
        return {}
    home = folder if folder.is_dir() else folder.parent
    return written_captions(home, [video.path.name for video in find_videos(home)])


def _store(run: Path) -> str:
    """Return a name that no other run's page has, even where two run folders are named alike."""
    where = run.resolve()
    return f"{where.name}:{hashlib.sha256(os.fsencode(where)).hexdigest()[:12]}"


def _commands(args: Review) -> dict[str, str]:
    """Return what to type with each downloaded file."""
    videos = ["--videos", str(args.videos)] if args.videos else []
    review = ["v2p", "scene", "review", str(args.run)]
    return {
        "captions.json": shlex.join([*review, "--apply", "captions.json", *videos]),
        "review.json": shlex.join([*review, "--summary", "review.json"]),
    }


def _applied(args: Review, addition: Path, folder: Path | None, results: Sequence[Result]) -> str:
    """Put hints into the caption file beside the videos and return what was done, in words."""
    if folder is None:
        raise V2PError(
            f"where the videos of {args.run} are is not known here; name it with --videos"
        )
    folder = folder if folder.is_dir() else folder.parent
    merged = merge_captions(folder, addition)
    by_name = {video.path.name: video for video in find_videos(folder)}
    for name, hints in merged.hints.items():
        stills = stills_of(by_name[name], 1)
        check_hints(hints, stills.size_px, stills.num_frames, f"{addition}, entry '{name}'")
    lines = [f"  {line}" for line in (*merged.added, *merged.kept)]
    if not merged.added:
        return "\n".join(
            [f"{addition} holds no hint that {merged.path} lacks; nothing was changed", *lines]
        )
    backup = write_captions(merged)
    was = f"; the old one is {backup.name}" if backup else ""
    again = shlex.join(_made_by(args, folder, results))
    return "\n".join(
        [
            f"Made {merged.path}{was}",
            f"{len(merged.added)} hints added",
            *lines,
            f"Next: {again}   (remakes only the clips whose hints changed)",
        ]
    )


def _made_by(args: Review, folder: Path, results: Sequence[Result]) -> list[str]:
    """Return the command that made the run, with all its settings, or the plain one where it is not known."""
    records = [r.record.provenance for r in results if r.record is not None]
    argv = command_of(records) if args.videos is None else None
    return argv or ["v2p", "scene", str(folder), "--out", str(args.run)]


def _read_review(path: Path) -> list[dict[str, Any]]:
    data = read_json(path, "download it anew from the review page")
    clips = data.get("clips") if isinstance(data, dict) else None
    if not isinstance(clips, list) or not all(isinstance(c, dict) for c in clips):
        raise V2PError(
            f"{path} is no review.json: it has no list of clips; download it from the review page"
        )
    return clips

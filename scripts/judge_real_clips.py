"""Judge the reconstruction of real clips against boxes that a person drew: the table of `docs/reconstruction.md`.

Each clip is decoded and rebuilt as `v2p scene` does it, without hints, with `--boxes` with one box
per object, or with `--boxes manipulated` with a box around what is moved and nothing else, as a
person in a hurry marks it. The boxes are those of `CLIPS/boxes.json` where there is one, drawn by
whoever keeps the clips, else those of the clips that we have looked at while building
(`docs/real_clip_boxes.json`). Only clips that nobody tuned on say what to expect of others.

    {"clip1.mp4": {"rating": 4, "objects": {"red box": {"first": [210, 140, 290, 230], "last": null}}}}

Boxes are `[x0, y0, x1, y1]` in the file's pixels, null where nothing of the object is seen; the
rating may be left out. A clip is right when every outline's box overlaps the drawn one by half or
more (intersection over union), at the first and at the last frame. Whatever follows the options
goes to the engine's settings, e.g. `--scene.min-confidence 0.6`.

    python scripts/judge_real_clips.py CLIPS --out outputs/judged
    python scripts/judge_real_clips.py CLIPS --scene.preset learned --out outputs/judged_learned
    python scripts/judge_real_clips.py CLIPS --boxes --no-gate --out outputs/judged_boxes
"""

import argparse
import json
import logging
import time
from concurrent.futures import ProcessPoolExecutor
from dataclasses import asdict, dataclass, field, replace
from multiprocessing import get_context
from pathlib import Path
from typing import Any, Literal, get_args

import av
import cv2
import numpy as np
from jaxtyping import Bool, UInt8

from policies.evaluation.rate import wilson
from studies.scene_gate import gate
from v2p_data.cli import parse
from v2p_data.errors import ItemRejectedError
from v2p_data.geometry.camera import between_centres
from v2p_data.scene.data_types import Estimate, Reconstruction
from v2p_data.scene.reconstruct import reconstruct
from v2p_data.seeds import rng_for
from v2p_data.stages import EngineConfig
from v2p_data.video.captions import VideoItem, find_videos
from v2p_data.video.clip import Clip, Hint
from v2p_data.video.decode import read_clip
from v2p_data.video.meaning import parse_caption

DRAWN = Path(__file__).parents[1] / "docs" / "real_clip_boxes.json"
RIGHT_IOU = 0.5
WELL_SUITED = 4
"""Clips rated so or better are those that one view can show."""
CLIPS_PER_SHEET = 8
_LEAST = (0.0, 0.3, 0.4, 0.5, 0.6, 0.7, 0.8, 0.9)
_PICTURE_PX = 400
_RED, _GREEN, _WHITE = (235, 30, 30), (40, 220, 40), (255, 255, 255)

Hinted = Literal["none", "all", "manipulated"]
"""Which objects' drawn boxes are given as hints."""
Box = list[float]
"""`[x0, y0, x1, y1]` [px of the file as shown]."""


@dataclass(kw_only=True)
class Verdict:
    """What became of one clip."""

    clip: str
    rating: int
    """How well suited a person found it, 1 to 5; 0 where nobody said."""
    reason: str = ""
    """Slug of the rejection; empty where it was accepted."""
    number: float | None = None
    """What decided the rejection."""
    confidence: float | None = None
    stages: dict[str, float] = field(default_factory=dict[str, float])
    """Confidence of each stage; `confidence` is their product."""
    gate: str = ""
    """Slug with which the default settings turn away what `--no-gate` accepted; empty where they accept it."""
    kind: str = ""
    ious: dict[str, dict[str, float]] = field(default_factory=dict[str, dict[str, float]])
    """By object, then `first` and `last`. An object that is left out has no entry."""
    missing: tuple[str, ...] = ()
    """Objects of the caption that are not in the scene."""
    right: bool = False
    seconds: float = 0.0
    frames: int = 0

    @property
    def accepted(self) -> bool:
        return not self.reason


def main() -> None:
    """Read the command line, judge every clip, print the table, write it and the pictures."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").split("\n")[0])
    parser.add_argument("videos", type=Path, help="folder of the clips, or one clip")
    parser.add_argument(
        "--boxes",
        nargs="?",
        choices=get_args(Hinted),
        const="all",
        default="none",
        help="give drawn boxes as hints: one per object, or one for the manipulated object alone",
    )
    parser.add_argument("--no-gate", action="store_true", help="reject nothing for low confidence")
    parser.add_argument("--out", type=Path, help="folder for judged.json and the pictures")
    parser.add_argument("--jobs", type=int, default=1, help="clips at a time")
    parser.add_argument(
        "--drawn", type=Path, help="the boxes drawn by hand; CLIPS/boxes.json where there is one"
    )
    parser.add_argument("--only", default="", help="clips whose file name has this in it")
    args, rest = parser.parse_known_args()
    logging.basicConfig(level=logging.ERROR)
    cfg = parse(EngineConfig, rest, "scene")
    if args.no_gate:
        cfg = replace(cfg, scene=cfg.scene.without_gate())
    beside = (args.videos if args.videos.is_dir() else args.videos.parent) / "boxes.json"
    args.drawn = args.drawn or (beside if beside.is_file() else DRAWN)
    drawn: dict[str, Any] = json.loads(args.drawn.read_text(encoding="utf-8"))
    videos = [
        v for v in find_videos(args.videos) if v.path.name in drawn and args.only in v.path.name
    ]
    if not videos:
        parser.error(f"{args.videos} holds none of the {len(drawn)} clips of {args.drawn}")
    work = [(v, drawn[v.path.name], cfg, args.boxes) for v in videos]
    verdicts: list[Verdict] = []
    pictures: list[UInt8[np.ndarray, "h w 3"]] = []
    print(HEAD)
    for verdict, picture in _each(work, args.jobs):
        verdicts.append(verdict)
        pictures.append(picture)
        print(row(verdict), flush=True)
    print(totals(verdicts))
    if args.out:
        args.out.mkdir(parents=True, exist_ok=True)
        (args.out / "judged.json").write_text(
            json.dumps([{**asdict(v), "accepted": v.accepted} for v in verdicts], indent=1) + "\n",
            encoding="utf-8",
        )
        for number, sheet in enumerate(sheets(pictures)):
            cv2.imwrite(str(args.out / f"sheet_{number}.png"), sheet[..., ::-1])


def judge(
    video: VideoItem, drawn: dict[str, Any], cfg: EngineConfig, boxes: Hinted
) -> tuple[Verdict, UInt8[np.ndarray, "h w 3"]]:
    """Rebuild one clip and compare it with what was drawn; return the verdict and its picture."""
    manipulated = parse_caption(video.caption, video.objects).manipulated.lower()
    hints = {
        phrase: hint_of(thing, video.path)
        for phrase, thing in drawn["objects"].items()
        if boxes == "all" or (boxes == "manipulated" and phrase.lower() == manipulated)
    }
    video = replace(video, hints=hints)
    verdict = Verdict(clip=video.path.stem, rating=drawn.get("rating", 0))
    start, clip, scene = time.monotonic(), None, None
    try:
        clip = read_clip(video, cfg.video)
        verdict.frames = len(clip.frames)
        scene = reconstruct(clip, cfg.scene, rng_for(cfg.seed, "scene", video.item))
    except ItemRejectedError as error:
        verdict.reason, verdict.number = error.reason, error.value
    verdict.seconds = round(time.monotonic() - start, 2)
    if clip is not None and scene is not None:
        verdict.kind, verdict.confidence = scene.kind, round(scene.confidence, 3)
        verdict.stages = {stage: round(sure, 4) for stage, (sure, _) in scene.stages.items()}
        verdict.gate = gate(scene)
        _compare(verdict, clip, scene, drawn)
    return verdict, _picture(verdict, clip, scene, drawn)


def hint_of(thing: dict[str, Any], path: Path) -> Hint:
    """Return the hint that was drawn for an object: its own, else its box at the first frame, else that at the last."""
    if "hint" in thing:
        return Hint(**thing["hint"])
    if thing["first"] is not None:
        return Hint(frame=0, box=thing["first"])
    with av.open(str(path)) as file:
        frames = sum(1 for _ in file.decode(video=0))
    return Hint(frame=frames - 1, box=thing["last"])


def _compare(verdict: Verdict, clip: Clip, scene: Reconstruction, drawn: dict[str, Any]) -> None:
    found = {thing.label.lower(): thing for thing in scene.objects}
    named = [p for p in drawn["objects"] if p.lower() in clip.caption.lower()]
    verdict.missing = tuple(p for p in named if p.lower() not in found)
    for phrase, there in drawn["objects"].items():
        thing = found.get(phrase.lower())
        if thing is None:
            continue
        ours = {end: _box_at(clip, scene, thing, end) for end in ("first", "last")}
        ious = {e: _iou(ours[e], there[e]) for e in ours if there[e] is not None}
        if thing.role != "manipulated":
            # what stands still has one outline, taken where least hides it
            ious = dict.fromkeys(ious, max(ious.values()))
        verdict.ious[phrase] = {end: round(iou, 3) for end, iou in ious.items()}
    overlaps = [iou for ends in verdict.ious.values() for iou in ends.values()]
    verdict.right = not verdict.missing and min(overlaps, default=0.0) >= RIGHT_IOU


def _mask_at(scene: Reconstruction, thing: Estimate, frame: int) -> Bool[np.ndarray, "h w"]:
    """Return the object's outline at a clip frame as it was filmed, or at the nearest one that has any."""
    at = min(thing.masks, key=lambda there: abs(there - frame))
    mask, to_filmed = thing.masks[at], scene.clip.to_filmed
    if to_filmed is None:
        return mask
    h, w = mask.shape
    to_mask = np.diag([w / scene.clip.width_px, h / scene.clip.height_px, 1.0])
    H = between_centres(to_mask @ to_filmed[at] @ np.linalg.inv(to_mask))
    return cv2.warpPerspective(mask.astype(np.uint8), H, (w, h), flags=cv2.INTER_NEAREST) > 0


def _box_at(clip: Clip, scene: Reconstruction, thing: Estimate, end: str) -> Box | None:
    mask = _mask_at(scene, thing, 0 if end == "first" else len(clip.frames) - 1)
    if not mask.any():
        return None
    y, x = np.nonzero(mask)
    left, top, right, bottom = scene.clip.in_file_px
    sx, sy = (right - left) / mask.shape[1], (bottom - top) / mask.shape[0]
    x0, x1 = left + x.min() * sx, left + (x.max() + 1) * sx
    y0, y1 = top + y.min() * sy, top + (y.max() + 1) * sy
    return [float(x0), float(y0), float(x1), float(y1)]


def _iou(a: Box | None, b: Box | None) -> float:
    """Return intersection over union of two boxes; 0 where one is missing."""
    if a is None or b is None:
        return 0.0
    width = min(a[2], b[2]) - max(a[0], b[0])
    height = min(a[3], b[3]) - max(a[1], b[1])
    both = max(0.0, width) * max(0.0, height)
    return both / ((a[2] - a[0]) * (a[3] - a[1]) + (b[2] - b[0]) * (b[3] - b[1]) - both)


def _each(work: list[tuple[VideoItem, dict[str, Any], EngineConfig, Hinted]], jobs: int):  # noqa: ANN202
    if jobs <= 1:
        yield from (judge(*one) for one in work)
        return
    with ProcessPoolExecutor(jobs, mp_context=get_context("spawn")) as pool:
        yield from pool.map(judge, *zip(*work, strict=True))


# --- what is shown -------------------------------------------------------------------------------------------

HEAD = (
    f"{'clip':48} {'rated':>5}  {'outcome':28} {'conf':>5}  {'box IoU first/last by object':44} "
    f"{'verdict':8} {'s':>5}"
)


def row(v: Verdict) -> str:
    """Return the clip's line of the table."""
    number = "" if v.number is None else f" {v.number:.3g}"
    ious = "; ".join(f"{p} " + "/".join(f"{i:.2f}" for i in e.values()) for p, e in v.ious.items())
    ious += "".join(f"; {p} missing" for p in v.missing)
    outcome = f"accepted {v.kind}" if v.accepted else f"{v.reason}{number}"
    confidence = "" if v.confidence is None else f"{v.confidence:.2f}"
    verdict = "-" if not v.accepted else "right" if v.right else "WRONG"
    return (
        f"{v.clip[:48]:48} {v.rating:>5}  {outcome:28} {confidence:>5}  {ious:44} {verdict:8} "
        f"{v.seconds:5.1f}"
    )


def totals(verdicts: list[Verdict]) -> str:
    """Return how many were accepted, how many of those are right, and how fast it went."""
    accepted = [v for v in verdicts if v.accepted]
    suited = [v for v in verdicts if v.rating >= WELL_SUITED]
    lines = [
        f"accepted: {wilson(len(accepted), len(verdicts))}",
        f"accepted of those rated {WELL_SUITED} or better: " + _rate([v.accepted for v in suited]),
        f"right of accepted: {_rate([v.right for v in accepted])}",
        f"accepted and right of all: {_rate([v.right for v in verdicts])}",
        f"accepted and right of those rated {WELL_SUITED} or better: "
        + _rate([v.right for v in suited]),
    ]
    reasons = sorted({v.reason for v in verdicts if v.reason})
    counts = [f"{r} {sum(v.reason == r for v in verdicts)}" for r in reasons]
    sure = [(least, [v for v in accepted if (v.confidence or 0) >= least]) for least in _LEAST]
    counts_by = [f"{least:g}: {sum(v.right for v in some)} of {len(some)}" for least, some in sure]
    lines.append(f"right by least confidence: {', '.join(counts_by)}")
    seconds, frames = sum(v.seconds for v in verdicts), sum(v.frames for v in verdicts)
    lines.append(f"rejected: {', '.join(counts) or 'none'}")
    lines.append(
        f"{seconds:.0f} s for {frames} frames: {frames / max(seconds, 1e-9):.1f} frames per second"
    )
    return "\n".join(lines)


def _rate(outcomes: list[bool]) -> str:
    return str(wilson(sum(outcomes), len(outcomes))) if outcomes else "none"


def sheets(pictures: list[UInt8[np.ndarray, "h w 3"]]) -> list[UInt8[np.ndarray, "h w 3"]]:
    """Return the pictures in sheets of two columns."""
    out = []
    for at in range(0, len(pictures), CLIPS_PER_SHEET):
        some = pictures[at : at + CLIPS_PER_SHEET]
        rows = []
        for pair in (some[i : i + 2] for i in range(0, len(some), 2)):
            height = max(p.shape[0] for p in pair)
            padded = [np.pad(p, ((0, height - p.shape[0]), (0, 0), (0, 0))) for p in pair]
            rows.append(np.hstack(padded if len(padded) == 2 else [padded[0], 0 * padded[0]]))
        out.append(np.vstack(rows))
    return out


def _picture(
    verdict: Verdict, clip: Clip | None, scene: Reconstruction | None, drawn: dict[str, Any]
) -> UInt8[np.ndarray, "h w 3"]:
    """Return first and last frame side by side: our outlines red, the drawn boxes green."""
    if clip is None:
        halves = [np.zeros((225, _PICTURE_PX, 3), np.uint8)] * 2
    else:
        halves = [_half(clip, scene, drawn, end) for end in ("first", "last")]
    picture = np.pad(np.hstack(halves), ((20, 4), (0, 0), (0, 0)))
    what = row(verdict)
    title = f"{verdict.clip[:44]} [{verdict.rating}] {' '.join(what[55:].split())}"
    cv2.putText(
        picture, title[:125], (3, 14), cv2.FONT_HERSHEY_SIMPLEX, 0.36, _WHITE, 1, cv2.LINE_AA
    )
    return picture


def _half(
    clip: Clip, scene: Reconstruction | None, drawn: dict[str, Any], end: str
) -> UInt8[np.ndarray, "h w 3"]:
    frame = 0 if end == "first" else len(clip.frames) - 1
    size = (_PICTURE_PX, round(clip.height_px * _PICTURE_PX / clip.width_px))
    image = cv2.resize(clip.frames[frame], size, interpolation=cv2.INTER_AREA)
    scale = _PICTURE_PX / clip.source_size_px[0]
    for there in drawn["objects"].values():
        if there[end] is not None:
            x0, y0, x1, y1 = (round(scale * v) for v in there[end])
            cv2.rectangle(image, (x0, y0), (x1, y1), _GREEN, 1)
    if scene is None:
        return image
    x0, y0, x1, y1 = (round(scale * v) for v in scene.clip.in_file_px)
    for thing in scene.objects:
        mask = _mask_at(scene, thing, frame).astype(np.uint8)
        large = np.zeros((size[1], size[0]), np.uint8)
        part = large[y0:y1, x0:x1]
        part[:] = cv2.resize(mask, part.shape[::-1], interpolation=cv2.INTER_NEAREST)
        outline, _ = cv2.findContours(large, cv2.RETR_EXTERNAL, cv2.CHAIN_APPROX_NONE)
        cv2.drawContours(image, outline, -1, _RED, 1, cv2.LINE_AA)
    return image


if __name__ == "__main__":
    main()

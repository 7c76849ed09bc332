"""Measure reconstruction on drawn clips with known truth: which stage fails how often, and by how much.

Clips of every kind of task are drawn (and kept: a second run only reconstructs), reconstructed
with the gate open, and compared with their truth; `drawn_clips.score` says what counts as a
failure. Then the gate is asked: which of them would have been accepted, and how many of those are
usable? Seeds are split: `tune` has the even ones, for looking at while working; `final` the odd
ones, on which NOTHING may be tuned, neither code nor thresholds. Each run on `final` is written
down beside its result with the commit that ran it.

    python scripts/bench_reconstruction.py --split tune --clips 120
    python scripts/bench_reconstruction.py --split tune --clips 120 --boxes
    python scripts/bench_reconstruction.py --quick

The caption is all that a clip comes with. With `--boxes` each named object has one box more, as a
person would draw it: around what is visible at the first frame, or at the last for what is hidden
at first, a few pixels off at each side. With `--size` the manipulated object's length, width and
height are given as well, as somebody measured them; with `--camera` how high the camera stands,
how far it looks down and how wide it sees, as somebody with one stand for all videos can measure
once.
"""

import argparse
import hashlib
import json
import logging
import multiprocessing
import os
import resource
import shutil
import signal
import sys
import tempfile
import time
import traceback
from collections.abc import Iterator, Sequence
from concurrent.futures import Future, ProcessPoolExecutor, as_completed
from contextlib import contextmanager
from dataclasses import asdict, dataclass, replace
from datetime import UTC, datetime
from pathlib import Path
from typing import Any, Protocol, cast, get_args

import cv2
import numpy as np
import trimesh
from jaxtyping import Bool, UInt8

from drawn_clips.clips import MotionKind, VideoSpec, drawing_code, random_spec, render
from drawn_clips.score import found_of, rejected, score_clip, shown_at
from drawn_clips.score_types import STAGES, FoundClip, TrueClip, TrueThing
from drawn_clips.truth import Truth, load_truth, write
from paper_tables import failure
from policies.evaluation.rate import wilson
from studies.results import commit
from studies.scene_gate import gate
from v2p_data.errors import ItemRejectedError
from v2p_data.geometry.camera import Camera
from v2p_data.geometry.pose import apply, transform_from_pose
from v2p_data.scene.config import SceneConfig
from v2p_data.scene.data_types import Reconstruction
from v2p_data.scene.frames.working_clip import WIDTH_PX
from v2p_data.scene.reconstruct import reconstruct
from v2p_data.scene.scale.shared_camera import filmed
from v2p_data.scene.schema import Symmetry
from v2p_data.seeds import rng_for
from v2p_data.video.captions import find_videos
from v2p_data.video.clip import Clip
from v2p_data.video.decode import read_clip

KINDS: tuple[MotionKind, ...] = get_args(MotionKind)
FINAL_RUNS = "final_runs.jsonl"
_IMPORTED_ONCE = (
    "v2p_data.scene.frames.network",
    "v2p_data.scene.reconstruct",
    "drawn_clips.clips",
)
"""By the process that all others are forked from: importing torch anew for each takes seconds."""
JITTER_PX = 3.0
"""Standard deviation of each side of a box drawn by hand, in a picture 640 px wide."""
FPS = 12
"""As of Something-Something-v2; drawing takes longest of all here."""
MAX_SECONDS = 180
"""A clip that takes longer counts as crashed."""
WORST_SHOWN = 24
"""Clips on the sheet."""
GOALS = {
    "grounding": 0.15,
    "segmentation": 0.10,
    "mesh": 0.20,
    "pose": 0.25,
    "usable": 0.65,
    "usable with boxes": 0.90,
}

WAYS = {
    "boxes": "one box per named object as a hint",
    "size": "the manipulated object's size as a hint",
    "camera": "the camera's height, pitch and field of view as settings",
}
"""What may be given beside the caption."""

Row = dict[str, Any]


class Drawn(Protocol):
    """A clip to draw."""

    @property
    def name(self) -> str: ...
    @property
    def kind(self) -> MotionKind: ...
    @property
    def seed(self) -> int: ...
    def spec(self) -> VideoSpec:
        """Return all that is drawn."""
        ...


@dataclass(frozen=True, kw_only=True)
class Job:
    """One clip to draw, like no other."""

    kind: MotionKind
    seed: int
    fps: int | None = None
    """Of the clip; drawn at random where None."""

    @property
    def name(self) -> str:
        return f"{self.kind}_{self.seed:04d}"

    def spec(self) -> VideoSpec:
        rng = rng_for(self.seed, "bench_reconstruction", self.kind)
        spec = random_spec(self.name, self.kind, rng)
        return spec if self.fps is None else replace(spec, fps=self.fps)


def main() -> None:
    """Read the command line, draw, reconstruct, compare, print."""
    args = _arguments()
    logging.basicConfig(level=logging.WARNING)
    jobs = planned(args.split, args.clips, args.kinds, FPS)
    args.out.mkdir(parents=True, exist_ok=True)
    runs = _note_final_run(args) if args.split == "final" else []
    folders = drawn(jobs, args)
    given = frozenset(way for way in WAYS if vars(args)[way])
    name = "_".join([args.split, *["quick"] * args.quick, *(way for way in WAYS if way in given)])
    pictures = args.out / f"pictures_{name}"
    tasks = [(job, folders[job.name], given, pictures) for job in jobs]
    rows = list(each(args.jobs, reconstructed, tasks, "reconstructed"))
    rows.sort(key=lambda row: (KINDS.index(row["kind"]), row["seed"]))
    summary = summarised(rows)
    result = {
        "split": args.split,
        **{way: way in given for way in WAYS},
        "commit": commit(),
        "finished": datetime.now(UTC).isoformat(timespec="seconds"),
        "load": round(os.getloadavg()[0], 2),
        "jobs": args.jobs,
        "final_runs": runs,
        "summary": summary,
        "rows": rows,
    }
    path = args.out / f"{name}.json"
    path.write_text(json.dumps(result, indent=1) + "\n", encoding="utf-8")
    sheet = args.out / f"worst_{name}.png"
    write_sheet(rows, pictures, sheet)
    print(table(rows, summary, boxes=args.boxes, jobs=args.jobs))
    print(f"\nrows: {path}\nworst clips: {sheet}")
    print(f"usable_scenes: {summary['usable']['rate']:.2f}")


def drawn(jobs: Sequence[Drawn], args: argparse.Namespace) -> dict[str, Path]:
    """Return each clip's folder; draw those that are not there yet, `args.jobs` at once."""
    os.environ.setdefault("LP_NUM_THREADS", "1")  # Mesa's threads get in each other's way
    folders = {job.name: folder_of(job, args.out / "clips", args.old_clips) for job in jobs}
    missing = [(job, folders[job.name]) for job in jobs if not folders[job.name].is_dir()]
    for _ in each(args.jobs, draw_clip, missing, "drawn"):
        pass
    return folders


def planned(split: str, clips: int, kinds: list[MotionKind], fps: int | None = None) -> list[Job]:
    """Return the clips of a split, kinds in turn; tune has even seeds, final odd ones.

    A clip depends on its kind and seed alone, so that fewer kinds or clips are a part of the same clips.
    """
    odd = {"tune": 0, "final": 1}[split]
    return [
        Job(kind=kinds[i % len(kinds)], seed=2 * (i // len(kinds)) + odd, fps=fps)
        for i in range(clips)
    ]


def true_of(truth: Truth) -> TrueClip:
    """Return the objects that the caption names, their masks at working size."""
    things = []
    for thing in truth.things:
        if thing.phrase is None:
            continue
        mesh = trimesh.load_mesh(thing.mesh)
        assert isinstance(mesh, trimesh.Trimesh)
        things.append(
            TrueThing(
                phrase=thing.phrase,
                manipulated=thing.role == "manipulated" or thing is truth.things[0],
                size_m=thing.size_m,
                hollow=thing.hollow,
                symmetry=cast(Symmetry, thing.symmetry),
                mesh=mesh,
                T_world_objs=np.stack([transform_from_pose(pose) for pose in thing.poses_world]),
                masks={
                    int(frame): _small(labels == thing.mask_label)
                    for frame, labels in zip(truth.mask_idx, truth.masks, strict=True)
                },
            )
        )
    return TrueClip(kind=truth.kind, things=tuple(things), T_world_cam=truth.camera.T_world_cam)


def boxes_of(true: TrueClip, camera: Camera, rng: np.random.Generator) -> dict[str, Any]:
    """Return one hint per named object, in the file's pixels: a box around what is visible of it, a little off."""
    hints: dict[str, Any] = {}
    size = np.array([camera.width_px, camera.height_px])
    for thing in true.things:
        frame = shown_at(thing)
        if frame is None:
            continue
        y, x = np.nonzero(thing.masks[frame])
        scale = camera.width_px / WIDTH_PX
        corners = np.array([[x.min(), y.min()], [x.max() + 1, y.max() + 1]]) * scale
        corners += rng.normal(0, JITTER_PX * camera.width_px / 640, (2, 2))
        low, high = np.clip(corners, 0, size - 1)
        high = np.maximum(high, low + 2)
        hints[thing.phrase] = {
            "frame": int(frame),
            "box": [*low.round(1).tolist(), *high.round(1).tolist()],
        }
    return hints


def summarised(rows: list[Row]) -> dict[str, Any]:
    """Return rates with intervals and medians with quartiles over these clips.

    A stage's `conditional` rate is over the clips on which all stages before it succeeded, as the paper counts; its
    `all` rate over all clips, where a rejected clip fails everything. Errors are over all objects of clips that
    were not rejected, wrongly grounded ones too.
    """
    out: dict[str, Any] = {"clips": len(rows), "stages": {}}
    left = rows
    for stage in STAGES:
        failed = [row for row in left if stage in row["failures"]]
        out["stages"][stage] = {
            "conditional": _rate(len(failed), len(left)),
            "all": _rate(sum(stage in row["failures"] for row in rows), len(rows)),
        }
        left = [row for row in left if stage not in row["failures"]]
    accepted = [row for row in rows if row["accepted"]]
    out["usable"] = _rate(sum(row["usable"] for row in rows), len(rows))
    out["accepted"] = _rate(len(accepted), len(rows))
    out["accepted_usable"] = _rate(sum(row["usable"] for row in accepted), len(accepted))
    out["kind_right"] = _rate(sum(row["kind_found"] == row["kind"] for row in rows), len(rows))
    things = [thing for row in rows if row["slug"] is None for thing in row["things"]]
    others = [t for row in rows if row["slug"] is None for t in row["things"][1:]]
    out["errors"] = {
        "size_m": _quartiles([t["size_error_m"] for t in things]),
        "size_share": _quartiles([t["size_error_share"] for t in things]),
        "position_m": _quartiles(
            [t[f"position_{end}_m"] for t in things for end in ("first", "last")]
        ),
        "position_first_others_m": _quartiles([t["position_first_m"] for t in others]),
        "position_last_m": _quartiles([t["position_last_m"] for t in things]),
        "position_last_depth_m": _quartiles([t.get("position_last_depth_m") for t in things]),
        "position_first_cam_m": _quartiles([t["position_first_cam_m"] for t in things]),
        "position_last_cam_m": _quartiles([t["position_last_cam_m"] for t in things]),
        "turn_first_rad": _quartiles([t["turn_first_rad"] for t in things]),
        "turn_last_rad": _quartiles([t["turn_last_rad"] for t in things]),
        "mask_iou_first": _quartiles([t["iou_first"] for t in things]),
        "mask_iou_last": _quartiles([t["iou_last"] for t in things]),
        "mask_iou": _quartiles([t["iou_mean"] for t in things]),
        "shape_iou": _quartiles([t["shape_iou"] for t in things]),
        "volume_iou": _quartiles([t["volume_iou"] for t in things]),
    }
    speeds = [row["frames_per_s"] for row in rows if row["frames_per_s"]]
    out["speed"] = {
        "frames_per_s": _quartiles(speeds),
        "frames_per_cpu_s": _quartiles([row["frames_per_cpu_s"] for row in rows]),
        "slowest_frames_per_s": min(speeds, default=None),
        "peak_mb": _quartiles([row["peak_mb"] for row in rows]),
        "largest_peak_mb": max((row["peak_mb"] for row in rows), default=None),
    }
    troubles = [row["trouble"] for row in rows if row["trouble"]]
    out["troubles"] = _counted([stage for stage, _ in troubles])
    out["slugs"] = _counted([row["slug"] for row in rows if row["slug"]])
    out["gate_slugs"] = _counted([row["gate_slug"] for row in rows if row["gate_slug"]])
    return out


def table(rows: list[Row], summary: dict[str, Any], *, boxes: bool, jobs: int) -> str:
    """Return all that is to be read, goals beside the numbers."""
    lines = [
        "failed clips per stage / clips that reached it (all stages before it right)",
        f"{'kind':16} {'clips':>5} {'ground':>8} {'segment':>8} {'mesh':>8} {'pose':>8} {'usable':>7} "
        f"{'accept':>7} {'of them ok':>10} {'size cm':>8} {'size %':>7} {'pos cm':>7} {'turn deg':>8}",
    ]
    for kind in [*(k for k in KINDS if any(row["kind"] == k for row in rows)), "all"]:
        some = rows if kind == "all" else [row for row in rows if row["kind"] == kind]
        s = summary if kind == "all" else summarised(some)
        stages = [s["stages"][stage]["conditional"] for stage in STAGES]
        e = s["errors"]
        lines.append(
            f"{kind:16} {len(some):5d} "
            + " ".join(f"{_of(rate):>8}" for rate in stages)
            + f" {_of(s['usable']):>7} {_of(s['accepted']):>7} {_of(s['accepted_usable']):>10}"
            + f" {_middle(e['size_m'], 100):>8} {_middle(e['size_share'], 100):>7}"
            + f" {_middle(e['position_m'], 100):>7} {_middle(e['turn_last_rad'], 180 / np.pi):>8}"
        )
    lines += [
        "",
        "failure rates [95 %]             where the stages before succeeded        of all clips",
    ]
    for stage in STAGES:
        both = summary["stages"][stage]
        lines.append(
            f"  {stage:14} goal < {GOALS[stage]:.0%}   {_said(both['conditional']):38}   {_said(both['all']):38}"
            f" paper {failure(stage):.0%}"
        )
    goal = GOALS["usable with boxes" if boxes else "usable"]
    lines += [
        "",
        f"usable scenes     goal > {goal:.0%}     {_said(summary['usable'])}",
        f"right kind                        {_said(summary['kind_right'])}",
        f"accepted by the gate              {_said(summary['accepted'])}",
        f"of these usable   goal > 95%     {_said(summary['accepted_usable'])}",
        "",
        "errors over all objects of clips not rejected: median [quartiles]",
    ]
    e = summary["errors"]
    for words, key, factor in (
        ("size [cm]                 goal < 1", "size_m", 100),
        ("size [%]                  goal < 15", "size_share", 100),
        ("position, both ends [cm]  goal < 2", "position_m", 100),
        ("position at last [cm]", "position_last_m", 100),
        ("depth declared unseen [cm]", "position_last_depth_m", 100),
        ("others at first [cm]", "position_first_others_m", 100),
        ("from the camera, first [cm]", "position_first_cam_m", 100),
        ("from the camera, last [cm]", "position_last_cam_m", 100),
        ("orientation at first [deg]", "turn_first_rad", 180 / np.pi),
        ("orientation at last [deg]", "turn_last_rad", 180 / np.pi),
        ("mask IoU at first", "mask_iou_first", 1),
        ("mask IoU at last", "mask_iou_last", 1),
        ("mask IoU, mean over frames", "mask_iou", 1),
        ("mesh: shape IoU", "shape_iou", 1),
        ("mesh: volume IoU", "volume_iou", 1),
    ):
        lines.append(f"  {words:36} {_spread(e[key], factor)}")
    speed = summary["speed"]
    lines += [
        "",
        f"speed with {jobs} clips at once: {_spread(speed['frames_per_s'])} frames/s, slowest "
        f"{speed['slowest_frames_per_s'] or 0:.1f} (goal >= 10 alone on two cores); "
        f"{_spread(speed['frames_per_cpu_s'])} frames per second of one core",
        f"memory: {_spread(speed['peak_mb'], 1, 0)} MB, largest {speed['largest_peak_mb'] or 0:.0f} (goal < 1500)",
        f"what makes clips unusable: {_listed(summary['troubles'])}",
        f"rejected though the gate is open: {_listed(summary['slugs'])}",
        f"turned away by the gate: {_listed(summary['gate_slugs'])}",
        "",
        "unusable clips",
    ]
    lines += [
        f"  {row['name']:22} {row['trouble'][0]:12} {row['trouble'][1]:60} confidence "
        f'{row["confidence"] or 0:.2f}{" ACCEPTED" if row["accepted"] else ""}   "{row["caption"]}"'
        for row in rows
        if row["trouble"]
    ]
    return "\n".join(lines)


def write_sheet(rows: list[Row], pictures: Path, path: Path) -> None:
    """Put the pictures of the worst clips on one sheet: confidently wrong ones first, then by the stage that failed."""
    order = ["rejected", "grounding", "kind", "mesh", "pose", "size"]
    wrong = [row for row in rows if row["trouble"]]
    wrong.sort(
        key=lambda r: (not r["accepted"], order.index(r["trouble"][0]), -(r["confidence"] or 0))
    )
    tiles = [cv2.imread(str(pictures / f"{row['name']}.png")) for row in wrong[:WORST_SHOWN]]
    tiles = [tile for tile in tiles if tile is not None]
    if not tiles:
        path.unlink(missing_ok=True)
        return
    height, width = max(t.shape[0] for t in tiles), max(t.shape[1] for t in tiles)
    across = min(2, len(tiles))
    sheet = np.full((-(-len(tiles) // across) * height, across * width, 3), 255, np.uint8)
    for i, tile in enumerate(tiles):
        y, x = i // across * height, i % across * width
        sheet[y : y + tile.shape[0], x : x + tile.shape[1]] = tile
    cv2.imwrite(str(path), sheet)


def _arguments() -> argparse.Namespace:
    parser = argparse.ArgumentParser(description=(__doc__ or "").split("\n")[0])
    parser.add_argument("--clips", type=int, default=120)
    parser.add_argument("--split", choices=["tune", "final"], default="tune")
    parser.add_argument("--quick", action="store_true", help="one clip per kind, few frames")
    for way, words in WAYS.items():
        parser.add_argument(f"--{way}", action="store_true", help=words)
    parser.add_argument("--kinds", nargs="+", choices=KINDS, default=list(KINDS))
    parser.add_argument("--jobs", type=int, default=os.cpu_count() or 1, help="processes at once")
    parser.add_argument(
        "--old-clips",
        action="store_true",
        help="take clips that another version of the drawing code drew",
    )
    parser.add_argument("--out", type=Path, default=Path("outputs/bench_reconstruction"))
    args = parser.parse_args()
    if args.quick:
        args.clips = len(args.kinds)
    if args.clips < 1 or args.jobs < 1:
        parser.error("--clips and --jobs must be at least 1")
    return args


def _note_final_run(args: argparse.Namespace) -> list[dict[str, Any]]:
    """Write down that the kept half was looked at, and return all such runs."""
    path = args.out / FINAL_RUNS
    run = {
        "started": datetime.now(UTC).isoformat(timespec="seconds"),
        "commit": commit(),
        "clips": args.clips,
        **{way: vars(args)[way] for way in WAYS},
    }
    with path.open("a", encoding="utf-8") as file:
        file.write(json.dumps(run) + "\n")
    runs = [json.loads(line) for line in path.read_text(encoding="utf-8").splitlines()]
    print(
        f"WARNING: this is run {len(runs)} on the final split, with commit {run['commit']}; nothing may be tuned on it",
        flush=True,
    )
    return runs


def each(jobs: int, function: Any, tasks: list[tuple[Any, ...]], done: str) -> Iterator[Any]:
    """Run tasks in fresh processes, a few at a time, so that each has its own peak of memory."""
    context = multiprocessing.get_context("forkserver")
    context.set_forkserver_preload(list(_IMPORTED_ONCE))
    with ProcessPoolExecutor(jobs, mp_context=context, max_tasks_per_child=1) as pool:
        futures: list[Future[Any]] = [pool.submit(function, *task) for task in tasks]
        for i, future in enumerate(as_completed(futures), 1):
            if sys.stderr.isatty() or i % 20 == 0 or i == len(futures):
                print(f"{done} {i} of {len(futures)}", file=sys.stderr, flush=True)
            yield future.result()


def folder_of(job: Drawn, clips: Path, old_code: bool) -> Path:
    """Return where the clip is, or where it belongs if this very clip was not drawn before by the same code."""
    recipe = _digest(json.dumps(asdict(job.spec()), sort_keys=True, default=str).encode())
    code = drawing_code()
    older = sorted(clips.glob(f"{job.name}-{recipe}-{'[0-9a-f]' * len(code)}"))
    return older[-1] if old_code and older else clips / f"{job.name}-{recipe}-{code}"


def draw_clip(job: Drawn, folder: Path) -> None:
    if folder.is_dir():  # a run beside this one drew it meanwhile
        return
    partial = folder.with_name(f"{folder.name}.{os.getpid()}.partial")
    shutil.rmtree(partial, ignore_errors=True)
    partial.mkdir(parents=True)
    write(render(job.spec()), partial)
    partial.rename(folder)


def _digest(content: bytes) -> str:
    return hashlib.sha256(content).hexdigest()[:8]


def settings_for(camera: Camera) -> SceneConfig:
    """Return the default settings with a camera as somebody measured it."""
    T = camera.T_world_cam
    return SceneConfig(
        camera_height_m=float(T[2, 3]),
        pitch_rad=float(np.arcsin(-T[2, 2])),
        fov_rad=float(2 * np.arctan(0.5 * camera.width_px / camera.K[0, 0])),
    )


def reconstructed(
    job: Drawn,
    folder: Path,
    given: frozenset[str],
    pictures: Path,
    camera: SceneConfig | None = None,
) -> Row:
    """Return what becomes of a clip, with what is `given` beside its caption and the settings of a known `camera`."""
    truth = load_truth(folder, job.name)
    true = true_of(truth)
    said: Row = {"caption": truth.caption}
    hints = boxes_of(true, truth.camera, rng_for(job.seed, "boxes")) if "boxes" in given else {}
    if "size" in given:
        thing = true.things[0]
        hints.setdefault(thing.phrase, {})["size_m"] = [round(side, 3) for side in thing.size_m]
    if hints:
        said |= {"hints": hints, "objects": list(truth.objects)}
    row: Row = {
        "name": job.name,
        "kind": job.kind,
        "seed": job.seed,
        "caption": truth.caption,
        "confidence": None,
        "accepted": False,
        "gate_slug": None,
        "sentence": None,
        "number": None,
        "frames_per_s": None,
        "frames_per_cpu_s": None,
    }
    clip, made, found, slug = None, None, None, None
    started, cpu = time.perf_counter(), time.process_time()
    try:
        with tempfile.TemporaryDirectory() as home, _limit(MAX_SECONDS):
            video = Path(home) / f"{job.name}.mp4"
            video.symlink_to((folder / video.name).resolve())
            (Path(home) / "captions.json").write_text(
                json.dumps({video.name: said}), encoding="utf-8"
            )
            clip = read_clip(find_videos(Path(home))[0])
            cfg = settings_for(truth.camera) if "camera" in given else camera or SceneConfig()
            rng = rng_for(job.seed, "scene")
            made = reconstruct(clip, cfg.without_gate(), rng)
            row["frames_per_s"] = round(len(clip.frames) / (time.perf_counter() - started), 2)
            row["frames_per_cpu_s"] = round(len(clip.frames) / (time.process_time() - cpu), 2)
            row["confidence"] = round(made.confidence, 4)
            row["stages"] = {stage: [sure, why] for stage, (sure, why) in made.stages.items()}
            row["cues"] = [[cue.stage, cue.what, round(cue.value, 4)] for cue in made.cues]
            row["scale_spread"] = round(made.scale_spread, 4)
            row["camera"] = asdict(filmed(job.name, made.camera, made.scale_spread))
            row["height_m"] = round(float(made.camera.T_world_cam[2, 3]), 4)
            row["true_height_m"] = round(float(true.T_world_cam[2, 3]), 4)
            row["least_found"] = round(made.least_found, 4)
            row["contradiction"] = made.contradiction
            row["objects"] = [thing.label for thing in made.objects]
            found = found_of(made)
    except ItemRejectedError as error:
        slug, row["sentence"] = error.reason, error.detail
        row["number"] = error.value
    except Exception as error:  # noqa: BLE001  a crash is a result here, with its place in the code
        at = traceback.extract_tb(error.__traceback__)[-1]
        slug = "crashed"
        row["sentence"] = f"{type(error).__name__}: {error} ({Path(at.filename).name}:{at.lineno})"
    row["peak_mb"] = round(resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024, 1)
    if made is not None and clip is not None:
        row["gate_slug"] = gate(made) or None
        row["accepted"] = row["gate_slug"] is None
    score = rejected(true, slug or "unknown") if found is None else score_clip(true, found)
    row |= {
        "slug": score.slug,
        "kind_found": score.kind_found,
        "usable": score.usable,
        "trouble": score.trouble,
        "failures": score.failures,
        "things": [_rounded(asdict(thing)) for thing in score.things],
    }
    if clip is not None:
        _draw(row, true, found, made, clip, pictures)
    return row


@contextmanager
def _limit(seconds: int) -> Iterator[None]:
    """End what takes too long by a TimeoutError."""

    def stop(*_: object) -> None:
        raise TimeoutError(f"not done after {seconds} s")

    signal.signal(signal.SIGALRM, stop)
    signal.alarm(seconds)
    try:
        yield
    finally:
        signal.alarm(0)


def _small(mask: Bool[np.ndarray, "h w"]) -> Bool[np.ndarray, "y x"]:
    """Return a mask at working size."""
    h, w = mask.shape
    size = (WIDTH_PX, max(8, round(h * WIDTH_PX / w)))
    return cv2.resize(mask.astype(np.float32), size, interpolation=cv2.INTER_AREA) >= 0.5


def _draw(
    row: Row,
    true: TrueClip,
    found: FoundClip | None,
    made: Reconstruction | None,
    clip: Clip,
    pictures: Path,
) -> None:
    """Write first and last frame side by side: truth's outlines green, ours red, our shapes as posed yellow."""
    panels = []
    file_last = max(true.things[0].masks)
    for last in (False, True):
        frame = file_last if last else 0
        if last and found is not None and found.things:
            frame = found.things[0].last_frame
        image = clip.frames[int(np.abs(clip.source_frame - frame).argmin())]
        size = (WIDTH_PX, max(8, round(image.shape[0] * WIDTH_PX / image.shape[1])))
        panel = np.ascontiguousarray(
            cv2.resize(image, size, interpolation=cv2.INTER_AREA)[..., ::-1]
        )
        if found is not None and made is not None:
            scale = WIDTH_PX / made.camera.width_px
            for thing in found.things:
                T = thing.T_world_last if last else thing.T_world_first
                points = made.camera.project(apply(T, np.asarray(thing.mesh.vertices))) * scale
                if np.isfinite(points).all():
                    hull = cv2.convexHull(points.clip(-2000, 2000).astype(np.float32))
                    cv2.polylines(
                        panel, [hull.astype(np.int32)], True, (0, 220, 255), 1, cv2.LINE_AA
                    )
                if thing.masks:
                    near = min(thing.masks, key=lambda other: abs(other - frame))
                    _outline(panel, thing.masks[near], (0, 0, 255))
        for thing in true.things:
            near = min(thing.masks, key=lambda other: abs(other - frame))
            _outline(panel, thing.masks[near], (0, 200, 0))
        panels.append(panel)
    title = np.full((30, 2 * WIDTH_PX, 3), 255, np.uint8)
    stage, why = row["trouble"] or ("usable", "")
    state = "ACCEPTED " if row["accepted"] else ""
    for y, words in (
        (12, f"{row['name']}: {row['caption']}  {row['confidence'] or 0:.2f} {state}"),
        (25, f"{stage}: {why}"),
    ):
        cv2.putText(
            title, words[:100], (3, y), cv2.FONT_HERSHEY_SIMPLEX, 0.38, (0, 0, 0), 1, cv2.LINE_AA
        )
    pictures.mkdir(parents=True, exist_ok=True)
    both = np.concatenate([title, np.concatenate(panels, axis=1)])
    cv2.imwrite(str(pictures / f"{row['name']}.png"), both)


def _outline(
    panel: UInt8[np.ndarray, "h w 3"],
    mask: Bool[np.ndarray, "h w"],
    colour: tuple[int, int, int],
) -> None:
    if mask.shape == panel.shape[:2]:
        found, _ = cv2.findContours(
            mask.astype(np.uint8), cv2.RETR_EXTERNAL, cv2.CHAIN_APPROX_NONE
        )
        cv2.drawContours(panel, found, -1, colour, 1)


def _rate(part: int, whole: int) -> dict[str, Any]:
    if whole == 0:
        return {"successes": 0, "trials": 0, "rate": float("nan"), "low": 0.0, "high": 1.0}
    return wilson(part, whole).as_dict()


def _quartiles(values: list[float | None]) -> dict[str, Any]:
    known = [value for value in values if value is not None]
    if not known:
        return {"n": 0, "median": None, "low": None, "high": None}
    low, middle, high = np.percentile(known, [25, 50, 75])
    return {"n": len(known), "median": float(middle), "low": float(low), "high": float(high)}


def _counted(words: list[str]) -> dict[str, int]:
    return {word: words.count(word) for word in sorted(set(words), key=lambda w: -words.count(w))}


def _rounded(values: Row) -> Row:
    return {k: round(v, 5) if isinstance(v, float) else v for k, v in values.items()}


def _of(rate: dict[str, Any]) -> str:
    return f"{rate['successes']}/{rate['trials']}"


def _said(rate: dict[str, Any]) -> str:
    if not rate["trials"]:
        return "no clip"
    return (
        f"{rate['rate']:6.1%} [{rate['low']:.1%}, {rate['high']:.1%}] "
        f"({rate['successes']} of {rate['trials']})"
    )


def _middle(values: dict[str, Any], factor: float) -> str:
    return "-" if values["n"] == 0 else f"{values['median'] * factor:.1f}"


def _spread(values: dict[str, Any], factor: float = 1, digits: int = 2) -> str:
    if values["n"] == 0:
        return "-"
    low, middle, high = (values[k] * factor for k in ("low", "median", "high"))
    return f"{middle:.{digits}f} [{low:.{digits}f}, {high:.{digits}f}]"


def _listed(counts: dict[str, int]) -> str:
    return ", ".join(f"{word} {count}" for word, count in counts.items()) or "nothing"


if __name__ == "__main__":
    main()

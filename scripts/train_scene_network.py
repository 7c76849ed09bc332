"""Train the scene network (`v2p_data/scene/frames/network.py`) on rendered clips, from nothing, on a CPU.

    python scripts/train_scene_network.py data --out DATA --clips 5500 --jobs 2 python
    scripts/train_scene_network.py data --out DATA --clips 750 --jobs 2 --start 80000 --kind
    push_with python scripts/train_scene_network.py train DATA --out a.safetensors --minutes 30
    python scripts/train_scene_network.py train DATA --out b.safetensors --minutes 30 --start-from
    a.safetensors --seed 1 python scripts/train_scene_network.py average a.safetensors
    b.safetensors --out v2p_data/scene/frames/network.safetensors python
    scripts/train_scene_network.py camera b.safetensors --out
    v2p_data/scene/frames/camera.safetensors

`data` renders clips of all kinds at low resolution and keeps six frames of each with the two
stills that the scene room makes of the whole clip. `train` prints the intersection over union of
each class on clips that it does not train on. No real video is used for training. Clips here are
drawn from seeds of their own (`network`), so that no clip of `bench_reconstruction.py` is among
them.
"""

import argparse
from dataclasses import replace
from itertools import count, islice
from pathlib import Path

import cv2
import numpy as np
import torch
from jaxtyping import Float, Float32, UInt8
from safetensors.torch import load_file, save_file
from scipy.spatial.transform import Rotation
from torch.nn import functional as F  # noqa: N812  (the usual name)

from drawn_clips.clips import (
    LABEL_HAND,
    LABEL_TABLE,
    LABEL_THING,
    MOTION_KINDS,
    VideoSpec,
    motion_of,
    random_spec,
    render_views,
)
from training import HELD_OUT, add_commands, compressed, descend, draw_all, half_precision, write
from v2p_data.geometry.camera import between_centres
from v2p_data.scene.fitting.silhouette import camera_above
from v2p_data.scene.frames.classes import BACKGROUND, CLASSES, HAND, MOVED, OTHER, TABLE
from v2p_data.scene.frames.network import CameraNetwork, SceneNetwork, inputs_of, net_size, resized
from v2p_data.scene.frames.working_clip import still_of
from v2p_data.scene.scale.camera_height import table_width_m
from v2p_data.seeds import rng_for

DRAWN_OVER_SEEN = 1.5
"""Clips are drawn larger than the network sees them, so that a part of a picture can be shown
enlarged and still sharp."""
FRAMES_DRAWN = 12
FRAMES_KEPT = 6
BATCH = 12
TURNED = 0.5
"""Share of the examples that are shown as another camera at the same place would have seen them."""
_MOST_ZOOM = 1.6
"""Such a camera's focal length is at most so much longer, or it would see too little."""
_MOST_BEYOND = 0.06
"""So much of the picture's sides it may look beyond them."""
UNEVEN = 0.4
"""Share of the examples that are lit unevenly."""
PARTS = 0.5
"""Share of the examples that are an enlarged part of a picture."""
CLASS_WEIGHTS = (0.6, 0.6, 1.0, 2.0, 1.5)


def kind_of(number: int) -> str:
    """Return the kind of task that the clip of this number shows."""
    return MOTION_KINDS[number % len(MOTION_KINDS)]


def make_clip(job: tuple[int, Path]) -> str:
    """Render one clip and write what training needs; return an error's words, or nothing."""
    number, out = job
    path = out / f"{number:05d}.npz"
    if path.is_file():
        return ""
    rng = rng_for(number, "network")
    kind = kind_of(number)
    try:
        spec = random_spec(f"clip{number}", kind, rng)
        h, w = (
            round(DRAWN_OVER_SEEN * side)
            for side in net_size(spec.view.height_px, spec.view.width_px)
        )
        spec = replace(spec, view=replace(spec.view, height_px=h, width_px=w))
        total = round(spec.seconds * spec.fps)
        steps = np.linspace(0, total - 1, FRAMES_DRAWN).round().astype(int)
        rgb, labels = render_views(spec, steps.tolist(), with_hand=True)
    except (ValueError, RuntimeError) as error:
        return f"{number} {kind}: {type(error).__name__} {error}"
    rgb = np.stack([compressed(image, rng) for image in rgb])
    quarter = FRAMES_DRAWN // 4
    keep = np.unique([0, FRAMES_DRAWN - 1, *rng.integers(1, FRAMES_DRAWN - 1, FRAMES_KEPT - 2)])
    camera = spec.view.camera()
    forward = camera.T_world_cam[:3, 2]
    np.savez(
        path,
        early=still_of(rgb[:quarter]),
        late=still_of(rgb[-quarter:]),
        frames=rgb[keep],
        labels=_classes(labels[keep], _moved_labels(spec)),
        camera=np.array(
            [
                np.arcsin(-forward[2]),
                np.log(camera.K[0, 0] / w),
                np.log(camera.T_world_cam[2, 3]),
            ],
            np.float32,
        ),
    )
    return ""


def _moved_labels(spec: VideoSpec) -> list[int]:
    """Return the labels of the things that do not stay where and as they are."""
    tracks = motion_of(spec).T_world_things
    away_m = np.linalg.norm(tracks[:, :, :3, 3] - tracks[:, :1, :3, 3], axis=-1).max(1)
    turned = np.abs(tracks[:, :, :3, :3] - tracks[:, :1, :3, :3]).max((1, 2, 3))
    return [LABEL_THING + k for k in np.flatnonzero((away_m > 0.005) | (turned > 0.1))]


def _classes(labels: UInt8[np.ndarray, "n h w"], moved: list[int]) -> UInt8[np.ndarray, "n h w"]:
    to = np.full(256, OTHER, np.uint8)
    to[0], to[LABEL_HAND], to[LABEL_TABLE] = BACKGROUND, HAND, TABLE
    to[moved] = MOVED
    return to[labels]


class Examples:
    """Clips in memory, grouped by picture size."""

    def __init__(self) -> None:
        self.groups: dict[tuple[int, int], list[dict[str, np.ndarray]]] = {}
        self.files: set[Path] = set()

    def add(self, files: list[Path]) -> None:
        """Read the files that were not read yet."""
        for file in sorted(set(files) - self.files):
            with np.load(file) as data:
                clip = {key: data[key] for key in data.files}
            # A tool comes and goes in the hand: the first and the last frame seldom show it.
            clip["ends_count"] = np.array(kind_of(int(file.stem)) != "push_with")
            self.groups.setdefault(clip["early"].shape[:2], []).append(clip)
            self.files.add(file)
        self.sizes = sorted(self.groups)
        counts = np.array([len(self.groups[size]) for size in self.sizes], float)
        self.shares = counts / counts.sum()

    def batch(self, rng: np.random.Generator, n: int) -> dict[str, torch.Tensor]:
        """Return a random batch of one picture size, changed at random in ways that keep its labels true."""
        clips = self.groups[self.sizes[rng.choice(len(self.sizes), p=self.shares)]]
        rows = []
        for _ in range(n):
            clip = clips[rng.integers(len(clips))]
            n_frames = len(clip["frames"])
            i = int(rng.integers(n_frames))
            if clip["ends_count"]:
                i = int(rng.choice(np.array([0, n_frames - 1, i])))
            rows.append(_varied(clip, i, rng))
        return {key: torch.from_numpy(np.stack([row[key] for row in rows])) for key in rows[0]}

    def everything(self) -> list[dict[str, torch.Tensor]]:
        """Return every frame of every clip, unchanged."""
        out = []
        for clips in self.groups.values():
            for clip in clips:
                n = len(clip["frames"])
                size = net_size(*clip["early"].shape[:2])
                stills = [
                    np.repeat(resized(clip[key], size)[None], n, 0) for key in ("early", "late")
                ]
                frames = np.stack([resized(frame, size) for frame in clip["frames"]])
                early, late, frame = (x.transpose(0, 3, 1, 2) for x in (*stills, frames))
                row = {
                    "frame": frame,
                    "early": early,
                    "late": late,
                    "labels": np.stack([_labels_at(size, one) for one in clip["labels"]]),
                    "camera": np.repeat(known_of(clip["camera"])[None], n, 0),
                }
                out.append({k: torch.from_numpy(np.ascontiguousarray(v)) for k, v in row.items()})
        return out


def _varied(
    clip: dict[str, np.ndarray], i: int, rng: np.random.Generator
) -> dict[str, np.ndarray]:
    pictures = [clip["frames"][i], clip["early"], clip["late"]]
    labels = clip["labels"][i]
    if rng.random() < 0.3:  # a clip played backwards
        pictures[1], pictures[2] = pictures[2], pictures[1]
    if rng.random() < 0.5:
        pictures, labels = [p[:, ::-1] for p in pictures], labels[:, ::-1]
    size = net_size(*labels.shape)
    camera, is_turned = clip["camera"], rng.random() < TURNED
    if is_turned:
        pictures, labels, camera = turned(pictures, labels, camera, rng)
    part = _nearer(labels, rng) if rng.random() < PARTS else None
    camera = known_of(camera, part, labels.shape)
    if is_turned:
        # All of them have a longer focal length than the clips: the guess would be too long.
        camera[1] = np.nan
    if part is not None:
        pictures, labels = [p[part] for p in pictures], labels[part]
    pictures, labels = [resized(p, size) for p in pictures], _labels_at(size, labels)
    mix = np.eye(3) + rng.normal(0, 0.08, (3, 3))
    if rng.random() < 0.1:
        mix = np.full((3, 3), 1 / 3) + 0.15 * mix
    gain, bias, gamma = np.exp(rng.normal(0, 0.25)), rng.normal(0, 8), np.exp(rng.normal(0, 0.2))
    light = light_over(size, rng) if rng.random() < UNEVEN else None
    blur, noise = rng.choice([0, 0, 0.7, 1.1]), rng.uniform(0, 4)
    out = []
    curve = 255 * (np.arange(256) / 255) ** gamma
    for k, picture in enumerate(pictures):
        toned = curve * (gain * (1 + rng.normal(0, 0.012))) + bias + rng.normal(0, 0.8)
        x = cv2.LUT(cv2.transform(picture, mix), np.clip(toned, 0, 255).astype(np.uint8))
        if light is not None:
            x = np.clip(x * light, 0, 255)
        if blur:
            x = cv2.GaussianBlur(x, (0, 0), blur)
        if k == 0:
            x = np.clip(x + noise * rng.standard_normal(x.shape, np.float32), 0, 255)
        out.append(x.astype(np.uint8).transpose(2, 0, 1))
    return {
        "frame": out[0],
        "early": out[1],
        "late": out[2],
        "labels": np.ascontiguousarray(labels),
        "camera": camera,
    }


def light_over(size: tuple[int, int], rng: np.random.Generator) -> Float32[np.ndarray, "h w 1"]:
    """Return how bright each place is: windows and lamps light a room unevenly, and cameras overexpose white tables."""
    coarse = np.exp(rng.normal(0, 0.25, (2, 3))).astype(np.float32)
    return cv2.resize(coarse, (size[1], size[0]), interpolation=cv2.INTER_CUBIC)[..., None]


def turned(
    pictures: list[UInt8[np.ndarray, "h w 3"]],
    labels: UInt8[np.ndarray, "h w"],
    camera: Float[np.ndarray, "3"],
    rng: np.random.Generator,
) -> tuple[list[UInt8[np.ndarray, "h w 3"]], UInt8[np.ndarray, "h w"], Float[np.ndarray, "3"]]:
    """Return what another camera at the same place sees, turned and with a longer focal length, and that camera.

    Where a camera stands decides what hides what; where it looks only moves pixels, by a
    homography. So few clips show many pitches and focal lengths. A camera that would look far
    beyond the picture is not taken; if none is found, nothing changes.
    """
    h, w = labels.shape
    pitch, log_focal, log_height = (float(v) for v in camera)
    old = camera_above((h, w), pitch, float(2 * np.arctan(0.5 / np.exp(log_focal))))
    corners = np.array([[0, 0], [w, 0], [0, h], [w, h]], float)
    for _ in range(10):
        zoom = float(np.exp(rng.uniform(0, np.log(_MOST_ZOOM))))
        half_view = np.array([h, w]) / 2 / old.K[0, 0]
        room = np.arctan(half_view) - np.arctan(half_view / zoom) + 0.03
        tilt, pan = rng.uniform(-room, room)
        new = camera_above(
            (h, w), pitch + tilt, float(2 * np.arctan(0.5 / np.exp(log_focal) / zoom))
        )
        to_world = Rotation.from_euler("z", pan).as_matrix() @ new.T_world_cam[:3, :3]
        to_old = old.K @ old.T_world_cam[:3, :3].T @ to_world @ np.linalg.inv(new.K)
        seen = np.column_stack([corners, np.ones(4)]) @ to_old.T
        spots = seen[:, :2] / seen[:, 2:]
        over = np.maximum(-spots, spots - [w, h]) / [w, h]
        if over.max() > _MOST_BEYOND:
            continue
        M = between_centres(to_old)
        known = np.array([pitch + tilt, log_focal + np.log(zoom), log_height], np.float32)

        def seen_by(image: UInt8[np.ndarray, "h w *c"], how: int, M: np.ndarray = M) -> np.ndarray:
            flags = how | cv2.WARP_INVERSE_MAP
            return cv2.warpPerspective(
                np.ascontiguousarray(image),
                M,
                (w, h),
                flags=flags,
                borderMode=cv2.BORDER_REPLICATE,
            )

        return (
            [seen_by(picture, cv2.INTER_LINEAR) for picture in pictures],
            seen_by(labels, cv2.INTER_NEAREST),
            known,
        )
    return pictures, labels, camera


def _nearer(labels: UInt8[np.ndarray, "h w"], rng: np.random.Generator) -> tuple[slice, slice]:
    """Return a part of the picture, mostly with something that moves in it."""
    h, w = labels.shape
    zoom = rng.uniform(1.05, 2.5)
    ch, cw = int(h / zoom), int(w / zoom)
    spots = np.argwhere(labels == MOVED)
    middle = spots[rng.integers(len(spots))] if len(spots) else np.array([h / 2, w / 2])
    y = int(np.clip(middle[0] - ch * rng.uniform(0.25, 0.75), 0, h - ch))
    x = int(np.clip(middle[1] - cw * rng.uniform(0.25, 0.75), 0, w - cw))
    return slice(y, y + ch), slice(x, x + cw)


def known_of(
    camera: Float[np.ndarray, "3"],
    part: tuple[slice, slice] | None = None,
    shape: tuple[int, int] = (1, 1),
) -> Float[np.ndarray, "3"]:
    """Return what the network is to say of a camera (pitch [rad], log focal over width, log height [m]).

    That is pitch and log focal as they are, and the logarithm of `table_width_m`. A part of a picture shows neither of
    the first two: where a whole picture might be a part, its focal length would be guessed too long.
    """
    pitch, log_focal, log_height = (float(v) for v in camera)
    focal, height = np.exp(log_focal), np.exp(log_height)
    if part is None:
        return np.array(
            [pitch, log_focal, np.log(table_width_m(pitch, focal, height))], np.float32
        )
    rows, columns = part
    below = ((rows.start + rows.stop) / 2 - shape[0] / 2) / shape[1]
    width = table_width_m(pitch, focal, height, below) * (columns.stop - columns.start) / shape[1]
    return np.array([np.nan, np.nan, np.log(width)], np.float32)


def _labels_at(
    size: tuple[int, int], labels: UInt8[np.ndarray, "h w"]
) -> UInt8[np.ndarray, "a b"]:
    return cv2.resize(
        np.ascontiguousarray(labels), (size[1], size[0]), interpolation=cv2.INTER_NEAREST
    )


def loss_of(
    logits: Float[torch.Tensor, "n 5 h w"], camera: Float[torch.Tensor, "n 6"], batch: dict
) -> torch.Tensor:
    """Return cross entropy, soft Dice of three classes, and the Gaussian likelihood of known cameras."""
    labels = batch["labels"].long()
    ce = F.cross_entropy(logits, labels, torch.tensor(CLASS_WEIGHTS), label_smoothing=0.02)
    share = logits.softmax(1)
    dice = 0.0
    for c in (HAND, MOVED, OTHER):
        truth = (labels == c).float()
        common = (share[:, c] * truth).sum((1, 2))
        total = share[:, c].sum((1, 2)) + truth.sum((1, 2))
        dice = dice + (1 - (2 * common + 50) / (total + 50)).mean()
    known = batch["camera"].isfinite()
    off, log_sd = (camera[:, :3] - batch["camera"])[known], camera[:, 3:].clamp(-4, 1)[known]
    likelihood = (log_sd + 0.5 * (off / log_sd.exp()) ** 2).sum() / max(1, int(known.sum()))
    return ce + 0.3 * dice + 0.6 * likelihood


@torch.inference_mode()
def measure(net: SceneNetwork, held_out: list[dict[str, torch.Tensor]]) -> str:
    """Return IoU by class over held-out pixels, the median of `moved` by frame, and camera errors, in words."""
    net.eval()
    common, either = np.zeros(len(CLASSES)), np.zeros(len(CLASSES))
    each, off = [], []
    for row in held_out:
        logits, camera = net(inputs_of(row["frame"], row["early"], row["late"]))
        guess, truth = logits.argmax(1).numpy(), row["labels"].numpy()
        for c in range(len(CLASSES)):
            common[c] += ((guess == c) & (truth == c)).sum()
            either[c] += ((guess == c) | (truth == c)).sum()
        for g, t in zip(guess == MOVED, truth == MOVED, strict=True):
            if t.sum() > 40:
                each.append((g & t).sum() / (g | t).sum())
        off.append((camera[:, :3] - row["camera"]).abs().mean(0).numpy())
    net.train()
    ious = ", ".join(f"{n} {i:.3f}" for n, i in zip(CLASSES, common / either, strict=True))
    pitch, focal, width = np.median(off, axis=0)
    good = float(np.mean(np.array(each) > 0.6))
    return (
        f"{ious}; moved per frame: median {np.median(each):.3f}, {good:.1%} above 0.6; "
        f"pitch off {np.degrees(pitch):.1f} deg, focal {focal:.1%}, width of the table {width:.1%}"
    )


def train(
    data: Path, out: Path, minutes: float, seed: int, start_from: Path | None, lr: float
) -> None:
    """Train for so many minutes, writing the weights (half precision) every two minutes."""
    held, examples = Examples(), Examples()

    def read() -> None:  # clips may still be rendered while training runs
        files = sorted(data.glob("*.npz"))
        held.add([f for f in files if int(f.stem) % HELD_OUT == 0][:40])
        examples.add([f for f in files if int(f.stem) % HELD_OUT])

    read()
    held_out = held.everything()
    print(f"{len(examples.files)} clips to train on, {len(held_out)} held out", flush=True)
    rng = rng_for(seed, "network", "batches")
    with torch.random.fork_rng():
        torch.random.default_generator.manual_seed(seed)
        net = SceneNetwork()
        net.to(memory_format=torch.channels_last)  # type: ignore[call-overload]
    if start_from:
        weights = {k: v.float() for k, v in load_file(start_from).items()}
        fresh = net.state_dict()
        net.load_state_dict(
            {
                k: weights[k] if k in weights and weights[k].shape == v.shape else v
                for k, v in fresh.items()
            }
        )

    def loss() -> torch.Tensor:
        batch = examples.batch(rng, BATCH)
        x = inputs_of(batch["frame"], batch["early"], batch["late"])
        with half_precision():
            logits, camera = net(x.contiguous(memory_format=torch.channels_last))
        return loss_of(logits.float(), camera, batch)

    def state() -> str:
        write(net, out)
        read()
        return f"{len(examples.files)} clips, {measure(net, held_out[::3])}"

    steps = descend(net, minutes, lr, loss, state)
    write(net, out)
    print(f"{steps} steps of {BATCH}: {measure(net, held_out)}", flush=True)


def average(files: list[Path], out: Path) -> None:
    """Write the mean of the weights of runs that went on from one another: it sees more than either."""
    states = [load_file(file) for file in files]
    mean = {
        k: torch.stack([s[k].float() for s in states]).mean(0).to(v.dtype)
        if v.is_floating_point()
        else v
        for k, v in states[0].items()
    }
    save_file({k: v.contiguous() for k, v in mean.items()}, out)


def only_camera(file: Path, out: Path) -> None:
    """Write the weights of the part that says the camera."""
    wanted = CameraNetwork().state_dict()
    save_file({k: v for k, v in load_file(file).items() if k in wanted}, out)


def main() -> None:
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    commands, data = add_commands(parser, "clip", 1500, minutes=60)
    data.add_argument("--kind", choices=MOTION_KINDS, help="of task; all in turn if not given")
    eye = commands.add_parser("camera", help="write the part that says the camera")
    eye.add_argument("weights", type=Path)
    eye.add_argument("--out", type=Path, required=True)
    merge = commands.add_parser("average", help="average the weights of runs")
    merge.add_argument("weights", type=Path, nargs="+")
    merge.add_argument("--out", type=Path, required=True)
    args = parser.parse_args()
    if args.command == "data":
        numbers = (n for n in count(args.start) if args.kind in (None, kind_of(n)))
        draw_all(make_clip, islice(numbers, args.clips), args.out, args.jobs)
    elif args.command == "average":
        average(args.weights, args.out)
    elif args.command == "camera":
        only_camera(args.weights, args.out)
    else:
        train(args.data, args.out, args.minutes, args.seed, args.start_from, args.lr)


if __name__ == "__main__":
    main()

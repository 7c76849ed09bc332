"""What the training of small networks shares: options, drawing in parallel, colours, descent, weights."""

import argparse
import os
import sys
import time
from collections.abc import Callable, Iterable
from concurrent.futures import ProcessPoolExecutor
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import torch
from jaxtyping import Bool, Float, UInt8
from safetensors.torch import load_file, save_file

from drawn_clips.camera import View
from drawn_clips.clips import VideoSpec
from v2p_data.seeds import rng_for

HELD_OUT = 20
"""One scene in so many is held out for measuring."""
SIZES = ((480, 360), (480, 360), (480, 270), (360, 480))
"""(width, height) [px] of what is drawn."""
HEIGHTS_M = (0.25, 0.9)
"""Of drawn cameras above the table."""
Scene = dict[str, np.ndarray]


def add_commands(
    parser: argparse.ArgumentParser, unit: str, how_many: int, minutes: float = 30
) -> tuple["argparse._SubParsersAction[argparse.ArgumentParser]", argparse.ArgumentParser]:
    """Give a script the commands `data` and `train`; return what takes more commands, and the parser of `data`."""
    commands = parser.add_subparsers(dest="command", required=True)
    data = commands.add_parser("data", help=f"draw training {unit}s")
    data.add_argument("--out", type=Path, required=True)
    data.add_argument(f"--{unit}s", type=int, default=how_many)
    data.add_argument("--start", type=int, default=0, help=f"number of the first {unit}")
    data.add_argument("--jobs", type=int, default=2)
    learn = commands.add_parser("train", help="train on them")
    learn.add_argument("data", type=Path)
    learn.add_argument("--out", type=Path, required=True)
    learn.add_argument("--minutes", type=float, default=minutes)
    learn.add_argument("--seed", type=int, default=0)
    learn.add_argument("--lr", type=float, default=2e-3)
    learn.add_argument("--start-from", type=Path)
    return commands, data


def draw_all(
    draw: Callable[[tuple[int, Path]], str], numbers: Iterable[int], out: Path, jobs: int
) -> None:
    """Draw what is not there yet; `draw` takes a number and the folder, and returns an error's words, or nothing."""
    os.environ.setdefault("LP_NUM_THREADS", "1")  # Mesa's threads get in each other's way
    out.mkdir(parents=True, exist_ok=True)
    began = time.time()
    with ProcessPoolExecutor(jobs) as pool:
        work = [(number, out) for number in numbers]
        for done, words in enumerate(pool.map(draw, work, chunksize=4), 1):
            if words:
                print(f"left out {words}", file=sys.stderr)
            if done % 50 == 0:
                print(f"{done} drawn, {(time.time() - began) / done:.2f} s each", flush=True)


def drawn_scene(
    job: tuple[int, Path],
    stream: str,
    rows_of: Callable[[int, np.random.Generator], list[dict[str, np.ndarray]]],
    nothing: str,
) -> str:
    """Write what training needs of one scene; return an error's words, or nothing.

    Args:
        job: the scene's number and the folder; a scene that is there is not drawn again.
        stream: name of the random stream.
        rows_of: draws the scene of a number and returns what each camera sees.
        nothing: what is said where no camera sees anything of use.
    """
    number, out = job
    path = out / f"{number:05d}.npz"
    if path.is_file():
        return ""
    try:
        rows = rows_of(number, rng_for(number, stream))
    except (ValueError, RuntimeError) as error:
        return f"{number}: {type(error).__name__} {error}"
    if not rows:
        return f"{number}: {nothing}"
    np.savez(path, **{key: np.stack([row[key] for row in rows]) for key in rows[0]})
    return ""


def resized_view(spec: VideoSpec, rng: np.random.Generator) -> VideoSpec:
    """Return a clip in another picture size and another field of view."""
    w, h = SIZES[int(rng.integers(len(SIZES)))]
    fovy_rad = float(np.radians(rng.uniform(35, 60)))
    return replace(spec, view=replace(spec.view, width_px=w, height_px=h, fovy_rad=fovy_rad))


def view_towards(
    view: View,
    aim_m: Float[np.ndarray, "2"],
    pitches_rad: tuple[float, float],
    rng: np.random.Generator,
) -> View:
    """Return a camera of random height and pitch that looks at a point of the table."""
    height = float(np.exp(rng.uniform(*np.log(HEIGHTS_M))))
    pitch = float(rng.uniform(*pitches_rad))
    return replace(
        view,
        height_m=height,
        pitch_rad=pitch,
        roll_rad=float(np.radians(rng.normal(0, 0.9))),
        back_m=float(height / np.tan(pitch) - aim_m[0]),
        side_m=float(aim_m[1]),
    )


def compressed(
    image: UInt8[np.ndarray, "h w 3"], rng: np.random.Generator
) -> UInt8[np.ndarray, "h w 3"]:
    """Return a picture as it comes out of a file of random quality."""
    quality = int(rng.integers(35, 95))
    _, data = cv2.imencode(".jpg", image[..., ::-1], [cv2.IMWRITE_JPEG_QUALITY, quality])
    return np.asarray(cv2.imdecode(data, cv2.IMREAD_COLOR))[..., ::-1]


def recoloured(
    rgb: UInt8[np.ndarray, "h w 3"], rng: np.random.Generator
) -> UInt8[np.ndarray, "h w 3"]:
    """Return a picture in other colours and another light, sometimes blurred."""
    mix = np.eye(3) + rng.normal(0, 0.08, (3, 3))
    gain, bias, gamma = np.exp(rng.normal(0, 0.25)), rng.normal(0, 8), np.exp(rng.normal(0, 0.2))
    curve = np.clip(255 * (np.arange(256) / 255) ** gamma * gain + bias, 0, 255).astype(np.uint8)
    rgb = cv2.LUT(cv2.transform(rgb, mix), curve)
    if blur := float(rng.choice([0, 0, 0.6, 1.2])):
        rgb = cv2.GaussianBlur(rgb, (0, 0), blur)
    return rgb


def disc_at(
    where: Bool[np.ndarray, "s s"], least_px: int, most_px: int, rng: np.random.Generator
) -> Bool[np.ndarray, "s s"]:
    """Return a disc of random size around a random place of these."""
    disc = np.zeros(where.shape, np.uint8)
    spots = np.argwhere(where)
    if len(spots):
        y, x = spots[rng.integers(len(spots))].tolist()
        cv2.circle(disc, (x, y), int(rng.integers(least_px, most_px)), 1, -1)
    return disc > 0


class Scenes:
    """Drawn scenes in memory, one in twenty held out."""

    def __init__(self, folder: Path) -> None:
        self._folder = folder
        self._read: dict[Path, Scene] = {}
        self.own: list[Scene] = []
        """To train on."""
        self.held_out: list[Scene] = []
        self.read_new()

    def read_new(self) -> None:
        """Read what was drawn meanwhile."""
        for file in sorted(set(self._folder.glob("*.npz")) - set(self._read)):
            with np.load(file) as arrays:
                scene = {key: arrays[key] for key in arrays.files}
            self._read[file] = scene
            (self.held_out if int(file.stem) % HELD_OUT == 0 else self.own).append(scene)


def batch_of(
    varied: Callable[[Scene, int, np.random.Generator], tuple[np.ndarray, ...]],
    views: list[tuple[Scene, int]],
    rng: np.random.Generator,
) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
    """Return inputs and truth of these views, each changed at random by `varied`."""
    columns = zip(*(varied(scene, k, rng) for scene, k in views), strict=True)
    planes, known, truth = (torch.from_numpy(np.stack(column)) for column in columns)
    return planes.contiguous(memory_format=torch.channels_last), known, truth


def half_precision() -> torch.autocast:
    """Return a context of half precision where this CPU has it; elsewhere it would be eight times slower."""
    return torch.autocast(
        "cpu", torch.bfloat16, enabled=bool(torch.cpu.get_capabilities().get("avx512_bf16"))
    )


def learn[N: torch.nn.Module](
    new: Callable[[], N],
    varied: Callable[[Scene, int, np.random.Generator], tuple[np.ndarray, ...]],
    loss_of: Callable[[torch.Tensor, torch.Tensor], torch.Tensor],
    measure: Callable[[N, list[Scene]], str],
    batch: int,
    stream: str,
    args: argparse.Namespace,
) -> None:
    """Train a network on views of scenes, as `args` says, writing the weights (half precision) every two minutes.

    Args:
        new: makes the network.
        varied: planes, what is known, and the truth of a scene's view, changed at random.
        loss_of: what the network says, and the truth.
        measure: says how good it is on the scenes held out.
        batch: number of views.
        stream: name of the random stream.
        args: of the command `train`.
    """
    scenes = Scenes(args.data)
    print(f"{len(scenes.own)} scenes, {len(scenes.held_out)} held out", flush=True)
    rng = rng_for(args.seed, stream, "batches")
    with torch.random.fork_rng():
        torch.random.default_generator.manual_seed(args.seed)
        net = new()
    net.to(memory_format=torch.channels_last)  # type: ignore[call-overload]
    if args.start_from:
        net.load_state_dict({k: v.float() for k, v in load_file(args.start_from).items()})

    def some() -> torch.Tensor:
        chosen = [scenes.own[k] for k in rng.integers(len(scenes.own), size=batch)]
        views = [(scene, int(rng.integers(len(scene["known"])))) for scene in chosen]
        planes, known, truth = batch_of(varied, views, rng)
        with half_precision():
            said = net(planes, known)
        return loss_of(said.float(), truth)

    def state() -> str:
        write(net, args.out)
        scenes.read_new()
        return f"{len(scenes.own)} scenes, {measure(net, scenes.held_out)}"

    steps = descend(net, args.minutes, args.lr, some, state)
    write(net, args.out)
    print(f"{steps} steps of {batch}: {measure(net, scenes.held_out)}", flush=True)


def descend(
    net: torch.nn.Module,
    minutes: float,
    lr: float,
    loss: Callable[[], torch.Tensor],
    state: Callable[[], str],
) -> int:
    """Make a network better for so many minutes, and return in how many steps; `state` is printed every two minutes.

    The learning rate rises to `lr` over a hundred steps and falls along a quarter of a cosine as time runs out.
    """
    optimiser = torch.optim.AdamW(net.parameters(), lr, weight_decay=1e-3)
    began = spoken = time.time()
    losses: list[float] = []
    while (share := (time.time() - began) / (60 * minutes)) < 1:
        warm = min(1, (len(losses) + 1) / 100)
        for group in optimiser.param_groups:
            group["lr"] = lr * warm * (0.02 + 0.98 * np.cos(np.pi / 2 * share))
        lost = loss()
        optimiser.zero_grad()
        lost.backward()
        torch.nn.utils.clip_grad_norm_(net.parameters(), 1.0)
        optimiser.step()
        losses.append(lost.item())
        if time.time() - spoken > 120:
            spoken = time.time()
            print(
                f"{spoken - began:5.0f} s step {len(losses)} loss {np.mean(losses[-100:]):.3f}: {state()}",
                flush=True,
            )
    return len(losses)


def write(net: torch.nn.Module, out: Path) -> None:
    """Write the weights in half precision, in one move."""
    partial = out.with_suffix(".partial")
    state = {
        k: (v.half() if v.is_floating_point() else v).contiguous()
        for k, v in net.state_dict().items()
    }
    save_file(state, partial)
    partial.replace(out)

"""Measure the masks' z-buffer against MuJoCo's renderer: frames per second on the same cores, and agreement.

    python scripts/bench_masks.py            # 12 turns
    python scripts/bench_masks.py --quick    # 3 turns, within 45 s; the same 200 states

The states are 20 each of ten scenes: six random toys, which are meshes of convex parts, and four
    benchmark tasks. Half of them come out of the batched environment after random actions, under
    the randomisation
of recording with a moving camera; in the other half the objects float in random orientations.
`mujoco.Renderer` draws segmentation of the same models in the same states, put there in the same
way; turning its ids into labels is not counted.

All take turns at all states, in processes of their own that are ready beforehand. "all cores": our
threads against as many renderer processes as there are cores. "one core": one of each, held on the
same core. The engine's models ask for no multisampling, which makes the renderer faster than with
MuJoCo's default of 4 samples. Software OpenGL keeps its own number of threads: setting
`LP_NUM_THREADS` to 0 or 1 changed nothing.

The last line, `masks_over_renderer: X`, is the median over the turns of the renderer's seconds per
    frame over ours, all cores.
"""

import multiprocessing
import os
import sys
import tempfile
import time
from dataclasses import dataclass, replace
from multiprocessing.connection import Connection
from pathlib import Path
from typing import Any, Protocol

os.environ.setdefault("MUJOCO_GL", "egl" if sys.platform == "linux" else "")

import mujoco
import numpy as np
import tyro
from jaxtyping import UInt8
from scipy.spatial.transform import Rotation

from studies.objects import make_toy
from v2p_data.pipeline.runner import Runtime
from v2p_data.scene.scene import Scene
from v2p_data.seeds import rng_for
from v2p_data.sim.env.batch_env import BatchEnv, SimConfig, Snapshot
from v2p_data.sim.env.ranges import RandomizationConfig
from v2p_data.sim.model.world import CAMERA, World
from v2p_data.sim.render.masks import BACKGROUND, GL_HINT, MaskRenderer, geom_labels
from v2p_data.task.benchmark import load_benchmark
from v2p_data.task.generate import TaskConfig, generate_task
from v2p_data.task.task import TaskBundle

STATES = 20
"""Of each scene."""
WARMUP_STEPS = 12
TOYS = tuple(f"toy_{k:04d}" for k in range(6))
TASKS = ("insert", "throw_into", "push_next_to", "cover")


@dataclass(frozen=True, kw_only=True)
class BenchConfig:
    """What is measured, and for how long."""

    quick: bool = False
    """Three turns, or fewer if time runs out."""
    size_px: int = 256
    scenes: int = len(TOYS) + len(TASKS)
    """The first so many, those with meshes first."""
    turns: int = 12
    seconds: float = 240.0
    """No further turn is begun after this time."""
    seed: int = 0


@dataclass(frozen=True, kw_only=True)
class Stage:
    """One scene and its states."""

    name: str
    world: World
    moments: Snapshot

    @property
    def num_mesh_geoms(self) -> int:
        mesh = mujoco.mjtGeom.mjGEOM_MESH  # pyright: ignore[reportAttributeAccessIssue]
        return int((self.world.model.geom_type == mesh).sum())


def main(cfg: BenchConfig) -> None:
    started = time.perf_counter()
    if cfg.quick:
        cfg = replace(cfg, turns=min(cfg.turns, 3), seconds=min(cfg.seconds, 15.0))
    print(f"{_cores()} cores, load before: {os.getloadavg()[0]:.2f}")
    with tempfile.TemporaryDirectory() as folder:
        stages = make_stages(Path(folder), cfg.scenes, cfg.seed)
    count = len(stages) * STATES
    meshes = sum(s.num_mesh_geoms > 0 for s in stages) * STATES
    print(
        f"{count} states of {len(stages)} scenes, {meshes} of them with meshes; {cfg.size_px} x {cfg.size_px}"
    )
    rivals = {
        "ours, all cores": Rival("ours", stages, cfg.size_px),
        "ours, one core": Rival("ours", stages, cfg.size_px, one_core=True),
        "renderer, all cores": Rival("renderer", stages, cfg.size_px, processes=_cores()),
        "renderer, one core": Rival("renderer", stages, cfg.size_px, one_core=True),
    }
    try:
        first_s = {name: rival.ready() for name, rival in rivals.items()}
        images = {
            name: rivals[name].images() for name in ("ours, all cores", "renderer, all cores")
        }
        seconds: dict[str, list[float]] = {name: [] for name in rivals}
        busy: dict[str, list[float]] = {name: [] for name in rivals}
        for turn in range(cfg.turns):
            if turn and time.perf_counter() - started > cfg.seconds:
                break
            for name, rival in rivals.items():
                clock, cores = rival.turn()
                seconds[name].append(clock / count)
                busy[name].append(cores / count)
    finally:
        for rival in rivals.values():
            rival.stop()
    show_speed(seconds, busy)
    show_agreement(stages, *images.values())
    print(
        f"first image of ours after {first_s['ours, all cores']:.1f} s, compiled or read from its cache"
    )
    print(f"load after: {os.getloadavg()[0]:.2f}; took {time.perf_counter() - started:.0f} s")
    ratio = _ratio(seconds["renderer, all cores"], seconds["ours, all cores"])
    print(f"masks_over_renderer: {ratio:.2f}")


def show_speed(seconds: dict[str, list[float]], busy: dict[str, list[float]]) -> None:
    """Print frames per second, and the cores' time per frame, which other load changes less."""
    turns = len(seconds["ours, all cores"])
    print(
        f"\n{'':30s} {'frames/s':>9s} {'best':>7s} {'CPU ms/frame':>13s} {'best':>6s}   {turns} turns"
    )
    for name, values in seconds.items():
        print(
            f"{name:30s} {1 / np.median(values):9.0f} {1 / min(values):7.0f} "
            f"{1e3 * np.median(busy[name]):13.2f} {1e3 * min(busy[name]):6.2f}"
        )
    for cores in ("all cores", "one core"):
        ratio = _ratio(seconds[f"renderer, {cores}"], seconds[f"ours, {cores}"])
        spent = _ratio(busy[f"renderer, {cores}"], busy[f"ours, {cores}"])
        print(f"ours over renderer, {cores}: {ratio:.2f}; by CPU time {spent:.2f}")


def show_agreement(
    stages: list[Stage], ours: UInt8[np.ndarray, "n h w"], theirs: UInt8[np.ndarray, "n h w"]
) -> None:
    """Print how well both agree, per label over all states and in each state that shows it."""
    differ = (ours != theirs).sum((1, 2))
    print(
        f"\npixels that differ: {differ.mean():.2f} per image on average, {differ.max()} at most, of {ours[0].size}"
    )
    print(f"{'label':>12s} {'pixels/image':>13s} {'IoU, all':>9s} {'mean':>8s} {'worst':>8s}")
    for label in np.union1d(ours, theirs):
        both = ((ours == label) & (theirs == label)).sum((1, 2))
        either = ((ours == label) | (theirs == label)).sum((1, 2))
        shown = either > 0
        each = both[shown] / either[shown]
        name = {BACKGROUND: "background", 1: "robot"}.get(int(label), f"object {int(label) - 1}")
        print(
            f"{name:>12s} {either[shown].mean():13.0f} {both.sum() / either.sum():9.5f} "
            f"{each.mean():8.5f} {each.min():8.5f}"
        )
    worst = int(differ.argmax())
    print(f"worst image: state {worst % STATES} of {stages[worst // STATES].name}")


def _ratio(theirs: list[float], ours: list[float]) -> float:
    return float(np.median(np.divide(theirs, ours)))


def _cores() -> int:
    return len(os.sched_getaffinity(0))


# --- who draws -----------------------------------------------------------------------------------------------


class Painter(Protocol):
    def paint(self) -> list[np.ndarray]:
        """Draw all states."""
        ...

    def labels(self) -> UInt8[np.ndarray, "n h w"]:
        """Return all label images."""
        ...


class Ours:
    """The engine's masks."""

    def __init__(self, stages: list[Stage], size_px: int) -> None:
        self.renderers = [MaskRenderer(s.world, size_px) for s in stages]
        self.stages = stages
        self.renderers[0].draw(stages[0].moments, 0)

    def paint(self) -> list[np.ndarray]:
        return [
            renderer.draw_many([(stage.moments, k) for k in range(STATES)])
            for renderer, stage in zip(self.renderers, self.stages, strict=True)
        ]

    def labels(self) -> UInt8[np.ndarray, "n h w"]:
        return np.concatenate(self.paint())


class Theirs:
    """`mujoco.Renderer` with segmentation."""

    def __init__(self, stages: list[Stage], size_px: int) -> None:
        self.stages = stages
        self.models = [s.world.model.__copy__() for s in stages]
        for model in self.models:
            model.vis.global_.offwidth = model.vis.global_.offheight = size_px
        self.data = [mujoco.MjData(m) for m in self.models]
        self.renderers = [mujoco.Renderer(m, size_px, size_px) for m in self.models]
        for renderer in self.renderers:
            renderer.enable_segmentation_rendering()

    def paint(self) -> list[np.ndarray]:
        pictures = []
        for stage, model, data, renderer in zip(
            self.stages, self.models, self.data, self.renderers, strict=True
        ):
            for k in range(STATES):
                stage.moments.write(model, data, k)
                renderer.update_scene(data, camera=CAMERA)
                pictures.append(renderer.render())
        return pictures

    def labels(self) -> UInt8[np.ndarray, "n h w"]:
        images = []
        for k, picture in enumerate(self.paint()):
            of_geom = np.append(geom_labels(self.stages[k // STATES].world), np.uint8(BACKGROUND))
            is_geom = picture[..., 1] == int(mujoco.mjtObj.mjOBJ_GEOM)  # pyright: ignore[reportAttributeAccessIssue]
            images.append(of_geom[np.where(is_geom, picture[..., 0], -1)])
        return np.stack(images)


class Rival:
    """One way to draw, in one or several processes that wait for their turn."""

    def __init__(
        self,
        kind: str,
        stages: list[Stage],
        size_px: int,
        *,
        processes: int = 1,
        one_core: bool = False,
    ) -> None:
        # Forked, so that the scenes need not be sent; this process itself never opens OpenGL.
        context = multiprocessing.get_context("fork")
        self.ends: list[Connection] = []
        self.workers = []
        for _ in range(processes):
            end, far_end = context.Pipe()
            arguments = (far_end, kind, stages, size_px, one_core)
            self.workers.append(context.Process(target=_serve, args=arguments, daemon=True))
            self.workers[-1].start()
            far_end.close()
            self.ends.append(end)

    def ready(self) -> float:
        """Wait for it; return the seconds that it took to prepare itself."""
        return max(_answer(end) for end in self.ends)

    def turn(self) -> tuple[float, float]:
        """Let each process draw all states; return the seconds that all states took, of the clock and of the cores."""
        for end in self.ends:
            end.send("turn")
        clocks, cores = zip(*(_answer(end) for end in self.ends), strict=True)
        return max(clocks) / len(self.ends), sum(cores) / len(self.ends)

    def images(self) -> UInt8[np.ndarray, "n h w"]:
        self.ends[0].send("images")
        return _answer(self.ends[0])

    def stop(self) -> None:
        for worker in self.workers:
            worker.terminate()
            worker.join()


def _answer(end: Connection) -> Any:
    answer = end.recv()
    if isinstance(answer, Exception):
        sys.exit(
            f"cannot measure: {type(answer).__name__}: {answer}; mujoco.Renderer needs OpenGL: {GL_HINT}"
        )
    return answer


def _serve(
    end: Connection,
    kind: str,
    stages: list[Stage],
    size_px: int,
    one_core: bool,
) -> None:
    if one_core:
        os.sched_setaffinity(0, {min(os.sched_getaffinity(0))})
    started = time.perf_counter()
    try:
        painter: Painter = Ours(stages, size_px) if kind == "ours" else Theirs(stages, size_px)
    except Exception as error:  # noqa: BLE001 - whatever OpenGL has to say is told by the parent
        end.send(RuntimeError(repr(error)))
        return
    end.send(time.perf_counter() - started)
    while True:
        if end.recv() == "images":
            end.send(painter.labels())
            continue
        started, worked = time.perf_counter(), time.process_time()
        painter.paint()
        end.send((time.perf_counter() - started, time.process_time() - worked))


# --- what is drawn -------------------------------------------------------------------------------------------


def make_stages(folder: Path, count: int, seed: int) -> list[Stage]:
    """Return the first `count` scenes with their states; mesh files are written to `folder`."""
    names = [*TOYS, *TASKS][:count]
    return [
        Stage(name=n, **_states(_bundle(folder, n, seed), rng_for(seed, "states", n)))
        for n in names
    ]


def _bundle(folder: Path, name: str, seed: int) -> TaskBundle:
    """Return the task of a toy or of the benchmark by its name.

    Raises:
        V2PError: there is no such benchmark task.
    """
    if name not in TOYS:
        return load_benchmark(name)
    out = folder / name
    out.mkdir()
    make_toy({"seed": seed, "kind": "lift_up"}, {}, out, Runtime(root=folder))
    return generate_task(Scene.load(out), TaskConfig(num_samples=1), seed).bundle


def _states(bundle: TaskBundle, rng: np.random.Generator) -> dict[str, Any]:
    randomization = replace(
        RandomizationConfig(), camera_pos_m=0.08, camera_angle_rad=0.08, camera_fovy_deg=5.0
    )
    cfg = SimConfig(fine=True, randomization=randomization)
    env = BatchEnv(bundle, cfg, num_envs=STATES, seed=int(rng.integers(2**31)), num_threads=1)
    for _ in range(WARMUP_STEPS):
        env.step(rng.uniform(-1, 1, (STATES, 7)).astype(np.float32))
    moments = env.snapshot(np.arange(STATES))
    floating = np.arange(STATES // 2)
    for obj in env.world.objects:
        at = obj.qpos_adr
        moments.qpos[floating, at : at + 3] = rng.uniform(
            (0.40, -0.2, 0.04), (0.66, 0.2, 0.25), (len(floating), 3)
        )
        turns = Rotation.random(len(floating), rng=rng).as_quat(scalar_first=True)
        moments.qpos[floating, at + 3 : at + 7] = turns
    return {"world": env.world, "moments": moments}


if __name__ == "__main__":
    main(tyro.cli(BenchConfig, description=__doc__))

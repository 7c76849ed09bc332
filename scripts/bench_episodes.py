"""Measure what a dataset costs: from an expert to finished, verified files, against LeRobot's own way.

    python scripts/bench_episodes.py             # 24 episodes, two codecs; 3 minutes
    python scripts/bench_episodes.py --quick     # 6 episodes, within 60 s
    python scripts/bench_episodes.py --scaling   # 10, 100, 1,000 episodes and 1, 10, 100 tasks; 10 minutes

A scripted expert lifts the benchmark's box under the recording randomisation. "ours": `collect`,
which rolls out, draws and stages, then `pack`. "lerobot": the same rollouts (checked: equal
actions), masks by `mujoco.Renderer`'s segmentation, `LeRobotDataset.add_frame` and `save_episode`
with lossless H.264 (crf 0, yuv420p, g 2), the best row of a table of fourteen ways to store masks,
or with LeRobot's default codec (without `--quick`). Each is given what it can use: ours all cores,
LeRobot's way its one process and what threads its parts start. Imports, compilation and the making
of windows come before the clock.

Then both datasets are read with LeRobot: every pixel of ours against what was drawn, and random rows with two frames of
pictures and states, in turns. The scaling packs synthetic episodes (discs and squares, 256 x 256,
30 frames), each size in a process of its own, because physics is not the question there; shown are
milliseconds per frame, by the clock and of all cores together, and the largest memory.

The last line, `expert_to_dataset_over_lerobot: X`, is our frames per second over LeRobot's.
"""

import json
import os
import resource
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

os.environ.setdefault("MUJOCO_GL", "egl" if sys.platform == "linux" else "")
os.environ.setdefault("HF_HUB_OFFLINE", "1")

import cv2
import mujoco
import numpy as np
import tyro
from jaxtyping import Float32

from v2p_data.episodes.collect import EpisodesConfig, collect
from v2p_data.episodes.dataset.features import (
    ACTION_KEY,
    DONE_KEY,
    FPS,
    MASK_KEY,
    ROBOT_TYPE,
    STATE_KEY,
    SUCCESS_KEY,
    features,
)
from v2p_data.episodes.dataset.writer import pack
from v2p_data.episodes.rollouts import Lesson, Rollouts, roll_out
from v2p_data.episodes.staging import Episode, staged_episodes
from v2p_data.play import StateActor
from v2p_data.seeds import rng_for, seed_for
from v2p_data.sim.env.batch_env import SimConfig
from v2p_data.sim.model.world import CAMERA, build_world
from v2p_data.sim.render.masks import (
    BACKGROUND,
    PALETTE,
    MaskRenderer,
    geom_labels,
    labels_to_rgb,
)
from v2p_data.sim.robot.robot import FINE
from v2p_data.task.benchmark import load_benchmark
from v2p_data.task.task import TaskBundle

SEED = 5
LIFT_M = 0.15
READS = 60
SYNTHETIC_FRAMES, SYNTHETIC_PX = 30, 256
SIZES = ((10, 1), (100, 1), (1000, 1), (100, 10), (100, 100))
"""Episodes and tasks of `--scaling`."""


@dataclass(frozen=True, kw_only=True)
class BenchConfig:
    """What is measured, and on how much."""

    quick: bool = False
    """6 episodes, one codec."""
    scaling: bool = False
    """Time per frame and memory against the number of episodes and of tasks."""
    pack_only: Path | None = None
    """Pack the staged episodes of this folder and print seconds and memory as JSON; a row of `--scaling`."""
    episodes: int = 0
    """0 for 6 with `--quick` and 24 without."""
    size_px: int = 256
    threads: int = 0
    """Of ours; 0 for all cores."""


def lift(obs: Float32[np.ndarray, "env obs"]) -> Float32[np.ndarray, "env act"]:
    """Return actions that go over the box, down, close and raise it, from what every policy sees."""
    to_box, ahead = obs[:, 22:25] / 10, obs[:, 11:14] / 20
    raised = obs[:, 75] / 5
    is_held = (obs[:, 70:72] > 0.5).all(1)
    is_over = np.linalg.norm(to_box[:, :2], axis=1) < 0.015
    goal = to_box + np.array([0, 0, 0.1])
    goal[is_over] = to_box[is_over]
    goal[is_held] = 0
    goal[is_held, 2] = np.clip(LIFT_M - raised[is_held], -0.03, 0.1)
    action = np.zeros((len(obs), 7), np.float32)
    action[:, :3] = np.clip((goal - ahead) / 0.03, -0.6, 0.6)
    is_there = np.linalg.norm(to_box, axis=1) < 0.02
    action[:, 6] = np.where(is_held | is_there, 1, -1)
    return action


def main() -> None:
    """Read the command line, measure, print."""
    cfg = tyro.cli(BenchConfig, description=__doc__.split("\n")[0])
    if cfg.pack_only:
        print(json.dumps(pack_alone(cfg.pack_only, cfg.threads)))
    elif cfg.scaling:
        scaling(cfg)
    else:
        compare(replace(cfg, episodes=cfg.episodes or (6 if cfg.quick else 24)))


def compare(cfg: BenchConfig) -> None:
    """Make the same dataset both ways, read both, print the table."""
    from lerobot.configs.video import RGBEncoderConfig

    bundle = load_benchmark("lift_up")
    recipe = EpisodesConfig(
        num_episodes=cfg.episodes,
        batch_worlds=cfg.episodes + 2,
        max_batches=4,
        size_px=cfg.size_px,
    )
    with tempfile.TemporaryDirectory() as folder:
        place = Path(folder)
        warm_up(bundle, place / "warm", cfg)
        started = time.perf_counter()
        lesson = Lesson(bundle=bundle, expert=StateActor(lift))
        collected = collect(lesson, recipe, place / "ours", SEED, num_threads=cfg.threads)
        staged_s = time.perf_counter() - started
        staged = staged_episodes(place / "ours")
        pack(staged, "bench/ours", place / "dataset", num_threads=cfg.threads)
        ours_s = time.perf_counter() - started
        frames = collected["frames"]
        print(
            f"{len(staged)} episodes of {collected['rollouts']}, {frames} frames, {cfg.size_px} x {cfg.size_px}"
        )
        print(
            f"ours: collect {1e3 * staged_s / frames:.2f} ms a frame, pack {1e3 * (ours_s - staged_s) / frames:.2f}"
        )
        codecs: dict[str, Any] = {
            "h264 crf 0": RGBEncoderConfig(vcodec="h264", crf=0, pix_fmt="yuv420p", g=2)
        }
        if not cfg.quick:
            codecs["default"] = None
        rows = {"ours": (ours_s, video_bytes(place / "dataset") / frames, place / "dataset")}
        for name, codec in codecs.items():
            root = place / name.replace(" ", "_")
            seconds = lerobots_way(bundle, recipe, staged, root, codec)
            rows[f"lerobot, {name}"] = (seconds, video_bytes(root) / frames, root)
        wrong = wrong_pixels(place / "dataset", staged)
        reads = read_times([root for _, _, root in rows.values()], frames)
        print(
            f"{'':22s} {'frames/s':>9s} {'ms/frame':>9s} {'B/frame':>8s} {'2-frame read ms':>16s}"
        )
        for (name, (seconds, size, _)), read in zip(rows.items(), reads, strict=True):
            print(
                f"{name:22s} {frames / seconds:9.1f} {1e3 * seconds / frames:9.2f} {size:8.0f} {read:16.2f}"
            )
        best = rows["lerobot, h264 crf 0"]
        print(f"wrong pixels in ours: {wrong} of {frames * cfg.size_px**2}")
        print(f"bytes_over_best_row: {rows['ours'][1] / best[1]:.3f}")
        print(f"read_over_best_row: {reads[0] / reads[1]:.2f}")
        print(f"expert_to_dataset_over_lerobot: {best[0] / ours_s:.2f}")


def warm_up(bundle: TaskBundle, place: Path, cfg: BenchConfig) -> None:
    """Import, compile and open everything that both ways need, on two episodes."""
    small = EpisodesConfig(num_episodes=2, batch_worlds=4, max_batches=4, size_px=64)
    collect(Lesson(bundle=bundle, expert=StateActor(lift)), small, place, 0)
    staged = staged_episodes(place)
    pack(staged, "bench/warm", place / "dataset")
    lerobots_way(bundle, small, staged, place / "lerobot", None, seed=0)
    with MaskRenderer(bundle, cfg.size_px):
        pass


def lerobots_way(
    bundle: TaskBundle,
    recipe: EpisodesConfig,
    staged: list[Path],
    root: Path,
    codec: Any,
    seed: int = SEED,
) -> float:
    """Make a dataset of the same episodes as LeRobot's users do; return the seconds it took.

    Raises:
        RuntimeError: the episodes are not the same.
    """
    from lerobot.datasets.lerobot_dataset import LeRobotDataset

    wanted = [Episode.load(path, pictures=False) for path in staged]
    started = time.perf_counter()
    dataset = LeRobotDataset.create(
        f"bench/{root.name}",
        fps=FPS,
        features=features(recipe.size_px, is_simulated=True),
        root=root,
        robot_type=ROBOT_TYPE,
        rgb_encoder=codec,
    )
    made: list[np.ndarray] = []
    for rollouts in batches(bundle, recipe, seed):
        world = build_world(bundle.scene, FINE)
        labels = np.append(geom_labels(world), np.uint8(BACKGROUND))
        data = mujoco.MjData(world.model)
        with mujoco.Renderer(world.model, recipe.size_px, recipe.size_px) as renderer:
            renderer.enable_segmentation_rendering()
            for k in np.flatnonzero(rollouts.successes)[: len(wanted) - len(made)]:
                length = int(rollouts.num_frames[k])
                known = rollouts.simulated(int(k), recipe.size_px)
                for t in range(length):
                    rollouts.snapshots[t].write(world.model, data, int(k))
                    renderer.update_scene(data, camera=CAMERA)
                    picture = labels_to_rgb(labels[renderer.render()[..., 0]])
                    dataset.add_frame(
                        {
                            MASK_KEY: picture,
                            STATE_KEY: rollouts.state[t, k],
                            ACTION_KEY: rollouts.action[t, k],
                            SUCCESS_KEY: np.array([t >= rollouts.held_at[k]]),
                            DONE_KEY: np.array([t == length - 1]),
                            **{key: np.atleast_1d(values[t]) for key, values in known.items()},
                            "task": bundle.description,
                        }
                    )
                with ThreadPoolExecutor(1) as own:  # as root, SVT-AV1 makes its caller real-time
                    own.submit(dataset.save_episode).result()
                made.append(rollouts.action[:length, k])
        if len(made) == len(wanted):
            break
    dataset.finalize()
    seconds = time.perf_counter() - started
    if not all(np.array_equal(a, e.action) for a, e in zip(made, wanted, strict=True)):
        raise RuntimeError("the two ways recorded different episodes")
    return seconds


def batches(bundle: TaskBundle, recipe: EpisodesConfig, seed: int) -> Iterator[Rollouts]:
    """Yield the rollouts that `collect` makes, with its seeds."""
    for number in range(recipe.max_batches):
        yield roll_out(
            Lesson(bundle=bundle, expert=StateActor(lift)),
            SimConfig(fine=True, randomization=recipe.randomization),
            num_worlds=recipe.batch_worlds,
            seed=seed_for(seed, "batch", number),
            num_threads=0,
            cut=recipe.cut,
        )


def wrong_pixels(root: Path, staged: list[Path]) -> int:
    """Return how many values of the pictures LeRobot reads differ from the greys that were drawn."""
    from lerobot.datasets.lerobot_dataset import LeRobotDataset

    dataset: Any = LeRobotDataset("bench/ours", root=root, return_uint8=True)
    greys = np.asarray(PALETTE, np.uint8)
    wrong = row = 0
    for path in staged:
        for image in Episode.load(path).labels:
            picture = np.asarray(dataset[row][MASK_KEY])
            wrong += int((picture != greys[image]).any(0).sum())
            row += 1
    return wrong


def read_times(roots: list[Path], frames: int) -> list[float]:
    """Return the median milliseconds to read a random row with two frames of pictures and states."""
    from lerobot.datasets.lerobot_dataset import LeRobotDataset

    two = [-1 / FPS, 0.0]
    datasets: list[Any] = [
        LeRobotDataset("bench/read", root=r, delta_timestamps={MASK_KEY: two, STATE_KEY: two})
        for r in roots
    ]
    rows = rng_for(0, "bench-reads").integers(0, frames, READS)
    times = np.zeros((len(datasets), READS))
    for k, row in enumerate([0, *rows]):  # the first opens the files
        for which, dataset in enumerate(datasets):
            started = time.perf_counter()
            dataset[int(row)]
            times[which, max(k - 1, 0)] = time.perf_counter() - started
    return [1e3 * float(t) for t in np.median(times, axis=1)]


def video_bytes(root: Path) -> int:
    """Return the size of the dataset's videos."""
    return sum(p.stat().st_size for p in root.glob("videos/**/*.mp4"))


def scaling(cfg: BenchConfig) -> None:
    """Pack ever more synthetic episodes, of ever more tasks, and print what it costs."""
    print("synthetic episodes: packing only, no physics")
    print(
        f"{'episodes':>8s} {'tasks':>6s} {'frames':>8s} {'ms/frame':>9s} {'CPU ms':>7s} "
        f"{'memory MB':>10s} {'more than before':>17s}"
    )
    for episodes, tasks in SIZES:
        with tempfile.TemporaryDirectory() as folder:
            stage_synthetic(Path(folder), episodes, tasks)
            command = [
                sys.executable,
                __file__,
                f"--pack-only={folder}",
                f"--threads={cfg.threads}",
            ]
            done = subprocess.run(command, capture_output=True, text=True, check=True)
        got = json.loads(done.stdout.splitlines()[-1])
        frames = episodes * SYNTHETIC_FRAMES
        print(
            f"{episodes:8d} {tasks:6d} {frames:8d} {1e3 * got['seconds'] / frames:9.3f} "
            f"{1e3 * got['cpu_seconds'] / frames:7.3f} {got['peak_mb']:10.0f} "
            f"{got['peak_mb'] - got['before_mb']:17.0f}",
            flush=True,
        )


def pack_alone(folder: Path, threads: int) -> dict[str, float]:
    """Pack the episodes staged in a folder; return seconds and memory [MB], before and at most."""
    paths = staged_episodes(folder)
    pack(paths[:2], "bench/warm", folder / "warm")
    before_mb = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024
    started, cpu = time.perf_counter(), time.process_time()
    pack(paths, "bench/many", folder / "dataset", num_threads=threads)
    seconds = time.perf_counter() - started
    peak_mb = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024
    cpu = time.process_time() - cpu
    return {"seconds": seconds, "cpu_seconds": cpu, "before_mb": before_mb, "peak_mb": peak_mb}


def stage_synthetic(out: Path, episodes: int, tasks: int) -> None:
    """Stage discs and squares that wander over a background."""
    for number in range(episodes):
        rng = rng_for(1, "synthetic", number)
        labels = np.zeros((SYNTHETIC_FRAMES, SYNTHETIC_PX, SYNTHETIC_PX), np.uint8)
        x, y = rng.integers(40, 200, (2, 3))
        for t, image in enumerate(labels):
            cv2.circle(image, (int(x[0]) + t, int(y[0])), 36, 1, -1)
            cv2.rectangle(
                image, (int(x[1]), int(y[1]) - t), (int(x[1]) + 40, int(y[1]) + 30), 2, -1
            )
            cv2.circle(image, (int(x[2]) - t, int(y[2]) + t), 20, 3, -1)
        Episode(
            id=f"synthetic_{number:05d}",
            item=f"item_{number % tasks}",
            task=f"do task {number % tasks}",
            seed=number,
            labels=labels,
            state=rng.normal(size=(SYNTHETIC_FRAMES, 11)).astype(np.float32),
            action=rng.uniform(-1, 1, (SYNTHETIC_FRAMES, 7)).astype(np.float32),
            success=np.arange(SYNTHETIC_FRAMES) > SYNTHETIC_FRAMES - 8,
            referee=True,
            objects=("a", "b"),
        ).save(out / "episodes")


if __name__ == "__main__":
    main()

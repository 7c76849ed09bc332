"""Measure how much of the bare physics' speed the whole environment keeps.

    python scripts/bench_sim.py             # the table, with a policy in training; 3 minutes
    python scripts/bench_sim.py --quick     # the table without training, within 45 s
    python scripts/bench_sim.py --scaling   # cost and memory per world, 64 to 4096 worlds

The environment is `BatchEnv.step`: clipping and noise, targets, physics, states, observation, the task's success
and reward, and the reset of the worlds whose episode ended. The limit is `Batch.step` alone on the same model
with the same per-world values, time steps, threads and controls, in the same states: what the environment did
is recorded, and the bare physics must end up in the same joint positions to the last bit, or the measurement
fails. Resets are put into the limit's states while its clock stands still.

The two take turns, `CHUNK` control steps each, and go through the same steps again and again.
"best" adds up the fastest time of each step, "median" the medians. The share of the limit is taken
per pair of neighbouring chunks, the seconds of the bare physics divided by those of the
environment, so that other load on the machine meets both; shown is the median over all pairs. The
last line, `env_over_limit: X`, is that share for lifting a box with random actions.
"""

import json
import os
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
import trimesh
import tyro
from jaxtyping import Float
from mujoco.batch import Batch
from tensordict import TensorDict, TensorDictBase

from policies.ppo.config import PPOConfig
from policies.ppo.policy import Expert
from policies.ppo.train import LAST_FOLDER, train_expert
from v2p_data.geometry.camera import Camera
from v2p_data.scene.scene import Scene, SceneObject
from v2p_data.seeds import rng_for, torch_rng_for
from v2p_data.sim.env.batch_env import BatchEnv
from v2p_data.sim.wrappers.torchrl_env import TorchRLEnv
from v2p_data.task.task import TaskBundle
from v2p_data.task.templates.write import write_samples

CHUNK = 4
QUICK_SECONDS = 26.0
"""With --quick, a row is left out that would not be done by then, if it took half as long again as
the slowest so far."""
SCALING_WORLDS = (64, 128, 256, 512, 1024, 2048, 4096)
MESH_FILE = "pebble.obj"


@dataclass(frozen=True, kw_only=True)
class BenchConfig:
    """What is measured, and for how long."""

    quick: bool = False
    """Fewer turns, and no training."""
    scaling: bool = False
    """Cost and memory per world against the number of worlds."""
    one_size: bool = False
    """One row of `--scaling`, as JSON."""
    worlds: int = 512
    threads: int = 0
    """0 for all cores."""
    steps: int = 24
    """Control steps per turn."""
    turns: int = 12
    """Of each kind; the fastest and the median are shown."""
    warmup_steps: int = 60
    """Before the first turn, so that objects have been pushed about and worlds are at all stages."""
    row_seconds: float = 30.0
    """A row takes no further turns after this time (but three at least)."""
    training_steps: int = 500_000
    """Control steps of PPO before the rows with a policy."""


@dataclass(frozen=True, kw_only=True)
class Trace:
    """Some control steps as they happened, from which they can be repeated."""

    start: dict[str, Any]
    """The environment's whole state before."""
    actions: np.ndarray
    """`(step, env, 7)`."""
    controls: np.ndarray
    """`(step, env, control)`: what the physics got."""
    resets: tuple[tuple[np.ndarray, dict[str, np.ndarray]], ...]
    """Per step the worlds that started anew, and their rows of every state and model field after that."""
    end_qpos: np.ndarray


@dataclass(frozen=True, kw_only=True)
class Turns:
    """Seconds per turn and control step of all worlds."""

    env: Float[np.ndarray, "turn step"]
    limit: Float[np.ndarray, "turn step"]
    """Next to `env`."""
    torchrl: Float[np.ndarray, "turn step"]
    torchrl_limit: Float[np.ndarray, "turn step"]
    """Next to `torchrl`."""
    num_worlds: int

    def env_over_limit(self) -> float:
        return _median_share(self.limit, self.env)

    def torchrl_over_limit(self) -> float:
        return _median_share(self.torchrl_limit, self.torchrl)

    def microseconds(self, seconds: Float[np.ndarray, "turn step"]) -> str:
        per_world = 1e6 / (self.num_worlds * seconds.shape[1])
        best, median = seconds.min(0).sum(), np.median(seconds, axis=0).sum()
        return f"{best * per_world:.1f} ({median * per_world:.1f})"

    def row(self, name: str) -> str:
        total = self.num_worlds * self.env.shape[1]
        env, wrapped, limit = (
            f"{total / s.min(0).sum():8,.0f} {total / np.median(s, axis=0).sum():8,.0f}"
            for s in (self.env, self.torchrl, self.limit)
        )
        return (
            f"{name:34s} {limit}   {env}   {self.env_over_limit():6.2f}   {wrapped}   "
            f"{self.torchrl_over_limit():6.2f}   {len(self.env):3d}"
        )


HEADER = (
    f"{'control steps per second':34s} {'limit':>17s}   {'environment':>17s}   {'/limit':>6s}   "
    f"{'through TorchRL':>17s}   {'/limit':>6s}   turns\n"
    f"{'':34s} {'best':>8s} {'median':>8s}   {'best':>8s} {'median':>8s}   {'median':>6s}   "
    f"{'best':>8s} {'median':>8s}   {'median':>6s}"
)


def _median_share(
    limit: Float[np.ndarray, "turn step"], other: Float[np.ndarray, "turn step"]
) -> float:
    starts = np.arange(0, limit.shape[1], CHUNK)
    return float(np.median(np.add.reduceat(limit, starts, 1) / np.add.reduceat(other, starts, 1)))


Policy = Callable[[np.ndarray], np.ndarray]


def main(cfg: BenchConfig) -> None:
    torch.set_num_threads(1)  # the worlds' threads need the cores
    load = ", ".join(f"{x:.2f}" for x in os.getloadavg())
    print(f"{os.cpu_count()} cores, load before: {load}")
    with tempfile.TemporaryDirectory() as name:
        if cfg.scaling:
            show_scaling(cfg)
        elif cfg.one_size:
            show_one_size(cfg)
        else:
            show_table(cfg, Path(name))


# --- tasks ---------------------------------------------------------------------------------------------------


def lift_box() -> TaskBundle:
    """Return the task that the last line is about."""
    return _task("lift_up", _object("box", size_m=(0.04, 0.05, 0.045), ends_at=(0.0, 0.0, 0.15)))


def insert_into_bowl() -> TaskBundle:
    """Return a task with a hollow object: a floor and ten walls."""
    return _task(
        "insert",
        _object("cube", size_m=(0.035, 0.035, 0.035), ends_at=(0.0, 0.2, 0.04)),
        _object(
            "bowl",
            "cylinder",
            size_m=(0.15, 0.15, 0.06),
            starts_at=(0.0, 0.2),
            role="container",
            hollow=True,
        ),
    )


def lift_mesh(folder: Path) -> TaskBundle:
    """Return a task with a mesh of 40 corners, written to `folder`."""
    pebble = trimesh.creation.icosphere(subdivisions=2, radius=1.0)
    pebble.apply_scale((0.03, 0.025, 0.02))
    pebble.export(folder / MESH_FILE)
    thing = _object("pebble", "mesh", size_m=(0.06, 0.05, 0.04), ends_at=(0.0, 0.0, 0.15))
    return _task("lift_up", replace(thing, mesh=MESH_FILE), folder=folder)


def _object(
    name: str,
    shape: Any = "box",
    *,
    size_m: tuple[float, float, float],
    starts_at: tuple[float, float] = (0.0, 0.0),
    ends_at: tuple[float, float, float] | None = None,
    role: Any = "manipulated",
    hollow: bool = False,
) -> SceneObject:
    first = (*starts_at, size_m[2] / 2)
    upright = (1.0, 0.0, 0.0, 0.0)
    return SceneObject(
        name=name,
        label=name,
        role=role,
        shape=shape,
        size_m=size_m,
        mass_kg=0.12,
        friction=0.8,
        hollow=hollow,
        frames=(0, 10),
        poses_world=((*first, *upright), (*(ends_at or first), *upright)),
        confidences=(1.0, 1.0),
    )


def _task(kind: str, *objects: SceneObject, folder: Path | None = None) -> TaskBundle:
    camera = Camera(
        width_px=64,
        height_px=48,
        K=np.array([[60.0, 0, 32], [0, 60.0, 24], [0, 0, 1]]),
        T_world_cam=np.eye(4),
    )
    scene = Scene(
        title=f"bench_{kind}",
        video="",
        description=f"{kind.replace('_', ' ')}: {objects[0].name}",
        kind=kind,
        objects=objects,
        camera=camera,
        fps=20.0,
        num_frames=11,
        confidence=1.0,
        folder=folder or Path(),
    )
    return TaskBundle(
        title=scene.title,
        description=scene.description,
        kind=kind,
        class_name="Task",
        code=write_samples(scene, 1)[0],
        scene=scene,
    )


# --- measuring -----------------------------------------------------------------------------------------------


def random_policy(num_envs: int) -> Policy:
    """Return uniformly random actions."""
    rng = rng_for(0, "bench")
    return lambda obs: rng.uniform(-1.0, 1.0, (num_envs, 7))


def exploring(expert: Expert) -> Policy:
    """Return the expert's actions with the noise that it trained with."""
    generator = torch_rng_for(0, "bench")
    return lambda obs: expert.act(obs, deterministic=False, generator=generator)


def measure(env: BatchEnv, policy: Policy, cfg: BenchConfig) -> Turns:
    """Let environment, TorchRL's view of it and bare physics take turns at the same control steps."""
    env.stagger()
    for _ in range(cfg.warmup_steps):
        result = env.step(policy(env.observe()))
        env.reset(np.flatnonzero(result.truncated | result.terminated))
    trace = record(env, policy, cfg.steps)
    wrapped = TorchRLEnv(env)
    physics = BarePhysics(env, cfg.threads)
    turns = []
    started = time.perf_counter()
    for turn in range(cfg.turns):
        turns.append(
            (
                *alternate(env_steps(env, trace), physics, trace),
                *alternate(torchrl_steps(wrapped, trace), physics, trace),
            )
        )
        if turn >= 2 and time.perf_counter() - started > cfg.row_seconds:
            break
    env_s, limit_s, torchrl_s, torchrl_limit_s = np.array(turns).transpose(1, 0, 2)
    return Turns(
        env=env_s,
        limit=limit_s,
        torchrl=torchrl_s,
        torchrl_limit=torchrl_limit_s,
        num_worlds=env.num_envs,
    )


def record(env: BatchEnv, policy: Policy, num_steps: int) -> Trace:
    """Act for some steps and note down all that a repetition needs."""
    start = env.state_dict()
    actions, controls, resets, qpos = [], [], [], np.empty(0)
    for _ in range(num_steps):
        actions.append(policy(env.observe()).astype(np.float32))
        result = env.step(actions[-1])
        state = env.state_dict()
        controls.append(state["batch.ctrl"].numpy())
        qpos = state["batch.qpos"].numpy()
        ids = np.flatnonzero(result.truncated | result.terminated)
        env.reset(ids)
        after = env.state_dict()
        rows = {
            key: value.numpy()[ids]
            for key, value in after.items()
            if key.startswith(("batch.", "model."))
        }
        resets.append((ids, rows))
    return Trace(
        start=start,
        actions=np.stack(actions),
        controls=np.stack(controls),
        resets=tuple(resets),
        end_qpos=qpos,
    )


def alternate(
    step: Callable[[int], None], physics: "BarePhysics", trace: Trace
) -> tuple[list[float], list[float]]:
    """Repeat the trace, some steps of one kind, then the same steps of the other; return the seconds of each step.

    Raises:
        RuntimeError: the bare physics ended elsewhere than the environment did.
    """
    physics.start(trace)
    ours, limit = [], []
    for first in range(0, len(trace.actions), CHUNK):
        chunk = range(first, min(first + CHUNK, len(trace.actions)))
        for k in chunk:
            started = time.perf_counter()
            step(k)
            ours.append(time.perf_counter() - started)
        limit += [physics.seconds(trace, k) for k in chunk]
    return ours, limit


def env_steps(env: BatchEnv, trace: Trace) -> Callable[[int], None]:
    """Return step `k` of the trace through the environment; call them in order."""
    env.load_state_dict(trace.start)

    def step(k: int) -> None:
        result = env.step(trace.actions[k])
        env.reset(np.flatnonzero(result.truncated | result.terminated))

    return step


def torchrl_steps(env: TorchRLEnv, trace: Trace) -> Callable[[int], None]:
    """Return the same as TorchRL's collectors do it."""
    env.load_state_dict(trace.start)
    actions = torch.from_numpy(trace.actions)
    now: TensorDictBase = TensorDict({}, env.batch_size)

    def step(k: int) -> None:
        nonlocal now
        _, now = env.step_and_maybe_reset(now.set("action", actions[k]))

    return step


class BarePhysics:
    """A second batch of the environment's model with its per-world values, and nothing else.

    Args:
        env: whose model.
        threads: as many as the environment uses.
    """

    def __init__(self, env: BatchEnv, threads: int) -> None:
        self.substeps = env.world.physics.substeps
        self.batch = Batch(env.world.model, env.num_envs, threads)
        state = env.state_dict()
        self.fields = {
            key: self.batch.expand(key.removeprefix("model."))
            if key.startswith("model.")
            else self.batch.bind(key.removeprefix("batch."))
            for key in state
            if key.startswith(("model.", "batch."))
        }

    def start(self, trace: Trace) -> None:
        """Put all worlds where the trace begins."""
        for key, value in self.fields.items():
            value[:] = trace.start[key].numpy()

    def seconds(self, trace: Trace, k: int) -> float:
        """Make step `k`, then the resets after it; return what `Batch.step` took.

        Raises:
            RuntimeError: it was the last one, and the state is not the environment's.
        """
        self.fields["batch.ctrl"][:] = trace.controls[k]
        started = time.perf_counter()
        self.batch.step(nstep=self.substeps)
        seconds = time.perf_counter() - started
        is_last = k == len(trace.actions) - 1
        if is_last and not np.array_equal(
            self.fields["batch.qpos"], trace.end_qpos, equal_nan=True
        ):
            raise RuntimeError("the bare physics went through other states than the environment")
        ids, rows = trace.resets[k]
        for key, value in self.fields.items():
            value[ids] = rows[key]
        return seconds


# --- what is shown -------------------------------------------------------------------------------------------


def show_table(cfg: BenchConfig, folder: Path) -> None:
    """Print a row per task, the rows with a policy, and the last line."""
    started = time.perf_counter()
    if cfg.quick:
        cfg = replace(
            cfg,
            steps=min(cfg.steps, 8),
            turns=min(cfg.turns, 12),
            warmup_steps=min(cfg.warmup_steps, 20),
            row_seconds=min(cfg.row_seconds, 4.0),
        )
    print(HEADER)
    ratio, slowest = float("nan"), 0.0
    rows = (
        ("lift a box, random actions", lift_box()),
        ("insert into a bowl, random actions", insert_into_bowl()),
        ("lift a mesh, random actions", lift_mesh(folder)),
    )
    for name, bundle in rows:
        begun = time.perf_counter()
        if cfg.quick and begun - started + 1.5 * slowest > QUICK_SECONDS:
            print(f"{name:34s} left out: the machine is too busy for --quick")
            continue
        turns = measure(_env(bundle, cfg), random_policy(cfg.worlds), cfg)
        print(turns.row(name), flush=True)
        slowest = max(slowest, time.perf_counter() - begun)
        ratio = turns.env_over_limit() if np.isnan(ratio) else ratio
    if not cfg.quick:
        show_training(cfg, folder)
    print(f"env_over_limit: {ratio:.2f}")


def show_training(cfg: BenchConfig, folder: Path) -> None:
    """Train on lifting the box, then measure with the policy in the states that it brings about."""
    worlds = _env(lift_box(), cfg)
    env = TimedEnv(worlds)
    recipe = PPOConfig(total_steps=cfg.training_steps, target_success=1.0)
    result = train_expert(env, recipe, folder / "expert", seed=0)
    print(measure_acting(worlds, result.folder, cfg).row("lift a box, policy in training"))
    print(
        f"in {result.seconds:.0f} s of training ({result.steps / result.seconds:,.0f} steps/s, success "
        f"{result.success:.2f}) {env.seconds / result.seconds:.0%} of the time went to the environment: "
        f"{result.steps / env.seconds:,.0f} steps/s there"
    )


def measure_acting(env: BatchEnv, expert: Path, cfg: BenchConfig) -> Turns:
    """Measure with the last policy of a training, not the best: they are the states it trains in."""
    return measure(env, exploring(Expert.load(expert / LAST_FOLDER)), cfg)


class TimedEnv(TorchRLEnv):
    """Adds up the time spent in the environment."""

    def __init__(self, env: BatchEnv) -> None:
        super().__init__(env)
        self.seconds = 0.0

    def _step(self, tensordict: TensorDictBase) -> TensorDictBase:
        started = time.perf_counter()
        after = super()._step(tensordict)
        self.seconds += time.perf_counter() - started
        return after

    def _reset(self, tensordict: TensorDictBase | None = None, **kwargs: object) -> TensorDictBase:
        started = time.perf_counter()
        after = super()._reset(tensordict, **kwargs)
        self.seconds += time.perf_counter() - started
        return after


def show_scaling(cfg: BenchConfig) -> None:
    """Print time and memory per world for 64 to 4096 worlds, each in a process of its own."""
    threads = cfg.threads or os.cpu_count() or 1
    print("lift a box, random actions; microseconds per control step of one world, best (median)")
    print(
        f"{'worlds':>7s} {'1 thread':>15s} {f'{threads} threads':>15s} {'bare physics':>15s} {'kB per world':>14s}"
    )
    for worlds in SCALING_WORLDS:
        one, many = (_sized(worlds, n) for n in (1, threads))
        print(
            f"{worlds:7d} {one['env']:>15s} {many['env']:>15s} {many['limit']:>15s} "
            f"{many['kb_per_world']:14.1f}",
            flush=True,
        )


def _sized(worlds: int, threads: int) -> dict[str, Any]:
    """Return one row of the scaling table, measured by a process of its own: memory is never given back."""
    command = [
        sys.executable,
        __file__,
        "--one-size",
        f"--worlds={worlds}",
        f"--threads={threads}",
    ]
    done = subprocess.run(command, capture_output=True, text=True, check=True)
    return json.loads(done.stdout.splitlines()[-1])


def show_one_size(cfg: BenchConfig) -> None:
    """Print one row of the scaling table as JSON."""
    BatchEnv(
        lift_box(), num_envs=1, seed=0, num_threads=1
    )  # what is needed whatever the number of worlds
    before = _resident_bytes()
    env = _env(lift_box(), cfg)
    policy = random_policy(cfg.worlds)
    for _ in range(3):
        env.reset(np.flatnonzero(env.step(policy(env.observe())).truncated))
    grown = _resident_bytes() - before
    turns = measure(env, policy, replace(cfg, steps=8, turns=6, warmup_steps=12, row_seconds=10.0))
    print(
        json.dumps(
            {
                "env": turns.microseconds(turns.env),
                "limit": turns.microseconds(turns.limit),
                "kb_per_world": grown / cfg.worlds / 1e3,
            }
        )
    )


def _resident_bytes() -> int:
    pages = int(Path("/proc/self/statm").read_text(encoding="utf-8").split()[1])
    return pages * os.sysconf("SC_PAGE_SIZE")


def _env(bundle: TaskBundle, cfg: BenchConfig) -> BatchEnv:
    return BatchEnv(bundle, num_envs=cfg.worlds, seed=0, num_threads=cfg.threads)


if __name__ == "__main__":
    main(tyro.cli(BenchConfig, description=__doc__))

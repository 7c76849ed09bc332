"""Measure the GPU backend: control steps per second at several numbers of worlds, then how long lifting takes to learn.

    python scripts/bench_warp.py                          # on a CUDA device; about ten minutes
    python scripts/bench_warp.py --num-worlds 8192 --learn-worlds 0
    python scripts/bench_warp.py --num-worlds             # learning alone
    python scripts/bench_warp.py --device cpu --num-worlds 16 --steps 3 --learn-worlds 24 --learn-steps 384

Speed: the full environment (actions, physics, states, reward, resets) under random actions, after a warm-up;
`physics` is the same worlds with nothing but the captured control step. Learning: `policies/ppo/train.py` on the
benchmark task `lift_up`, then fresh episodes on the CPU backend at the fine time step. With thousands of worlds a
batch is thousands of times 16 steps, so minibatches grow with it; everything else is the CPU's recipe.

The last line is `warp_steps_per_second: X`, of the full environment, the best of all numbers of worlds. Learning
prints `warp_learned: X`, its success in the fresh episodes.
"""

import sys
import tempfile
import time
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import torch
import tyro

from policies.evaluation.rate import wilson
from policies.ppo.config import PPOConfig
from policies.ppo.policy import Expert
from policies.ppo.train import train_expert
from v2p_data.errors import V2PError
from v2p_data.experts.teacher import try_out
from v2p_data.play import StateActor
from v2p_data.sim.env.batch_env import BatchEnv, SimConfig
from v2p_data.sim.wrappers.torchrl_env import TorchRLEnv
from v2p_data.task.benchmark import load_benchmark


@dataclass(frozen=True, kw_only=True)
class Settings:
    """What is measured."""

    device: str = "cuda:0"
    """`cpu` tries the same code without a GPU; its speed means nothing."""
    num_worlds: tuple[int, ...] = (1024, 2048, 4096, 8192)
    steps: int = 100
    """Timed control steps per number of worlds."""
    learn_worlds: int = 8192
    """Worlds that learn to lift; 0 leaves that out."""
    learn_steps: int = 20_000_000
    """Control steps at most."""
    eval_episodes: int = 256
    """Episodes at the fine step that judge what was learned."""
    seed: int = 0


def speed(num_envs: int, settings: Settings) -> tuple[float, float]:
    """Return control steps per second of the environment and of its physics alone."""
    env = BatchEnv(
        load_benchmark("lift_up"),
        SimConfig(backend="warp", device=settings.device),
        num_envs=num_envs,
        seed=settings.seed,
    )
    env.stagger()
    rng = np.random.default_rng(settings.seed)

    def step() -> None:
        result = env.step(rng.uniform(-1, 1, (num_envs, env.act_dim)))
        env.reset(np.flatnonzero(result.truncated | result.terminated))

    rates = []
    for work in (step, lambda: env._sim._advance(None)):
        for _ in range(3):
            work()
        _wait(env.device)
        started = time.perf_counter()
        for _ in range(settings.steps):
            work()
        _wait(env.device)
        rates.append(num_envs * settings.steps / (time.perf_counter() - started))
    return rates[0], rates[1]


def learn(settings: Settings) -> None:
    """Train lifting and print steps, seconds and success in fresh episodes at the fine time step."""
    bundle, n = load_benchmark("lift_up"), settings.learn_worlds
    sim = SimConfig(backend="warp", device=settings.device)
    env = BatchEnv(bundle, sim, num_envs=n, seed=settings.seed)
    cfg = PPOConfig()
    cfg = replace(
        cfg,
        total_steps=settings.learn_steps,
        minibatch=max(cfg.minibatch, n * cfg.batch_time // 8),
        num_deterministic=min(cfg.num_deterministic, n // 4),
    )
    with tempfile.TemporaryDirectory() as folder:
        result = train_expert(TorchRLEnv(env), cfg, Path(folder), seed=settings.seed)
        expert = Expert.load(Path(folder))
    print(
        f"lift with {n} worlds: {result.steps} steps in {result.seconds:.1f} s, stopped by {result.stopped_by}, "
        f"success in training {result.success:.0%}, worlds that broke down {env.broken_count}"
    )
    judge = BatchEnv(
        bundle, SimConfig(fine=True), num_envs=settings.eval_episodes, seed=settings.seed + 1
    )
    held = try_out(judge, StateActor(expert.act)).at_end
    rate = wilson(int(held.sum()), len(held))
    print(f"fresh episodes on the CPU backend at the fine step: {rate}")
    print(f"warp_learned: {rate.value:.3f}")


def _wait(device: torch.device) -> None:
    if device.type == "cuda":
        torch.cuda.synchronize(device)


def main(settings: Settings) -> int:
    """Print one line per measurement."""
    if settings.device != "cpu" and not torch.cuda.is_available():
        print(
            "bench_warp needs a CUDA device and found none; --device cpu tries the code without one",
            file=sys.stderr,
        )
        return 2
    name = torch.cuda.get_device_name() if settings.device != "cpu" else "Warp's CPU device"
    print(f"device: {name}")
    best = 0.0
    try:
        for num_envs in settings.num_worlds:
            full, physics = speed(num_envs, settings)
            best = max(best, full)
            print(
                f"{num_envs:6d} worlds: {full:12,.0f} steps/s, physics {physics:12,.0f} steps/s, "
                f"share {full / physics:.2f}",
                flush=True,
            )
        if settings.learn_worlds:
            learn(settings)
    except V2PError as error:
        print(error, file=sys.stderr)
        return 2
    if settings.num_worlds:
        print(f"warp_steps_per_second: {best:.0f}")
    return 0


if __name__ == "__main__":
    sys.exit(main(tyro.cli(Settings)))

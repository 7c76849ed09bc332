"""Measure how long our training and others need to lift a box, on the same worlds.

    python scripts/bench_ppo.py                # all learners, two seeds; half an hour
    python scripts/bench_ppo.py --quick        # everything runs once, within 60 s; the figures mean nothing
    python scripts/bench_ppo.py --learners ours sb3-many-worlds --seeds 0 1 2 --json out.json

Learners: `ours` (`policies/ppo/train.py` with its defaults, no teacher), Stable-Baselines3 with
three published sets of settings, and the settings of TorchRL's own example; see `LEARNERS` for where they are from.
Stable-Baselines3 with our settings is a control and does not count. `engine` is what the engine does by default:
the best scripted program, imitated until the target.
All of them act in the same `BatchEnv` with the same randomisation, seeds and reward; how many worlds is part of
the settings. Seeds are the outer loop, so that learners take turns and a noise of the machine hits all of them.

Every few seconds of learning the deterministic policy plays the same fresh episodes in worlds of its own, and
the learner's clock stands still. An episode is a success if success has held for 0.25 s at its end. A learner has
arrived when it first reaches the target; one that does not within `--max-seconds` counts with that time, which
favours it. The last line, `ours_over_best_peer_speed: X`, is the median time of the best peer over ours.
"""

import json
import logging
import math
import os
import statistics
import tempfile
import time
import warnings
from collections.abc import Callable, Sequence
from contextlib import suppress
from dataclasses import asdict, dataclass, field, replace
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import numpy as np
import torch
import tyro
from jaxtyping import Float32
from tensordict import TensorDictBase
from tensordict.nn import AddStateIndependentNormalScale, TensorDictModule
from torch import nn
from torchrl.collectors import Collector
from torchrl.envs import ClipTransform, Compose, TransformedEnv, VecNorm
from torchrl.modules import MLP, ProbabilisticActor, TanhNormal, ValueOperator
from torchrl.objectives import ClipPPOLoss
from torchrl.objectives.value import GAE

from policies.ppo.config import ImitationConfig, PPOConfig
from policies.ppo.evaluate import evaluate
from policies.ppo.imitate import imitate
from policies.ppo.policy import EXPERT_FILE, Expert
from policies.ppo.train import LAST_FOLDER, train_expert
from v2p_data.experts.teacher import Teacher
from v2p_data.seeds import seed_for, torch_rng_for
from v2p_data.sim.env.batch_env import BatchEnv, SimConfig
from v2p_data.sim.wrappers.torchrl_env import TorchRLEnv
from v2p_data.task.benchmark import load_benchmark

Act = Callable[[Float32[np.ndarray, "env obs"]], Float32[np.ndarray, "env act"]]
OURS = "ours"
ENGINE = "engine"
ENDLESS = 10**9
"""Steps: what stops a learner is the target or the clock."""


@dataclass(frozen=True, kw_only=True)
class BenchConfig:
    """What is measured, and for how long."""

    quick: bool = False
    """Prove that everything runs: one seed, a few seconds per learner."""
    learners: tuple[str, ...] = (
        "ours",
        "engine",
        "sb3-many-worlds",
        "sb3-lift",
        "sb3-default",
        "torchrl",
        "sb3-our-settings",
    )
    """Which learners, in the order of their turns."""
    seeds: tuple[int, ...] = (0, 1)
    """One training of each learner per seed."""
    task: str = "lift_up"
    """Which benchmark task."""
    target: float = 0.9
    """Success of the deterministic policy that is to be reached."""
    max_seconds: float = 300.0
    """A learner is stopped after this much time of its own."""
    judge_seconds: float = 6.0
    """Seconds of learning between two judgements."""
    judge_episodes: int = 128
    """Episodes per judgement, the same ones each time."""
    threads: int = 1
    """Threads of physics and of torch, for all (our training keeps torch to one)."""
    json: Path | None = None
    """Where to write all figures."""


@dataclass(frozen=True, kw_only=True)
class Settings:
    """A learner's worlds, and what its source says about the rest."""

    num_envs: int
    source: str
    ppo: dict[str, Any] = field(default_factory=dict[str, Any])
    """Arguments of Stable-Baselines3's PPO."""
    clip_obs: float | None = None
    """Observations are normalised and clipped to +-this."""
    norm_reward: bool = False
    """Rewards are divided by the spread of the returns."""
    is_control: bool = False
    """No peer: it does not count for the ratio."""


LEARNERS = {
    OURS: Settings(num_envs=512, source="policies/ppo/train.py, PPOConfig()"),
    ENGINE: Settings(
        num_envs=512, source="v2p_data/learning.py: program, then imitation", is_control=True
    ),
    # Isaac Lab's settings for thousands of worlds are used with as many worlds as ours, since two cores saturate there.
    "sb3-many-worlds": Settings(
        num_envs=512,
        source="isaac-sim/IsaacLab, manager_based/locomotion/velocity/config/a1/agents/sb3_ppo_cfg.yaml",
        ppo={
            "n_steps": 24,
            "batch_size": 512 * 24 // 4,
            "n_epochs": 5,
            "gae_lambda": 0.95,
            "gamma": 0.99,
            "ent_coef": 0.005,
            "vf_coef": 1.0,
            "learning_rate": 1e-3,
            "clip_range": 0.2,
            "max_grad_norm": 1.0,
            "policy_kwargs": {
                "activation_fn": nn.ELU,
                "net_arch": [512, 256, 128],
                "optimizer_kwargs": {"eps": 1e-8},
                "ortho_init": False,
            },
        },
        clip_obs=10.0,
    ),
    "sb3-lift": Settings(
        num_envs=512,
        source="isaac-sim/IsaacLab, manager_based/manipulation/lift/config/franka/agents/sb3_ppo_cfg.yaml",
        ppo={
            "n_steps": 64,
            "batch_size": 192,
            "n_epochs": 8,
            "gae_lambda": 0.95,
            "gamma": 0.99,
            "ent_coef": 0.0,
            "vf_coef": 1e-4,
            "learning_rate": 3e-4,
            "clip_range": 0.2,
            "target_kl": 0.01,
            "max_grad_norm": 1.0,
            "policy_kwargs": {
                "activation_fn": nn.ELU,
                "net_arch": {"pi": [256, 128, 64], "vf": [256, 128, 64]},
            },
        },
    ),
    # What remains of our lead when Stable-Baselines3 is told our settings; it also shows that it can learn here.
    "sb3-our-settings": Settings(
        num_envs=512,
        source="policies/ppo/train.py, PPOConfig(), as far as there is a counterpart",
        ppo={
            "n_steps": PPOConfig().batch_time,
            "batch_size": PPOConfig().minibatch,
            "n_epochs": PPOConfig().epochs,
            "gae_lambda": PPOConfig().gae_lambda,
            "gamma": PPOConfig().gamma,
            "ent_coef": 0.0,
            "vf_coef": 1.0,
            "learning_rate": PPOConfig().learning_rate,
            "clip_range": PPOConfig().clip,
            "max_grad_norm": PPOConfig().max_grad_norm,
            "policy_kwargs": {
                "net_arch": list(PPOConfig().actor.hidden),
                "log_std_init": math.log(PPOConfig().actor.init_std),
            },
        },
        clip_obs=PPOConfig().actor.obs_clip,
        norm_reward=True,
        is_control=True,
    ),
    # 2048 steps of each world are meant for few worlds; DLR-RM/rl-baselines3-zoo, hyperparams/ppo.yml has 1 to 32.
    "sb3-default": Settings(
        num_envs=16, source="DLR-RM/stable-baselines3, stable_baselines3/ppo/ppo.py"
    ),
    # 2048 frames are one world's in the example; 64 of each of 32 worlds are faster here and keep its batch.
    "torchrl": Settings(
        num_envs=32, source="pytorch/rl, sota-implementations/ppo/config_mujoco.yaml"
    ),
}


@dataclass(frozen=True, kw_only=True)
class Moment:
    """How good a learner was after so much learning."""

    steps: int
    """Control steps over all worlds."""
    wall_s: float
    cpu_s: float
    """Of all threads; less disturbed by whatever else runs on the machine."""
    success: float


@dataclass(frozen=True, kw_only=True)
class Run:
    """One training."""

    learner: str
    seed: int
    moments: tuple[Moment, ...]
    arrived: bool

    @property
    def last(self) -> Moment:
        """When it arrived, or was stopped."""
        return self.moments[-1]


class Judge:
    """Plays the same fresh episodes with every policy."""

    def __init__(self, cfg: BenchConfig) -> None:
        self.num_episodes = cfg.judge_episodes
        self.seed = seed_for(0, "bench-ppo", "judge")
        self.env = TorchRLEnv(
            BatchEnv(
                load_benchmark(cfg.task),
                SimConfig(),
                num_envs=cfg.judge_episodes,
                seed=self.seed,
                num_threads=0,
            )
        )

    def success(self, act: Act) -> float:
        self.env.worlds.seed(self.seed)
        return evaluate(self.env, act, num_episodes=self.num_episodes).value


class Watch:
    """A learner's clock, which stands still while its policy is judged."""

    def __init__(self, judge: Judge, cfg: BenchConfig) -> None:
        self.judge, self.cfg = judge, cfg
        self.moments: list[Moment] = []
        self._began = self._times()

    @staticmethod
    def _times() -> np.ndarray:
        return np.array([time.perf_counter(), time.process_time()])

    def times(self) -> tuple[float, float]:
        """Return wall and CPU seconds of learning so far."""
        wall, cpu = self._times() - self._began
        return float(wall), float(cpu)

    @property
    def is_over(self) -> bool:
        return self.has_arrived or self.times()[0] >= self.cfg.max_seconds

    @property
    def has_arrived(self) -> bool:
        return bool(self.moments) and self.moments[-1].success >= self.cfg.target

    @property
    def is_due(self) -> bool:
        last = self.moments[-1].wall_s if self.moments else 0.0
        return self.times()[0] - last >= self.cfg.judge_seconds

    def note(self, act: Act, steps: int, times: tuple[float, float] | None = None) -> None:
        """Judge a policy, as it was after `steps` at `times` (now, unless told)."""
        paused = self._times()
        wall, cpu = times or self.times()
        moment = Moment(steps=steps, wall_s=wall, cpu_s=cpu, success=self.judge.success(act))
        self.moments.append(moment)
        self._began += self._times() - paused

    def finish(self, act: Act, steps: int) -> None:
        """Judge the final policy, unless it has arrived."""
        if not self.has_arrived:
            self.note(act, steps)


# --- ours ----------------------------------------------------------------------------------------------------


class _OverError(Exception):
    """Ends our training from its progress callback."""


def learn_with_ours(worlds: BatchEnv, settings: Settings, watch: Watch, seed: int) -> None:
    """Run our training; its policy is judged whenever it has saved one."""
    del settings
    cfg = replace(
        PPOConfig(),
        total_steps=ENDLESS,
        max_seconds=math.inf,
        target_success=2.0,
        checkpoint_seconds=watch.cfg.judge_seconds,
    )
    seen, before = 0, (0, watch.times())
    with tempfile.TemporaryDirectory() as folder:
        last = Path(folder) / LAST_FOLDER

        def follow(steps: int, total: int, success: float) -> None:
            nonlocal seen, before
            del total, success
            saved = (last / EXPERT_FILE).stat().st_mtime_ns if last.is_dir() else 0
            if saved != seen:
                # It was saved after the previous call, before the batch that has just ended.
                watch.note(Expert.load(last).act, *before)
                seen = saved
            if watch.is_over and watch.moments:
                raise _OverError
            before = steps, watch.times()

        with suppress(_OverError):
            train_expert(TorchRLEnv(worlds), cfg, Path(folder), seed=seed, on_progress=follow)


def learn_with_engine(worlds: BatchEnv, settings: Settings, watch: Watch, seed: int) -> None:
    """Find a program, imitate it; the policy is judged after every round. PPO would only go on from there."""
    del settings
    trials = BatchEnv(
        worlds.bundle,
        SimConfig(),
        num_envs=64,
        seed=seed_for(seed, "trials"),
        num_threads=watch.cfg.threads,
    )
    teacher = Teacher(worlds)
    teacher.choose(trials)
    steps = len(teacher.trials) * trials.num_envs * worlds.horizon
    cfg = replace(ImitationConfig(), rounds=1000, least_rounds=1, target_success=watch.cfg.target)

    def judged(expert: Expert) -> float:
        nonlocal steps
        steps += cfg.round_steps * worlds.num_envs
        watch.note(expert.act, steps)
        if watch.is_over:
            raise _OverError
        return watch.moments[-1].success

    with tempfile.TemporaryDirectory() as folder, suppress(_OverError):
        imitate(TorchRLEnv(worlds), teacher.act, cfg, Path(folder), seed=seed, check=judged)


# --- Stable-Baselines3 ---------------------------------------------------------------------------------------


def learn_with_sb3(worlds: BatchEnv, settings: Settings, watch: Watch, seed: int) -> None:
    """Run Stable-Baselines3's PPO; its policy is judged between two updates."""
    from stable_baselines3 import PPO  # pyright: ignore[reportMissingImports]
    from stable_baselines3.common.callbacks import (  # pyright: ignore[reportMissingImports]
        BaseCallback,
    )
    from stable_baselines3.common.vec_env import VecNormalize  # pyright: ignore[reportMissingImports]

    env = sb3_vec_env(worlds)
    if settings.clip_obs is not None:
        env = VecNormalize(
            env,
            norm_reward=settings.norm_reward,
            clip_obs=settings.clip_obs,
            gamma=settings.ppo["gamma"],
        )
    model = PPO("MlpPolicy", env, device="cpu", seed=seed % 2**31, **settings.ppo)

    def act(obs: np.ndarray) -> np.ndarray:
        normal = env.normalize_obs(obs) if isinstance(env, VecNormalize) else obs
        return model.predict(normal, deterministic=True)[0]

    class Follow(BaseCallback):
        def _on_rollout_start(self) -> None:
            if watch.is_due:
                watch.note(act, self.num_timesteps)

        def _on_step(self) -> bool:
            return not watch.is_over

    model.learn(ENDLESS, callback=Follow())
    watch.finish(act, model.num_timesteps)


def sb3_vec_env(worlds: BatchEnv) -> Any:
    """Return Stable-Baselines3's view of a `BatchEnv`: worlds that have ended start anew within the step."""
    from gymnasium.spaces import Box
    from stable_baselines3.common.vec_env import VecEnv  # pyright: ignore[reportMissingImports]

    class SB3Env(VecEnv):
        def __init__(self) -> None:
            obs = Box(-np.inf, np.inf, (worlds.obs_dim,), np.float32)
            super().__init__(worlds.num_envs, obs, Box(-1.0, 1.0, (worlds.act_dim,), np.float32))
            self.action = np.zeros((worlds.num_envs, worlds.act_dim))

        def reset(self) -> np.ndarray:
            worlds.reset(np.arange(worlds.num_envs))
            return worlds.observe()

        def step_async(self, actions: np.ndarray) -> None:
            self.action = actions

        def step_wait(self) -> tuple[np.ndarray, np.ndarray, np.ndarray, list[dict[str, Any]]]:
            result = worlds.step(self.action)
            done = result.terminated | result.truncated
            infos: list[dict[str, Any]] = [{} for _ in range(worlds.num_envs)]
            ended = np.flatnonzero(done)
            for k in ended.tolist():
                # The learner bootstraps from the last observation unless the simulation broke down.
                infos[k]["terminal_observation"] = result.obs[k].copy()
                infos[k]["TimeLimit.truncated"] = not result.terminated[k]
            worlds.reset(ended)
            return worlds.observe() if len(ended) else result.obs, result.reward, done, infos

        def close(self) -> None: ...

        def get_attr(self, attr_name: str, indices: Any = None) -> list[Any]:
            return [getattr(worlds, attr_name, None)] * worlds.num_envs

        def set_attr(self, attr_name: str, value: Any, indices: Any = None) -> None:
            raise NotImplementedError

        def env_method(self, method_name: str, *args: Any, **kwargs: Any) -> list[Any]:
            raise NotImplementedError

        def env_is_wrapped(self, wrapper_class: Any, indices: Any = None) -> list[bool]:
            return [False] * worlds.num_envs

    return SB3Env()


# --- TorchRL's example ---------------------------------------------------------------------------------------

FRAMES_PER_BATCH, TOTAL_FRAMES, MINI_BATCH, EPOCHS, LEARNING_RATE = 2048, 1_000_000, 64, 10, 3e-4


def learn_with_torchrl(worlds: BatchEnv, settings: Settings, watch: Watch, seed: int) -> None:
    """Run PPO as TorchRL's MuJoCo example does.

    Source: pytorch/rl, sota-implementations/ppo: ppo_mujoco.py (the loop), utils_mujoco.py (networks and
    observation normalisation), config_mujoco.yaml (the numbers above and below).
    """
    del settings
    torch.manual_seed(seed)  # noqa: TID251 - the example draws from the global generator
    generator = torch_rng_for(seed, "minibatches")
    # Not its announced successor: that scales features far from zero by their size for the first 100,000 steps.
    norm = VecNorm(in_keys=["observation"], decay=0.99999, eps=1e-2)
    clip = ClipTransform(in_keys=["observation"], low=-10, high=10)
    env = TransformedEnv(TorchRLEnv(worlds), Compose(norm, clip))  # pyright: ignore[reportCallIssue]
    net, actor, critic = example_networks(worlds.obs_dim, worlds.act_dim)
    collector = Collector(
        env,
        actor,
        frames_per_batch=FRAMES_PER_BATCH,
        total_frames=-1,
        trust_policy=True,
        track_traj_ids=False,
        auto_register_policy_transforms=False,
    )
    gae = GAE(gamma=0.99, lmbda=0.95, value_network=critic, average_gae=False)
    loss = ClipPPOLoss(
        actor,
        critic,
        clip_epsilon=0.2,
        loss_critic_type="l2",
        entropy_coeff=0.0,
        critic_coeff=0.25,
        normalize_advantage=True,
    )
    optimisers = [
        torch.optim.Adam(part.parameters(), lr=LEARNING_RATE, eps=1e-5) for part in (actor, critic)
    ]

    @torch.no_grad()
    def act(obs: np.ndarray) -> np.ndarray:
        loc, scale = norm.loc, norm.scale
        assert loc is not None  # there has been a batch
        assert scale is not None
        normal = (torch.from_numpy(obs) - loc["observation"]) / scale["observation"]
        mean, _ = net(normal.clamp(-10, 10))
        return torch.tanh(mean).numpy()

    def update(batch: TensorDictBase, steps: int) -> None:
        """Learn from one batch; the learning rate falls linearly to zero."""
        rate = LEARNING_RATE * max(0.0, 1 - steps / TOTAL_FRAMES)
        for optimiser in optimisers:
            optimiser.param_groups[0]["lr"] = rate
        for _ in range(EPOCHS):
            with torch.no_grad():
                gae(batch)
            flat = batch.exclude("next").reshape(-1)
            order = torch.randperm(flat.numel(), generator=generator)
            for chosen in order.split(MINI_BATCH):
                losses = loss(flat[chosen])
                total = losses["loss_objective"] + losses["loss_entropy"] + losses["loss_critic"]
                total.backward()
                for optimiser in optimisers:
                    optimiser.step()
                    optimiser.zero_grad()

    steps = 0
    for batch in collector:
        update(batch, steps)
        steps += batch.numel()
        if watch.is_due:
            watch.note(act, steps)
        if watch.is_over:
            break
    collector.shutdown(close_env=False)
    watch.finish(act, steps)


def example_networks(
    obs_dim: int, act_dim: int
) -> tuple[nn.Module, ProbabilisticActor, ValueOperator]:
    """Return the actor's network (mean and scale), the actor over it, and the critic."""

    def mlp(out: int, gain: float) -> MLP:
        net = MLP(
            in_features=obs_dim, out_features=out, num_cells=[64, 64], activation_class=nn.Tanh
        )
        for layer in net.modules():
            if isinstance(layer, nn.Linear):
                nn.init.orthogonal_(layer.weight, gain)
                nn.init.zeros_(layer.bias)
        return net

    scale = AddStateIndependentNormalScale(act_dim, scale_lb=1e-8)  # pyright: ignore[reportArgumentType]
    net = nn.Sequential(mlp(act_dim, 1.0), scale)
    actor = ProbabilisticActor(
        TensorDictModule(net, in_keys=["observation"], out_keys=["loc", "scale"]),
        in_keys=["loc", "scale"],
        distribution_class=TanhNormal,
        distribution_kwargs={"low": -1.0, "high": 1.0, "tanh_loc": False},
        return_log_prob=True,
    )
    return net, actor, ValueOperator(mlp(1, 0.01), in_keys=["observation"])


# --- the race ------------------------------------------------------------------------------------------------


def race(cfg: BenchConfig) -> list[Run]:
    """Train every learner with every seed, in turns."""
    judge = Judge(cfg)
    runs: list[Run] = []
    for seed in cfg.seeds:
        for name in cfg.learners:
            run = train(name, cfg, judge, seed)
            runs.append(run)
            print(f"  seed {seed}, {name}: {words_of(run)}", flush=True)
    return runs


def train(name: str, cfg: BenchConfig, judge: Judge, seed: int) -> Run:
    """Train one learner until it arrives or its time is over."""
    settings = LEARNERS[name]
    if cfg.quick:  # short batches, so that there are updates
        settings = replace(settings, ppo=settings.ppo | {"n_steps": 16})
    worlds = BatchEnv(
        load_benchmark(cfg.task),
        SimConfig(),
        num_envs=settings.num_envs,
        seed=seed_for(seed, "bench-ppo", "worlds"),
        num_threads=cfg.threads,
    )
    torch.set_num_threads(cfg.threads)
    own = {OURS: learn_with_ours, ENGINE: learn_with_engine, "torchrl": learn_with_torchrl}
    learn = own.get(name, learn_with_sb3)
    watch = Watch(judge, cfg)
    learn(worlds, settings, watch, seed_for(seed, "bench-ppo", "learner"))
    return Run(learner=name, seed=seed, moments=tuple(watch.moments), arrived=watch.has_arrived)


def words_of(run: Run) -> str:
    last = run.last
    how = f"{last.steps / 1e6:.2f} M steps, {last.wall_s:.0f} s ({last.cpu_s:.0f} CPU s)"
    if run.arrived:
        return f"reached after {how}"
    return f"not reached ({last.success:.0%} at the end) after {how}"


def table(runs: Sequence[Run], cfg: BenchConfig) -> str:
    """Return a row per learner: median (least to most) over the seeds."""
    head = ("learner", "worlds", "reached", "wall s", "M steps", "CPU s", "at the end", "steps/s")
    rows: list[tuple[str, ...]] = [head]
    for name in cfg.learners:
        own = [run for run in runs if run.learner == name]
        ends = [run.last for run in own]
        late = "" if all(run.arrived for run in own) else ">"
        rows.append(
            (
                name,
                str(LEARNERS[name].num_envs),
                f"{sum(run.arrived for run in own)}/{len(own)}",
                late + spread([m.wall_s for m in ends], 0),
                late + spread([m.steps / 1e6 for m in ends], 2),
                late + spread([m.cpu_s for m in ends], 0),
                spread([100 * m.success for m in ends], 0) + " %",
                spread([m.steps / m.wall_s for m in ends], 0),
            )
        )
    widths = [max(len(row[k]) for row in rows) for k in range(len(head))]
    return "\n".join(
        "  ".join(cell.ljust(width) for cell, width in zip(row, widths, strict=True)).rstrip()
        for row in rows
    )


def spread(values: list[float], digits: int) -> str:
    low, mid, high = min(values), statistics.median(values), max(values)
    text = f"{mid:.{digits}f}"
    return text if len(values) == 1 else f"{text} ({low:.{digits}f}-{high:.{digits}f})"


def speed_over_best_peer(
    runs: Sequence[Run],
    clock: Callable[[Moment], float] = lambda moment: moment.wall_s,
    ours: str = OURS,
) -> float:
    """Return the median time of the fastest peer over ours; NaN without a peer, or if nobody arrived."""
    times: dict[str, float] = {}
    for name in {run.learner for run in runs}:
        times[name] = statistics.median(clock(run.last) for run in runs if run.learner == name)
    peers = [
        seconds
        for name, seconds in times.items()
        if name != ours and not LEARNERS[name].is_control
    ]
    if ours not in times or not peers or not any(run.arrived for run in runs):
        return math.nan
    return min(peers) / times[ours]


def quickened(cfg: BenchConfig) -> BenchConfig:
    return replace(cfg, seeds=cfg.seeds[:1], max_seconds=3.0, judge_seconds=1.0, judge_episodes=32)


def main(cfg: BenchConfig) -> None:
    """Print the table, write the figures, end with the ratio."""
    logging.getLogger("torchrl").setLevel(logging.WARNING)
    warnings.simplefilter(
        "ignore"
    )  # of the learners, on what they will rename, and on uneven minibatches
    unknown = [name for name in cfg.learners if name not in LEARNERS]
    if unknown:
        raise SystemExit(f"unknown learners {unknown}; known: {', '.join(LEARNERS)}")
    cfg = quickened(cfg) if cfg.quick else cfg
    if find_spec("stable_baselines3") is None:
        print(
            "Stable-Baselines3 is not installed, so its rows are left out: "
            "'uv pip install --no-deps stable-baselines3' adds it."
        )
        cfg = replace(cfg, learners=tuple(n for n in cfg.learners if not n.startswith("sb3")))
    print(
        f"time to {cfg.target:.0%} deterministic success at {cfg.task} over {cfg.judge_episodes} episodes, "
        f"seeds {', '.join(map(str, cfg.seeds))}, {cfg.threads} thread(s), {os.cpu_count()} cores, "
        f"load {os.getloadavg()[0]:.1f} at the start, at most {cfg.max_seconds:.0f} s each"
    )
    runs = race(cfg)
    print(table(runs, cfg))
    speed = speed_over_best_peer(runs)
    if any(not run.arrived for run in runs):
        print(
            "> a training was stopped before it arrived: its time counts, the real one is longer"
        )
    if cfg.json is not None:
        result = {
            "config": asdict(cfg) | {"json": cfg.json.name},
            "settings": {n: repr(LEARNERS[n]) for n in cfg.learners},
            "runs": [asdict(run) for run in runs],
            "ours_over_best_peer_speed": speed if math.isfinite(speed) else None,
        }
        cfg.json.write_text(json.dumps(result, indent=1))
    print(f"the same in CPU time: {speed_over_best_peer(runs, lambda moment: moment.cpu_s):.2f}")
    print(f"engine_over_best_peer_speed: {speed_over_best_peer(runs, ours=ENGINE):.2f}")
    print(f"ours_over_best_peer_speed: {speed:.2f}")


if __name__ == "__main__":
    main(tyro.cli(BenchConfig, description=__doc__))

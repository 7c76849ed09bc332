"""How a task becomes an expert: a scripted policy teaches it, and PPO improves it.

`learn` does four steps, each a function with a frozen result:

* `teach`: scripted programs are tried; the one that the task's own success function likes best is imitated (DAgger);
* `record_resets`: moments of the program's episodes, from which PPO may start;
* `improve_by_ppo`: PPO goes on from the taught policy, from another task's expert, or from nothing;
* `keep_better`: of the taught policy and PPO's the better one is kept, by episodes at the fine time step.

The result is a neural network in any case; scripts never make a dataset.
"""

import logging
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any, Literal

import numpy as np

from policies.ppo.imitate import imitate
from policies.ppo.policy import Expert
from policies.ppo.train import train_expert
from v2p_data.experts.bank import Bank, record_bank, use_bank
from v2p_data.experts.config import ExpertConfig
from v2p_data.experts.solved import Solved, rank_solved
from v2p_data.experts.teacher import Teacher, Trial, play
from v2p_data.seeds import seed_for
from v2p_data.sim.backends import make_batch_env
from v2p_data.sim.batch_env import BatchEnv, SimConfig
from v2p_data.sim.torchrl_env import TorchRLEnv
from v2p_data.task.task import TaskBundle

logger = logging.getLogger(__name__)

TAUGHT_FOLDER = "taught"
PROGRESS_TAUGHT = 0.4
"""Share of the whole that is done when imitation ends."""
Progress = Callable[[float, str], None]


@dataclass(frozen=True, kw_only=True)
class Worlds:
    """Makes worlds of one task; each purpose has a seed of its own."""

    bundle: TaskBundle
    seed: int
    """Everything that is drawn follows from it."""
    num_threads: int = 1
    """For the physics; changes no result."""
    bonus_ratio: float = SimConfig.bonus_ratio
    """What a step of success earns, see `SimConfig`; 0 by RoboGen's method."""

    def make(self, num_envs: int, purpose: str, *, fine: bool = False) -> BatchEnv:
        """Return worlds on the CPU for a purpose, whose name is part of their seed."""
        return BatchEnv(
            self.bundle,
            SimConfig(fine=fine, bonus_ratio=self.bonus_ratio),
            num_envs=num_envs,
            seed=seed_for(self.seed, purpose),
            num_threads=self.num_threads,
        )

    def seed_of(self, purpose: str) -> int:
        """Return the seed of a training, below 2**63 as torch has it."""
        return seed_for(self.seed, purpose) % 2**63


@dataclass(frozen=True, kw_only=True)
class Taught:
    """What came of trying programs and imitating the best one."""

    program: str
    """The best program's name."""
    program_success: float
    """Share of the trial worlds in which it held success at the end."""
    trials: tuple[Trial, ...]
    folder: Path | None
    """The policy; None where no program succeeds often enough."""
    steps: int
    """Control steps, trials of programs included."""
    seconds: float
    """Of imitation."""


@dataclass(frozen=True, kw_only=True)
class Improved:
    """What came of PPO; the policy is in the folder that it was given."""

    steps: int
    seconds: float
    stopped_by: str


@dataclass(frozen=True, kw_only=True)
class Kept:
    """Which policy is kept, and how both did: shares of worlds in which success held at some time."""

    kept: Literal["taught", "ppo"]
    taught_success: float | None = None
    ppo_success: float | None = None


@dataclass(frozen=True, kw_only=True)
class Learned:
    """The sum of all steps; the expert itself is in the folder."""

    steps: int
    """Control steps in all, trials of programs included."""
    seconds: float
    kept: Literal["taught", "ppo"]
    teacher: str
    """The program's name, or nothing."""
    trials: tuple[Trial, ...]
    taught_success: float | None
    """At the fine step, on worlds that decide which policy is kept; so is `ppo_success`."""
    ppo_success: float | None
    stopped_by: str
    started_from: str = ""
    """Folder of another task's expert, if PPO started from one."""

    def as_dict(self) -> dict[str, Any]:
        """Return it for JSON."""
        return asdict(self)


def learn(
    worlds: Worlds,
    cfg: ExpertConfig,
    out: Path,
    *,
    device: str = "cuda:0",
    solved: Sequence[Solved] = (),
    on_progress: Progress = lambda share, words: None,
) -> Learned:
    """Write the task's expert into `out`, with the curve of its training.

    Args:
        worlds: the task and the seed.
        cfg: the recipe.
        out: folder; `taught/` in it is the policy that imitation gave.
        device: of the backend `warp`.
        solved: experts of other tasks, see `ExpertConfig.warm_start`.
        on_progress: told the share that is done and a few words.
    """
    taught, bank = None, None
    steps, seconds = 0, 0.0
    if cfg.teacher == "programs":
        trial_env = worlds.make(cfg.trial_worlds, "trials")
        taught = teach(
            worlds, trial_env, cfg, out / TAUGHT_FOLDER,
            on_progress=lambda share, words: on_progress(PROGRESS_TAUGHT * share, words),
        )  # fmt: skip
        steps, seconds = taught.steps, taught.seconds
        if cfg.bank.share:
            bank = record_resets(trial_env, taught.program)
            steps += cfg.trial_worlds * worlds.bundle.horizon_steps
        del trial_env
    pupil = taught.folder if taught else None
    env = _training_worlds(worlds, cfg, bank, device)
    ranked = rank_solved(worlds.bundle, env.worlds.obs_dim, solved) if pupil is None else []
    other = ranked[0].folder if ranked else None
    if other is not None:
        logger.info("PPO starts from %s", other)
    begun = PROGRESS_TAUGHT if pupil else 0.0
    improved = improve_by_ppo(
        env,
        cfg,
        out,
        seed=worlds.seed_of("ppo"),
        start=pupil or other,
        on_progress=lambda share, words: on_progress(begun + (1 - begun) * share, words),
    )
    better = keep_better(worlds, cfg, pupil, out)
    return Learned(
        steps=steps + improved.steps,
        seconds=seconds + improved.seconds,
        kept=better.kept,
        teacher=taught.program if taught and pupil else "",
        trials=taught.trials if taught else (),
        taught_success=better.taught_success,
        ppo_success=better.ppo_success,
        stopped_by=improved.stopped_by,
        started_from=other.name if other is not None else "",
    )


def teach(
    worlds: Worlds,
    trial_env: BatchEnv,
    cfg: ExpertConfig,
    out: Path,
    *,
    has_exams: bool = True,
    on_progress: Progress = lambda share, words: None,
) -> Taught:
    """Try the programs and write the policy that imitates the best one into `out`.

    Args:
        worlds: the task and the seed.
        trial_env: worlds in which each program plays one episode.
        cfg: the recipe.
        out: folder of the policy; not made where no program succeeds often enough.
        has_exams: judge the policy after each round, and end early where it is good enough.
        on_progress: told the share of imitation that is done and a few words.
    """
    env = worlds.make(cfg.num_envs, "taught")
    teacher = Teacher(env)
    on_progress(0.0, "trying programs")
    best = teacher.choose(trial_env)
    steps = len(teacher.trials) * trial_env.num_envs * worlds.bundle.horizon_steps
    folder, seconds = None, 0.0
    if best.success >= cfg.least_teacher_success:
        words = f"imitating '{best.name}', which succeeds in {best.success:.0%}"
        exams = worlds.make(cfg.trial_worlds, "exams", fine=True) if has_exams else None
        imitated = imitate(
            TorchRLEnv(env),
            teacher.act,
            cfg.imitation,
            out,
            seed=worlds.seed_of("imitation"),
            check=(lambda expert: success_of(exams, expert)) if exams else None,
            on_progress=lambda share: on_progress(share, words),
        )
        folder, seconds = imitated.folder, imitated.seconds
        steps += imitated.steps
    else:
        logger.info("no program succeeds at '%s'", worlds.bundle.title)
    return Taught(
        program=best.name,
        program_success=best.success,
        trials=teacher.trials,
        folder=folder,
        steps=steps,
        seconds=seconds,
    )


def record_resets(env: BatchEnv, program: str) -> Bank:
    """Let a program play one episode in every world and return moments on the way to success."""
    player = Teacher(env)
    player.name = program
    return record_bank(env, player.act)


def improve_by_ppo(
    env: TorchRLEnv,
    cfg: ExpertConfig,
    out: Path,
    *,
    seed: int,
    start: Path | None,
    on_progress: Progress = lambda share, words: None,
) -> Improved:
    """Train by PPO in some worlds, from the policy in the folder `start` where there is one; write into `out`."""
    result = train_expert(
        env,
        cfg.ppo,
        out,
        seed=seed,
        warm_start=start,
        on_progress=lambda done, total, success: on_progress(
            min(done / total, 1), "PPO" if np.isnan(success) else f"PPO, success {success:.0%}"
        ),
    )
    return Improved(steps=result.steps, seconds=result.seconds, stopped_by=result.stopped_by)


def keep_better(worlds: Worlds, cfg: ExpertConfig, taught: Path | None, out: Path) -> Kept:
    """Leave the better of the taught policy and of PPO's in `out`, by episodes at the fine time step."""
    if taught is None:
        return Kept(kept="ppo")
    judge_env = worlds.make(2 * cfg.trial_worlds, "which is better", fine=True)
    of_taught = success_of(judge_env, Expert.load(taught))
    of_ppo = success_of(judge_env, Expert.load(out))
    is_taught_better = of_taught > of_ppo
    if is_taught_better:
        Expert.load(taught).save(out)
    return Kept(
        kept="taught" if is_taught_better else "ppo", taught_success=of_taught, ppo_success=of_ppo
    )


def _training_worlds(
    worlds: Worlds, cfg: ExpertConfig, bank: Bank | None, device: str
) -> TorchRLEnv:
    """Return the worlds of PPO, some of whose episodes begin from the bank where there is one."""
    env = make_batch_env(
        worlds.bundle,
        SimConfig(bonus_ratio=worlds.bonus_ratio),
        num_envs=cfg.num_envs,
        seed=seed_for(worlds.seed, "worlds"),
        num_threads=worlds.num_threads,
        backend=cfg.backend,
        device=device,
    )
    if bank is not None and len(bank) and isinstance(env, BatchEnv):
        use_bank(env, bank, replace(cfg.bank, num_plain=cfg.ppo.num_deterministic))
    return TorchRLEnv(env)


def success_of(env: BatchEnv, expert: Expert) -> float:
    """Play one episode in every world and return the share that the task's success held at some time.

    That is what episodes are recorded for, and what `taught_success` and `ppo_success` mean wherever they are kept.
    """
    return float(play(env, expert.act)[1].mean())

"""How a task becomes an expert: it is there already, or a scripted policy teaches it, and PPO improves it.

`learn` does up to four steps, each a function with a frozen result:

* `ask_pretrained`: the package's expert of this kind plays the task; where it succeeds often it is the task's expert;
* `teach`: scripted programs are tried; the one that the task's own success function likes best is imitated (DAgger);
* `improve_by_ppo`: PPO goes on from the taught policy, or from nothing. After a taught
  policy it trains at the fine time step, at which episodes are recorded;
* `keep_better`: the taught policy and PPO's play the same episodes at the fine time step, and PPO's is kept if it
  is surely better. Where nobody taught, the better one of PPO's best and its last policy is kept.

The result is a neural network; it is called PPO's only if PPO changed it. Where a program is to
act itself, see `labeller`.
"""

import logging
from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path

import numpy as np

from policies.evaluation.paired import median_difference, success_difference
from policies.ppo.imitate import imitate
from policies.ppo.policy import Expert
from policies.ppo.train import LAST_FOLDER, ExpertResult, train_expert
from v2p_data.errors import ItemRejectedError
from v2p_data.experts.config import ExpertConfig
from v2p_data.experts.pretrained import FOLDER, pretrained_for
from v2p_data.experts.record import Comparison, Learned, PolicyScore
from v2p_data.experts.teacher import EpisodeOutcomes, ProgramScore, Teacher, try_out
from v2p_data.play import StateActor
from v2p_data.seeds import seed_for
from v2p_data.sim.env.batch_env import BatchEnv, SimConfig
from v2p_data.sim.robot.robot import FINE
from v2p_data.sim.wrappers.torchrl_env import TorchRLEnv
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
    """What a step of success earns, see `SimConfig`."""

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
    """What PPO may start from: the package's expert, or what came of trying programs and imitating the best one."""

    program: str
    """The best program's name; empty for the package's expert."""
    success: float
    """Share of the trial worlds in which the program held success at the end, or the package's expert at any time."""
    trials: tuple[ProgramScore, ...]
    folder: Path | None
    """The policy; None where no program succeeds often enough."""
    steps: int
    """Control steps, trials of programs included."""
    seconds: float
    """Duration of the imitation."""

    def as_learned(self, improved: ExpertResult | None = None) -> Learned:
        """Return the record of an expert that started here, before any choice between the two."""
        return Learned(
            steps=self.steps + (improved.steps if improved else 0),
            seconds=self.seconds + (improved.seconds if improved else 0.0),
            actor_updates=0,
            teacher=self.program if self.folder else "",
            trials=self.trials,
            comparison=None,
            stopped_by=improved.stopped_by if improved else "",
            is_pretrained=self.folder is not None and not self.program,
        )


def ask_pretrained(
    worlds: Worlds, cfg: ExpertConfig, out: Path, folder: Path = FOLDER
) -> Taught | None:
    """Let the expert in the package's folder play the task; write it into `out` and return its success.

    None where there is none of this kind, where it succeeds too seldom, or where the task observes more than it knows.
    """
    expert = pretrained_for(worlds.bundle, folder)
    if expert is None:
        return None
    env = worlds.make(cfg.trial_worlds, "pretrained", fine=True)
    if env.obs_dim != expert.model.obs_dim:
        return None
    success = success_of(env, expert)
    logger.info("the pretrained expert succeeds in %.0f %%", 100 * success)
    if success < cfg.least_pretrained_success:
        return None
    expert.save(out)
    steps = env.num_envs * env.horizon
    return Taught(program="", success=success, trials=(), folder=out, steps=steps, seconds=0.0)


def learn(
    worlds: Worlds,
    cfg: ExpertConfig,
    out: Path,
    *,
    device: str = "cuda:0",
    on_progress: Progress = lambda share, words: None,
) -> Learned:
    """Write the task's expert into `out`, with the curve of its training.

    Args:
        worlds: the task and the seed.
        cfg: the recipe.
        out: folder; `taught/` in it is the policy that PPO started from.
        device: of the backend `warp`.
        on_progress: told the share that is done and a few words.
    """
    taught = (
        ask_pretrained(worlds, cfg, out / TAUGHT_FOLDER) if cfg.start == "pretrained" else None
    )
    if taught is not None and taught.success >= cfg.pretrained_is_enough:
        Expert.load(out / TAUGHT_FOLDER).save(out)
        return taught.as_learned()
    if taught is None and cfg.start in ("pretrained", "program"):
        trial_env = worlds.make(cfg.trial_worlds, "trials")
        taught = teach(
            worlds,
            trial_env,
            cfg,
            out / TAUGHT_FOLDER,
            on_progress=lambda share, words: on_progress(PROGRESS_TAUGHT * share, words),
        )
        del trial_env
    student = taught.folder if taught else None
    env = _training_worlds(worlds, cfg, device, is_taught=student is not None)
    logger.info("PPO starts from %s", student or "nothing")
    begun = PROGRESS_TAUGHT if student else 0.0
    improved = improve_by_ppo(
        env,
        cfg,
        out,
        seed=worlds.seed_of("ppo"),
        start=student,
        on_progress=lambda share, words: on_progress(begun + (1 - begun) * share, words),
    )
    del env
    comparison, updates = None, improved.actor_updates
    if improved.last_actor_updates == 0 or (student is None and updates == 0):
        _say_unchanged(worlds.bundle.title, improved, student)
    elif student is not None:
        comparison, updates = keep_better(worlds, cfg, student, out, improved)
    else:
        best, updates, _ = better_of_ppo(_exams(worlds, cfg), out, improved)
        best.save(out)
    begun_from = taught or Taught(
        program="", success=0.0, trials=(), folder=None, steps=0, seconds=0.0
    )
    return replace(begun_from.as_learned(improved), actor_updates=updates, comparison=comparison)


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
        success=best.success,
        trials=teacher.trials,
        folder=folder,
        steps=steps,
        seconds=seconds,
    )


def improve_by_ppo(
    env: TorchRLEnv,
    cfg: ExpertConfig,
    out: Path,
    *,
    seed: int,
    start: Path | None,
    on_progress: Progress = lambda share, words: None,
) -> ExpertResult:
    """Train by PPO in some worlds, from the policy in the folder `start` where there is one; write into `out`."""
    actor = cfg.ppo.actor
    if start is not None:  # a pretrained network is wider than one task's
        actor = replace(actor, hidden=Expert.load(start).model.cfg.hidden)
    return train_expert(
        env,
        replace(cfg.ppo, actor=actor),
        out,
        seed=seed,
        warm_start=start,
        on_progress=lambda done, total, success: on_progress(
            min(done / total, 1), "PPO" if np.isnan(success) else f"PPO, success {success:.0%}"
        ),
    )


def keep_better(
    worlds: Worlds, cfg: ExpertConfig, taught: Path, out: Path, improved: ExpertResult
) -> tuple[Comparison, int]:
    """Leave PPO's policy in `out` if it is surely better than the taught one, else that.

    Also return its gradient steps.

    Both of PPO's policies, the best in training and the last one, and the taught one play the same
    episodes at the fine time step. Of PPO's two the one with the higher score is compared with the
    taught one. Where no difference shows, the taught one is the better teacher: it saw more
    states, and policies cloned from it lift unseen objects more often.
    """
    play = _exams(worlds, cfg)
    before, seen = Expert.load(taught), list[np.ndarray]()

    def watched(obs: np.ndarray) -> np.ndarray:
        seen.append(obs.copy())
        return before.act(obs)

    of_taught = play(StateActor(watched))
    after, updates, of_ppo = better_of_ppo(play, out, improved)
    both = of_taught.once & of_ppo.once
    states, dt_s = np.concatenate(seen), FINE.control_dt_s
    comparison = Comparison(
        taught=PolicyScore.of(of_taught, dt_s),
        ppo=PolicyScore.of(of_ppo, dt_s),
        success_gain=success_difference(of_ppo.once, of_taught.once),
        time_saved_s=median_difference(dt_s * of_taught.steps[both], dt_s * of_ppo.steps[both]),
        moved=float(np.abs(after.act(states) - before.act(states)).mean()),
    )
    (after if comparison.is_better else before).save(out)
    return comparison, updates if comparison.is_better else 0


def _exams(worlds: Worlds, cfg: ExpertConfig) -> Callable[[StateActor], EpisodeOutcomes]:
    """Return what plays the same episodes, at the fine time step, with every policy that it is given."""
    env = worlds.make(cfg.compare_worlds, "which is better", fine=True)
    return partial(try_out, env, seed=worlds.seed_of("episodes that compare"))


def better_of_ppo(
    play: Callable[[StateActor], EpisodeOutcomes], out: Path, improved: ExpertResult
) -> tuple[Expert, int, EpisodeOutcomes]:
    """Return the better one of PPO's two policies, its gradient steps and its episodes.

    The best in training had the highest of many noisy rates; the last one is as often the better one.
    """
    updates = (improved.actor_updates, improved.last_actor_updates)
    experts = (Expert.load(out), Expert.load(out / LAST_FOLDER))
    played = [play(StateActor(expert.act)) for expert in experts]
    chosen = int(np.argmax([p.score for p in played]))
    return experts[chosen], updates[chosen], played[chosen]


def _say_unchanged(title: str, improved: ExpertResult, student: Path | None) -> None:
    """Warn that PPO changed nothing of the policy that it started from, or nothing for the better.

    Raises:
        ItemRejectedError: `ppo_changed_nothing`: there is no taught policy either.
    """
    words = (
        f"PPO ended ({improved.stopped_by}) after {improved.steps} steps, before the best policy of '{title}' had "
        "taken a gradient step"
    )
    if student is None:
        raise ItemRejectedError(
            "ppo_changed_nothing",
            f"{words}; give it more with --expert.ppo.total-steps or --expert.ppo.max-seconds",
            float(improved.steps),
        )
    logger.warning("%s: the expert is the taught policy", words)


def _training_worlds(
    worlds: Worlds, cfg: ExpertConfig, device: str, *, is_taught: bool
) -> TorchRLEnv:
    """Return the worlds of PPO; a taught policy goes on at the fine time step."""
    bonus = worlds.bonus_ratio * (cfg.taught_bonus_factor if is_taught else 1.0)
    env = BatchEnv(
        worlds.bundle,
        SimConfig(fine=is_taught, bonus_ratio=bonus, backend=cfg.backend, device=device),
        num_envs=cfg.num_envs,
        seed=seed_for(worlds.seed, "worlds"),
        num_threads=worlds.num_threads,
    )
    return TorchRLEnv(env)


def success_of(env: BatchEnv, expert: Expert) -> float:
    """Play one episode in every world and return the share that the task's success held at some time.

    That is what episodes are recorded for, and what success means wherever two policies are compared.
    """
    return float(try_out(env, StateActor(expert.act)).once.mean())

"""How a task becomes an expert: a teacher is found, imitated, and then surpassed or confirmed by PPO.

Scripted programs are tried on the task; the one that its own success function likes best teaches a policy
(DAgger), and PPO goes on from there until the deterministic policy succeeds. Without a program that succeeds at
all, PPO starts from nothing. Of the taught policy and the one that PPO made of it the better one is kept, by
episodes at the fine time step. What is kept is a neural network in any case; scripts never make a dataset.
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
from v2p_data.expert_config import ExpertConfig
from v2p_data.seeds import seed_for
from v2p_data.sim.backends import make_batch_env
from v2p_data.sim.bank import Bank, record_bank, use_bank
from v2p_data.sim.batch_env import BatchEnv, SimConfig
from v2p_data.sim.teacher import Teacher, Trial, play
from v2p_data.sim.torchrl_env import TorchRLEnv
from v2p_data.task.nearest import Solved, rank_solved
from v2p_data.task.task import TaskBundle

logger = logging.getLogger(__name__)

TAUGHT_FOLDER = "taught"
Progress = Callable[[float, str], None]


@dataclass(frozen=True, kw_only=True)
class Learned:
    """What came of it; the expert itself lies in the folder."""

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
    bundle: TaskBundle,
    cfg: ExpertConfig,
    out: Path,
    *,
    seed: int,
    num_threads: int = 1,
    device: str = "cuda:0",
    solved: Sequence[Solved] = (),
    success_bonus: float = SimConfig.success_bonus,
    on_progress: Progress = lambda share, words: None,
) -> Learned:
    """Write the task's expert into `out`, with the curve of its training.

    Args:
        bundle: the task.
        cfg: the recipe.
        out: folder; `taught/` in it is what imitation gave.
        seed: of everything that is drawn.
        num_threads: for the physics; changes no result.
        device: of the backend `warp`.
        solved: experts of other tasks, see `ExpertConfig.warm_start`.
        success_bonus: what a step of success earns in training, see `SimConfig`; nothing by RoboGen's method.
        on_progress: told the share that is done and a few words.
    """

    def worlds(num_envs: int, what: str, *, fine: bool = False) -> BatchEnv:
        return BatchEnv(
            bundle,
            SimConfig(fine=fine, success_bonus=success_bonus),
            num_envs=num_envs,
            seed=seed_for(seed, what),
            num_threads=num_threads,
        )

    teacher_name, trials, taught, steps, seconds = "", (), None, 0, 0.0
    bank: Bank | None = None
    other: Path | None = None
    if cfg.teacher == "programs":
        trial_env = worlds(cfg.trial_worlds, "trials")
        env = worlds(cfg.num_envs, "taught")
        teacher = Teacher(env)
        on_progress(0.0, "trying programs")
        best = teacher.choose(trial_env)
        trials = teacher.trials
        steps += len(trials) * cfg.trial_worlds * bundle.horizon_steps
        if best.success >= cfg.least_teacher_success:
            teacher_name = best.name
            exam_env = worlds(cfg.trial_worlds, "exams", fine=True)
            imitated = imitate(
                TorchRLEnv(env),
                teacher.act,
                cfg.imitation,
                out / TAUGHT_FOLDER,
                seed=seed_for(seed, "imitation") % 2**63,
                check=lambda expert: success_of(exam_env, expert),
                on_progress=lambda share: on_progress(
                    0.4 * share,
                    f"imitating '{teacher_name}', which succeeds in {best.success:.0%}",
                ),
            )
            taught = imitated.folder
            steps, seconds = steps + imitated.steps, seconds + imitated.seconds
        else:
            logger.info("no program succeeds at '%s'", bundle.title)
        if cfg.bank.share:
            player = Teacher(trial_env)
            player.name = best.name
            bank = record_bank(trial_env, player.act)
            steps += cfg.trial_worlds * bundle.horizon_steps
        del env, trial_env
    start = 0.4 if taught else 0.0
    env = make_batch_env(
        bundle,
        SimConfig(success_bonus=success_bonus),
        num_envs=cfg.num_envs,
        seed=seed_for(seed, "worlds"),
        num_threads=num_threads,
        backend=cfg.backend,
        device=device,
    )
    if bank is not None and len(bank) and isinstance(env, BatchEnv):
        use_bank(env, bank, replace(cfg.bank, num_plain=cfg.ppo.num_deterministic))
    if taught is None and (ranked := rank_solved(bundle, env.obs_dim, solved)):
        other = ranked[0].folder
        logger.info("PPO starts from %s", other)
    result = train_expert(
        TorchRLEnv(env),
        cfg.ppo,
        out,
        seed=seed_for(seed, "ppo") % 2**63,
        warm_start=taught or other,
        on_progress=lambda done, total, success: on_progress(
            start + (1 - start) * min(done / total, 1),
            "PPO" if np.isnan(success) else f"PPO, success {success:.0%}",
        ),
    )
    kept, of_taught, of_ppo = "ppo", None, None
    if taught is not None:
        judge_env = worlds(2 * cfg.trial_worlds, "which is better", fine=True)
        of_taught = success_of(judge_env, Expert.load(taught))
        of_ppo = success_of(judge_env, Expert.load(out))
        if of_taught > of_ppo:
            kept = "taught"
            Expert.load(taught).save(out)
    return Learned(
        steps=steps + result.steps,
        seconds=seconds + result.seconds,
        kept=kept,
        teacher=teacher_name,
        trials=tuple(trials),
        taught_success=of_taught,
        ppo_success=of_ppo,
        stopped_by=result.stopped_by,
        started_from=other.name if other is not None else "",
    )


def success_of(env: BatchEnv, expert: Expert) -> float:
    """Play one episode in every world and return the share that the task's success held at some time.

    That is what episodes are recorded for, and what `taught_success` and `ppo_success` mean wherever they are kept.
    """
    return float(play(env, expert.act)[1].mean())

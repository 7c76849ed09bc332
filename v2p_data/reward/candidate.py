"""One reward as a stage of the pipeline: PPO learns with it from nothing up to a rung, and its policy is judged.

A rung is a stage whose input is the rung before, from whose checkpoint it goes on. The record's counts hold success,
rank and what each component did; `train/` holds checkpoint, curve and policies. All candidates get the same worlds and
weights: they differ by their rewards alone.
"""

import csv
import functools
import os
import shutil
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, field, replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float

from policies.ppo.config import PPOConfig
from policies.ppo.curve import CURVE_FILE
from policies.ppo.policy import Expert
from policies.ppo.train import LAST_FOLDER, train_expert
from v2p_data.experts.learning import Worlds
from v2p_data.pipeline.artifact import provenance
from v2p_data.pipeline.runner import Runtime, Stage
from v2p_data.play import StateActor
from v2p_data.reward.config import RewardConfig
from v2p_data.reward.feedback import Feedback, feedback_of
from v2p_data.reward.trajectories import Trajectories, record_trajectories
from v2p_data.scene.scene import SceneObject
from v2p_data.sim.env.task_check import check_reward
from v2p_data.sim.robot.robot import COARSE
from v2p_data.sim.wrappers.torchrl_env import TorchRLEnv
from v2p_data.task.sandbox.confine import Rights, confine
from v2p_data.task.task import TaskBundle

TRAIN_FOLDER = "train"
LEAST_WAY_M = 0.01
"""The video's displacement says nothing below this."""
RANKING_WEIGHT = 0.1
"""So much success is made up for by a reward that pays successes more than failures instead of
less: 192 episodes tell no smaller difference of success apart (1.96 standard errors of a
difference, 0.10)."""
RIGHTS = {"memory_bytes": 4 * 2**30, "file_bytes": 2 * 2**30, "open_files": 256, "processes": 64}
"""What a process may use that runs a generated reward; the memory is on top of what the libraries take."""


@dataclass(kw_only=True)
class Candidate:
    """One reward of a search, and how far it came."""

    number: int
    iteration: int
    """Its round, from 0."""
    code: str = field(repr=False)
    """Whole task code."""
    origin: str
    """Who wrote its reward: `given` with the task, a `template` or a `model`."""
    parent: int | None = None
    """The candidate from which it was written."""
    reasons: tuple[str, ...] = ()
    why: str = ""
    """Why it has no further result."""
    results: list[dict[str, Any]] = field(default_factory=list[dict[str, Any]])
    """The counts of its rungs' records, with the folder of each and its seconds."""
    stage: Stage | None = None
    """Its last rung."""

    @property
    def success(self) -> float:
        """Share of episodes whose success was held at their end, after the last rung; 0 without any."""
        return self.results[-1]["success"] if self.results else 0.0

    def is_finished(self, cfg: RewardConfig) -> bool:
        """Tell whether it trained to the end, or reached the target."""
        return len(self.results) == len(cfg.rungs) or self.success >= cfg.target_success


def candidate_stage(
    candidate: Candidate, bundle: TaskBundle, cfg: RewardConfig, rung: int, seed: int
) -> Stage:
    """Return a candidate's stage up to a rung; the rung before is its input."""
    return Stage(
        name="candidate",
        item=f"{candidate.number:03d}-rung-{rung}",
        config={"code": candidate.code, "rung": rung, "reward": cfg, "seed": seed},
        inputs={"before": candidate.stage} if candidate.stage else {},
        make=partial(make_candidate, bundle=bundle),
        resumes=True,
    )


def make_candidate(
    cfg: dict[str, Any],
    inputs: Mapping[str, Path],
    out: Path,
    runtime: Runtime,
    *,
    bundle: TaskBundle,
) -> dict[str, Any]:
    """Train from the rung before, play one episode in each of the judging worlds, return what came of it."""
    _confine(runtime.root)
    reward: RewardConfig = cfg["reward"]
    # Tried by the search, which made it; a confined process can start no trial of its own.
    bundle = replace(bundle, code=cfg["code"], folder=Path())
    check_reward(bundle)
    worlds = Worlds(
        bundle=bundle,
        seed=cfg["seed"],
        num_threads=runtime.num_threads,
        bonus_ratio=reward.bonus_ratio,
    )
    train = out / TRAIN_FOLDER
    if "before" in inputs and not train.is_dir():
        copied = shutil.copytree(inputs["before"] / TRAIN_FOLDER, out / "copy", dirs_exist_ok=True)
        copied.rename(train)
    steps = round(reward.steps * reward.rungs[cfg["rung"]])
    train_expert(
        TorchRLEnv(worlds.make(reward.num_envs, "worlds")),
        ppo_config(reward.num_envs, steps, num_threads=runtime.num_threads),
        train,
        seed=worlds.seed_of("ppo"),
        on_progress=lambda done, total, _: runtime.progress(done / total, "training"),
        draws=False,
    )
    judge = worlds.make(reward.eval_worlds, "judging")
    played = record_trajectories(judge, StateActor(Expert.load(train / LAST_FOLDER).act))
    curves = component_curves(train / CURVE_FILE)
    feedback = feedback_of(played, COARSE.control_dt_s, curves=curves)
    return {
        "steps": steps,
        "success": feedback.success_rate,
        "rank": rank_of(feedback, played, bundle.scene.manipulated),
        "feedback": asdict(feedback),
        "feedback_text": feedback.text(),
    }


def ppo_config(num_envs: int, total_steps: int, *, num_threads: int = 1) -> PPOConfig:
    """Return the recipe of all candidates: only steps end it, never what training itself believes."""
    return PPOConfig(
        total_steps=total_steps,
        max_seconds=float("inf"),
        target_success=2.0,
        decline=2.0,
        plateau_steps=total_steps,
        num_deterministic=max(1, num_envs // 8),
        window_episodes=max(64, num_envs // 4),
        min_window_episodes=max(1, num_envs // 8),
        minibatch=min(1024, num_envs * 4),
        num_threads=num_threads,
    )


def rank_of(feedback: Feedback, played: Trajectories, obj: SceneObject) -> float:
    """Return what candidates are ordered by: success first, then whose reward tells success from failure.

    Where nobody succeeds it is who is on the way to success: at any step, as far as in the video, or in touch.
    """
    moved = played.states[f"{obj.name}_pos"][-1] - played.states[f"{obj.name}_start_pos"][-1]
    touched = float((played.states[f"{obj.name}_touched"] > 0.5).mean())
    on_the_way = (
        0.5 * feedback.ever_success + 0.4 * float(closeness(moved, obj).mean()) + 0.1 * touched
    )
    success, ranking = feedback.success_rate, feedback.reward_ranks
    if ranking is None:  # none succeeded, or none failed
        ranking = float(success > 0)
    return success + 0.1 * on_the_way + RANKING_WEIGHT * ranking


def closeness(moved_m: Float[np.ndarray, "env 3"], obj: SceneObject) -> Float[np.ndarray, "env"]:
    """Return how much of the video's displacement happened: 0 for none, 1 for all of it."""
    way = np.asarray(obj.motion.translation_m if obj.poses_world else np.zeros(3), float)
    length = float(np.linalg.norm(way))
    if length < LEAST_WAY_M:
        return np.zeros(len(moved_m))
    return np.clip(1 - np.linalg.norm(moved_m - way, axis=1) / length, 0.0, 1.0)


def component_curves(curve: Path) -> dict[str, Sequence[float]]:
    """Return per component, and for `success`, its mean in the course of training."""
    with curve.open(newline="", encoding="utf-8") as stream:
        rows = list(csv.DictReader(stream))
    names = {"success_deterministic": "success"} | {
        k: k.removeprefix("reward_") for k in rows[0] if k.startswith("reward_")
    }
    return {name: [float(row[k] or "nan") for row in rows] for k, name in names.items()}


@functools.cache
def _confine(root: Path) -> None:
    """Give up the network, programs, memory and all folders but the search's, for the rest of this process's life."""
    provenance()  # asks git, for the record
    confine(
        Rights(seconds=None, folder=root, **RIGHTS), parent_pid=os.getppid(), give_up_root=False
    )

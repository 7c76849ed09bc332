"""One expert for all objects of a cell: a program is imitated on all of them at once, and PPO goes on from there.

Its observation is the base observation, in which sizes, poses, contacts and what gripper and object are to each other stand;
so one network tells objects apart by what they measure. `v2p_data/sim/wrappers/joined_worlds.py` joins their worlds.
"""

import logging
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Bool

from policies.evaluation.paired import success_difference
from policies.evaluation.rate import wilson
from policies.ppo.imitate import imitate
from policies.ppo.policy import Expert
from policies.ppo.train import LAST_FOLDER, train_expert
from v2p_data.experts.actors import ProgramActor
from v2p_data.experts.config import ExpertConfig
from v2p_data.experts.labeller import labeller_of, network_actor
from v2p_data.experts.teacher import LIFT, Teacher, try_out
from v2p_data.pipeline.runner import Runtime, Stage
from v2p_data.play import Actor
from v2p_data.seeds import seed_for
from v2p_data.sim.env.batch_env import BatchEnv, SimConfig
from v2p_data.sim.wrappers.joined_worlds import JoinedWorlds
from v2p_data.sim.wrappers.torchrl_env import TorchRLEnv
from v2p_data.stages import EngineConfig, Seeded
from v2p_data.task.task import TaskBundle

MOST_TASKS = 75
"""Tasks that it learns from, evenly spread over those of the cell: each has worlds, whose number must not be small."""
HIDDEN = (256, 256)
"""Twice as wide as the network of one object."""
EXAM_EPISODES, COMPARE_EPISODES = 3, 8
"""Per task."""

logger = logging.getLogger(__name__)


def one_expert_stage(tasks: Sequence[Stage], engine: EngineConfig) -> Stage:
    """Return the stage that makes the expert of all tasks."""
    return Stage(
        name="expert",
        item=f"one_for_{len(tasks)}",
        config=Seeded(config=engine.expert, seed=engine.seed),
        inputs={task.item: task for task in tasks},
        make=make_one_expert,
    )


def make_one_expert(
    cfg: Seeded, inputs: Mapping[str, Path], out: Path, runtime: Runtime
) -> dict[str, Any]:
    """Imitate the lifting program on all tasks, go on with PPO, keep what is surely better on the same episodes."""
    expert: ExpertConfig = cfg.config
    bundles = [TaskBundle.load(folder) for folder in inputs.values()]
    bundles = bundles[:: -(-len(bundles) // MOST_TASKS)]
    each = max(1, round(expert.num_envs / len(bundles)))

    def worlds(purpose: str, count: int, sim: SimConfig) -> list[BatchEnv]:
        return [
            BatchEnv(
                b, sim, num_envs=count, seed=seed_for(cfg.seed, purpose, b.title), num_threads=1
            )
            for b in bundles
        ]

    taught, seed = out / "taught", seed_for(cfg.seed, "one expert") % 2**63
    exams = worlds("exams", EXAM_EPISODES, SimConfig(fine=True))
    parts = worlds("taught", each, SimConfig())
    joined, teachers = JoinedWorlds(parts), [Teacher(part) for part in parts]
    for teacher in teachers:
        teacher.name = LIFT
    recipe = replace(expert.imitation, actor=replace(expert.imitation.actor, hidden=HIDDEN))
    imitated = imitate(
        TorchRLEnv(joined),
        lambda: joined.joined([t.act() for t in teachers]),
        recipe,
        taught,
        seed=seed,
        check=lambda learner: float(_successes(exams, network_actor(learner), None).mean()),
        on_progress=lambda share: runtime.progress(0.4 * share, "imitating on all objects"),
    )
    bonus = expert.taught_bonus_factor
    ppo = train_expert(
        TorchRLEnv(JoinedWorlds(worlds("ppo", each, SimConfig(fine=True, bonus_ratio=bonus)))),
        replace(expert.ppo, actor=replace(expert.ppo.actor, hidden=HIDDEN)),
        out,
        seed=seed,
        warm_start=taught,
        on_progress=lambda done, total, _: runtime.progress(0.4 + 0.5 * done / total, "PPO"),
    )
    fresh, start = worlds("which is better", COMPARE_EPISODES, SimConfig(fine=True)), seed % 2**31
    players = {"program": ProgramActor(0, LIFT)} | {
        name: labeller_of(folder)
        for name, folder in (("taught", taught), ("best", out), ("last", out / LAST_FOLDER))
    }
    played = {name: _successes(fresh, actor, start) for name, actor in players.items()}
    name = max(("best", "last"), key=lambda k: played[k].mean())
    gain = success_difference(played[name].ravel(), played["taught"].ravel())
    kept, folder = (name, out / LAST_FOLDER) if gain.low > 0 else ("taught", taught)
    if kept != "best":
        Expert.load(folder).save(out)
    rate = wilson(int(played[kept].sum()), played[kept].size)
    return {
        "steps": imitated.steps + ppo.steps,
        "train_seconds": round(imitated.seconds + ppo.seconds, 1),
        "tasks": len(bundles),
        "kept": kept,
        "ppo_gain": [gain.low, gain.value, gain.high],
        "successes": {k: float(v.mean()) for k, v in played.items()},
        "least": {k: float(v.mean(1).min()) for k, v in played.items()},
        "success": rate.as_dict(),
    }


def _successes(
    parts: Sequence[BatchEnv], actor: Actor, seed: int | None
) -> Bool[np.ndarray, "task episode"]:
    return np.array([try_out(part, actor, seed).once for part in parts])

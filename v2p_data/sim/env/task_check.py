"""Is a task worth training for? Asked of the real simulator before any training starts.

Three things make a training useless whatever it learns: a success that is always true, one that is true already at
the start or comes about by itself, and one that nothing can bring about. The first two are asked of states that the
simulator resets to and rests in; the last of the audit's search over the workspace. So is the reward: one that is
constant, unbounded or not finite teaches nothing.
"""

import numpy as np
import torch

from v2p_data.errors import ItemRejectedError
from v2p_data.seeds import rng_for
from v2p_data.sim.env.batch_env import BatchEnv, SimConfig
from v2p_data.sim.env.start_check import SOLVED_AT_MOST
from v2p_data.task.audit.moments import build_probes
from v2p_data.task.audit.rewards import reward_fault
from v2p_data.task.sandbox.guarded import GuardedTask, Show
from v2p_data.task.task import Task, TaskBundle

NUM_WORLDS = 64
IDLE_STEPS = 30
"""The robot stays where it is for this long (1.5 s), until everything has come to rest."""


def check_task(
    bundle: TaskBundle, *, seed: int = 0, num_threads: int = 1, task: type[Task] | None = None
) -> None:
    """Demand that success is false at first, stays so while nothing is done, and can be reached.

    Args:
        bundle: the task.
        seed: of the worlds and of the search.
        num_threads: for the physics.
        task: the task, instead of `bundle.code`.

    Raises:
        ItemRejectedError: `success_always_true`, `success_at_start`, `success_by_itself` or `success_unreachable`;
            or whatever making a `BatchEnv` raises.
    """
    env = BatchEnv(
        bundle, SimConfig(), num_envs=NUM_WORLDS, seed=seed, num_threads=num_threads, task=task
    )
    where = f"success of task '{bundle.title}' ({bundle.kind})"
    at_start = _share(env.task, env.task_states)
    states = _search_states(bundle, seed)
    searched, count = _share(env.task, lambda: states), len(states["eef_pos"])
    if at_start == 1 and searched == 1:
        raise ItemRejectedError(
            "success_always_true",
            f"{where} is always true, at all {NUM_WORLDS} starts and in all {count} states that were tried; "
            "compute_success must ask what has become of the object",
            1.0,
        )
    if at_start > SOLVED_AT_MOST:
        raise ItemRejectedError(
            "success_at_start",
            f"{where} is true at {at_start:.0%} of {NUM_WORLDS} starts, before the robot has moved; "
            "compute_success must ask for a change from the start, as in <object>_start_pos",
            at_start,
        )
    idle = np.zeros((NUM_WORLDS, env.act_dim))
    held = [env.step(idle).held for _ in range(IDLE_STEPS)]
    by_itself = float(held[-1].mean())
    if by_itself > SOLVED_AT_MOST:
        raise ItemRejectedError(
            "success_by_itself",
            f"{where} is true in {by_itself:.0%} of {NUM_WORLDS} worlds after {IDLE_STEPS} steps without any action; "
            "do the objects fall or slide by themselves, or does compute_success ask for too little?",
            by_itself,
        )
    if searched == 0:
        raise ItemRejectedError(
            "success_unreachable",
            f"{where} is true in none of {count} states all over the workspace, tipped, carried, at the other object "
            "and along the video's motion among them; are its distances and heights in metres, and its names right?",
            0.0,
        )


def check_reward(bundle: TaskBundle, *, seed: int = 0, task: type[Task] | None = None) -> None:
    """Demand a reward that is finite, bounded and not the same everywhere, by the audit's search over the workspace.

    Args:
        bundle: the task.
        seed: of the worlds and of the search.
        task: the task, instead of `bundle.code`.

    Raises:
        ItemRejectedError: `reward_not_finite`, `reward_unbounded` or `reward_constant`; or whatever making a
            `BatchEnv` raises.
    """
    env = BatchEnv(bundle, SimConfig(), num_envs=1, seed=seed, task=task)
    states = _search_states(bundle, seed)
    count = len(states["eef_pos"])
    said = env.task.judge(lambda: dict(states), torch.zeros((count, env.act_dim)))
    fault = reward_fault(said.reward.numpy(), "states all over the workspace")
    if fault is not None:
        raise ItemRejectedError(
            f"reward_{fault.reason}",
            f"the reward of task '{bundle.title}' ({bundle.kind}) {fault.words}",
            fault.value,
        )


def _search_states(bundle: TaskBundle, seed: int) -> dict[str, torch.Tensor]:
    probes = build_probes(bundle.scene, rng_for(seed, "audit", bundle.title))
    return {name: torch.from_numpy(values) for name, values in probes.states.items()}


def _share(task: GuardedTask, show: Show) -> float:
    return float(task.succeeds(show).float().mean())

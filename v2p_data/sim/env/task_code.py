"""What an environment does with its task's code, on whichever machine it simulates."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Bool, Float32

from v2p_data.errors import V2PError
from v2p_data.sim.env.start_check import check_solved
from v2p_data.task.sandbox.guarded import GuardedTask
from v2p_data.task.task import FULL_REWARD, MAX_REWARD, Placer, Task, TaskBundle

HELD_STEPS = 5
"""Success counts when it is true for this many steps on end (0.25 s)."""
FRESH, BEGAN_SOLVED = -1, -2
"""Values of `held`: before an episode's first step, and all through one that began in success."""


@dataclass(frozen=True, kw_only=True)
class StepResult:
    """What one control step led to, per world."""

    obs: Float32[np.ndarray, "env obs"]
    reward: Float32[np.ndarray, "env"]
    """`task_reward / FULL_REWARD + bonus_ratio * success`."""
    success: Bool[np.ndarray, "env"]
    """The task's own judgement of this very moment."""
    held: Bool[np.ndarray, "env"]
    """Success for the last `HELD_STEPS` steps: what an episode is judged by, at its end."""
    terminated: Bool[np.ndarray, "env"]
    """The simulation broke down: the state is not finite, or MuJoCo warned and reset it."""
    truncated: Bool[np.ndarray, "env"]
    """The time is up."""
    task_reward: Float32[np.ndarray, "env"]
    components: dict[str, Float32[np.ndarray, "env"]]
    """The task's named parts of its reward."""


def load(bundle: TaskBundle, worlds: Placer, task: type[Task] | None) -> GuardedTask:
    """Return the bundle's task over some worlds, or `task` instead of its code.

    Raises:
        V2PError: the code comes from a folder and fails its trial, or does not load.
    """
    if task is not None:
        return GuardedTask(task(worlds, str(bundle.scene.folder), {}), title=bundle.title)
    from v2p_data.task.sandbox.sandbox import load_task
    from v2p_data.task.sandbox.trial import demand_trial

    demand_trial(bundle)
    return load_task(bundle.code, worlds, bundle.scene, bundle.title)


def checked_obs_dim(task: GuardedTask, title: str, made: int) -> int:
    """Return the observation's length.

    Raises:
        V2PError: the task's code says another one than the `made` one.
    """
    said = task.observation_size()
    if made != said:
        raise V2PError(
            f"task '{title}' makes observations of length {made} but says {said}; "
            "correct get_observation_space or compute_observation_key in its task.py"
        )
    return said


class Judgement:
    """What a task says of worlds, made sure of: finite, fair, and success that lasts.

    Args:
        task: the task.
        title: its title, for messages.
        bonus_ratio: see `SimConfig.bonus_ratio`.
        num_envs: number of worlds.

    Attributes:
        held: for how many steps success has been true on end; see `FRESH`.
        num_starts: episodes that began so far.
        num_solved: how many of them began in success.
        obs_dim: length of the observation, once it is known.
    """

    def __init__(self, task: GuardedTask, title: str, bonus_ratio: float, num_envs: int) -> None:
        self.task, self.title, self.bonus_ratio = task, title, bonus_ratio
        self.held = np.zeros(num_envs, np.int64)
        self.num_starts = self.num_solved = self.obs_dim = 0

    def observation(
        self, obs: torch.Tensor, broken: Bool[np.ndarray, "env"]
    ) -> Float32[np.ndarray, "env obs"]:
        """Return a copy of what the task observed, 0 where it is not finite because the world broke down."""
        array = obs.clone(memory_format=torch.contiguous_format).numpy()
        finite = np.isfinite(array)
        if not finite.all():
            odd = np.flatnonzero(~finite.all(1) & ~broken)
            if len(odd):
                raise V2PError(
                    f"the observation of task '{self.title}' is not finite in world {odd[0]} although its "
                    f"state is; first in column {np.flatnonzero(~finite[odd[0]])[0]}"
                )
            array[~finite] = 0.0
        return array

    def of(
        self,
        show: Callable[[], dict[str, torch.Tensor]],
        action: Float32[torch.Tensor, "env 7"],
        broken: Bool[np.ndarray, "env"],
        is_late: Bool[np.ndarray, "env"],
    ) -> StepResult:
        """Return what an action led to, as the task says.

        Args:
            show: gives the states as they are.
            action: the last one.
            broken: where the simulation broke down.
            is_late: where the time is up.

        Raises:
            V2PError: an observation or a reward of a sound world is not fit.
            ItemRejectedError: more episodes begin in success than chance explains.
        """
        ok = ~broken
        said = self.task.judge(show, action)
        obs = self.observation(said.observation, broken)
        if obs.shape[1] != self.obs_dim:
            raise V2PError(
                f"task '{self.title}' observes {obs.shape[1]} numbers after it observed {self.obs_dim}"
            )
        success = said.success.numpy() & ok
        task_reward = _of_sound_worlds(said.reward, broken)
        is_fair = np.abs(task_reward) <= MAX_REWARD  # false for NaN too
        if not is_fair.all():
            env = int(np.flatnonzero(~is_fair)[0])
            raise unfair_reward(self.title, env, task_reward[env], said.components)
        self._count_held(success)
        reward = task_reward / FULL_REWARD + self.bonus_ratio * success
        return StepResult(
            obs=obs,
            reward=reward.astype(np.float32),
            success=success,
            held=self.held >= HELD_STEPS,
            terminated=broken.copy(),
            truncated=is_late & ok,
            task_reward=task_reward,
            components={k: _of_sound_worlds(v, broken) for k, v in said.components.items()},
        )

    def _count_held(self, success: Bool[np.ndarray, "env"]) -> None:
        """Count the steps for which success has been true on end; an episode that began in success never counts.

        Raises:
            ItemRejectedError: `starts_solved`: more episodes began so than chance explains.
        """
        is_fresh = self.held == FRESH
        began = (self.held == BEGAN_SOLVED) | (is_fresh & success)
        self.held = np.where(success, np.maximum(self.held, 0) + 1, 0)
        self.held[began] = BEGAN_SOLVED
        if is_fresh.any():
            self.num_starts += int(is_fresh.sum())
            self.num_solved += int((is_fresh & success).sum())
            check_solved(self.num_solved, self.num_starts, self.title)


def _of_sound_worlds(
    value: torch.Tensor, broken: Bool[np.ndarray, "env"]
) -> Float32[np.ndarray, "env"]:
    """Return a copy of what the task gave, 0 for broken worlds."""
    array = value.detach().numpy().astype(np.float32)
    array[broken] = 0.0
    return array


def unfair_reward(
    title: str,
    env: int,
    reward: float | np.floating,
    parts: Mapping[str, torch.Tensor],
) -> V2PError:
    """Return the error for a reward beyond what is allowed in world `env`, whose state is sound."""
    return V2PError(
        f"the reward of task '{title}' is {reward} in world {env} although its state is finite; rewards lie within "
        f"+-{MAX_REWARD:g}, a full one is {FULL_REWARD:g}; parts: { {k: float(v[env]) for k, v in parts.items()} }"
    )

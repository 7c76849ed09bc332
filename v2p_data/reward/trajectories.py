"""What a policy did in a batch of episodes, one per world: played and written down in memory.

The first axis is the control step, the second the world; what comes after an episode's end is NaN. States are
kept for a few moments only.
"""

from dataclasses import dataclass, field

import numpy as np
from jaxtyping import Bool, Float32, Int

from v2p_data.play import Actor, View, play
from v2p_data.sim.env.batch_env import BatchEnv
from v2p_data.sim.env.task_code import HELD_STEPS
from v2p_data.task.task import OBJECT_STATES

NUM_MOMENTS = 25
"""Moments of each episode whose states are kept, evenly spread over the horizon."""


@dataclass(frozen=True, kw_only=True)
class Trajectories:
    """What a policy did in a batch of episodes, one per world."""

    components: dict[str, Float32[np.ndarray, "step env"]]
    """Named components of the reward, NaN after an episode's end."""
    reward: Float32[np.ndarray, "step env"]
    """The generated reward without the bonus for success, NaN after an episode's end."""
    success: Bool[np.ndarray, "step env"]
    """The task's own success per step, False after an episode's end."""
    length: Int[np.ndarray, "env"]
    """Steps that each episode took."""
    moments: Int[np.ndarray, "moment"] = field(default_factory=lambda: np.zeros(0, np.int64))
    """Steps, ascending, for which `states` are kept: those that `reward[moments]` was paid for."""
    states: dict[str, np.ndarray] = field(default_factory=dict[str, np.ndarray])
    """`eef_pos` and each object's `task.task.OBJECT_STATES`, each `(moment, env, ...)` float32."""

    @property
    def num_episodes(self) -> int:
        """Number of episodes."""
        return self.success.shape[1]

    @property
    def played(self) -> Bool[np.ndarray, "step env"]:
        """Which steps belong to an episode."""
        return np.arange(len(self.success))[:, None] < self.length

    @property
    def succeeded(self) -> Bool[np.ndarray, "env"]:
        """Which episodes succeeded: success held for their last `HELD_STEPS` steps."""
        steps = np.arange(len(self.success))[:, None]
        is_last = (steps >= self.length - HELD_STEPS) & self.played
        return (self.success | ~is_last).all(0) & (self.length >= HELD_STEPS)


def record_trajectories(
    env: BatchEnv, actor: Actor, *, num_moments: int = NUM_MOMENTS
) -> Trajectories:
    """Play one episode in every world and return what was paid, and the states of some moments.

    A world whose simulation breaks down ends its episode at the step before.

    Args:
        env: the worlds; they are reset first and left as they are at the end.
        actor: who acts.
        num_moments: how many moments' states are kept; all if the horizon is shorter.
    """
    n, horizon = env.num_envs, env.horizon
    moments = np.unique(np.linspace(0, horizon - 1, min(num_moments, horizon)).round().astype(int))
    keys = ["eef_pos", *(f"{o}_{k}" for o in env.object_names for k in OBJECT_STATES)]
    components = {
        k: np.full((horizon, n), np.nan, np.float32) for k in dict.fromkeys(env.component_names)
    }
    reward = np.full((horizon, n), np.nan, np.float32)
    success = np.zeros((horizon, n), bool)
    length = np.full(n, horizon)
    states: dict[str, list[np.ndarray]] = {key: [] for key in keys}
    env.reset(np.arange(n))

    def note(view: View) -> None:
        step, result = view.t - 1, view.result
        np.minimum(length, step, out=length, where=result.terminated)
        goes_on = length > step
        for name, row in components.items():
            row[step] = np.where(goes_on, result.components[name], np.nan)
        reward[step] = np.where(goes_on, result.task_reward, np.nan)
        success[step] = result.success & goes_on
        if step in moments:
            now = env.states()
            for key in keys:
                # A copy, finite also where a world broke down: those rows are beyond the episode's end.
                states[key].append(np.nan_to_num(now[key].numpy().astype(np.float32)))

    play(View(env), actor, [note])
    return Trajectories(
        components=components,
        reward=reward,
        success=success,
        length=length,
        moments=moments,
        states={k: np.stack(v) for k, v in states.items()},
    )

"""Plays one episode per world and writes down what a reward must answer for."""

import numpy as np

from v2p_data.play import Actor, View, play
from v2p_data.reward.trajectories import Trajectories
from v2p_data.sim.env.batch_env import BatchEnv
from v2p_data.task.task import OBJECT_STATES, ROBOT_STATES

NUM_MOMENTS = 25
"""Moments of each episode whose states are kept, evenly spread over the horizon."""


def record_trajectories(
    env: BatchEnv, actor: Actor, *, num_moments: int = NUM_MOMENTS
) -> Trajectories:
    """Play one episode in every world and return what was paid, and the states of some moments.

    A world whose simulation breaks down ends its episode at the step before.

    Args:
        env: the worlds; they are reset first and left as they are at the end.
        actor: who acts.
        num_moments: how many moments' states are kept; all if the horizon is shorter, none for 0.
    """
    n, horizon = env.num_envs, env.horizon
    moments = np.unique(np.linspace(0, horizon - 1, min(num_moments, horizon)).round().astype(int))
    keys = [*ROBOT_STATES, *(f"{o}_{k}" for o in env.object_names for k in OBJECT_STATES)]
    components = {
        k: np.full((horizon, n), np.nan, np.float32) for k in dict.fromkeys(env.component_names)
    }
    reward = np.full((horizon, n), np.nan, np.float32)
    success = np.zeros((horizon, n), bool)
    length = np.full(n, horizon)
    states: dict[str, list[np.ndarray]] = {key: [] for key in keys}
    actions: list[np.ndarray] = []
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
            actions.append(view.action.astype(np.float32))

    play(View(env), actor, [note])
    return Trajectories(
        components=components,
        reward=reward,
        success=success,
        length=length,
        moments=moments,
        states={k: np.stack(v) for k, v in states.items()} if len(moments) else {},
        actions=np.stack(actions) if actions else np.zeros((0, n, 7), np.float32),
    )

"""An expert's episodes in many worlds at once: physics and judgement, no pictures.

An episode succeeds if the task's own success held and the independent referee agrees. It is cut soon after success
has held, and the referee sees it as cut: each world stands still from its episode's end on.
"""

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
from jaxtyping import Bool, Float32, Int

from v2p_data.episodes.features import FPS
from v2p_data.sim.batch_env import BatchEnv, SimConfig, Snapshot
from v2p_data.sim.verdict import referee_verdict
from v2p_data.task.task import Task, TaskBundle

Act = Callable[[Float32[np.ndarray, "env obs"]], Float32[np.ndarray, "env act"]]
Course = Mapping[str, np.ndarray]
"""Per key of the task interface's `states` an array `(time, env, ...)`, the moment after the reset first."""
Referee = Callable[[TaskBundle, Course], Bool[np.ndarray, "env"]]


@dataclass(frozen=True, kw_only=True)
class CutConfig:
    """Where an episode ends."""

    tail_steps: int = 6
    """Control steps kept after success has held (0.3 s): a policy sees what being done looks like, and the
    referee whether it lasts."""
    min_frames: int = 10
    """Shorter episodes go on up to this length."""


@dataclass(frozen=True, kw_only=True)
class Rollouts:
    """One batch of episodes, drawn later or never. Row `t` precedes action `t`."""

    seed: int
    state: Float32[np.ndarray, "time env 11"]
    action: Float32[np.ndarray, "time env 7"]
    success: Bool[np.ndarray, "time env"]
    """The task's judgement after action `t`."""
    snapshots: tuple[Snapshot, ...]
    """All worlds, before action `t`."""
    num_frames: Int[np.ndarray, "env"]
    """Rows that belong to the episode."""
    held_at: Int[np.ndarray, "env"]
    """Row at whose end success had held for the first time; beyond the last row where it never did."""
    task_successes: Bool[np.ndarray, "env"]
    """The task's success held."""
    referee: Bool[np.ndarray, "env"]
    """The independent success function agrees."""
    broke: Bool[np.ndarray, "env"]
    """The simulation broke down during the episode."""
    params: tuple[dict[str, Any], ...]
    """What the randomisation drew, per world."""

    @property
    def successes(self) -> Bool[np.ndarray, "env"]:
        return self.task_successes & self.referee

    @property
    def snapshot_seconds(self) -> tuple[float, ...]:
        return tuple(t / FPS for t in range(len(self.snapshots)))

    def reject(self, world: int) -> dict[str, Any]:
        """Return why the episode of `world` is no demonstration."""
        steps_true = int(self.success[:, world].sum())
        if self.broke[world]:
            return {"reason": "simulation_broke", "detail": "the state was not finite",
                    "value": int(self.num_frames[world])}  # fmt: skip
        if not self.task_successes[world]:
            return {"reason": "not_successful", "value": steps_true,
                    "detail": f"success was true in {steps_true} steps and never held"}  # fmt: skip
        return {"reason": "referee_disagrees", "value": int(self.num_frames[world]),
                "detail": "the task's success held, the independent one did not"}  # fmt: skip


def roll_out(
    bundle: TaskBundle,
    act: Act,
    sim: SimConfig,
    *,
    num_worlds: int,
    seed: int,
    num_threads: int = 1,
    cut: CutConfig,
    task: type[Task] | None = None,
    referee: Referee | None = None,
) -> Rollouts:
    """Run one episode in every world until each has succeeded or its time is up."""
    env = BatchEnv(bundle, sim, num_envs=num_worlds, seed=seed, num_threads=num_threads, task=task)
    everyone = np.arange(num_worlds)
    params = tuple(env.episode_params(k) for k in range(num_worlds))
    obs = env.observe()
    states, actions, successes, snapshots = [], [], [], []
    trajectory = [_copied(env)]
    held = np.zeros(num_worlds, bool)
    broke = np.zeros(num_worlds, bool)
    end = np.full(num_worlds, env.horizon)
    held_at = end.copy()
    for t in range(env.horizon):
        states.append(env.robot_state())
        snapshots.append(env.snapshot(everyone))
        action = np.clip(np.asarray(act(obs), np.float32), -1.0, 1.0)
        result = env.step(action)
        obs = result.obs
        actions.append(action)
        successes.append(result.success)
        trajectory.append(_copied(env))
        now = result.held & ~held & ~broke
        end[now] = np.clip(t + 1 + cut.tail_steps, cut.min_frames, env.horizon)
        held_at[now] = t
        held |= now
        gone = result.terminated & ~broke & (t < end)
        end[gone] = t + 1
        broke |= gone
        if (t + 1 >= end).all():
            break
    held &= ~broke
    judge = referee or referee_verdict
    verdict = judge(bundle, _as_cut(trajectory, end)) & held if held.any() else held
    return Rollouts(
        seed=seed,
        state=np.stack(states),
        action=np.stack(actions),
        success=np.stack(successes),
        snapshots=tuple(snapshots),
        num_frames=end,
        held_at=held_at,
        task_successes=held,
        referee=verdict,
        broke=broke,
        params=params,
    )


def _copied(env: BatchEnv) -> dict[str, np.ndarray]:
    return {
        key: value.numpy().copy()
        for key, value in env.states().items()
        if key != "base_observation"
    }


def _as_cut(moments: list[dict[str, np.ndarray]], end: Int[np.ndarray, "env"]) -> Course:
    """Return the moments stacked, each world standing still from its episode's end on."""
    time = np.minimum(np.arange(len(moments))[:, None], end[None])
    worlds = np.arange(len(end))
    return {key: np.stack([m[key] for m in moments])[time, worlds] for key in moments[0]}

"""An expert's episodes in many worlds at once: physics and judgement, no pictures.

An episode succeeds if the task's own success held and the independent referee agrees. It is cut soon after success
has held, and the referee sees it as cut: each world stands still from its episode's end on.
"""

from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from jaxtyping import Bool, Float, Float32, Int

from v2p_data.episodes.dataset.features import (
    CAMERA_POSE_KEY,
    COLUMNS,
    CONTACT_KEY,
    EXECUTED_KEY,
    FPS,
    INTRINSICS_KEY,
    OBJECT_POSE_KEY,
    REWARD_KEY,
    SIMULATED,
    SLOTS,
)
from v2p_data.geometry.camera import intrinsics
from v2p_data.geometry.rotation import product
from v2p_data.play import Actor, Film, View, play
from v2p_data.sim.env.actions import state_as_seen, targets_of
from v2p_data.sim.env.batch_env import BatchEnv, SimConfig, Snapshot
from v2p_data.sim.env.verdict import RefereeRecord, referee_verdict
from v2p_data.sim.robot.action_names import action_names
from v2p_data.sim.robot.interface import STEPS, ArmInterface
from v2p_data.task.task import Task, TaskBundle

ABOUT_X = np.array([[0.0], [1.0], [0.0], [0.0]])
"""Half a turn about x: from OpenCV's camera axes to MuJoCo's."""
Referee = Callable[[TaskBundle, Mapping[str, np.ndarray]], Bool[np.ndarray, "env"]]
"""Given a task and `RefereeRecord.history_as_cut`, tells which episodes succeeded."""


@dataclass(frozen=True, kw_only=True)
class Lesson:
    """One task and who can do it."""

    bundle: TaskBundle
    expert: Actor
    task: type[Task] | None = None
    """The task, instead of `bundle.code`."""
    referee: Referee | None = None
    """The independent judge, instead of `task.referee`."""


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
    state: Float32[np.ndarray, "time env state"]
    action: Float32[np.ndarray, "time env 7"]
    """Steps of the tool."""
    executed: Float32[np.ndarray, "time env 7"]
    """What was carried out: `action`, but in a handover, where `action` is the expert's throughout."""
    success: Bool[np.ndarray, "time env"]
    """The task's judgement after action `t`."""
    reward: Float32[np.ndarray, "time env"]
    """What action `t` earned, as environments give it; see `StepResult.reward`."""
    object_pose: Float[np.ndarray, "time env object 7"]
    touches: Bool[np.ndarray, "time env object 3"]
    """By the left pad, the right pad, the whole hand; see `BatchEnv.touches`."""
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
    names: tuple[str, ...] = ()
    """Of the entries of `targets`; empty without."""
    targets: Float[np.ndarray, "time env act"] | None = None
    """What `action` leads to, where a dataset's `action` is a target."""

    @property
    def recorded_action(self) -> Float32[np.ndarray, "time env act"]:
        """A dataset's `action`."""
        return self.action if self.targets is None else self.targets.astype(np.float32)

    @property
    def successes(self) -> Bool[np.ndarray, "env"]:
        return self.task_successes & self.referee

    @property
    def snapshot_seconds(self) -> tuple[float, ...]:
        return tuple(t / FPS for t in range(len(self.snapshots)))

    def simulated(self, world: int, size_px: int) -> dict[str, np.ndarray]:
        """Return the columns of an episode that only a simulator knows, by name.

        Args:
            world: in which it ran.
            size_px: width and height of the pictures.
        """
        length, count = int(self.num_frames[world]), self.object_pose.shape[2]
        pose, touches = np.zeros((length, SLOTS, 7)), np.zeros((length, SLOTS, 3), bool)
        pose[:, :count] = self.object_pose[:length, world]
        touches[:, :count] = self.touches[:length, world]
        start = self.snapshots[0]
        K = intrinsics(size_px, size_px, np.radians(start.camera_fovy_deg[world]))
        quat = product(start.camera_quat[world][:, None], ABOUT_X)[:, 0]
        found = {
            REWARD_KEY: self.reward[:length, world],
            OBJECT_POSE_KEY: pose.reshape(length, -1),
            CONTACT_KEY: touches.reshape(length, -1),
            INTRINSICS_KEY: np.tile(K[[0, 1, 0, 1], [0, 1, 2, 2]], (length, 1)),
            CAMERA_POSE_KEY: np.tile(np.append(start.camera_pos[world], quat), (length, 1)),
        }
        columns = {key: found[key].astype(COLUMNS[key].dtype) for key in SIMULATED}
        return columns | ({EXECUTED_KEY: self.executed[:length, world]} if self.names else {})

    def reject(self, world: int) -> dict[str, Any]:
        """Return why the episode of `world` is no demonstration."""
        steps_true = int(self.success[:, world].sum())
        if self.broke[world]:
            return {
                "reason": "simulation_broke",
                "detail": "the state was not finite",
                "value": int(self.num_frames[world]),
            }
        if not self.task_successes[world]:
            how = (
                "from the start, which never counts"
                if self.success[0, world]
                else "and never held"
            )
            return {
                "reason": "not_successful",
                "value": steps_true,
                "detail": f"success was true in {steps_true} steps {how}",
            }
        return {
            "reason": "referee_disagrees",
            "value": int(self.num_frames[world]),
            "detail": "the task's success held, the independent one did not",
        }


class EpisodeEnds:
    """Stop rule of demonstrations: soon after success has held, at a breakdown, or when time is up.

    Args:
        num_worlds: number of worlds.
        horizon: longest episode, in control steps.
        cut: how soon after success.

    Attributes:
        num_frames: rows that belong to each episode, as far as is known.
        held_at: row at whose end success had held for the first time; the horizon where it has not.
        broke: where the simulation broke down during the episode.
    """

    def __init__(self, num_worlds: int, horizon: int, cut: CutConfig) -> None:
        self.cut, self.horizon = cut, horizon
        self.num_frames = np.full(num_worlds, horizon)
        self.held_at = np.full(num_worlds, horizon)
        self.broke = np.zeros(num_worlds, bool)
        self._held = np.zeros(num_worlds, bool)

    def __call__(self, view: View) -> Bool[np.ndarray, "env"]:
        """Take into account what the last action led to; return which episodes are over."""
        t, result = view.t - 1, view.result
        now = result.held & ~self._held & ~self.broke
        self.num_frames[now] = np.clip(
            t + 1 + self.cut.tail_steps, self.cut.min_frames, self.horizon
        )
        self.held_at[now] = t
        self._held |= now
        gone = result.terminated & ~self.broke & (t < self.num_frames)
        self.num_frames[gone] = t + 1
        self.broke |= gone
        return view.t >= self.num_frames

    @property
    def successes(self) -> Bool[np.ndarray, "env"]:
        """Where success has held and the simulation is sound."""
        return self._held & ~self.broke


class NotedActor:
    """An actor whose steps are noted as targets, and whose state is noted with the angles of the joints.

    Args:
        actor: who acts.
        interface: what a dataset's `action` says, and what its state shows.
        worlds: in which it acts.
    """

    def __init__(self, actor: Actor, interface: ArmInterface, worlds: BatchEnv) -> None:
        self._actor, self._interface = actor, interface
        self._states: list[np.ndarray] = []
        self._targets: list[np.ndarray] = []
        self._num_joints = worlds.world.robot.num_joints

    def reset(self, worlds: BatchEnv) -> None:
        """Tell the actor that episodes begin."""
        self._actor.reset(worlds)

    def act(self, view: View) -> Float[np.ndarray, "env 7"]:
        """Return the actor's actions."""
        action = self._actor.act(view)
        self._states.append(state_as_seen(view.state, view.worlds, self._interface))
        if self._interface.actions != "delta_tool":
            step = np.clip(action, -1.0, 1.0).astype(np.float32)
            self._targets.append(targets_of(view.worlds, step, self._interface.actions))
        return action

    def columns(self) -> dict[str, Any]:
        """Return fields of `Rollouts`: `state`, and `names` and `targets` where actions are targets."""
        found: dict[str, Any] = {"state": np.stack(self._states)}
        if self._targets:
            found["names"] = action_names(self._interface.actions, self._num_joints)
            found["targets"] = np.stack(self._targets)
        return found


def roll_out(
    lesson: Lesson,
    sim: SimConfig,
    *,
    num_worlds: int,
    seed: int,
    num_threads: int = 1,
    cut: CutConfig,
    interface: ArmInterface = STEPS,
) -> Rollouts:
    """Run one episode in every world until each has succeeded or its time is up."""
    env = BatchEnv(
        lesson.bundle,
        sim,
        num_envs=num_worlds,
        seed=seed,
        num_threads=num_threads,
        task=lesson.task,
    )
    noted = NotedActor(lesson.expert, interface, env)
    recorded = record_rollouts(View(env), noted, cut, seed=seed, referee=lesson.referee)
    return replace(recorded, **noted.columns())


def record_rollouts(
    view: View,
    actor: Actor,
    cut: CutConfig,
    *,
    seed: int,
    horizon: int | None = None,
    referee: Referee | None = None,
) -> Rollouts:
    """Run one episode in every world that is seen, from where the worlds are.

    Args:
        view: of worlds whose episodes begin.
        actor: who acts.
        cut: where an episode ends.
        seed: of the worlds, written down.
        horizon: longest episode, in control steps; by default the task's.
        referee: the independent judge, instead of `task.referee`.
    """
    env, count = view.worlds, view.worlds.num_envs
    params = tuple(env.episode_params(k) for k in range(count))
    film, record = Film(env), RefereeRecord(env)
    ends = EpisodeEnds(count, horizon or env.horizon, cut)
    states, poses, touches = [view.state], [env.object_poses()], [env.touches()]
    actions, successes, rewards = [], [], []

    def note(view: View) -> None:
        states.append(view.state)
        poses.append(env.object_poses())
        touches.append(env.touches())
        actions.append(view.action.astype(np.float32))
        successes.append(view.result.success)
        rewards.append(view.result.reward)

    play(view, actor, [note, film.note, record.note], ends, ends.horizon)
    held = ends.successes
    judge = referee or referee_verdict
    history = record.history_as_cut(ends.num_frames)
    return Rollouts(
        seed=seed,
        state=np.stack(states[:-1]),
        action=np.stack(actions),
        executed=np.stack(actions),
        success=np.stack(successes),
        reward=np.stack(rewards),
        object_pose=np.stack(poses[:-1]),
        touches=np.stack(touches[:-1]),
        snapshots=film.snapshots()[:-1],
        num_frames=ends.num_frames,
        held_at=ends.held_at,
        task_successes=held,
        referee=judge(env.bundle, history) & held if held.any() else held,
        broke=ends.broke,
        params=params,
    )

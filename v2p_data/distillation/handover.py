"""Episodes that a student begins and an expert ends: states that no demonstration shows, labelled by the expert.

In each world the student acts up to a random step, then the expert takes over and finishes. Every frame is labelled
with what the expert would do there, so `action` is the expert's throughout, also where the student acted. Only
episodes that end in success are kept: the expert's labels in hopeless states teach nothing.
"""

from dataclasses import dataclass
from typing import Any, Protocol, runtime_checkable

import numpy as np
from jaxtyping import Bool, Float32, Int, UInt8

from v2p_data.distillation.config import DistillationConfig
from v2p_data.episodes.rollouts import Act, CutConfig, EpisodeEnds, InWorlds
from v2p_data.seeds import rng_for
from v2p_data.sim.batch_env import BatchEnv, SimConfig
from v2p_data.sim.masks import MaskRenderer
from v2p_data.sim.randomize import RandomizationConfig
from v2p_data.sim.verdict import Course
from v2p_data.task.task import TaskBundle


@runtime_checkable
class ActingStudent(Protocol):
    """A policy that sees masks and the robot's state."""

    def reset(self, task: str) -> None:
        """Start episodes of a task, given in words, in all worlds."""
        ...

    def act(
        self, labels: UInt8[np.ndarray, "env h w"], state: Float32[np.ndarray, "env 11"]
    ) -> Float32[np.ndarray, "env 7"]:
        """Return the worlds' next actions."""
        ...


@dataclass(frozen=True, kw_only=True)
class Handovers:
    """One batch of handover episodes. Row `t` precedes action `t`."""

    seed: int
    labels: UInt8[np.ndarray, "time env h w"]
    state: Float32[np.ndarray, "time env 11"]
    action: Float32[np.ndarray, "time env 7"]
    """The expert's, in every frame."""
    taken_over_at: Int[np.ndarray, "env"]
    """First row in which the expert acts."""
    num_frames: Int[np.ndarray, "env"]
    held_at: Int[np.ndarray, "env"]
    task_successes: Bool[np.ndarray, "env"]
    referee: Bool[np.ndarray, "env"]
    broke: Bool[np.ndarray, "env"]
    params: tuple[dict[str, Any], ...]

    @property
    def successes(self) -> Bool[np.ndarray, "env"]:
        return self.task_successes & self.referee


def hand_over(
    bundle: TaskBundle,
    expert: Act | InWorlds,
    student: ActingStudent,
    cfg: DistillationConfig,
    *,
    seed: int,
    size_px: int,
    randomization: RandomizationConfig,
    cut: CutConfig,
    num_threads: int = 1,
) -> Handovers:
    """Run one handover episode in each of `cfg.worlds` worlds.

    Args:
        bundle: the task.
        expert: the deterministic expert, or whoever acts in the worlds themselves.
        student: the policy that begins.
        cfg: when the expert takes over, and how long an episode may last.
        seed: of everything that is drawn.
        size_px: width and height of the label images.
        randomization: what the demonstrations were recorded under.
        cut: where an episode ends.
        num_threads: for physics and masks; changes no result.
    """
    n = cfg.worlds
    env = BatchEnv(
        bundle,
        SimConfig(fine=True, randomization=randomization),
        num_envs=n,
        seed=seed,
        num_threads=num_threads,
    )
    horizon = round(cfg.time_scale * env.horizon)
    earliest, latest = (round(share * env.horizon) for share in cfg.takeover)
    takeover = rng_for(seed, "takeover").integers(earliest, latest + 1, n)
    params = tuple(env.episode_params(k) for k in range(n))
    course = Course(env)
    course.restart()
    acts = expert.begin(env) if isinstance(expert, InWorlds) else expert
    student.reset(bundle.description)
    obs = env.observe()
    labels = np.zeros((n, size_px, size_px), np.uint8)
    pictures = np.empty((horizon, *labels.shape), np.uint8)
    states, actions = [], []
    ends = EpisodeEnds(n, horizon, cut)
    with MaskRenderer(env.world, size_px, num_threads=num_threads) as renderer:
        for t in range(horizon):
            is_going = t < ends.num_frames
            going = np.flatnonzero(is_going)
            snapshot = env.snapshot(going)
            labels[going] = renderer.draw_many([(snapshot, k) for k in range(len(going))])
            state = env.robot_state()
            label = np.clip(np.asarray(acts(obs), np.float32), -1.0, 1.0)
            action = label
            if (is_students := (t < takeover) & is_going).any():
                action = np.where(is_students[:, None], student.act(labels, state), label)
            pictures[t] = labels
            states.append(state)
            actions.append(label)
            result = env.step(action)
            obs = result.obs
            course.note()
            ends.note(t, result)
            if ends.all_over(t):
                break
    return Handovers(
        seed=seed,
        labels=pictures[: len(states)],
        state=np.stack(states),
        action=np.stack(actions),
        taken_over_at=takeover,
        num_frames=ends.num_frames,
        held_at=ends.held_at,
        task_successes=ends.successes,
        referee=course.verdict_as_cut(ends.num_frames) & ends.successes,
        broke=ends.broke,
        params=params,
    )

"""Episodes that a student begins and an expert ends: states that no demonstration shows, labelled by the expert.

In each world the student acts up to a random step, then the expert takes over and finishes. Every frame is labelled
with what the expert would do there, so `action` is the expert's throughout, also where the student acted. Only
episodes that end in success are kept: the expert's labels in hopeless states teach nothing.
"""

from dataclasses import dataclass
from typing import Any

import numpy as np
from jaxtyping import Float32, Int, UInt8

from v2p_data.distillation.config import DistillationConfig
from v2p_data.episodes.config import EpisodesConfig
from v2p_data.episodes.rollouts import Lesson, NotedActor, Rollouts, record_rollouts
from v2p_data.play import Actor, View
from v2p_data.seeds import rng_for
from v2p_data.sim.env.batch_env import BatchEnv, SimConfig


@dataclass(frozen=True, kw_only=True)
class Handovers(Rollouts):
    """One batch of handover episodes. Row `t` precedes action `t`; `action` is the expert's, in every frame."""

    labels: UInt8[np.ndarray, "time env h w"]
    taken_over_at: Int[np.ndarray, "env"]
    """First row in which the expert acts."""


class Handover:
    """An actor that begins and an expert that takes over, each world at a step of its own.

    Args:
        student: acts before the takeover; not asked once no world is its own.
        expert: acts from it on.
        takeover: first control step of the expert, per world.
        pictures: room for what is seen before each action.

    Attributes:
        answers: what the expert would do, at each action.
    """

    def __init__(
        self,
        student: Actor,
        expert: Actor,
        takeover: Int[np.ndarray, "env"],
        pictures: UInt8[np.ndarray, "time env h w"],
    ) -> None:
        self._student, self._expert, self._takeover = student, expert, takeover
        self._pictures = pictures
        self.answers: list[Float32[np.ndarray, "env 7"]] = []

    def reset(self, worlds: BatchEnv) -> None:
        """Tell both that episodes begin."""
        self._student.reset(worlds)
        self._expert.reset(worlds)

    def act(self, view: View) -> Float32[np.ndarray, "env 7"]:
        """Return the actions of whoever acts in each world."""
        self._pictures[view.t] = view.labels
        answer = np.clip(self._expert.act(view), -1.0, 1.0).astype(np.float32)
        self.answers.append(answer)
        is_students = (view.t < self._takeover) & view.going
        if not is_students.any():
            return answer
        return np.where(is_students[:, None], self._student.act(view), answer)


def hand_over(
    lesson: Lesson,
    student: Actor,
    cfg: DistillationConfig,
    episodes: EpisodesConfig,
    *,
    seed: int,
    num_threads: int = 1,
) -> Handovers:
    """Run one handover episode in each of `cfg.worlds` worlds.

    Args:
        lesson: the task and its deterministic expert, or whoever acts in the worlds themselves.
        student: the policy that begins.
        cfg: when the expert takes over, and how long an episode may last.
        episodes: what the demonstrations were recorded under.
        seed: of everything that is drawn.
        num_threads: for physics and masks; changes no result.
    """
    env = BatchEnv(
        lesson.bundle,
        SimConfig(fine=True, randomization=episodes.randomization),
        num_envs=cfg.worlds,
        seed=seed,
        num_threads=num_threads,
        task=lesson.task,
    )
    earliest, latest = (round(share * env.horizon) for share in cfg.takeover)
    takeover = rng_for(seed, "takeover").integers(earliest, latest + 1, cfg.worlds)
    horizon = round(cfg.time_scale * env.horizon)
    size_px, wrist = episodes.size_px, episodes.wrist
    pictures = np.empty((horizon, cfg.worlds, size_px * (1 + wrist), size_px), np.uint8)
    noted = NotedActor(lesson.expert, episodes.interface, env)
    actor = Handover(student, noted, takeover, pictures)
    view = View(env, size_px, num_threads, wrist=wrist)
    recorded = record_rollouts(
        view, actor, episodes.cut, seed=seed, horizon=horizon, referee=lesson.referee
    )
    columns: dict[str, Any] = (
        vars(recorded) | {"action": np.stack(actor.answers)} | noted.columns()
    )
    return Handovers(
        **columns,
        labels=pictures[: len(actor.answers)],
        taken_over_at=takeover,
    )

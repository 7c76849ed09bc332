"""How well something does a task in the twin, from the starts that the training simulator's judge uses.

Episode k starts from `first_seed + k` in both (`evaluation.batch.judge`), so the rates are paired seed by seed. A policy
sees true masks of the twin's camera here; masks tracked in its pictures are the deployment loop's. Experts and programs
see the twin's truth. All of it is sim-to-sim: no real arm was asked.
"""

import time
from collections import Counter
from collections.abc import Callable, Sequence
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass
from multiprocessing import get_context
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Bool, Float, Int, UInt8

from v2p_data.errors import V2PError
from v2p_data.evaluation.actors import Actor, WorldActor
from v2p_data.evaluation.batch import NEVER
from v2p_data.evaluation.config import EvaluationConfig
from v2p_data.evaluation.failures import failure_kinds
from v2p_data.sim.robot.gripper_wait import GripperWait
from v2p_data.task.task import TaskBundle
from v2p_data.twin.arm import TwinArm
from v2p_data.twin.parameters import TwinParameters

Load = Callable[[TaskBundle], tuple[Actor | WorldActor, int | tuple[int, int]]]
"""From a task to who acts in it, and the size of the pictures that it sees [px]."""


Look = Callable[[TwinArm], Callable[[], UInt8[np.ndarray, "h w"]]]
"""From a twin to what gives the label image of now; `deployment.view` has one that allows for the camera's place."""


def true_labels(arm: TwinArm) -> Callable[[], UInt8[np.ndarray, "h w"]]:
    """Return the true labels as the twin's camera sees them."""
    return arm.robot.true_labels


@dataclass(frozen=True, kw_only=True)
class Played:
    """What became of one episode."""

    seed: int
    success_step: int
    """The control step that led to the first success, from 0; `NEVER` where there was none."""
    at_end: bool
    """Success at the last step."""
    broke: bool
    failure: str
    """Kind of failure; empty where the episode succeeded once."""
    seconds: float


@dataclass(frozen=True, kw_only=True)
class TwinJudged:
    """What became of the episodes of one task, in the order of their seeds."""

    episodes: tuple[Played, ...]

    @property
    def success_step(self) -> Int[np.ndarray, "episode"]:
        return np.array([e.success_step for e in self.episodes])

    @property
    def successes(self) -> Bool[np.ndarray, "episode"]:
        """Which episodes succeeded at some time."""
        return self.success_step != NEVER

    @property
    def at_end(self) -> Bool[np.ndarray, "episode"]:
        """Which episodes were a success at their last step."""
        return np.array([e.at_end for e in self.episodes])

    def failure_counts(self) -> dict[str, int]:
        """Return how many episodes failed in which way, in the order of the names."""
        counts = Counter(e.failure for e in self.episodes if e.failure)
        return dict(sorted(counts.items()))


def play(
    arm: TwinArm,
    actor: Actor | WorldActor,
    seed: int,
    steps: int,
    *,
    at_end: bool,
    labels: Callable[[], UInt8[np.ndarray, "h w"]] | None = None,
    waits: bool = False,
) -> Played:
    """Play one episode of at most `steps` control steps; without `at_end` it is over with its first success.

    Args:
        arm: the twin.
        actor: who acts.
        seed: of the episode.
        steps: the most.
        at_end: go on after a success.
        labels: what a policy sees; by default the true labels of the twin's camera.
        waits: the arm waits while the gripper travels.

    Raises:
        V2PError: an action is not finite or has another shape.
    """
    start = time.perf_counter()
    bundle = arm.mirror.bundle
    labels = labels or true_labels(arm)
    arm.reset(seed)
    if isinstance(actor, Actor):
        actor.reset(1)
    else:
        actor.begin(arm.mirror.env)
    wait = GripperWait() if waits else None
    success_step, last, broke = NEVER, False, False
    for t in range(steps):
        action = _action(actor, arm, labels)
        if wait is not None:
            action = wait.held(action, arm.tool.opening, arm.target.opening)
        outcome = arm.act(action)
        broke = outcome.is_broken
        if broke:
            break
        if outcome.is_held and (success_step == NEVER or t + 1 == steps) and arm.mirror.verdict():
            success_step = t if success_step == NEVER else success_step
            last = t + 1 == steps
            if not at_end:
                break
    failure = ""
    if success_step == NEVER:
        failure = failure_kinds(bundle, arm.mirror.referee.history(), np.array([broke]))[0]
    return Played(
        seed=seed,
        success_step=success_step,
        at_end=last,
        broke=broke,
        failure=failure,
        seconds=time.perf_counter() - start,
    )


def judge_in_twin(
    task_folder: Path,
    load: Load,
    *,
    seeds: Sequence[int],
    cfg: EvaluationConfig,
    parameters: TwinParameters | None = None,
    workers: int = 1,
    look: Look = true_labels,
    waits: bool = False,
) -> TwinJudged:
    """Play one episode per seed.

    Args:
        task_folder: the task.
        load: makes who acts; called once per worker, and picklable where there is more than one.
        seeds: of the episodes.
        cfg: how long they last and whether they go on after a success.
        parameters: of the twin; by default the nominal one.
        workers: processes that share out the episodes; changes no result.
        look: how a policy sees the twin; picklable.
        waits: the arm waits while the gripper travels, as in `v2p deploy`.

    Raises:
        V2PError: the folder holds no task, or the actor does not suit the twin.
    """
    settings = (task_folder, load, cfg, parameters, look, waits)
    if workers == 1:
        table = _Table(*settings)
        try:
            return TwinJudged(episodes=tuple(table.play(seed) for seed in seeds))
        finally:
            table.arm.close()
    with ProcessPoolExecutor(
        workers, mp_context=get_context("spawn"), initializer=_sit_down, initargs=settings
    ) as pool:
        return TwinJudged(episodes=tuple(pool.map(_play_here, seeds)))


class _Table:
    """A twin and who acts in it."""

    def __init__(
        self,
        task_folder: Path,
        load: Load,
        cfg: EvaluationConfig,
        parameters: TwinParameters | None,
        look: Look,
        waits: bool,
    ) -> None:
        bundle = TaskBundle.load(task_folder)
        self.actor, size_px = load(bundle)
        height, width = (size_px, size_px) if isinstance(size_px, int) else size_px
        if height != width:
            raise V2PError(
                f"the policy sees pictures of {height} x {width} px; the twin's rectified pictures are square"
            )
        self.cfg = cfg
        self.steps = bundle.policy_steps(cfg.horizon_scale)
        self.arm = TwinArm(bundle, parameters, height)
        self.labels = look(self.arm)
        self.waits = waits

    def play(self, seed: int) -> Played:
        return play(
            self.arm, self.actor, seed, self.steps, at_end=self.cfg.at_end, labels=self.labels,
            waits=self.waits,
        )  # fmt: skip


_table: _Table | None = None
"""Of this worker process."""


def _sit_down(*settings: Any) -> None:
    global _table
    import torch

    torch.set_num_threads(1)
    _table = _Table(*settings)


def _play_here(seed: int) -> Played:
    assert _table is not None, "the initializer comes first"
    return _table.play(seed)


def _action(
    actor: Actor | WorldActor, arm: TwinArm, labels: Callable[[], UInt8[np.ndarray, "h w"]]
) -> Float[np.ndarray, "7"]:
    if isinstance(actor, Actor):
        actions = actor.act(labels()[None], arm.state()[None])
    else:
        actions = actor.act_in(arm.mirror.env)
    action = np.asarray(actions, float)
    if action.shape != (1, 7) or not np.isfinite(action).all():
        raise V2PError(
            f"the actor's action in task '{arm.mirror.bundle.title}' must be 7 finite numbers for one world, got"
            f" {np.array2string(action, precision=3)}"
        )
    return action[0]

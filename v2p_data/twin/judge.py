"""How well something does a task in the twin, from the starts that the training simulator's judge uses.

Episode k starts from `first_seed + k` in both (`evaluation.batch.judge`), so the rates are paired
seed by seed. A policy sees true masks of the twin's camera here; masks tracked in its pictures are
the deployment loop's. Experts and programs see the twin's truth. All of it is sim-to-sim: no real
arm was asked.
"""

from collections.abc import Callable, Sequence
from concurrent.futures import ProcessPoolExecutor
from contextlib import closing
from dataclasses import dataclass
from itertools import repeat
from multiprocessing import get_context
from pathlib import Path
from typing import Any

import numpy as np
import torch
from jaxtyping import Bool, Float, Float32, Int, UInt8

from v2p_data.errors import V2PError
from v2p_data.evaluation.batch import NEVER, Verdicts
from v2p_data.evaluation.config import EvaluationConfig
from v2p_data.play import Actor, View, play
from v2p_data.sim.env.batch_env import StepResult
from v2p_data.sim.robot.gripper_wait import GripperWait
from v2p_data.task.task import TaskBundle
from v2p_data.twin.arm import TwinArm
from v2p_data.twin.parameters import TwinParameters

Load = Callable[[TaskBundle], tuple[Actor, int | tuple[int, int]]]
"""From a task to who acts in it, and the size of the pictures that it sees [px]."""


Look = Callable[[TwinArm], Callable[[], UInt8[np.ndarray, "h w"]]]
"""From a twin to what gives the label image of now; `deployment.view` has one that allows for the camera's place."""


def true_labels(arm: TwinArm) -> Callable[[], UInt8[np.ndarray, "h w"]]:
    """Return the true labels as the twin's camera sees them."""
    return arm.robot.true_labels


@dataclass(frozen=True, kw_only=True)
class TwinSetup:
    """Parameters of the twin, what its camera shows to the policy, and how its gripper delays the arm."""

    parameters: TwinParameters | None = None
    """Of the twin; by default the nominal one."""
    look: Look = true_labels
    """How a policy sees the twin; picklable."""
    waits: bool = False
    """The arm waits while the gripper travels, as in `v2p deploy`."""


@dataclass(frozen=True, kw_only=True)
class TwinJudged:
    """What became of the episodes of one task, in the order of their seeds."""

    success_step: Int[np.ndarray, "episode"]
    """The control step that led to the first success, from 0; `NEVER` where there was none."""
    at_end: Bool[np.ndarray, "episode"]
    """Success at the last step."""
    failures: tuple[str, ...]
    """Kind of failure; empty where the episode succeeded once."""

    @property
    def successes(self) -> Bool[np.ndarray, "episode"]:
        """Which episodes succeeded at some time."""
        return self.success_step != NEVER


class TwinView(View):
    """What can be seen of an episode in the twin: the robot's own readings, and labels that its camera gives.

    Args:
        arm: the twin, at the start of an episode.
        look: gives the label image of now.
        waits: the arm waits while the gripper travels.
    """

    def __init__(
        self, arm: TwinArm, look: Callable[[], UInt8[np.ndarray, "h w"]], *, waits: bool
    ) -> None:
        super().__init__(arm.mirror)
        self._arm, self._look = arm, look
        self._wait = GripperWait() if waits else None

    @property
    def state(self) -> Float32[np.ndarray, "1 11"]:
        """The robot's state, from joint readings."""
        return self._arm.state()[None]

    @property
    def labels(self) -> UInt8[np.ndarray, "1 h w"]:
        """The label picture."""
        return self._look()[None]

    @property
    def rgb(self) -> UInt8[np.ndarray, "1 h w 3"]:
        """What the twin's camera gives."""
        return self._arm.picture()[None]

    def step(self, action: Float[np.ndarray, "1 7"]) -> StepResult:
        """Let the twin carry out an action; return what the mirror says of it."""
        arm, wanted = self._arm, action[0].astype(float)
        if self._wait is not None:
            wanted = self._wait.held(wanted, arm.tool.opening, arm.target.opening)
        return arm.act(wanted)


def judge_in_twin(
    task_folder: Path,
    load: Load,
    *,
    seeds: Sequence[int],
    cfg: EvaluationConfig,
    setup: TwinSetup | None = None,
    workers: int = 1,
) -> TwinJudged:
    """Play one episode per seed.

    Args:
        task_folder: the task.
        load: makes who acts; called once per worker, and picklable where there is more than one.
        seeds: of the episodes.
        cfg: how long they last and whether they go on after a success.
        setup: the twin; by default the nominal one, whose true labels are seen.
        workers: processes that share out the episodes; changes no result.

    Raises:
        V2PError: the folder holds no task, or the actor does not suit the twin.
    """
    settings = (task_folder, load, cfg, setup or TwinSetup())
    if workers == 1:
        episodes = _played(seeds, *settings)
    else:
        shares = [share.tolist() for share in np.array_split(seeds, workers)]
        with ProcessPoolExecutor(workers, mp_context=get_context("spawn")) as pool:
            played = pool.map(_played_apart, shares, *map(repeat, settings))
            episodes = [episode for share in played for episode in share]
    success_step, at_end, failures = zip(*episodes, strict=True)
    return TwinJudged(
        success_step=np.array(success_step), at_end=np.array(at_end), failures=failures
    )


def _played(
    seeds: Sequence[int], task_folder: Path, load: Load, cfg: EvaluationConfig, setup: TwinSetup
) -> list[tuple[int, bool, str]]:
    """Play one episode per seed; return for each the step of the first success, success at the end, and the failure."""
    bundle = TaskBundle.load(task_folder)
    actor, size_px = load(bundle)
    height, width = (size_px, size_px) if isinstance(size_px, int) else size_px
    if height != width:
        raise V2PError(
            f"the policy sees pictures of {height} x {width} px; the twin's rectified pictures are square"
        )
    steps = bundle.policy_steps(cfg.horizon_scale)
    episodes = []
    with closing(TwinArm(bundle, setup.parameters, height)) as arm:
        look = setup.look(arm)
        for seed in seeds:
            arm.reset(seed)
            verdicts = Verdicts(arm.mirror.referee, 1, steps, at_end=cfg.at_end)
            play(TwinView(arm, look, waits=setup.waits), actor, (), verdicts, steps)
            (failure,) = verdicts.failures(bundle)
            episodes.append((int(verdicts.success_step[0]), bool(verdicts.at_end[0]), failure))
    return episodes


def _played_apart(*settings: Any) -> list[tuple[int, bool, str]]:
    """Play in a process of its own, on one core."""
    torch.set_num_threads(1)
    return _played(*settings)

"""Who may act in an evaluation: a policy that sees masks, or someone who sees the simulator's own states.

Experts and scripted programs are of the second kind: the same judge then says what a policy could reach at best.
"""

from collections.abc import Callable
from typing import Protocol, runtime_checkable

import numpy as np
from jaxtyping import Float, Float32, UInt8

from v2p_data.errors import V2PError
from v2p_data.experts.teacher import Teacher
from v2p_data.seeds import seed_for
from v2p_data.sim.batch_env import BatchEnv, SimConfig

TRIAL_WORLDS = 64
"""Episodes in which each scripted program is tried before one is chosen."""


@runtime_checkable
class Actor(Protocol):
    """A policy: what it sees of `n` worlds at a time is pictures of labels and the robot's state."""

    def reset(self, n: int) -> None:
        """Forget the last episodes; `n` new ones begin."""
        ...

    def act(
        self, labels: UInt8[np.ndarray, "n h w"], state: Float32[np.ndarray, "n 11"]
    ) -> Float32[np.ndarray, "n 7"]:
        """Return the next action of every world; the environment clips it to [-1, 1]."""
        ...


@runtime_checkable
class WorldActor(Protocol):
    """Someone who sees the simulator's states; no picture is drawn for it."""

    def begin(self, env: BatchEnv) -> None:
        """Episodes begin in all worlds of `env`."""
        ...

    def act_in(self, env: BatchEnv) -> Float[np.ndarray, "env 7"]:
        """Return the next action of every world."""
        ...


class ExpertActor:
    """An expert on simulator states.

    Args:
        act: from the task's observation to actions.
        obs_dim: length of the observation that it knows.
    """

    def __init__(
        self,
        act: Callable[[Float32[np.ndarray, "env obs"]], Float32[np.ndarray, "env 7"]],
        obs_dim: int,
    ) -> None:
        self._act = act
        self._obs_dim = obs_dim

    def begin(self, env: BatchEnv) -> None:
        """Demand that the worlds' observation is the one that the expert knows.

        Raises:
            V2PError: the task's observation is not the expert's.
        """
        if env.obs_dim != self._obs_dim:
            raise V2PError(
                f"the expert knows observations of length {self._obs_dim}, and task '{env.bundle.title}' makes ones of"
                f" length {env.obs_dim}: it is another task's expert"
            )

    def act_in(self, env: BatchEnv) -> Float32[np.ndarray, "env 7"]:
        """Return the expert's actions."""
        return self._act(env.observe())


class ProgramActor:
    """The scripted program that does the task best, chosen by trials at the coarse time step.

    Args:
        seed: of the trials.
        name: of the program, where it is known already.
    """

    def __init__(self, seed: int, name: str = "") -> None:
        self._seed = seed
        self._teacher: Teacher | None = None
        self.name = name
        """Of the program."""

    def begin(self, env: BatchEnv) -> None:
        """Choose a program, at the first call."""
        self._teacher = Teacher(env)
        if not self.name:
            trials = BatchEnv(
                env.bundle,
                SimConfig(),
                num_envs=TRIAL_WORLDS,
                seed=seed_for(self._seed, "program-trials"),
                num_threads=1,
            )
            self.name = self._teacher.choose(trials).name
        self._teacher.name = self.name

    def act_in(self, env: BatchEnv) -> Float[np.ndarray, "env 7"]:
        """Return the program's actions."""
        del env  # the teacher's own
        assert self._teacher is not None, "begin comes first"
        return self._teacher.act()

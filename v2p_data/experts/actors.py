"""A scripted program in the place of a policy: the same judge then says what a policy could reach at best."""

import numpy as np
from jaxtyping import Float

from v2p_data.errors import V2PError
from v2p_data.experts.teacher import Teacher
from v2p_data.play import View
from v2p_data.seeds import seed_for
from v2p_data.sim.env.batch_env import BatchEnv, SimConfig

TRIAL_WORLDS = 64
"""Episodes in which each scripted program is tried before one is chosen."""


class ProgramActor:
    """The scripted program that does the task best, chosen by trials at the coarse time step.

    Args:
        seed: of the trials.
        name: of the program, where it is chosen already.
    """

    def __init__(self, seed: int, name: str = "") -> None:
        self._seed, self.name = seed, name
        self._teacher: Teacher | None = None

    def reset(self, worlds: BatchEnv) -> None:
        """Choose a program, at the first call.

        Raises:
            V2PError: the task has no program of this name.
        """
        self._teacher = Teacher(worlds)
        if not self.name:
            trials = BatchEnv(
                worlds.bundle,
                SimConfig(),
                num_envs=TRIAL_WORLDS,
                seed=seed_for(self._seed, "program-trials"),
                num_threads=1,
            )
            self.name = self._teacher.choose(trials).name
        if self.name not in self._teacher.programs:
            raise V2PError(
                f"the expert is the program '{self.name}', and task '{worlds.bundle.title}' has "
                f"{', '.join(self._teacher.programs)}; make the expert anew"
            )
        self._teacher.name = self.name

    def act(self, view: View) -> Float[np.ndarray, "env 7"]:
        """Return the program's actions."""
        del view  # the teacher's own
        assert self._teacher is not None, "reset comes first"
        return self._teacher.act()

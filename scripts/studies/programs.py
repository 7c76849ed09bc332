"""Code-as-Policies with our primitives: a scripted program per world, chosen anew every 50 control steps.

A language model would write the program from the caption and the states; offline, the choice is
between the programs that a scene offers (`experts.teacher`). Those that the caption names come
first. At each choice a world keeps its program where the object has moved since the last one or
the task's success holds, and takes the next program otherwise. In between the program sees the
robot and the objects at every step, as the paper's closed-loop baseline does.
"""

import numpy as np
from jaxtyping import Float, Float32

from v2p_data.experts.teacher import Teacher
from v2p_data.kinds import KINDS
from v2p_data.play import View
from v2p_data.sim.env.batch_env import BatchEnv

EVERY_STEPS = 50
"""The paper's number."""
MOVED_M = 0.01
"""A program that moves the object less than this within `EVERY_STEPS` leads nowhere."""


class ProgramPolicy:
    """An actor: programs for worlds whose episodes start together."""

    def reset(self, worlds: BatchEnv) -> None:
        """Begin new episodes with the program that the caption names."""
        self.env, self.teacher = worlds, Teacher(worlds)
        meant = KINDS[worlds.bundle.kind].programs
        self.names = sorted(self.teacher.programs, key=lambda name: not name.startswith(meant))
        self.step = 0
        self.chosen = np.zeros(worlds.num_envs, np.int64)
        self.seen = self._object_pos()

    def act(self, view: View) -> Float32[np.ndarray, "env 7"]:
        """Return the programs' actions for the worlds as they are, as precise as they are recorded."""
        del view  # the teacher's own
        if self.step and self.step % EVERY_STEPS == 0:
            self._choose()
        self.step += 1
        moment = self.teacher.moment()
        actions = np.zeros((self.env.num_envs, self.env.act_dim), np.float32)
        for k in np.unique(self.chosen):
            rows = self.chosen == k
            actions[rows] = self.teacher.programs[self.names[k]](moment)[rows]
        return actions

    def _choose(self) -> None:
        now = self._object_pos()
        is_stuck = np.linalg.norm(now - self.seen, axis=1) < MOVED_M
        success = self.env.task.succeeds(self.env.task_states).numpy()
        self.chosen = np.where(is_stuck & ~success, self.chosen + 1, self.chosen)
        self.chosen %= len(self.names)
        self.seen = now

    def _object_pos(self) -> Float[np.ndarray, "env 3"]:
        name = self.env.bundle.scene.manipulated.name
        return self.env.states()[f"{name}_pos"].numpy().astype(float)

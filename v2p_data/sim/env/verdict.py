"""The independent referee on episodes that a `BatchEnv` is running: what happened so far, and is it success?"""

from collections.abc import Mapping

import numpy as np
from jaxtyping import Bool, Int

from v2p_data.sim.env.batch_env import BatchEnv
from v2p_data.task.referee import ObjectTrack, Trajectory, referee_success
from v2p_data.task.task import TaskBundle

GRIPPER_KEYS = ("eef_pos", "gripper_width")
TOUCH_KEYS = ("by_arm", "touched", "grasped")


def referee_verdict(
    bundle: TaskBundle, history: Mapping[str, np.ndarray]
) -> Bool[np.ndarray, "env"]:
    """Return what the referee says of episodes, given per key of `states` an array `(time, env, ...)`."""
    objects = {
        obj.name: ObjectTrack(
            pos=history[f"{obj.name}_pos"].astype(float),
            quat_wxyz=history[f"{obj.name}_quat"].astype(float),
            size_m=history[f"{obj.name}_size"][0].astype(float),
            **{key: history[f"{obj.name}_{key}"] > 0 for key in TOUCH_KEYS},
        )
        for obj in bundle.scene.objects
    }
    trajectory = Trajectory(
        objects=objects,
        eef_pos=history["eef_pos"].astype(float),
        opening_m=history["gripper_width"].astype(float),
    )
    return referee_success(bundle.kind, bundle.scene, trajectory)


class RefereeRecord:
    """What the referee is shown of all worlds of an environment, from the start of their episodes.

    Args:
        env: the worlds; their present moment is noted as the start.
    """

    def __init__(self, env: BatchEnv) -> None:
        self._env = env
        self._keys = [*GRIPPER_KEYS] + [
            f"{name}_{key}"
            for name in env.object_names
            for key in ("pos", "quat", "size", "touched", "grasped")
        ]
        self.restart()

    def restart(self) -> None:
        """Forget everything and note the start of new episodes; call after a reset."""
        self._moments: list[dict[str, np.ndarray]] = []
        self.note()

    def note(self, _: object = None) -> None:
        """Note the present moment; call after each step, or let `play` call it."""
        states = self._env.states()
        moment = {key: states[key].numpy().astype(float) for key in self._keys}
        by_arm = self._env.arm_touches()
        for k, name in enumerate(self._env.object_names):
            moment[f"{name}_by_arm"] = by_arm[:, k]
        self._moments.append(moment)

    def __len__(self) -> int:
        """Return the number of moments so far."""
        return len(self._moments)

    def history(self, worlds: Int[np.ndarray, "n"] | slice = slice(None)) -> dict[str, np.ndarray]:
        """Return the states of some worlds up to now, per key an array `(time, world, ...)`."""
        return {key: np.stack([m[key][worlds] for m in self._moments]) for key in self._moments[0]}

    def history_as_cut(self, end: Int[np.ndarray, "env"]) -> dict[str, np.ndarray]:
        """Return the history in which each world stands still from the step `end` on."""
        time = np.minimum(np.arange(len(self))[:, None], end[None])
        return {key: array[time, np.arange(len(end))] for key, array in self.history().items()}

    def verdict(self, worlds: Int[np.ndarray, "n"] | slice = slice(None)) -> Bool[np.ndarray, "n"]:
        """Return what the referee says of the episodes of some worlds so far."""
        return referee_verdict(self._env.bundle, self.history(worlds))

"""The independent referee on episodes that a `BatchEnv` is running: what happened so far, and is it success?"""

from collections.abc import Mapping, Sequence

import numpy as np
from jaxtyping import Bool, Int

from v2p_data.sim.batch_env import BatchEnv
from v2p_data.task.referee import ObjectTrack, Trajectory, referee_success
from v2p_data.task.task import TaskBundle


def referee_verdict(
    bundle: TaskBundle, course: Mapping[str, np.ndarray]
) -> Bool[np.ndarray, "env"]:
    """Return what the referee says of episodes, given per key of `states` an array `(time, env, ...)`."""
    objects = {
        obj.name: ObjectTrack(
            pos=course[f"{obj.name}_pos"].astype(float),
            quat_wxyz=course[f"{obj.name}_quat"].astype(float),
            size_m=course[f"{obj.name}_size"][0].astype(float),
            # "any pad" and "both pads" stand for the two pads: all rules ask for one or the other.
            touched=np.stack(
                [course[f"{obj.name}_{key}"] > 0 for key in ("touched", "grasped")], axis=-1
            ),
        )
        for obj in bundle.scene.objects
    }
    trajectory = Trajectory(objects=objects, eef_pos=course["eef_pos"].astype(float))
    return referee_success(bundle.kind, bundle.scene, trajectory)


def as_cut(
    moments: Sequence[Mapping[str, np.ndarray]], end: Int[np.ndarray, "env"]
) -> dict[str, np.ndarray]:
    """Return the moments stacked, each world standing still from its episode's end on."""
    time = np.minimum(np.arange(len(moments))[:, None], end[None])
    worlds = np.arange(len(end))
    return {key: np.stack([m[key] for m in moments])[time, worlds] for key in moments[0]}


def course_keys(env: BatchEnv) -> list[str]:
    """Return the states that `referee_verdict` looks at."""
    return ["eef_pos"] + [
        f"{name}_{key}"
        for name in env.object_names
        for key in ("pos", "quat", "size", "touched", "grasped")
    ]


class Witness:
    """Remembers the courses of all worlds of an environment, which start and end together."""

    def __init__(self, env: BatchEnv) -> None:
        self.env = env
        self.moments: list[dict[str, np.ndarray]] = []

    def restart(self) -> None:
        """Forget everything and note the start of new episodes; call after a reset."""
        self.moments = []
        self.note()

    def note(self) -> None:
        """Note the present moment; call after each step."""
        states = self.env.states()
        self.moments.append(
            {key: states[key].numpy().astype(float) for key in course_keys(self.env)}
        )

    def verdict_as_cut(self, end: Int[np.ndarray, "env"]) -> Bool[np.ndarray, "env"]:
        """Return what the referee says of episodes of `end` steps each; see `as_cut`."""
        return referee_verdict(self.env.bundle, as_cut(self.moments, end))

    def verdict(self) -> Bool[np.ndarray, "env"]:
        """Return what the referee says of the episodes so far."""
        course = {key: np.stack([m[key] for m in self.moments]) for key in self.moments[0]}
        return referee_verdict(self.env.bundle, course)

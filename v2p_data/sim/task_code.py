"""What an environment does with its task's code, on whichever machine it simulates."""

import torch
from jaxtyping import Float

from v2p_data.errors import V2PError
from v2p_data.task.task import Placer, Task, TaskBundle


def load(bundle: TaskBundle, worlds: Placer, task: type[Task] | None) -> Task:
    """Return the bundle's task over some worlds, or `task` instead of its code.

    Raises:
        V2PError: the code comes from a folder and fails its trial, or does not load.
    """
    if task is not None:
        return task(worlds, str(bundle.scene.folder), {})
    from v2p_data.task.sandbox import load_task
    from v2p_data.task.trial import demand_trial

    demand_trial(bundle)
    return load_task(bundle.code, envs=worlds, scene=bundle.scene)


def observation(task: Task, states: dict[str, torch.Tensor]) -> Float[torch.Tensor, "env obs"]:
    """Return the columns that the task's code observes; a single one is the state itself, not a copy."""
    columns = [states[key] for key in task.compute_observation_key(states)]
    parts = [c if c.ndim == 2 else c[:, None] for c in columns]
    return parts[0] if len(parts) == 1 else torch.cat(parts, dim=1)


def checked_obs_dim(task: Task, title: str, made: int) -> int:
    """Return the observation's length.

    Raises:
        V2PError: the task's code says another one than the `made` one.
    """
    said = int(task.get_observation_space())
    if made != said:
        raise V2PError(
            f"task '{title}' makes observations of length {made} but says {said}; "
            "correct get_observation_space or compute_observation_key in its task.py"
        )
    return said


def component_names(
    task: Task, idle: Float[torch.Tensor, "env act"], states: dict[str, torch.Tensor]
) -> tuple[str, ...]:
    """Return the names of the reward's parts, asked with the action `idle`."""
    task.compute_observation_key(states)  # a reward may use what the observation adds
    _, parts = task.compute_reward(idle, states)
    return tuple(parts)

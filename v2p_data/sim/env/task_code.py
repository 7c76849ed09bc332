"""What an environment does with its task's code, on whichever machine it simulates."""

from v2p_data.errors import V2PError
from v2p_data.task.sandbox.guarded import GuardedTask
from v2p_data.task.task import Placer, Task, TaskBundle


def load(bundle: TaskBundle, worlds: Placer, task: type[Task] | None) -> GuardedTask:
    """Return the bundle's task over some worlds, or `task` instead of its code.

    Raises:
        V2PError: the code comes from a folder and fails its trial, or does not load.
    """
    if task is not None:
        return GuardedTask(task(worlds, str(bundle.scene.folder), {}), title=bundle.title)
    from v2p_data.task.sandbox.sandbox import load_task
    from v2p_data.task.sandbox.trial import demand_trial

    demand_trial(bundle)
    return load_task(bundle.code, worlds, bundle.scene, bundle.title)


def checked_obs_dim(task: GuardedTask, title: str, made: int) -> int:
    """Return the observation's length.

    Raises:
        V2PError: the task's code says another one than the `made` one.
    """
    said = task.observation_size()
    if made != said:
        raise V2PError(
            f"task '{title}' makes observations of length {made} but says {said}; "
            "correct get_observation_space or compute_observation_key in its task.py"
        )
    return said

"""A task whose code may be wrong or hostile: what it is given is its own to keep, what it answers is checked.

Success is judged by the simulator's state, so task code gets copies of that state and never the memory itself. The
reward comes from a second copy of the task, made from the same code, which shares no object with the one that judges.
Every answer is checked for type, shape and number format, at every call. Now and then a question is asked twice.

What the observation adds to `states` may be used by success and reward (as in the paper's figure 8), so the
observation is always made first.
"""

import contextlib
import functools
import re
import secrets
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from typing import Any, Concatenate

import torch
from jaxtyping import Bool, Float, Int

from v2p_data.errors import V2PError
from v2p_data.task.sandbox.source_text import shown
from v2p_data.task.sandbox.time_limit import (
    TaskCallError,
    in_time,
    line_in_task_code,
    method_in_task_code,
)
from v2p_data.task.task import Placer, Task

States = dict[str, torch.Tensor]
Show = Callable[[], States]
"""Gives fresh copies of the states, in memory that nothing is judged by."""

MAX_COMPONENTS = 32
MAX_OBSERVATION = 4096
"""Numbers of one world; the robot's own are 90. More would fill the memory of training, not teach it."""
COMPONENT_NAME = re.compile(r"[A-Za-z_][A-Za-z0-9_]{0,39}")
"""A component's name becomes a column of a table and text of a page."""
ASKED_TWICE_ONCE_IN = 500
"""Calls of `judge`, on average, until one is asked twice."""
UNIT_TOLERANCE = 1e-3
"""How far the length of a reset pose's quaternion may be from 1."""


class TaskOutputError(V2PError):
    """Task code answers what it may not answer."""


class StatesChangedError(TaskOutputError):
    """Task code has written into what it was only shown."""


@dataclass(frozen=True, kw_only=True)
class Answers:
    """What a task says of one moment, per environment."""

    observation: torch.Tensor
    """`(env, obs)`, float; may share memory with the states that the task was shown."""
    success: torch.Tensor
    """`(env,)`, bool."""
    reward: torch.Tensor
    """`(env,)`, float32."""
    components: dict[str, torch.Tensor]
    """Each `(env,)`."""

    def named(self) -> dict[str, torch.Tensor]:
        """Return all of them by a name for messages."""
        parts = {f"reward component '{name}'": part for name, part in self.components.items()}
        return {
            "the observation": self.observation,
            "compute_success": self.success,
            "the reward": self.reward,
        } | parts

    def cloned(self) -> "Answers":
        """Return copies that later calls of the task cannot change."""
        return Answers(
            observation=self.observation.clone(),
            success=self.success.clone(),
            reward=self.reward.clone(),
            components={name: part.clone() for name, part in self.components.items()},
        )

    def check_finite(self, sound: Bool[torch.Tensor, "env"] | None = None) -> None:
        """Demand finite numbers.

        Args:
            sound: environments to look at, all by default. A simulation that broke down has no finite state.

        Raises:
            TaskOutputError: names the answer and the first environment.
        """
        for what, value in self.named().items():
            finite = value.isfinite()
            if bool(finite.all()):
                continue
            bad = ~(finite if finite.ndim == 1 else finite.all(1))
            if sound is not None:
                bad = bad & sound
            if bool(bad.any()):
                env = int(bad.nonzero()[0])
                raise TaskOutputError(f"{what} is not finite in environment {env}")


class PlacerView:
    """The two things of the environment that task code may use. Poses are drawn during a reset only.

    Args:
        envs: the environment.
    """

    __slots__ = ("_again", "_drawn", "_envs", "_ids")

    def __init__(self, envs: Placer) -> None:
        self._envs = envs
        self._ids: torch.Tensor | None = None
        self._drawn: list[dict[str, torch.Tensor]] = []
        self._again: Iterator[dict[str, torch.Tensor]] | None = None

    @property
    def num_envs(self) -> int:
        return self._envs.num_envs

    def sample_object_poses(self, env_ids: torch.Tensor) -> dict[str, torch.Tensor]:
        """Return copies of the poses that the environment draws.

        Raises:
            TaskOutputError: no reset is under way, or it is one of other environments.
        """
        if self._ids is None:
            raise TaskOutputError(
                "sample_object_poses may be called in reset_objects_states only: it draws from the world's random"
                " numbers"
            )
        if not isinstance(env_ids, torch.Tensor) or not torch.equal(env_ids, self._ids):
            raise TaskOutputError("sample_object_poses must be given the env_ids of the reset")
        if self._again is None:
            self._drawn.append(self._envs.sample_object_poses(self._ids.clone()))
        poses = self._drawn[-1] if self._again is None else next(self._again, None)
        if poses is None:
            raise TaskOutputError("reset_objects_states draws poses that depend on its reward")
        return {name: pose.clone() for name, pose in poses.items()}

    @contextlib.contextmanager
    def during_reset(
        self, env_ids: torch.Tensor, like: "PlacerView | None" = None
    ) -> Iterator[None]:
        """Let poses be drawn for these environments; the same ones, in turn, that another view drew last."""
        self._ids, self._drawn = env_ids, []
        self._again = iter(like._drawn) if like else None
        try:
            yield
        finally:
            self._ids = None


def _guarded[**P, T](
    question: Callable[Concatenate["GuardedTask", P], T],
) -> Callable[Concatenate["GuardedTask", P], T]:
    """Let a question to a task end in time, with a result or an error of ours that names the task."""

    @functools.wraps(question)
    def ask(self: "GuardedTask", *args: P.args, **kwargs: P.kwargs) -> T:
        asked = functools.partial(question, self, *args, **kwargs)
        try:
            return in_time(asked) if self._is_limited else asked()
        except TaskOutputError as error:
            if not self._title:
                raise
            raise type(error)(f"task '{self._title}': {error}") from error
        except (V2PError, MemoryError):
            raise
        except Exception as error:
            if not self._is_limited:
                raise
            line, method = line_in_task_code(error), method_in_task_code(error)
            where = f"line {line} of the task's code, {method}," if line else "the task's code"
            words = " ".join(str(error).split())[:300]
            raise TaskCallError(
                f"{where} raises {type(error).__name__}: {words}; correct it in its task.py"
            ) from error

    return ask


class GuardedTask:
    """A task and the checks on all that it answers.

    Args:
        task: the task; nothing else may call its methods.
        view: what the task knows of the environment; None for a task of our own that knows the environment itself.
        title: for messages.
        rewarder: a second copy of the task that shares no object with the first, and its view. It gives the reward
            and nothing else. None: a task of our own gives its reward itself.
        is_limited: end calls that take too long, and say in one sentence what they raise.
    """

    def __init__(
        self,
        task: Task,
        view: PlacerView | None = None,
        title: str = "",
        *,
        rewarder: tuple[Task, PlacerView] | None = None,
        is_limited: bool = False,
    ) -> None:
        self._task = task
        self._view = view
        self._rewarder = rewarder
        self._title = title
        self._is_limited = is_limited
        self._component_names: tuple[str, ...] | None = None
        # Not from a seed: it decides when to look, never what is made, and task code may not foresee it.
        self._until_twice = self._draw_until_twice()

    @_guarded
    def reset_poses(
        self, env_ids: Int[torch.Tensor, "n"], names: Sequence[str]
    ) -> dict[str, Float[torch.Tensor, "n 7"]]:
        """Return the objects' poses `[x, y, z, qw, qx, qy, qz]` for environments that start anew.

        Raises:
            TaskOutputError: they are not one finite pose with a unit quaternion per object and environment.
        """
        n = len(env_ids)
        during = (
            self._view.during_reset(env_ids.clone()) if self._view else contextlib.nullcontext()
        )
        with during:
            poses = self._task.reset_objects_states(env_ids.clone())
        if self._rewarder:
            rewarder, view = self._rewarder
            with view.during_reset(env_ids.clone(), like=self._view):
                rewarder.reset_objects_states(env_ids.clone())
        if not isinstance(poses, dict) or set(poses) != set(names):
            raise TaskOutputError(
                f"reset_objects_states must return a pose per object: {', '.join(names)}"
            )
        for name in names:
            pose = poses[name]
            if not isinstance(pose, torch.Tensor) or tuple(pose.shape) != (n, 7):
                shape = tuple(getattr(pose, "shape", ()))
                raise TaskOutputError(
                    f"the reset pose of {name} must be a tensor of shape ({n}, 7), not {shape}"
                )
            if pose.is_meta or pose.has_names():
                raise TaskOutputError(
                    f"the reset pose of {name} must be a plain tensor with numbers in it"
                )
            if not pose.is_floating_point() or not bool(pose.isfinite().all()):
                raise TaskOutputError(f"the reset pose of {name} is not finite")
            if bool(((pose[:, 3:].norm(dim=1) - 1).abs() > UNIT_TOLERANCE).any()):
                raise TaskOutputError(
                    f"the quaternion of the reset pose of {name} is not of length 1"
                )
        return {name: poses[name] for name in names}

    @_guarded
    def observation_size(self) -> int:
        """Return the length of the observation, as the task says it."""
        said = self._task.get_observation_space()
        if isinstance(said, bool) or not isinstance(said, int):
            raise TaskOutputError("get_observation_space must return a whole number")
        return said

    @_guarded
    def observe(self, show: Show) -> Float[torch.Tensor, "env obs"]:
        """Return the observation; it may share memory with what `show` gave."""
        states = show()  # before `inference_mode`, in which torch does not count writes
        with torch.inference_mode():
            return _observation(_keys(self._task, _Watch(states)), states)

    @_guarded
    def succeeds(self, show: Show) -> Bool[torch.Tensor, "env"]:
        """Return the task's success."""
        watch = _Watch(show())
        with torch.inference_mode():
            _keys(self._task, watch)
            return _success(self._task, watch)

    @_guarded
    def judge(self, show: Show, actions: Float[torch.Tensor, "env act"]) -> Answers:
        """Return all that the task says of a moment.

        Numbers may be infinite or NaN: see `Answers.check_finite`.

        Raises:
            TaskOutputError: an answer has another type or shape than it must have, the same question got two answers,
                or a state was written into.
        """
        answers = self._asked(show, actions)
        self._until_twice -= 1
        if self._until_twice < 1:
            self._until_twice = self._draw_until_twice()
            answers = answers.cloned()
            demand_equal(answers, self._asked(show, actions))
        return answers

    # -- inside

    def _asked(self, show: Show, actions: torch.Tensor) -> Answers:
        """Ask for the reward first: nothing that it does is left when success is asked for, of states made anew."""
        states = show()  # before `inference_mode`, in which torch does not count writes
        with torch.inference_mode():
            reward, parts = self._reward(_Watch(states), actions)
        states = show()
        with torch.inference_mode():
            watch = _Watch(states)
            observation = _observation(_keys(self._task, watch), states)
            success = _success(self._task, watch)
        return Answers(observation=observation, success=success, reward=reward, components=parts)

    def _reward(
        self, watch: "_Watch", actions: torch.Tensor
    ) -> tuple[torch.Tensor, dict[str, torch.Tensor]]:
        task = self._rewarder[0] if self._rewarder else self._task
        _keys(task, watch)
        _success(task, watch)  # what it adds to the states or notes may be used by the reward
        count = _count(actions)
        result = task.compute_reward(actions, watch.states)
        watch.check("compute_reward")
        if _count(actions) != count:
            raise StatesChangedError("compute_reward changes the actions in place; work on a copy")
        if not isinstance(result, tuple) or len(result) != 2 or not isinstance(result[1], dict):
            raise TaskOutputError(
                "compute_reward must return the reward and a dict of its components"
            )
        reward, parts = result
        check_tensor("the reward", reward, watch.num_envs, watch.device, kind=torch.float32)
        self._check_parts(parts, watch)
        return reward, parts

    def _check_parts(self, parts: dict[Any, Any], watch: "_Watch") -> None:
        names = tuple(parts)
        if names != self._component_names:
            if len(names) > MAX_COMPONENTS:
                raise TaskOutputError(f"the reward has more than {MAX_COMPONENTS} components")
            for name in names:
                if not isinstance(name, str) or not COMPONENT_NAME.fullmatch(name):
                    raise TaskOutputError(
                        f"'{shown(name, 60)}' is no name for a reward component: at most 40 letters, digits and"
                        " underscores, no digit first"
                    )
            if self._component_names is not None and set(names) != set(self._component_names):
                raise TaskOutputError(
                    "the names of the reward components change from call to call"
                )
            self._component_names = names
        for name, part in parts.items():
            check_tensor(f"reward component '{name}'", part, watch.num_envs, watch.device)

    @staticmethod
    def _draw_until_twice() -> int:
        return 1 + secrets.randbelow(2 * ASKED_TWICE_ONCE_IN)


def _keys(task: Task, watch: "_Watch") -> list[str]:
    keys = task.compute_observation_key(watch.states)
    watch.check("compute_observation_key")
    if not isinstance(keys, list) or not all(isinstance(key, str) for key in keys):
        raise TaskOutputError("compute_observation_key must return a list of keys")
    for key in keys:
        if key not in watch.states:
            raise TaskOutputError(f"observation key '{shown(key, 60)}' is not in states")
        what = f"observation '{shown(key, 60)}'"
        check_tensor(what, watch.states[key], watch.num_envs, watch.device, max_dim=2)
    return keys


def _success(task: Task, watch: "_Watch") -> torch.Tensor:
    success = task.compute_success(watch.states)
    watch.check("compute_success")
    check_tensor("compute_success", success, watch.num_envs, watch.device, kind=torch.bool)
    return success


def check_tensor(
    what: str,
    value: Any,
    n: int,
    device: torch.device,
    *,
    kind: torch.dtype | None = None,
    max_dim: int = 1,
) -> None:
    """Demand a plain tensor with a row per environment, on the device of the states.

    Raises:
        TaskOutputError: it is not.
    """
    if not isinstance(value, torch.Tensor):
        raise TaskOutputError(f"{what} must be a tensor, not {type(value).__name__}")
    if not 1 <= value.ndim <= max_dim or value.shape[0] != n:
        raise TaskOutputError(
            f"{what} must have one row per environment ({n}), not shape {tuple(value.shape)}"
        )
    if kind is not None and value.dtype != kind:
        raise TaskOutputError(f"{what} must be of type {kind}, not {value.dtype}")
    if value.is_complex():
        raise TaskOutputError(f"{what} must be of real numbers, not {value.dtype}")
    if value.device != device:
        raise TaskOutputError(
            f"{what} must be on the device of the states, {device}, not {value.device}"
        )
    if value.has_names() or value.layout != torch.strided:
        raise TaskOutputError(
            f"{what} must be a plain tensor, without named dimensions and not sparse"
        )


def demand_equal(first: Answers, second: Answers) -> None:
    """Demand that the same question got the same answer; NaN equals NaN.

    Raises:
        TaskOutputError: it did not.
    """
    other = second.named()
    for what, value in first.named().items():
        if value.shape != other[what].shape or not torch.equal(
            value.nan_to_num(), other[what].nan_to_num()
        ):
            raise TaskOutputError(f"two calls with the same states give different results: {what}")


def _observation(keys: list[str], states: States) -> torch.Tensor:
    """Return the columns side by side; a single one is the state itself, not a copy."""
    if not keys:
        raise TaskOutputError("compute_observation_key must return at least one key")
    parts = [c if c.ndim == 2 else c[:, None] for c in (states[key] for key in keys)]
    if (width := sum(part.shape[1] for part in parts)) > MAX_OBSERVATION:
        raise TaskOutputError(
            f"the observation has {width} numbers; at most {MAX_OBSERVATION} are taken"
        )
    joined = parts[0] if len(parts) == 1 else torch.cat(parts, dim=1)
    return joined.float()


class _Watch:
    """The states that were shown to a task, and what torch counts of writes into them.

    Task code writes into a tensor by torch operations only.
    """

    __slots__ = ("_counts", "_given", "device", "num_envs", "states")

    def __init__(self, states: States) -> None:
        self.states = states
        self._given = dict(states)
        self._counts = [_count(value) for value in self._given.values()]
        first = next(iter(states.values()))
        self.num_envs, self.device = len(first), first.device

    def check(self, method: str) -> None:
        """Demand that none of the states has changed.

        Raises:
            StatesChangedError: names the method and the state.
        """
        for (key, value), count in zip(self._given.items(), self._counts, strict=True):
            now = self.states.get(key)
            if _count(value) != count or (now is not value and not _is_equal(now, value)):
                raise StatesChangedError(
                    f"{method} changes states['{key}'] in place; work on a copy"
                )


def _count(value: torch.Tensor) -> int:
    return 0 if value.is_inference() else value._version  # pyright: ignore[reportAttributeAccessIssue]


def _is_equal(now: Any, value: torch.Tensor) -> bool:
    return isinstance(now, torch.Tensor) and now.shape == value.shape and torch.equal(now, value)

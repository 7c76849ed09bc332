"""The one loop that plays episodes: all worlds in step, until each episode is over.

Recording, handover, evaluation, the trials of scripted programs, the search for rewards and the twin all call `play`.
An `Actor` acts on a `View`, and may hold other actors to hand worlds over to. Observers are shown the view after each
control step: they keep states, snapshots, what the referee asks for. A stop rule says which episodes are over.
"""

import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Protocol, runtime_checkable

import numpy as np
from jaxtyping import Bool, Float, Float32, UInt8

from v2p_data.errors import V2PError
from v2p_data.sim.env.actions import state_as_seen, steps_to
from v2p_data.sim.env.batch_env import BatchEnv, Snapshot, StepResult
from v2p_data.sim.render.masks import MaskRenderer
from v2p_data.sim.robot.interface import STEPS, ArmInterface
from v2p_data.sim.wrappers.gym_env import within_bounds


@dataclass(kw_only=True)
class Stopwatch:
    """Adds up wall time by name; what is timed within something else does not count there."""

    seconds: dict[str, float] = field(default_factory=dict[str, float])

    @contextmanager
    def on(self, name: str) -> Iterator[None]:
        start, others = time.perf_counter(), sum(self.seconds.values())
        yield
        within = sum(self.seconds.values()) - others
        took = time.perf_counter() - start - within
        self.seconds[name] = self.seconds.get(name, 0.0) + took


class View:
    """What can be seen of worlds, one episode in each; up to date until the next step.

    A world whose episode is over costs no physics and no picture. Its state and picture stay as they were.

    Args:
        worlds: where their episodes begin.
        size_px: width and height of the pictures, or (height, width).
        num_threads: for the pictures; changes no result.
        watch: told what pictures, physics and actors take.
        wrist: whether the wrist's picture comes below the table's.

    Attributes:
        t: control steps so far.
        going: the worlds whose episodes are not over.
        obs: the task's own observation of the simulator's states; experts act on it.
        action: the last one, within [-1, 1]; zero where no time passed. Set by the first step.
        result: what it led to. Set by the first step.
    """

    action: Float[np.ndarray, "env 7"]
    result: StepResult

    def __init__(
        self,
        worlds: BatchEnv,
        size_px: int | tuple[int, int] = 256,
        num_threads: int = 1,
        watch: Stopwatch | None = None,
        *,
        wrist: bool = False,
    ) -> None:
        self.worlds, self.watch = worlds, watch or Stopwatch()
        self.t, self.going = 0, np.ones(worlds.num_envs, bool)
        self.obs = worlds.observe()
        self._state = worlds.robot_state()
        shape = (size_px, size_px) if isinstance(size_px, int) else size_px
        self._labels = np.zeros((worlds.num_envs, shape[0] * (1 + wrist), shape[1]), np.uint8)
        self._rgb = np.zeros((worlds.num_envs, *shape, 3), np.uint8)
        self._drawn_at = -1
        self._picture_settings = size_px, num_threads, wrist

    @property
    def state(self) -> Float32[np.ndarray, "env 11"]:
        """The robot's state; see `BatchEnv.robot_state`."""
        self._state = np.where(self.going[:, None], self.worlds.robot_state(), self._state)
        return self._state

    @property
    def labels(self) -> UInt8[np.ndarray, "env h w"]:
        """The label pictures, drawn when asked for; those of the next moment overwrite them."""
        if self._drawn_at != self.t:
            with self.watch.on("masks"):
                moments = self._moments()
                self._labels[self.going] = self._renderer.draw_many(moments)
            self._drawn_at = self.t
        return self._labels

    @property
    def rgb(self) -> UInt8[np.ndarray, "env h w 3"]:
        """The colour pictures of now, drawn at each call.

        Raises:
            V2PError: there is no OpenGL.
        """
        with self.watch.on("rgb"):
            self._rgb[self.going] = [self._renderer.draw_rgb(*m) for m in self._moments()]
        return self._rgb

    def step(self, action: Float[np.ndarray, "env 7"]) -> StepResult:
        """Let 50 ms pass in the worlds that go on; return what the action led to."""
        return self.worlds.step(action, None if self.going.all() else np.flatnonzero(self.going))

    @cached_property
    def _renderer(self) -> MaskRenderer:
        size_px, num_threads, wrist = self._picture_settings
        return MaskRenderer(self.worlds.world, size_px, num_threads=num_threads, wrist=wrist)

    def _moments(self) -> list[tuple[Snapshot, int]]:
        seen = np.flatnonzero(self.going)
        snapshot = self.worlds.snapshot(seen)
        return [(snapshot, k) for k in range(len(seen))]


@runtime_checkable
class Actor(Protocol):
    """Who acts in all worlds at a time."""

    def reset(self, worlds: BatchEnv) -> None:
        """Episodes begin in all worlds."""
        ...

    def act(self, view: View) -> Float[np.ndarray, "env 7"]:
        """Return the next actions; they are clipped to [-1, 1]."""
        ...


@runtime_checkable
class Policy(Protocol):
    """A policy that is told its task: `n` pictures and robot states at a time are all that it sees."""

    def reset(self, n: int) -> None:
        """Forget the last episodes; `n` new ones begin."""
        ...

    def act(
        self,
        labels: UInt8[np.ndarray, "n h w"],
        state: Float32[np.ndarray, "n state"],
        rgb: UInt8[np.ndarray, "n h2 w 3"] | None = None,
    ) -> Float32[np.ndarray, "n act"]:
        """Return the next action of every world, seen in labels and, where it was asked for, in colour."""
        ...


@dataclass(frozen=True)
class VisionActor:
    """A policy in the place of an actor."""

    policy: Policy
    wrist: bool = False
    """Whether it sees the wrist's picture too, below the table's."""
    interface: ArmInterface = STEPS
    """What it sees of the arm and tells it."""
    num_states: int | None = None
    """Length of the state that it knows; any if None."""
    rgb: bool = False
    """Whether it sees the colour picture too."""

    def reset(self, worlds: BatchEnv) -> None:
        """Tell the policy that episodes begin."""
        self.policy.reset(worlds.num_envs)

    def act(self, view: View) -> Float[np.ndarray, "env 7"]:
        """Return the steps to the policy's actions on what `V2PEnv` shows: the state is within bounds.

        Raises:
            V2PError: the arm has not as many joints as the policy sees.
        """
        state = within_bounds(state_as_seen(view.state, view.worlds, self.interface))
        if self.num_states not in (None, state.shape[1]):
            raise V2PError(
                f"the policy sees a state of {self.num_states} numbers, and the arm of task "
                f"'{view.worlds.bundle.title}'"
                f" gives {state.shape[1]}: evaluate the policy with the arm of its dataset"
            )
        colours = [view.rgb] if self.rgb else []
        action = self.policy.act(view.labels, state, *colours)
        return steps_to(view.worlds, action, self.interface.actions)


@dataclass(frozen=True)
class StateActor:
    """An expert on the task's observation of simulator states; no picture is drawn for it."""

    function: Callable[[Float32[np.ndarray, "env obs"]], Float[np.ndarray, "env 7"]]
    """From observations to actions."""
    obs_dim: int | None = None
    """Length of the observation that it knows; any if None."""

    def reset(self, worlds: BatchEnv) -> None:
        """Demand that the worlds' observation is the one that the expert knows.

        Raises:
            V2PError: the task's observation is not the expert's.
        """
        if self.obs_dim not in (None, worlds.obs_dim):
            raise V2PError(
                f"the expert knows observations of length {self.obs_dim}, and task "
                f"'{worlds.bundle.title}' makes ones of"
                f" length {worlds.obs_dim}: it is another task's expert"
            )

    def act(self, view: View) -> Float[np.ndarray, "env 7"]:
        """Return the expert's actions."""
        return self.function(view.obs)


class Film:
    """Notes where everything was at each moment; sizes and cameras stay as they were at the start."""

    def __init__(self, worlds: BatchEnv) -> None:
        self._start = worlds.snapshot(np.arange(worlds.num_envs))
        self._moments = [(self._start.qpos, self._start.qvel)]

    def note(self, view: View) -> None:
        """Note the moment after a step."""
        self._moments.append(view.worlds.motion())

    def snapshots(self) -> tuple[Snapshot, ...]:
        """Return all worlds at each moment, the start first."""
        return tuple(replace(self._start, qpos=pos, qvel=vel) for pos, vel in self._moments)


def play(
    view: View,
    actor: Actor,
    observers: Sequence[Callable[[View], None]] = (),
    until: Callable[[View], Bool[np.ndarray, "env"]] | None = None,
    steps: int | None = None,
) -> None:
    """Play one episode in every world, from where the worlds are.

    Args:
        view: of the worlds; all of their episodes begin.
        actor: who acts.
        observers: shown the view after each step, in this order.
        until: says after each step, and after the observers, which episodes are over; by default none.
        steps: the most that an episode lasts; by default the task's horizon.

    Raises:
        V2PError: the actions are not finite or have another shape.
    """
    with view.watch.on("network"):
        actor.reset(view.worlds)
    for _ in range(steps or view.worlds.horizon):
        with view.watch.on("network"):
            view.action = _carried_out(actor.act(view), view)
        with view.watch.on("physics"):
            view.result = view.step(view.action)
        view.obs = view.result.obs
        view.t += 1
        for note in observers:
            note(view)
        if until is not None:
            view.going &= ~until(view)
            if not view.going.any():
                break


def _carried_out(action: Float[np.ndarray, "env 7"], view: View) -> Float[np.ndarray, "env 7"]:
    worlds = view.worlds
    wanted = (worlds.num_envs, worlds.act_dim)
    if action.shape != wanted:
        raise V2PError(f"actions have the shape {action.shape}; the simulator needs {wanted}")
    odd = np.flatnonzero(~np.isfinite(action).all(1) & view.going & ~worlds.is_broken)
    if len(odd):
        raise V2PError(
            f"the action in world {odd[0]} of task '{worlds.bundle.title}' is not finite: {action[odd[0]].tolist()}"
        )
    # Rounded as it is recorded, so that a recording plays again to the bit.
    return np.clip(np.where(view.going[:, None], action, 0.0), -1.0, 1.0).astype(np.float32)

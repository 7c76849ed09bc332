"""Episodes in many worlds in step: physics, masks and network in batches, judged as one environment at a time is.

Episode k starts from `first_seed + k` and is, step by step, the episode of `V2PEnv` with that seed. So with as many
worlds as environments the successes are those of `lerobot-eval`. An episode counts as a success once the task's own
success has held and the independent referee agrees with all that happened so far. It may go on, and is asked again at
its end. A world whose episode is over costs no physics and no pictures. What a policy sees of it stays as it was.
"""

import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
from jaxtyping import Bool, Float, Int

from v2p_data.errors import V2PError
from v2p_data.evaluation.actors import Actor, WorldActor
from v2p_data.evaluation.config import EvaluationConfig
from v2p_data.evaluation.failures import failure_kinds
from v2p_data.sim.env import randomize
from v2p_data.sim.env.batch_env import BatchEnv, SimConfig, Snapshot
from v2p_data.sim.env.randomize import RandomizationConfig
from v2p_data.sim.env.verdict import RefereeRecord
from v2p_data.sim.render.masks import MaskRenderer
from v2p_data.sim.wrappers.gym_env import CONTROL_HZ, STATE_HIGH, STATE_LOW, stream_seed
from v2p_data.task.task import Task, TaskBundle

NEVER = -1
TAIL_STEPS = 6
"""Control steps (0.3 s) that films go on after a success."""


@dataclass(frozen=True, kw_only=True)
class Shown:
    """The first batch of episodes, to be drawn: what `report.sheet` and `report.films` take."""

    successes: Bool[np.ndarray, "env"]
    num_frames: Int[np.ndarray, "env"]
    """Moments that belong to the episode: until a little after its success, else all."""
    snapshots: Sequence[Snapshot]
    """All worlds, once per control step."""

    @property
    def snapshot_seconds(self) -> tuple[float, ...]:
        return tuple(t / CONTROL_HZ for t in range(len(self.snapshots)))


@dataclass(frozen=True, kw_only=True)
class Judged:
    """What became of the episodes of one task; arrays have an entry per episode, in the order of their seeds."""

    first_seed: int
    horizon_steps: int
    """Control steps that an episode lasts at most."""
    success_step: Int[np.ndarray, "episode"]
    """The control step that led to the first success, from 0; `NEVER` where there was none."""
    at_end: Bool[np.ndarray, "episode"] | None
    """Success at the last step; None where episodes were over with their first success."""
    broke: Bool[np.ndarray, "episode"]
    """The simulation broke down; the episode failed there and then."""
    failures: tuple[str, ...]
    """Kind of failure; empty where the episode succeeded once."""
    seconds: dict[str, float]
    """Wall time of what it took: `physics`, `masks`, `network` (or whoever acted), `referee`, `all`."""
    shown: Shown

    @property
    def successes(self) -> Bool[np.ndarray, "episode"]:
        """Which episodes succeeded at some time."""
        return self.success_step != NEVER

    @property
    def median_success_s(self) -> float | None:
        """Median time to the first success; None without any."""
        steps = self.success_step[self.successes]
        return float(np.median(steps + 1)) / CONTROL_HZ if len(steps) else None

    def failure_counts(self) -> dict[str, int]:
        """Return how many episodes failed by each kind of failure, the most frequent first."""
        kinds = [kind for kind in self.failures if kind]
        return {
            kind: kinds.count(kind)
            for kind in sorted(set(kinds), key=lambda k: (-kinds.count(k), k))
        }

    def as_dict(self) -> dict[str, Any]:
        """Return what is not a rate, for JSON."""
        return {
            "first_seed": self.first_seed,
            "episodes": len(self.success_step),
            "horizon_steps": self.horizon_steps,
            "median_success_s": self.median_success_s,
            "failures": self.failure_counts(),
            "seconds": {name: round(value, 2) for name, value in self.seconds.items()},
        }


def judge(
    bundle: TaskBundle,
    actor: Actor | WorldActor,
    *,
    episodes: int,
    first_seed: int,
    cfg: EvaluationConfig,
    num_threads: int = 1,
    size_px: int | tuple[int, int] = 256,
    randomization: RandomizationConfig | None = None,
    task: type[Task] | None = None,
    on_progress: Callable[[float], None] = lambda share: None,
) -> Judged:
    """Play episodes of one task, `cfg.worlds` at a time, and judge them.

    Args:
        bundle: the task.
        actor: who acts.
        episodes: how many, instead of `cfg.episodes`.
        first_seed: episode k starts from `first_seed + k`.
        cfg: how it is judged.
        num_threads: for physics and masks, 0 for all cores; changes no result.
        size_px: width and height of the pictures, or (height, width).
        randomization: what episodes start under; by default, what they are recorded under.
        task: the task, instead of `bundle.code`.
        on_progress: told the share that is done.

    Raises:
        V2PError: the actor's actions are not finite or have another shape.
    """
    watch = _Watch()
    sim = SimConfig(fine=True, randomization=randomization or randomize.recording())
    steps = bundle.policy_steps(cfg.horizon_scale)
    parts: list[_Played] = []
    with watch.on("all"):
        for start in range(0, episodes, cfg.worlds):
            count = min(cfg.worlds, episodes - start)
            with watch.on("physics"):
                env = BatchEnv(
                    bundle,
                    sim,
                    num_envs=count,
                    seed=0,
                    num_threads=num_threads,
                    task=task,
                    base_reset=cfg.reset == "base",
                )
                seeds = [stream_seed(first_seed + start + k) for k in range(count)]
                env.reset_seeded(np.arange(count), seeds)
            player = (
                _Sighted(actor, env, size_px, num_threads, watch)
                if isinstance(actor, Actor)
                else _Knowing(actor, env, watch)
            )
            with player:
                parts.append(
                    _play(
                        env,
                        player,
                        steps,
                        at_end=cfg.at_end,
                        is_shown=start == 0,
                        watch=watch,
                        on_step=lambda t, s=start, n=count: on_progress(
                            (s + n * t / steps) / episodes
                        ),
                    )
                )
    shown = parts[0].shown
    assert shown is not None
    return Judged(
        first_seed=first_seed,
        horizon_steps=steps,
        success_step=np.concatenate([p.success_step for p in parts]),
        at_end=np.concatenate([p.at_end for p in parts]) if cfg.at_end else None,
        broke=np.concatenate([p.broke for p in parts]),
        failures=tuple(kind for p in parts for kind in p.failures),
        seconds=watch.seconds,
        shown=shown,
    )


# --- one batch -----------------------------------------------------------------------------------------------


@dataclass(frozen=True, kw_only=True)
class _Played:
    success_step: Int[np.ndarray, "env"]
    at_end: Bool[np.ndarray, "env"]
    broke: Bool[np.ndarray, "env"]
    failures: tuple[str, ...]
    shown: Shown | None


def _play(
    env: BatchEnv,
    player: "_Sighted | _Knowing",
    steps: int,
    *,
    at_end: bool,
    is_shown: bool,
    watch: "_Watch",
    on_step: Callable[[int], None],
) -> _Played:
    """Play one episode in every world, from where the worlds are."""
    n = env.num_envs
    referee = RefereeRecord(env)
    referee.restart()
    film = _Film(env, steps) if is_shown else None
    success_step = np.full(n, NEVER)
    broke, over, last = np.zeros(n, bool), np.zeros(n, bool), np.zeros(n, bool)
    for t in range(steps):
        action = player.act(over)
        moving = np.flatnonzero(~over)
        with watch.on("physics"):
            result = env.step(action, None if len(moving) == n else moving)
            referee.note()
            if film is not None:
                film.note()
        gone = result.terminated & ~over
        broke |= gone
        over |= gone
        is_asked = result.held & ~over & ((success_step == NEVER) | (t + 1 == steps))
        asked = np.flatnonzero(is_asked)
        if len(asked):
            with watch.on("referee"):
                agreed = asked[referee.verdict(asked)]
            success_step[agreed[success_step[agreed] == NEVER]] = t
            if t + 1 == steps:
                last[agreed] = True
            if not at_end:
                over[agreed] = True
        on_step(t + 1)
        if over.all():
            break
    failed = np.flatnonzero(success_step == NEVER)
    failures = np.full(n, "", dtype=object)
    failures[failed] = failure_kinds(env.bundle, referee.history(failed), broke[failed])
    succeeded = success_step != NEVER
    end = np.where(
        succeeded, np.minimum(success_step + 2 + TAIL_STEPS, len(referee)), len(referee)
    )
    shown = None
    if film is not None:
        shown = Shown(successes=succeeded, num_frames=end, snapshots=film.snapshots())
    return _Played(
        success_step=success_step,
        at_end=last,
        broke=broke,
        failures=tuple(str(kind) for kind in failures),
        shown=shown,
    )


class _Film:
    """Where everything was at each moment; sizes and cameras stay as they were at the start."""

    def __init__(self, env: BatchEnv, steps: int) -> None:
        self._env, self._everyone = env, np.arange(env.num_envs)
        self._start = env.snapshot(self._everyone)
        self._moments = [(self._start.qpos, self._start.qvel)]

    def note(self) -> None:
        now = self._env.motion()
        self._moments.append(now)

    def snapshots(self) -> list[Snapshot]:
        return [replace(self._start, qpos=qpos, qvel=qvel) for qpos, qvel in self._moments]


# --- who acts ------------------------------------------------------------------------------------------------


class _Sighted:
    """Shows a policy the worlds: pictures and robot states of those that go on, the last ones of those that are over."""

    def __init__(
        self,
        actor: Actor,
        env: BatchEnv,
        size_px: int | tuple[int, int],
        num_threads: int,
        watch: "_Watch",
    ) -> None:
        self._actor, self._env, self._watch = actor, env, watch
        shape = (size_px, size_px) if isinstance(size_px, int) else size_px
        self._renderer = MaskRenderer(env.world, size_px, num_threads=num_threads)
        self._labels = np.zeros((env.num_envs, *shape), np.uint8)
        self._state = np.zeros((env.num_envs, len(STATE_LOW)), np.float32)
        with watch.on("network"):
            actor.reset(env.num_envs)

    def act(self, over: Bool[np.ndarray, "env"]) -> Float[np.ndarray, "env 7"]:
        seen = np.flatnonzero(~over)
        with self._watch.on("masks"):
            snapshot = self._env.snapshot(seen)
            self._labels[seen] = self._renderer.draw_many(
                [(snapshot, k) for k in range(len(seen))]
            )
            self._state[seen] = np.clip(self._env.robot_state()[seen], STATE_LOW, STATE_HIGH)
        with self._watch.on("network"):
            return _checked(self._actor.act(self._labels, self._state), self._env)

    def __enter__(self) -> "_Sighted":
        return self

    def __exit__(self, *_: object) -> None:
        self._renderer.close()


class _Knowing:
    """Lets someone act who sees the simulator's states."""

    def __init__(self, actor: WorldActor, env: BatchEnv, watch: "_Watch") -> None:
        self._actor, self._env, self._watch = actor, env, watch
        with watch.on("network"):
            actor.begin(env)

    def act(self, over: Bool[np.ndarray, "env"]) -> Float[np.ndarray, "env 7"]:
        with self._watch.on("network"):
            action = np.where(over[:, None], 0.0, self._actor.act_in(self._env))
            return _checked(action, self._env)

    def __enter__(self) -> "_Knowing":
        return self

    def __exit__(self, *_: object) -> None:
        pass


def _checked(action: Float[np.ndarray, "env 7"], env: BatchEnv) -> Float[np.ndarray, "env 7"]:
    wanted = (env.num_envs, env.act_dim)
    if action.shape != wanted:
        raise V2PError(
            f"the policy's actions have the shape {action.shape}; the simulator needs {wanted}"
        )
    if not np.isfinite(action).all():
        world = int(np.flatnonzero(~np.isfinite(action).all(1))[0])
        raise V2PError(
            f"the policy's action in world {world} of task '{env.bundle.title}' is not finite: {action[world].tolist()}"
        )
    return action


@dataclass(kw_only=True)
class _Watch:
    """Adds up wall time by name."""

    seconds: dict[str, float] = field(default_factory=dict[str, float])

    @contextmanager
    def on(self, name: str) -> Iterator[None]:
        start = time.perf_counter()
        yield
        self.seconds[name] = self.seconds.get(name, 0.0) + time.perf_counter() - start

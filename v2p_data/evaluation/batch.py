"""Episodes in many worlds in step: physics, masks and network in batches, judged as one environment at a time is.

Episode k starts from `first_seed + k` and is, step by step, the episode of `V2PEnv` with that seed. So with as many
worlds as environments the successes are those of `lerobot-eval`. An episode counts as a success once the task's own
success has held and the independent referee agrees with all that happened so far. It may go on, and is asked again at
its end. A world whose episode is over costs no physics and no pictures. What a policy sees of it stays as it was.
"""

import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from jaxtyping import Bool, Int

from v2p_data.evaluation.config import EvaluationConfig
from v2p_data.evaluation.failures import failure_kinds
from v2p_data.play import Actor, Film, Stopwatch, View, VisionActor, play
from v2p_data.sim.env.batch_env import BatchEnv, SimConfig, Snapshot
from v2p_data.sim.env.verdict import RefereeRecord
from v2p_data.sim.wrappers.gym_env import CONTROL_HZ, stream_seed
from v2p_data.task.task import TaskBundle

NEVER = -1
TAIL_STEPS = 6
"""Control steps (0.3 s) that films go on after a success."""


@dataclass(frozen=True, kw_only=True)
class Shown:
    """The first batch of episodes, to be drawn: what `report.sheet` takes."""

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
    actor: Actor,
    *,
    first_seed: int,
    cfg: EvaluationConfig,
    num_threads: int = 1,
    size_px: int | tuple[int, int] = 256,
    on_progress: Callable[[float], None] = lambda share: None,
) -> Judged:
    """Play `cfg.episodes` episodes of one task, `cfg.worlds` at a time, and judge them.

    Args:
        bundle: the task.
        actor: who acts.
        first_seed: episode k starts from `first_seed + k`.
        cfg: how it is judged.
        num_threads: for physics and masks, 0 for all cores; changes no result.
        size_px: width and height of the pictures, or (height, width).
        on_progress: told the share that is done.

    Raises:
        V2PError: the actor's actions are not finite or have another shape.
    """
    start, watch = time.perf_counter(), Stopwatch()
    steps = bundle.policy_steps(cfg.horizon_scale)
    parts: list[tuple[np.ndarray, ...]] = []
    failures: list[str] = []
    shown: Shown | None = None
    for first in range(0, cfg.episodes, cfg.worlds):
        count = min(cfg.worlds, cfg.episodes - first)
        with watch.on("physics"):
            seeds = [stream_seed(first_seed + first + k) for k in range(count)]
            env = _begun(bundle, seeds, num_threads, base_reset=cfg.reset == "base")
            wrist = isinstance(actor, VisionActor) and actor.wrist
            view, film = View(env, size_px, num_threads, watch, wrist=wrist), Film(env)
            record = RefereeRecord(env)
            verdicts = Verdicts(record, count, steps, at_end=cfg.at_end)

        def note(view: View, begun: int = first) -> None:
            on_progress((begun + len(view.going) * view.t / steps) / cfg.episodes)

        play(view, actor, [record.note, note, *([] if shown else [film.note])], verdicts, steps)
        if shown is None:
            shown = _shown(verdicts.success_step, film, len(record))
        parts.append((verdicts.success_step, verdicts.at_end, verdicts.broke))
        failures += verdicts.failures(bundle)
    assert shown is not None
    success_step, at_end, broke = (np.concatenate(part) for part in zip(*parts, strict=True))
    watch.seconds["all"] = time.perf_counter() - start
    return Judged(
        first_seed=first_seed,
        horizon_steps=steps,
        success_step=success_step,
        at_end=at_end if cfg.at_end else None,
        broke=broke,
        failures=tuple(failures),
        seconds=watch.seconds,
        shown=shown,
    )


def _shown(success_step: Int[np.ndarray, "env"], film: Film, num_moments: int) -> Shown:
    """Return the episodes of one batch, each up to a little after its success."""
    is_won = success_step != NEVER
    return Shown(
        successes=is_won,
        num_frames=np.where(
            is_won, np.minimum(success_step + 2 + TAIL_STEPS, num_moments), num_moments
        ),
        snapshots=film.snapshots(),
    )


def _begun(
    bundle: TaskBundle, seeds: Sequence[int], num_threads: int, *, base_reset: bool
) -> BatchEnv:
    """Return worlds at the start of their episodes, one for each seed."""
    sim = SimConfig(fine=True, base_reset=base_reset)
    env = BatchEnv(bundle, sim, num_envs=len(seeds), seed=0, num_threads=num_threads)
    env.reset_seeded(np.arange(len(seeds)), seeds)
    return env


class Verdicts:
    """Stop rule of evaluations: over at a breakdown, and without `at_end` at the first success.

    An episode succeeds once the task's own success has held and the referee agrees. It may go on, and is asked again
    at its last step.

    Args:
        record: what the referee is shown of the worlds; noted before each question.
        num_worlds: number of worlds.
        steps: that an episode lasts at most.
        at_end: go on after a success.

    Attributes:
        success_step: the control step that led to the first success, from 0; `NEVER` where there was none.
        at_end: success at the last step.
        broke: where the simulation broke down.
    """

    def __init__(
        self, record: RefereeRecord, num_worlds: int, steps: int, *, at_end: bool
    ) -> None:
        self._record, self._steps, self._goes_on = record, steps, at_end
        self.success_step = np.full(num_worlds, NEVER)
        self.at_end, self.broke = np.zeros(num_worlds, bool), np.zeros(num_worlds, bool)

    def __call__(self, view: View) -> Bool[np.ndarray, "env"]:
        """Ask the referee where there is something to ask; return which episodes are over."""
        is_last = view.t == self._steps
        over = view.result.terminated & view.going
        self.broke |= over
        is_asked = view.result.held & view.going & ~over
        asked = np.flatnonzero(is_asked & ((self.success_step == NEVER) | is_last))
        if len(asked):
            with view.watch.on("referee"):
                agreed = asked[self._record.verdict(asked)]
            self.success_step[agreed[self.success_step[agreed] == NEVER]] = view.t - 1
            self.at_end[agreed] = is_last
            over[agreed] |= not self._goes_on
        return over

    def failures(self, bundle: TaskBundle) -> tuple[str, ...]:
        """Return the kind of failure of each episode, empty where it succeeded once."""
        failed = np.flatnonzero(self.success_step == NEVER)
        kinds = np.full(len(self.broke), "", dtype=object)
        kinds[failed] = failure_kinds(bundle, self._record.history(failed), self.broke[failed])
        return tuple(str(kind) for kind in kinds)

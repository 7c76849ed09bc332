"""The control loop: read, see, decide, limit, act, 20 times a second, until the time is up or something stops it.

It ends in one sentence and with a robot that holds its position. What cannot be done in time is said before the arm
moves. World frame and units as in `robot`.
"""

import time
from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Literal

import numpy as np

from v2p_data.deployment.limits import STEP_S, LimitStop, Watchdog
from v2p_data.deployment.recording import Recorder
from v2p_data.deployment.rig import LostError, Rig
from v2p_data.deployment.robot import Reading
from v2p_data.deployment.sight import Seen
from v2p_data.errors import V2PError
from v2p_data.play import Policy

REHEARSALS = 8
"""Steps without motion by which the rate is measured beforehand; the first two, which compile, do not count."""
WINDOW = 20
"""Steps whose mean decides whether the rate holds during the run."""


class TooSlowError(V2PError):
    """20 Hz cannot be kept."""


FASTER = "stop other programs, use a GPU (--device cuda) or a smaller policy"
LONGER = "--limits.max-silence-ms allows more, where the robot may stand still for longer"
_PATIENCE_MS = 3.6e6
"""A simulated robot is waited for, but not for ever."""

Ending = Literal[
    "time", "done", "limit", "lost", "silence", "robot", "slow", "interrupted", "policy"
]


ENDINGS: dict[type[V2PError], Ending] = {
    LimitStop: "limit",
    LostError: "lost",
    TooSlowError: "slow",
}
"""What these errors mean; any other one is the robot's."""


@dataclass(frozen=True, kw_only=True)
class LoopConfig:
    """How a run goes."""

    max_seconds: float = 30.0
    """Then the arm holds and the run ends."""
    dry_run: bool = False
    """Everything but the commands: nothing is sent to the robot, not even to hold."""
    slow: bool = False
    """Go on below 20 Hz. The policy then acts on older pictures than in training; its motion is slower and worse."""

    def __post_init__(self) -> None:
        if not self.max_seconds > 0:
            raise ValueError(f"max_seconds must be above 0, got {self.max_seconds}")


@dataclass(kw_only=True)
class Outcome:
    """How a run went."""

    ending: Ending
    sentence: str
    steps: int = 0
    work_ms: list[float] = field(default_factory=list)
    """Per step the time that reading, seeing, deciding and acting took."""
    acted: Counter[str] = field(default_factory=Counter)
    """How often each limit changed an action."""

    @property
    def mean_ms(self) -> float:
        return float(np.mean(self.work_ms)) if self.work_ms else 0.0

    @property
    def went_well(self) -> bool:
        """Whether nothing had to stop the run."""
        return self.ending in ("time", "done")


@dataclass(frozen=True, kw_only=True)
class Onlooker:
    """Who looks on at a run, and may end it."""

    recorder: Recorder | None = None
    """Notes every step."""
    is_done: Callable[[], bool] = lambda: False
    """Asked after every step; true ends the run."""
    on_step: Callable[[Reading, Seen], None] = lambda reading, seen: None
    """Shown every step."""


class Run:
    """One run of a policy on a robot.

    Args:
        rig: the connected robot with its sight and its limits.
        policy: what decides.
        cfg: how long, and whether for real.
        onlooker: who looks on.
    """

    def __init__(
        self, rig: Rig, policy: Policy, cfg: LoopConfig, onlooker: Onlooker | None = None
    ) -> None:
        if rig.guard is None:
            raise ValueError("a run needs limits")
        self.rig, self.policy, self.cfg = rig, policy, cfg
        self.max_silence_ms = _PATIENCE_MS if rig.waits else rig.guard.cfg.max_silence_ms
        self.is_patient = cfg.slow or rig.waits
        self.onlooker = onlooker or Onlooker()
        self._works_on = ""
        """What this side does at the moment; nothing while the robot is awaited."""

    def go(self) -> Outcome:
        """Run to the end; the robot holds its position afterwards.

        Raises:
            V2PError: something is wrong before anything moved: a click, the arm's place, the rate.
        """
        self.rehearse()
        outcome = Outcome(ending="time", sentence="")
        silence = self.max_silence_ms
        late = ""

        def bite() -> None:
            nonlocal late
            late = self._works_on
            # A simulator cannot hold while a reading is awaited; it stands still by itself.
            if self.rig.can_hold:
                self._hold()

        with Watchdog(silence, bite) as watchdog:
            try:
                self._steps(outcome, watchdog)
            except KeyboardInterrupt:
                outcome.ending, outcome.sentence = "interrupted", "stopped by Ctrl-C"
            except V2PError as error:
                outcome.ending, outcome.sentence = ENDINGS.get(type(error), "robot"), str(error)
            except BaseException:
                self._hold()  # a bug of ours, or the policy's: it is shown, with the arm at rest
                raise
            if watchdog.has_bitten and late:
                outcome.ending = "slow"
                outcome.sentence = (
                    f"{late} took more than {silence:g} ms in one step, so no "
                    f"reading was asked for; {FASTER}; {LONGER}"
                )
            elif watchdog.has_bitten:
                outcome.ending = "silence"
                where = "look after the robot and its connection"
                outcome.sentence = f"no reading came for {silence:g} ms; {where}; {LONGER}"
        try:
            self._hold()
        except V2PError as error:
            outcome.sentence += f"; it could not be told to hold its position: {error}"
        else:
            when = f"after {outcome.steps} steps ({outcome.steps * STEP_S:.1f} s)"
            held = "nothing was sent" if self.cfg.dry_run else "the robot holds its position"
            outcome.sentence = f"{outcome.sentence}, {when}; {held}"
        return outcome

    def rehearse(self) -> None:
        """Go through a step's work without moving, and say whether it fits into 50 ms.

        Raises:
            V2PError: it does not, a click is on no object, or the arm stands where it may not.
        """
        self.rig.check(self.rig.read())
        took: list[float] = []
        for _ in range(REHEARSALS):
            began = time.perf_counter()
            reading = self.rig.read()
            self._decide(self.rig.see(reading), reading)
            took.append(time.perf_counter() - began)
        self.rig.look_anew()
        self.policy.reset(1)
        mean = float(np.median(took[2:]))
        if mean > STEP_S and not self.is_patient:
            raise V2PError(_too_slow(mean, "nothing was moved"))

    def _steps(self, outcome: Outcome, watchdog: Watchdog) -> None:
        due = time.perf_counter()
        for _ in range(max(1, round(self.cfg.max_seconds / STEP_S))):
            began = time.perf_counter()
            reading = self.rig.read()
            watchdog.heard()
            self.rig.check(reading)
            self._works_on = "finding the objects"
            seen = self.rig.see(reading)
            self._works_on = "the policy"
            limited = self.rig.limited(self._decide(seen, reading), reading)
            self._works_on = ""
            if watchdog.has_bitten:
                return
            done = limited.action
            if not self.cfg.dry_run:
                done = self.rig.act(done)
                self.rig.maker.sent(done, reading)
            outcome.steps += 1
            outcome.acted.update(limited.acted)
            if self.onlooker.recorder is not None:
                self.onlooker.recorder.add(reading, seen, done, limited.acted)
            self.onlooker.on_step(reading, seen)
            outcome.work_ms.append(1000 * (time.perf_counter() - began))
            if self.onlooker.is_done():
                outcome.ending, outcome.sentence = "done", "the task succeeded"
                return
            self._check_rate(outcome)
            # A late step is not caught up with: two actions in one would be a jump.
            due = max(due + STEP_S, time.perf_counter())
            time.sleep(max(0.0, due - time.perf_counter()))
        outcome.sentence = f"the {self.cfg.max_seconds:g} s are up"

    def _decide(self, seen: Seen, reading: Reading) -> np.ndarray:
        state = self.rig.maker.state(reading)[None].astype(np.float32)
        return self.policy.act(seen.labels[None], state)[0].astype(float)

    def _check_rate(self, outcome: Outcome) -> None:
        recent = outcome.work_ms[-WINDOW:]
        mean = float(np.mean(recent)) / 1000
        if len(recent) == WINDOW and mean > STEP_S and not self.is_patient:
            raise TooSlowError(_too_slow(mean, "the run was stopped"))

    def _hold(self) -> None:
        if not self.cfg.dry_run:
            self.rig.hold()


def _too_slow(seconds: float, consequence: str) -> str:
    return (
        f"20 Hz cannot be kept: a step takes {1000 * seconds:.0f} ms ({1 / seconds:.1f} Hz) and "
        f"{consequence}; {FASTER}, or go on slower"
        " with --slow"
    )

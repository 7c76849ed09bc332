"""What a policy may do to an arm: every action passes here, every limit that acts is named, and some stop the run.

Actions are displacements of the controller's target; limits are in metres and seconds. World frame: the arm's base.
"""

import threading
import time
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float
from scipy.spatial.transform import Rotation

from v2p_data.deployment.robot import ActionScale, Reading
from v2p_data.errors import V2PError
from v2p_data.sim.env.batch_env import SimConfig
from v2p_data.sim.robot.gripper_wait import GripperWait
from v2p_data.sim.robot.robot import TARGET_HIGH_M, TARGET_LOW_M

STEP_S = 0.05
LAG_S = 0.1
"""The target runs ahead of the tool by at most what the speed limit covers in this time, so that an arm that was held
up does not shoot forward."""
PENDING = 2
"""Steps after which a turn is taken to be done."""
START_OUTSIDE_M = 0.03
"""So far outside the workspace a run may begin; further out it is refused."""
ESCAPED_M = 0.06
PRESSES, PRESSES_WITHIN = 2, 10
"""So many readings above the force limit among so many (0.5 s) stop the run."""
OVERSPEED = 1.8
"""A tool measured at this multiple of the speed limit stops the run: the policy cannot cause such a speed."""


@dataclass(frozen=True, kw_only=True)
class LimitsConfig:
    """Bounds of every action and of what the robot reports."""

    max_speed_m_s: float = 1.04
    """Speed of the tool's target. The default is a full action of the training along all axes;
    begin with 0.1 on a real arm."""
    max_turn_rad_s: float = 4.0
    """Of the tool's target, about any axis; a full action of the training about one. Whichever of the two limits acts
    slows both motions down alike."""
    workspace_low_m: tuple[float, float, float] = TARGET_LOW_M
    """Lowest x, y, z of the tool's target; the training's by default, 17 mm above the table."""
    workspace_high_m: tuple[float, float, float] = TARGET_HIGH_M
    """Highest x, y, z of the tool's target."""
    max_tilt_rad: float = SimConfig.tilt_limit_rad
    """How far the gripper may lean from straight down."""
    max_force_n: float = 60.0
    """Contact force at the tool, of either sign, that stops the run when two of ten readings exceed it:
    the peak of a touch is one. For robots that report it."""
    wait_for_gripper: bool = True
    """The arm waits while the gripper travels: real ones are slower than that of the training."""
    max_silence_ms: float = 300.0
    """Without a reading for so long the robot is told to hold and the run ends."""

    def __post_init__(self) -> None:
        for name in (
            "max_speed_m_s",
            "max_turn_rad_s",
            "max_tilt_rad",
            "max_force_n",
            "max_silence_ms",
        ):
            value = getattr(self, name)
            if not (np.isfinite(value) and value > 0):
                raise ValueError(f"{name} must be a number above 0, got {value}")
        if not all(
            low < high
            for low, high in zip(self.workspace_low_m, self.workspace_high_m, strict=True)
        ):
            raise ValueError(
                f"workspace_low_m {self.workspace_low_m} must lie below workspace_high_m {self.workspace_high_m}"
            )


@dataclass(frozen=True, kw_only=True)
class Limited:
    """An action that may be carried out."""

    action: Float[np.ndarray, "7"]
    acted: tuple[str, ...]
    """Which limits changed it: `range`, `gripper`, `speed`, `turn`, `lead`, `workspace`, `tilt`."""


class LimitStop(V2PError):  # noqa: N818 - it is no error of the program's
    """A limit that ends the run.

    Args:
        limit: its name.
        sentence: what happened, for a person.
    """

    def __init__(self, limit: str, sentence: str) -> None:
        super().__init__(sentence)
        self.limit = limit


class Guard:
    """Holds one run to its limits.

    Args:
        cfg: the limits.
        scale: what an action of 1 means.
        step_s: time between actions.
    """

    def __init__(self, cfg: LimitsConfig, scale: ActionScale, step_s: float = STEP_S) -> None:
        self.cfg, self.scale, self.step_s = cfg, scale, step_s
        self.low, self.high = np.array(cfg.workspace_low_m), np.array(cfg.workspace_high_m)
        self._last: np.ndarray | None = None
        self._pressing: deque[bool] = deque(maxlen=PRESSES_WITHIN)
        self._turns: deque[np.ndarray] = deque(maxlen=PENDING)
        self._wait = GripperWait() if cfg.wait_for_gripper else None

    def check_start(self, reading: Reading) -> None:
        """Refuse to begin where the arm is.

        Raises:
            LimitStop: the tool is outside the workspace, or leans too far.
        """
        outside = self._outside(reading)
        if outside > START_OUTSIDE_M:
            raise LimitStop(
                "workspace",
                f"the tool is at {_place(reading.tool_pos)}, {outside:.2f} m outside the workspace"
                f" {_place(self.low)} to {_place(self.high)}; move the arm inside, or widen the workspace",
            )
        self.look(reading)

    def look(self, reading: Reading) -> None:
        """Stop for what the robot reports.

        Raises:
            LimitStop: too much force, too fast, too far out, leaning too far.
        """
        cfg = self.cfg
        force = abs(reading.force_n or 0.0)
        self._pressing.append(not force <= cfg.max_force_n)  # so that no number counts as pressing
        if sum(self._pressing) >= PRESSES:
            raise LimitStop(
                "force",
                f"the contact force was {PRESSES} times above the limit of {cfg.max_force_n:.0f} N within"
                f" {PRESSES_WITHIN} readings, and is {force:.0f} N now: the tool presses on something; free it,"
                " or raise --limits.max-force-n",
            )
        outside = self._outside(reading)
        if outside > ESCAPED_M:
            raise LimitStop(
                "workspace",
                f"the tool is {outside:.2f} m outside the workspace, at "
                f"{_place(reading.tool_pos)}: something else moves"
                " the arm, or its calibration is off",
            )
        lean = _from_down(_pointing(reading))
        if lean > cfg.max_tilt_rad + 0.15:
            raise LimitStop(
                "tilt",
                f"the gripper leans by {np.degrees(lean):.0f} degrees from straight down, and"
                f" {np.degrees(cfg.max_tilt_rad):.0f} are allowed; set the arm upright, or raise --limits.max-tilt-rad",
            )
        last, self._last = self._last, reading.tool_pos.copy()
        if last is not None:
            speed = float(np.linalg.norm(reading.tool_pos - last)) / self.step_s
            if speed > OVERSPEED * max(cfg.max_speed_m_s, 0.1):
                raise LimitStop(
                    "speed",
                    f"the tool moves at {speed:.2f} m/s, and {cfg.max_speed_m_s:g} m/s are "
                    "allowed: something else moves"
                    " the arm, or readings were lost",
                )

    def limit(self, action: Float[np.ndarray, "7"], reading: Reading) -> Limited:
        """Return what of an action may be done.

        Raises:
            LimitStop: the action is no number.
        """
        if not np.isfinite(action).all():
            raise LimitStop(
                "range", f"the policy's action holds a value that is no number: {action.tolist()}"
            )
        acted: list[str] = []
        allowed = np.clip(action, -1.0, 1.0)
        if np.abs(action - allowed).max() > 1e-6:
            acted.append("range")
        if self._wait is not None and self._wait.is_waiting(
            float(reading.state[6]), float(reading.state[10])
        ):
            allowed[:6] = 0.0
            acted.append("gripper")
        shift = allowed[:3] * self.scale.position_step_m
        turn = allowed[3:6] * self.scale.rotation_step_rad
        # One factor for both: the arm goes the same way, later.
        slower = min(
            1.0,
            self._share(shift, self.cfg.max_speed_m_s, "speed", acted),
            self._share(turn, self.cfg.max_turn_rad_s, "turn", acted),
        )
        shift = self._shift(slower * shift, reading, acted)
        turn = self._turn(slower * turn, reading, acted)
        allowed[:3] = np.clip(shift / self.scale.position_step_m, -1.0, 1.0)
        allowed[3:6] = turn / self.scale.rotation_step_rad
        return Limited(action=allowed, acted=tuple(acted))

    def _share(self, motion: np.ndarray, limit_per_s: float, name: str, acted: list[str]) -> float:
        """Return how much of a step's motion a limit leaves."""
        length = float(np.linalg.norm(motion))
        share = limit_per_s * self.step_s / max(length, 1e-12)
        if share < 1 - 1e-9:
            acted.append(name)
        return min(1.0, share)

    def _shift(self, shift: np.ndarray, reading: Reading, acted: list[str]) -> np.ndarray:
        old = reading.target_pos
        lead = self.cfg.max_speed_m_s * LAG_S
        target = old + shift
        led = np.clip(target, reading.tool_pos - lead, reading.tool_pos + lead)
        # A target that is too far ahead already may come back, and need not jump.
        is_nearer = np.abs(target - reading.tool_pos) < np.abs(old - reading.tool_pos)
        led = np.where(is_nearer, target, led)
        if np.abs(led - target).max() > 1e-6:
            acted.append("lead")
        # From outside the box any way back in is allowed, none further out.
        low, high = np.minimum(self.low, old), np.maximum(self.high, old)
        boxed = np.clip(led, low, high)
        if np.abs(boxed - led).max() > 1e-6:
            acted.append("workspace")
        return boxed - old

    def _turn(self, turn: np.ndarray, reading: Reading, acted: list[str]) -> np.ndarray:
        # Where the tool will point once what was sent has been done, and with this turn.
        axis = _pointing(reading)
        for sent in self._turns:
            axis = Rotation.from_rotvec(sent).apply(axis)
        after = _from_down(Rotation.from_rotvec(turn).apply(axis))
        if after > self.cfg.max_tilt_rad and after > _from_down(axis):
            turn = np.array([0.0, 0.0, turn[2]])
            acted.append("tilt")
        self._turns.append(turn)
        return turn

    def _outside(self, reading: Reading) -> float:
        pos = reading.tool_pos
        return float(np.maximum(np.maximum(self.low - pos, pos - self.high), 0.0).max())


class Watchdog:
    """Calls `stop` from a thread of its own when nothing was heard for too long.

    Args:
        limit_ms: how long.
        stop: told once; must be safe to call while a reading is awaited.
    """

    def __init__(self, limit_ms: float, stop: Callable[[], None]) -> None:
        self.limit_s = limit_ms / 1000
        self._stop = stop
        self._heard = time.monotonic()
        self._done = threading.Event()
        self._thread = threading.Thread(target=self._watch, name="v2p-watchdog", daemon=True)
        self.has_bitten = False

    def __enter__(self) -> "Watchdog":
        self.heard()
        self._thread.start()
        return self

    def __exit__(self, *_: object) -> None:
        self._done.set()
        self._thread.join()

    def heard(self) -> None:
        """Start waiting anew: a reading came."""
        self._heard = time.monotonic()

    def _watch(self) -> None:
        while not self._done.wait(self.limit_s / 5):
            if time.monotonic() - self._heard > self.limit_s:
                self.has_bitten = True
                self._stop()
                return


def _pointing(reading: Reading) -> Float[np.ndarray, "3"]:
    """Return the direction in which the gripper points, in the world."""
    return reading.rotation.apply([0.0, 0.0, 1.0])


def _from_down(axis: Float[np.ndarray, "3"]) -> float:
    """Return the angle between a unit vector and straight down [rad]."""
    return float(np.arccos(np.clip(-axis[2], -1.0, 1.0)))


def _place(pos: np.ndarray) -> str:
    return "(" + ", ".join(f"{v:.2f}" for v in pos) + ")"

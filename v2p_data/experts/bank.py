"""Episodes that begin in the middle: saved worlds, from which training starts a share of its episodes.

A task that is rarely finished from its beginning is finished sooner from a moment at which somebody - a teacher, or
an expert of the same task - had done most of it. A bank holds such moments, each the whole state of one world, and
how many steps later success came. In reverse order (Florensa et al. 2017) the moments just before success come
first and earlier ones follow as the learner masters the earliest of those that are open. The first worlds always start plainly, so that what PPO
measures there stays honest; evaluating and recording use no bank.
"""

import json
import logging
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Bool, Float, Int

from v2p_data.errors import V2PError
from v2p_data.sim.batch_env import BatchEnv

logger = logging.getLogger(__name__)

LIFTED_M = 0.03
"""An object this far above its start is lifted."""
MIN_OPEN_ROWS = 32
"""So many moments are drawn from at least, however early it is in the curriculum."""
EARLIEST = 1 / 3
"""So much of what is open decides whether more is opened."""
UNKNOWN = -1
PLAIN = -1


@dataclass(frozen=True, kw_only=True)
class BankConfig:
    """How a training uses a bank."""

    share: float = 0.4
    """Of the episodes that begin from the bank, in worlds that may use it."""
    num_plain: int = 64
    """The first worlds never use it: PPO's deterministic ones, whose success is the one reported."""
    reverse: bool = False
    """Begin with the moments nearest to success, and go back from there."""
    first_part: float = 0.15
    """Of the bank that is open at level 0."""
    raise_at: float = 0.6
    """Success from the earliest open moments at which still earlier ones are opened."""
    raise_by: float = 0.1
    window_episodes: int = 64
    """Begun at the earliest third of the open moments, over which that success is taken. The later ones would hide
    that the learner comes no further: with all counted, everything was open while plain episodes never succeeded."""

    def __post_init__(self) -> None:
        for name in ("share", "first_part", "raise_at", "raise_by"):
            if not 0 <= getattr(self, name) <= 1:
                raise ValueError(f"{name} must be between 0 and 1, got {getattr(self, name)}")
        if self.window_episodes < 1 or self.num_plain < 0:
            raise ValueError(
                f"need window_episodes >= 1 and num_plain >= 0, got {self.window_episodes} and {self.num_plain}"
            )


@dataclass(frozen=True, kw_only=True)
class Bank:
    """Moments of one task's worlds, nearest to success first."""

    rows: dict[str, np.ndarray]
    """What `BatchEnv.rows` gave."""
    steps_left: Int[np.ndarray, "row"]
    """From the moment to where success began that held until the end; -1 where it never did."""

    def __len__(self) -> int:
        return len(self.steps_left)

    @property
    def is_solved(self) -> bool:
        """Whether success followed; otherwise the moments are merely the furthest that were reached."""
        return len(self) > 0 and bool((self.steps_left != UNKNOWN).all())

    def take(self, index: Int[np.ndarray, "n"]) -> dict[str, np.ndarray]:
        """Return some moments, for `BatchEnv.restore`."""
        return {name: rows[index] for name, rows in self.rows.items()}

    def save(self, path: Path) -> None:
        """Write it as `.npz`."""
        np.savez_compressed(path, steps_left=self.steps_left, **self.rows)  # pyright: ignore[reportArgumentType]

    @staticmethod
    def load(path: Path) -> "Bank":
        """Read what `save` wrote."""
        with np.load(path) as arrays:
            rows = dict(arrays)
        return Bank(steps_left=rows.pop("steps_left"), rows=rows)


def record_bank(
    env: BatchEnv,
    act: Callable[[], Float[np.ndarray, "env 7"]],
    *,
    every_steps: int = 4,
    max_rows: int = 2048,
) -> Bank:
    """Play one episode in every world and return moments on the way to success.

    If no episode succeeds, the moments are those at the furthest stage that any episode reached: touched, grasped,
    lifted. If nothing was even touched, the bank is empty.

    Args:
        env: worlds of the task, simulated as in training.
        act: what to do in them as they are now, e.g. a teacher's or an expert's actions.
        every_steps: control steps between two moments of one world.
        max_rows: more are thinned out evenly; a row takes about 8 kB.
    """
    everyone = np.arange(env.num_envs)
    env.reset(everyone)
    taken: list[dict[str, np.ndarray]] = []
    steps: list[int] = []
    stages: list[np.ndarray] = []
    sound: list[np.ndarray] = []
    held = np.zeros(env.num_envs, np.int64)
    is_held = np.zeros(env.num_envs, bool)
    for step in range(env.horizon):
        if step and step % every_steps == 0:
            taken.append(env.rows(everyone))
            steps.append(step)
            stages.append(_stages(env))
            sound.append(np.isfinite(env.observe()).all(1) & ~env.is_broken)
        result = env.step(act())
        held = np.where(result.success, held + 1, 0)
        is_held = result.held
    began = env.horizon - held + 1
    left = began[None] - np.array(steps)[:, None]
    keep = np.array(sound) & is_held[None] & (left > 0)
    if not keep.any():
        stage = np.array(stages)
        furthest = int(stage[np.array(sound)].max(initial=0))
        keep = np.array(sound) & (stage == furthest) & (furthest > 0)
        left = np.full_like(left, UNKNOWN)
    chosen = np.argwhere(keep)
    chosen = chosen[np.argsort(left[keep], kind="stable")]
    if len(chosen) > max_rows:
        chosen = chosen[np.linspace(0, len(chosen) - 1, max_rows).astype(int)]
    time, world = chosen.T
    rows = {name: np.stack([t[name] for t in taken])[time, world] for name in taken[0]}
    bank = Bank(rows=rows, steps_left=left[time, world])
    logger.info(
        "%d moments of %d episodes of %d succeeded", len(bank), int(is_held.sum()), env.num_envs
    )
    return bank


def use_bank(env: BatchEnv, bank: Bank, cfg: BankConfig) -> "Starts":
    """Let an environment's further resets draw from a bank, and return who draws.

    Raises:
        V2PError: the bank is empty or of other worlds, or the environment is one to judge or record in.
    """
    if env.cfg.fine:
        raise V2PError(
            "a reset bank was given to an environment with the fine time step, which judges and records; "
            "use it in the training environment only"
        )
    if not len(bank):
        raise V2PError(
            f"the reset bank for task '{env.bundle.title}' is empty: nothing was even touched while it was "
            "recorded; record it with another program, or train without"
        )
    fitting = {name: rows.shape[1:] for name, rows in env.rows(np.arange(1)).items()}
    given = {name: rows.shape[1:] for name, rows in bank.rows.items()}
    if fitting != given:
        wrong = sorted(k for k in fitting.keys() | given.keys() if fitting.get(k) != given.get(k))
        raise V2PError(
            f"the reset bank is not of task '{env.bundle.title}': {', '.join(wrong)} differ; "
            "record it in an environment of the same task and robot"
        )
    env.starts = Starts(bank, cfg)
    return env.starts


class Starts:
    """Draws from a bank for one environment, and remembers how far the curriculum is: a `batch_env.ResetSource`.

    Args:
        bank: the moments.
        cfg: how they are used.

    Attributes:
        level: 0 where only moments near success are open, 1 where all are; 1 without `reverse`.
    """

    def __init__(self, bank: Bank, cfg: BankConfig) -> None:
        self.bank, self.cfg = bank, cfg
        # Moments that nothing followed have no order.
        self.level = 0.0 if cfg.reverse and bank.is_solved else 1.0
        self._outcomes: list[bool] = []

    @property
    def num_open(self) -> int:
        """How many moments are drawn from now."""
        part = self.cfg.first_part + (1 - self.cfg.first_part) * self.level
        return min(len(self.bank), max(MIN_OPEN_ROWS, round(part * len(self.bank))))

    def draw(self, ids: Int[np.ndarray, "n"], rng: np.random.Generator) -> Int[np.ndarray, "n"]:
        """Return the bank's row that each of the worlds starts from; -1 for a plain start."""
        is_banked = (rng.random(len(ids)) < self.cfg.share) & (ids >= self.cfg.num_plain)
        return np.where(is_banked, rng.integers(0, self.num_open, len(ids)), PLAIN)

    def take(self, index: Int[np.ndarray, "n"]) -> dict[str, np.ndarray]:
        """Return the moments of some rows, for `BatchEnv.restore`."""
        return self.bank.take(index)

    def note(self, rows: Int[np.ndarray, "n"], succeeded: Bool[np.ndarray, "n"]) -> None:
        """Take in how episodes that began at some rows ended."""
        if self.level >= 1:
            return
        is_early = rows >= (1 - EARLIEST) * self.num_open
        self._outcomes += succeeded[is_early].tolist()
        del self._outcomes[: -self.cfg.window_episodes]
        is_full = len(self._outcomes) == self.cfg.window_episodes
        if is_full and np.mean(self._outcomes) >= self.cfg.raise_at:
            self.level = min(1.0, self.level + self.cfg.raise_by)
            self._outcomes.clear()
            logger.info("curriculum: level %.2f, %d moments open", self.level, self.num_open)

    def state(self) -> str:
        """Return level and outcomes as text, for a checkpoint."""
        return json.dumps({"level": self.level, "outcomes": self._outcomes})

    def load_state(self, text: str) -> None:
        """Go on from what `state` gave."""
        saved: dict[str, Any] = json.loads(text)
        self.level, self._outcomes = float(saved["level"]), list(saved["outcomes"])


def _stages(env: BatchEnv) -> Int[np.ndarray, "env"]:
    """Return how far each world is: 0 nothing, 1 an object is touched, 2 grasped, 3 grasped and lifted."""
    states = env.states()
    stage = np.zeros(env.num_envs, int)
    for name in env.object_names:
        grasped = states[f"{name}_grasped"].numpy() > 0.5
        height = (states[f"{name}_pos"] - states[f"{name}_start_pos"])[:, 2].numpy()
        here = np.where(states[f"{name}_touched"].numpy() > 0.5, 1, 0)
        here = np.where(grasped, np.where(height > LIFTED_M, 3, 2), here)
        stage = np.maximum(stage, here)
    return stage

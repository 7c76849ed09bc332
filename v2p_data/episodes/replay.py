"""Published episodes are played again from their seeds and actions: do the same states and successes come back?

An episode's world follows from its batch's seed, its number in that batch and the randomisation
that the dataset's record names. The tasks are those that the dataset carries. Handovers cannot be
played again: where a student acted, the dataset holds the expert's labels.
"""

import hashlib
from collections import defaultdict
from collections.abc import Callable, Iterator, Mapping
from dataclasses import asdict, dataclass, replace
from importlib.metadata import version
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow.parquet as pq
from jaxtyping import Bool, Float32

from v2p_data.episodes.config import EpisodesConfig
from v2p_data.episodes.dataset.about import CARRIED_TASKS, demand_about
from v2p_data.episodes.dataset.features import (
    ACTION_KEY,
    EXECUTED_KEY,
    HANDOVER,
    METADATA_FILE,
    REWARD_KEY,
    STATE_KEY,
    SUCCESS_KEY,
)
from v2p_data.episodes.dataset.intake import demand_bounded
from v2p_data.episodes.dataset.tables import (
    DATA_GLOB,
    column,
    damage_named,
    demand_sound,
    read_info,
    row_spans,
)
from v2p_data.episodes.rollouts import Lesson, Rollouts, roll_out
from v2p_data.errors import V2PError
from v2p_data.pipeline.settings import from_values
from v2p_data.play import StateActor
from v2p_data.sim.env.batch_env import SimConfig
from v2p_data.task.task import TaskBundle

SAME = 1e-9
"""Largest difference of states [m, rad] that counts as none."""
SAME_REWARD = 1e-5
"""Likewise of rewards, where a full one is 1: task code may use functions that processors round differently."""
MAX_WORLDS = 4096
"""A stranger's record may not ask for more worlds at a time."""


@dataclass(frozen=True, kw_only=True)
class Recorded:
    """An episode as the dataset has it."""

    number: int
    """In the dataset."""
    world: int
    """In its batch."""
    state: Float32[np.ndarray, "time state"]
    action: Float32[np.ndarray, "time 7"]
    success: Bool[np.ndarray, "time"]
    reward: Float32[np.ndarray, "time"] | None = None
    """None in datasets of earlier versions."""


@dataclass(frozen=True, kw_only=True)
class Replayed:
    """What became of an episode that was played again."""

    episode: int
    item: str
    state_error: float
    """Largest difference of a state from the recorded one [m, rad]."""
    reward_error: float
    """Largest difference of `next.reward` from the recorded one; 0 where none was."""
    same_success: bool
    """`next.success` is the same in every row, the length too, and the referee agrees again."""

    @property
    def is_same(self) -> bool:
        is_near = self.state_error <= SAME and self.reward_error <= SAME_REWARD
        return self.same_success and is_near


@dataclass(frozen=True, kw_only=True)
class ReplayReport:
    """What came back."""

    episodes: tuple[Replayed, ...]
    skipped: int
    """Handovers."""
    digest: str
    """SHA-256 of the states that came back, as float32, in the dataset's order."""
    note: str
    """Which version differs from the one that the episodes were made with; empty where none does."""

    @property
    def is_same(self) -> bool:
        return all(e.is_same for e in self.episodes)

    def lines(self) -> list[str]:
        """Return a line per episode that did not come back, the note, and the sum."""
        others = [
            f"episode {e.episode} ({e.item}): states differ by up to {e.state_error:.2g}, "
            f"rewards by {e.reward_error:.2g}, success is {'the same' if e.same_success else 'another'}"
            for e in self.episodes
            if not e.is_same
        ]
        same = len(self.episodes) - len(others)
        left = f"; {self.skipped} handovers cannot be replayed" if self.skipped else ""
        total = (
            f"{same} of {len(self.episodes)} episodes came back with the same states, rewards "
            f"and success{left}; states {self.digest[:16]}"
        )
        return [*others, *([self.note] if self.note else []), total]

    def as_json(self) -> dict[str, Any]:
        """Return it for a file."""
        return asdict(self)


def replay(
    root: Path,
    *,
    num_episodes: int | None = None,
    num_threads: int = 1,
    on_progress: Callable[[float, str], None] = lambda share, words: None,
) -> ReplayReport:
    """Play the first `num_episodes` demonstrations of the dataset at `root` again, all by default.

    Raises:
        V2PError: it is no dataset of ours, does not say how it was recorded, carries no tasks, or has only handovers.
    """
    info = read_info(root)
    demand_bounded(root)
    about = demand_about(root)
    demand_sound(root, info)
    with damage_named(root):
        batches, skipped = _batches(root, about, num_episodes or int(info["total_episodes"]))
    total = sum(map(len, batches.values()))
    if not total:
        raise V2PError(
            f"{root} holds handovers only; the dataset of demonstrations can be replayed"
        )
    done: list[tuple[Replayed, np.ndarray]] = []
    for (item, seed), episodes in batches.items():
        on_progress(len(done) / total, f"{len(done)}/{total} episodes")
        bundle, cfg = TaskBundle.load(root / CARRIED_TASKS / item), _recipe(about, item)
        rollouts = _played(bundle, cfg, seed, episodes, num_threads)
        done += [_compared(rollouts, e, item, e.world % cfg.batch_worlds) for e in episodes]
    done.sort(key=lambda pair: pair[0].episode)
    digest = hashlib.sha256(b"".join(states.tobytes() for _, states in done))
    return ReplayReport(
        episodes=tuple(e for e, _ in done),
        skipped=skipped,
        digest=digest.hexdigest(),
        note=_other_version(about),
    )


def _batches(
    root: Path, about: Mapping[str, Any], at_most: int
) -> tuple[dict[tuple[str, int], list[Recorded]], int]:
    """Return the demonstrations by task and batch's seed, and the number of handovers."""
    batches: dict[tuple[str, int], list[Recorded]] = defaultdict(list)
    handovers = found = 0
    for number, columns in _rows(root):
        entry = about["episodes"][number]
        if entry.get("source") == HANDOVER:
            handovers += 1
        elif found < at_most:
            found += 1
            world = int(entry["id"].rpartition("_")[2])
            batches[entry["item"], entry["seed"]].append(
                Recorded(number=number, world=world, **columns)
            )
    return batches, handovers


def _rows(root: Path) -> Iterator[tuple[int, dict[str, np.ndarray]]]:
    names = {"state": STATE_KEY, "action": ACTION_KEY, "success": SUCCESS_KEY}
    for path in sorted(root.glob(DATA_GLOB)):
        there = pq.read_schema(path).names
        if REWARD_KEY in there:
            names["reward"] = REWARD_KEY
        if EXECUTED_KEY in there:
            names["action"] = EXECUTED_KEY
        table = pq.read_table(path, columns=["episode_index", *names.values()])
        for number, (first, length) in row_spans(column(table, "episode_index")).items():
            rows = table.slice(first, length)
            columns = {k: np.array(rows[n].to_pylist(), np.float32) for k, n in names.items()}
            yield number, columns | {"success": columns["success"].reshape(length) > 0}


def _recipe(about: Mapping[str, Any], item: str) -> EpisodesConfig:
    """Return how the episodes of a task were recorded."""
    place = f"{METADATA_FILE}:provenance.items.{item}.recipe.config.config"
    values: Any = about["provenance"]
    for key in ("items", item, "recipe", "config", "config"):
        values = values.get(key) if isinstance(values, dict) else None
    if values is None:
        raise V2PError(f"{place} is missing: it does not say under what '{item}' was recorded")
    cfg = from_values(EpisodesConfig, values, place)
    if cfg.batch_worlds > MAX_WORLDS:
        raise V2PError(
            f"{place}.batch_worlds is {cfg.batch_worlds}; at most {MAX_WORLDS} worlds are replayed at a time"
        )
    return cfg


def _played(
    bundle: TaskBundle,
    cfg: EpisodesConfig,
    seed: int,
    episodes: list[Recorded],
    num_threads: int,
) -> Rollouts:
    """Return the whole batch, with the recorded actions in the worlds that have some."""
    actions = np.zeros((bundle.horizon_steps, cfg.batch_worlds, 7), np.float32)
    for e in episodes:  # a longer one than its task lets be is played to the task's end
        actions[: len(e.action), e.world % cfg.batch_worlds] = e.action[: len(actions)]
    rows = iter(actions)
    return roll_out(
        Lesson(bundle=bundle, expert=StateActor(lambda obs: next(rows))),
        SimConfig(fine=True, randomization=cfg.randomization),
        num_worlds=cfg.batch_worlds,
        seed=seed,
        num_threads=num_threads,
        cut=cfg.cut,
        interface=replace(cfg.interface, actions="delta_tool"),
    )


def _compared(
    rollouts: Rollouts, recorded: Recorded, item: str, world: int
) -> tuple[Replayed, np.ndarray]:
    length = min(len(recorded.state), len(rollouts.state))
    states = rollouts.state[:length, world]
    held = np.arange(length) >= rollouts.held_at[world]
    same = (
        rollouts.num_frames[world] == len(recorded.state)
        and bool(rollouts.successes[world])
        and np.array_equal(held, recorded.success[:length])
    )
    error = float(np.abs(states.astype(float) - recorded.state[:length]).max())
    earned = rollouts.reward[:length, world]
    noted = earned if recorded.reward is None else recorded.reward[:length]
    replayed = Replayed(
        episode=recorded.number,
        item=item,
        state_error=error,
        reward_error=float(np.abs(earned - noted).max()),
        same_success=bool(same),
    )
    return replayed, states


def _other_version(about: Mapping[str, Any]) -> str:
    made = about["provenance"].get("packages", {}).get("mujoco")
    here = version("mujoco")
    if made in (None, here):
        return ""
    return (
        f"{METADATA_FILE}:provenance.packages.mujoco is {made}, this is {here}: physics may differ"
    )

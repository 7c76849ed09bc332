"""Roll an expert out under randomisation and stage what succeeded.

Physics first, pictures after: a batch of worlds runs to its end while states are saved, then only the
successful episodes are drawn. A batch follows from (seed, its number) alone and is written down in a ledger
once its episodes are staged, so a killed run that is started again makes the same files as an undisturbed
one. An episode succeeds if the task's own success held and the independent referee agrees; it is cut soon
after, and the referee sees it as cut.
"""

import json
import logging
from collections import Counter
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Bool, Float32, Int

from v2p_data.episodes.features import FPS
from v2p_data.episodes.staging import EPISODES_FOLDER, Episode, staged_episodes
from v2p_data.errors import ItemRejectedError
from v2p_data.pipeline.artifact import REJECTS_FILE, write_json_atomically, write_rejects
from v2p_data.seeds import seed_for
from v2p_data.sim import randomize
from v2p_data.sim.batch_env import BatchEnv, SimConfig, Snapshot
from v2p_data.sim.masks import MaskRenderer
from v2p_data.sim.randomize import RandomizationConfig
from v2p_data.sim.verdict import referee_verdict
from v2p_data.task.task import Task, TaskBundle

logger = logging.getLogger(__name__)

LEDGER_FOLDER = "batches"
Act = Callable[[Float32[np.ndarray, "env obs"]], Float32[np.ndarray, "env act"]]
Course = Mapping[str, np.ndarray]
"""Per key of the task interface's `states` an array `(time, env, ...)`, the moment after the reset first."""
Referee = Callable[[TaskBundle, Course], Bool[np.ndarray, "env"]]
Progress = Callable[[float, str], None]


@dataclass(frozen=True, kw_only=True)
class CutConfig:
    """Where an episode ends."""

    tail_steps: int = 6
    """Control steps kept after success has held (0.3 s): a policy sees what being done looks like, and the
    referee whether it lasts."""
    min_frames: int = 10
    """Shorter episodes go on up to this length."""


@dataclass(frozen=True, kw_only=True)
class EpisodesConfig:
    """How many demonstrations are collected, and under what."""

    num_episodes: int = 100
    """Successful episodes per task; the paper's policies learn from 100."""
    batch_worlds: int = 64
    """Worlds that run at the same time; part of the recipe, because it decides which world is which."""
    max_batches: int = 10
    """After this many the task makes do with what it has."""
    min_episodes: int = 1
    """With fewer the task is rejected."""
    size_px: int = 256
    """Width and height of the masks."""
    cut: CutConfig = field(default_factory=CutConfig)
    randomization: RandomizationConfig = field(default_factory=randomize.recording)

    def __post_init__(self) -> None:
        if not 1 <= self.min_episodes <= self.num_episodes:
            raise ValueError(
                f"need 1 <= min_episodes <= num_episodes, got {self.min_episodes} and {self.num_episodes}"
            )
        if self.batch_worlds < 1 or self.max_batches < 1:
            raise ValueError("batch_worlds and max_batches must be at least 1")


@dataclass(frozen=True, kw_only=True)
class Rollouts:
    """One batch of episodes, drawn later or never. Row `t` precedes action `t`."""

    seed: int
    state: Float32[np.ndarray, "time env 7"]
    action: Float32[np.ndarray, "time env 7"]
    success: Bool[np.ndarray, "time env"]
    """The task's judgement after action `t`."""
    snapshots: tuple[Snapshot, ...]
    """All worlds, before action `t`."""
    num_frames: Int[np.ndarray, "env"]
    """Rows that belong to the episode."""
    held_at: Int[np.ndarray, "env"]
    """Row at whose end success had held for the first time; beyond the last row where it never did."""
    task_successes: Bool[np.ndarray, "env"]
    """The task's success held."""
    referee: Bool[np.ndarray, "env"]
    """The independent success function agrees."""
    broke: Bool[np.ndarray, "env"]
    """The simulation broke down during the episode."""
    params: tuple[dict[str, Any], ...]
    """What the randomisation drew, per world."""

    @property
    def successes(self) -> Bool[np.ndarray, "env"]:
        return self.task_successes & self.referee

    @property
    def snapshot_seconds(self) -> tuple[float, ...]:
        return tuple(t / FPS for t in range(len(self.snapshots)))

    def reject(self, world: int) -> dict[str, Any]:
        """Return why the episode of `world` is no demonstration."""
        steps_true = int(self.success[:, world].sum())
        if self.broke[world]:
            return {"reason": "simulation_broke", "detail": "the state was not finite",
                    "value": int(self.num_frames[world])}  # fmt: skip
        if not self.task_successes[world]:
            return {"reason": "not_successful", "value": steps_true,
                    "detail": f"success was true in {steps_true} steps and never held"}  # fmt: skip
        return {"reason": "referee_disagrees", "value": int(self.num_frames[world]),
                "detail": "the task's success held, the independent one did not"}  # fmt: skip


@dataclass(frozen=True, kw_only=True)
class Collected:
    """What lies in an episodes folder."""

    paths: tuple[Path, ...]
    num_frames: int
    num_rollouts: int
    num_successes: int
    num_task_successes: int
    rejected: dict[str, int]
    """How many episodes were rejected, by reason."""

    def counts(self) -> dict[str, Any]:
        """Return it for the record."""
        return {
            "episodes": len(self.paths),
            "frames": self.num_frames,
            "rollouts": self.num_rollouts,
            "success": round(self.num_successes / self.num_rollouts, 4),
            "task_success": round(self.num_task_successes / self.num_rollouts, 4),
            "rejected": self.rejected,
        }


def collect(
    bundle: TaskBundle,
    act: Act,
    cfg: EpisodesConfig,
    out: Path,
    seed: int,
    *,
    num_threads: int = 1,
    on_progress: Progress = lambda share, words: None,
    task: type[Task] | None = None,
    referee: Referee | None = None,
) -> Collected:
    """Stage `cfg.num_episodes` successful episodes under `out`; go on where an earlier call was stopped.

    Args:
        bundle: the task.
        act: the deterministic expert.
        cfg: how many, and under what.
        out: `episodes/<id>.npz`, `rejected.jsonl` and `batches/` are written here.
        seed: decides everything that is drawn.
        num_threads: for the physics; changes no result.
        on_progress: told the share that is done and a few words.
        task: the task, instead of `bundle.code`.
        referee: the independent judge, instead of `task.referee`.

    Raises:
        ItemRejectedError: after `cfg.max_batches` there are fewer than `cfg.min_episodes`.
    """
    folder, ledgers = out / EPISODES_FOLDER, out / LEDGER_FOLDER
    folder.mkdir(parents=True, exist_ok=True)
    ledgers.mkdir(exist_ok=True)
    for leftover in [*folder.glob("*.tmp"), *ledgers.glob("*.tmp")]:
        leftover.unlink()
    batches: list[dict[str, Any]] = []
    for number in range(cfg.max_batches):
        have = sum(len(b["episodes"]) for b in batches)
        if have >= cfg.num_episodes:
            break
        ledger = ledgers / f"{number:03d}.json"
        if not ledger.is_file():
            on_progress(
                have / cfg.num_episodes, f"{have}/{cfg.num_episodes} episodes, batch {number + 1}"
            )
            rollouts = roll_out(
                bundle,
                act,
                SimConfig(fine=True, randomization=cfg.randomization),
                num_worlds=cfg.batch_worlds,
                seed=seed_for(seed, "batch", number),
                num_threads=num_threads,
                cut=cfg.cut,
                task=task,
                referee=referee,
            )
            entry = _stage(bundle, rollouts, cfg, folder, number, have, on_progress)
            write_json_atomically(ledger, entry)
        batches.append(json.loads(ledger.read_text()))
    return _finish(bundle, cfg, out, batches)


def judge_expert(
    bundle: TaskBundle,
    act: Act,
    *,
    episodes: int,
    seed: int,
    num_threads: int = 1,
    randomization: RandomizationConfig | None = None,
    task: type[Task] | None = None,
    referee: Referee | None = None,
) -> Rollouts:
    """Return `episodes` fresh episodes at the fine time step under recording conditions, judged."""
    return roll_out(
        bundle,
        act,
        SimConfig(fine=True, randomization=randomization or randomize.recording()),
        num_worlds=episodes,
        seed=seed,
        num_threads=num_threads,
        cut=CutConfig(),
        task=task,
        referee=referee,
    )


def roll_out(
    bundle: TaskBundle,
    act: Act,
    sim: SimConfig,
    *,
    num_worlds: int,
    seed: int,
    num_threads: int = 1,
    cut: CutConfig,
    task: type[Task] | None = None,
    referee: Referee | None = None,
) -> Rollouts:
    """Run one episode in every world until each has succeeded or its time is up."""
    env = BatchEnv(bundle, sim, num_envs=num_worlds, seed=seed, num_threads=num_threads, task=task)
    everyone = np.arange(num_worlds)
    params = tuple(env.episode_params(k) for k in range(num_worlds))
    obs = env.observe()
    states, actions, successes, snapshots = [], [], [], []
    trajectory = [_copied(env)]
    held = np.zeros(num_worlds, bool)
    broke = np.zeros(num_worlds, bool)
    end = np.full(num_worlds, env.horizon)
    held_at = end.copy()
    for t in range(env.horizon):
        states.append(env.robot_state())
        snapshots.append(env.snapshot(everyone))
        action = np.clip(np.asarray(act(obs), np.float32), -1.0, 1.0)
        result = env.step(action)
        obs = result.obs
        actions.append(action)
        successes.append(result.success)
        trajectory.append(_copied(env))
        now = result.held & ~held & ~broke
        end[now] = np.clip(t + 1 + cut.tail_steps, cut.min_frames, env.horizon)
        held_at[now] = t
        held |= now
        gone = result.terminated & ~broke & (t < end)
        end[gone] = t + 1
        broke |= gone
        if (t + 1 >= end).all():
            break
    held &= ~broke
    judge = referee or referee_verdict
    verdict = judge(bundle, _as_cut(trajectory, end)) & held if held.any() else held
    return Rollouts(
        seed=seed,
        state=np.stack(states),
        action=np.stack(actions),
        success=np.stack(successes),
        snapshots=tuple(snapshots),
        num_frames=end,
        held_at=held_at,
        task_successes=held,
        referee=verdict,
        broke=broke,
        params=params,
    )


def _copied(env: BatchEnv) -> dict[str, np.ndarray]:
    return {
        key: value.numpy().copy()
        for key, value in env.states().items()
        if key != "base_observation"
    }


def _as_cut(moments: list[dict[str, np.ndarray]], end: Int[np.ndarray, "env"]) -> Course:
    """Return the moments stacked, each world standing still from its episode's end on."""
    time = np.minimum(np.arange(len(moments))[:, None], end[None])
    worlds = np.arange(len(end))
    return {key: np.stack([m[key] for m in moments])[time, worlds] for key in moments[0]}


def _stage(
    bundle: TaskBundle,
    rollouts: Rollouts,
    cfg: EpisodesConfig,
    folder: Path,
    batch: int,
    have: int,
    on_progress: Progress,
) -> dict[str, Any]:
    """Draw and write the successful episodes that are still wanted; return the batch's ledger."""

    def name(world: int) -> str:
        return f"{bundle.title}_{batch * cfg.batch_worlds + world:05d}"

    winners = [int(w) for w in np.flatnonzero(rollouts.successes)]
    kept = winners[: cfg.num_episodes - have]
    missing = [w for w in kept if not (folder / f"{name(w)}.npz").is_file()]
    if missing:
        with MaskRenderer(bundle, cfg.size_px) as renderer:
            for world in missing:
                _drawn(bundle, rollouts, world, name(world), renderer).save(folder)
                done = have + sum((folder / f"{name(w)}.npz").is_file() for w in kept)
                on_progress(done / cfg.num_episodes, f"{done}/{cfg.num_episodes} episodes")
    losers = np.flatnonzero(~rollouts.successes)
    return {
        "episodes": [name(w) for w in kept],
        "frames": int(rollouts.num_frames[kept].sum()),
        "rollouts": len(rollouts.successes),
        "successes": len(winners),
        "task_successes": int(rollouts.task_successes.sum()),
        "rejected": [{"id": name(int(w)), **rollouts.reject(int(w))} for w in losers],
    }


def _drawn(
    bundle: TaskBundle, rollouts: Rollouts, world: int, episode_id: str, renderer: MaskRenderer
) -> Episode:
    length = int(rollouts.num_frames[world])
    return Episode(
        id=episode_id,
        item=bundle.title,
        task=bundle.description,
        seed=rollouts.seed,
        labels=np.stack([renderer.draw(s, world) for s in rollouts.snapshots[:length]]),
        state=rollouts.state[:length, world].copy(),
        action=rollouts.action[:length, world].copy(),
        success=np.arange(length) >= rollouts.held_at[world],
        referee=bool(rollouts.referee[world]),
        objects=tuple(o.name for o in bundle.scene.objects),
        params=rollouts.params[world],
    )


def _finish(
    bundle: TaskBundle, cfg: EpisodesConfig, out: Path, batches: list[dict[str, Any]]
) -> Collected:
    rejected = [row for b in batches for row in b["rejected"]]
    (out / REJECTS_FILE).unlink(missing_ok=True)
    write_rejects(out, rejected)
    paths = tuple(staged_episodes(out))
    collected = Collected(
        paths=paths,
        num_frames=sum(b["frames"] for b in batches),
        num_rollouts=sum(b["rollouts"] for b in batches),
        num_successes=sum(b["successes"] for b in batches),
        num_task_successes=sum(b["task_successes"] for b in batches),
        rejected=dict(Counter(row["reason"] for row in rejected).most_common()),
    )
    if len(paths) < cfg.min_episodes:
        reasons = ", ".join(f"{n} {reason}" for reason, n in collected.rejected.items())
        raise ItemRejectedError(
            "too_few_episodes",
            f"'{bundle.title}': {len(paths)} of {collected.num_rollouts} episodes succeeded ({reasons}), "
            f"fewer than {cfg.min_episodes}",
            float(len(paths)),
        )
    if len(paths) < cfg.num_episodes:
        logger.warning("%s: only %d of %d episodes after %d batches",
                       bundle.title, len(paths), cfg.num_episodes, len(batches))  # fmt: skip
    return collected

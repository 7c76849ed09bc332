"""Roll an expert out under randomisation and stage what succeeded.

Physics first, pictures after: a batch of worlds runs to its end while states are saved, then only the
successful episodes are drawn. A batch follows from (seed, its number) alone and is written down in a ledger
once its episodes are staged, so a killed run that is started again makes the same files as an undisturbed
one. An episode succeeds if the task's own success held and the independent referee agrees; it is cut soon
after, and the referee sees it as cut. What failed is kept aside, with its reason and without pictures.
"""

import json
import logging
from collections import Counter
from collections.abc import Callable, Iterator
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np

from v2p_data.episodes.config import EpisodesConfig
from v2p_data.episodes.pictures import Artist
from v2p_data.episodes.rollouts import CutConfig, Lesson, Rollouts, roll_out
from v2p_data.episodes.staging import (
    EPISODES_FOLDER,
    Episode,
    refusals_named,
    save_arrays,
    staged_episodes,
)
from v2p_data.errors import ItemRejectedError
from v2p_data.json_files import read_object
from v2p_data.pipeline.artifact import write_json_atomically, write_rejects
from v2p_data.seeds import seed_for
from v2p_data.sim.env.batch_env import SimConfig
from v2p_data.task.task import TaskBundle

logger = logging.getLogger(__name__)

LEDGER_FOLDER = "batches"
FAILED_FOLDER = "failed"
Progress = Callable[[float, str], None]


def collect(
    lesson: Lesson,
    cfg: EpisodesConfig,
    out: Path,
    seed: int,
    *,
    num_threads: int = 1,
    on_progress: Progress = lambda share, words: None,
) -> dict[str, Any]:
    """Stage `cfg.num_episodes` successful episodes under `out` and count them; go on where an earlier call was stopped.

    Args:
        lesson: the task and its deterministic expert.
        cfg: how many, and under what.
        out: `episodes/<id>.npz`, `failed/<batch>.npz`, `rejected.jsonl` and `batches/` are written here.
        seed: decides everything that is drawn.
        num_threads: for physics, masks and writing; changes no result.
        on_progress: called with the share that is done and a few words.

    Raises:
        ItemRejectedError: after `cfg.max_batches` there are fewer than `cfg.min_episodes`.
        V2PError: the disk is full, or `out` cannot be written to; what was staged is kept.
    """
    with refusals_named("collecting episodes", out):
        folders = [out / name for name in (EPISODES_FOLDER, LEDGER_FOLDER, FAILED_FOLDER)]
        for folder in folders:
            folder.mkdir(parents=True, exist_ok=True)
            for leftover in folder.glob("*.tmp"):
                leftover.unlink()
        batches: list[dict[str, Any]] = []
        for number in range(cfg.max_batches):
            have = sum(len(b["episodes"]) for b in batches)
            if have >= cfg.num_episodes:
                break
            ledger = out / LEDGER_FOLDER / f"{number:03d}.json"
            if not ledger.is_file():
                on_progress(
                    have / cfg.num_episodes,
                    f"{have}/{cfg.num_episodes} episodes, batch {number + 1}",
                )
                rollouts = roll_out(
                    lesson,
                    SimConfig(fine=True, randomization=cfg.randomization),
                    num_worlds=cfg.batch_worlds,
                    seed=seed_for(seed, "batch", number),
                    num_threads=num_threads,
                    cut=cfg.cut,
                    interface=cfg.interface,
                )
                artist = Artist(lesson.bundle, cfg, num_threads)
                write_json_atomically(
                    ledger, _stage(artist, rollouts, out, number, have, on_progress)
                )
            batches.append(read_object(ledger, "delete it; its batch is made again"))
        return _finish(lesson.bundle, cfg, out, batches)


def judge_expert(
    lesson: Lesson,
    *,
    episodes: int,
    seed: int,
    num_threads: int = 1,
) -> Rollouts:
    """Return `episodes` fresh episodes at the fine time step under recording conditions, judged."""
    return roll_out(
        lesson,
        SimConfig(fine=True),
        num_worlds=episodes,
        seed=seed,
        num_threads=num_threads,
        cut=CutConfig(),
    )


def _stage(
    artist: Artist,
    rollouts: Rollouts,
    out: Path,
    batch: int,
    have: int,
    on_progress: Progress,
) -> dict[str, Any]:
    """Draw and write the successful episodes that are still wanted; return the batch's ledger."""
    cfg = artist.cfg

    def name(world: int) -> str:
        return f"{artist.bundle.title}_{batch * cfg.batch_worlds + world:05d}"

    folder = out / EPISODES_FOLDER
    winners = [int(w) for w in np.flatnonzero(rollouts.successes)]
    losers = [int(w) for w in np.flatnonzero(~rollouts.successes)]
    kept = winners[: cfg.num_episodes - have]
    missing = [w for w in kept if not (folder / f"{name(w)}.npz").is_file()]
    done = have + len(kept) - len(missing)
    with _writer(folder) as write, artist:
        for world in missing:
            write(artist.episode(rollouts, world, name(world)))
            done += 1
            on_progress(done / cfg.num_episodes, f"{done}/{cfg.num_episodes} episodes")
    _keep_aside(rollouts, losers, [name(w) for w in losers], out, batch)
    return {
        "episodes": [name(w) for w in kept],
        "frames": int(rollouts.num_frames[kept].sum()),
        "rollouts": len(rollouts.successes),
        "successes": len(winners),
        "task_successes": int(rollouts.task_successes.sum()),
        "rejected": [{"id": name(w), **rollouts.reject(w)} for w in losers],
    }


@contextmanager
def _writer(folder: Path) -> Iterator[Callable[[Episode], None]]:
    """Yield what writes an episode while the next one is drawn; in the end all are written."""
    waiting: list[Future[Path]] = []
    with ThreadPoolExecutor(1) as pool:

        def write(episode: Episode) -> None:
            if len(waiting) > 1:  # two in memory are enough
                waiting.pop(0).result()
            waiting.append(pool.submit(episode.save, folder))

        yield write
        for future in waiting:
            future.result()


def _keep_aside(
    rollouts: Rollouts, losers: list[int], names: list[str], out: Path, batch: int
) -> None:
    """Write what failed in a batch, end to end, without pictures."""
    if not losers:
        return
    lengths = rollouts.num_frames[losers]

    def rows(values: np.ndarray) -> np.ndarray:
        return np.concatenate([values[:n, w] for n, w in zip(lengths, losers, strict=True)])

    about = [
        {"id": name, "num_frames": int(n), "params": rollouts.params[w], **rollouts.reject(w)}
        for name, n, w in zip(names, lengths, losers, strict=True)
    ]
    arrays = {name: rows(getattr(rollouts, name)) for name in ("state", "action", "success")}
    arrays["about"] = np.array(json.dumps(about, sort_keys=True))
    save_arrays(out / FAILED_FOLDER / f"{batch:03d}.npz", arrays)


def _finish(
    bundle: TaskBundle, cfg: EpisodesConfig, out: Path, batches: list[dict[str, Any]]
) -> dict[str, Any]:
    rejected = [row for b in batches for row in b["rejected"]]
    write_rejects(out, rejected)
    num_episodes = len(staged_episodes(out))
    num_rollouts = sum(b["rollouts"] for b in batches)
    by_reason = dict(Counter(row["reason"] for row in rejected).most_common())
    if num_episodes < cfg.min_episodes:
        reasons = ", ".join(f"{n} {reason}" for reason, n in by_reason.items())
        raise ItemRejectedError(
            "too_few_episodes",
            f"'{bundle.title}': {num_episodes} of {num_rollouts} episodes succeeded ({reasons}), "
            f"fewer than {cfg.min_episodes}",
            float(num_episodes),
        )
    if num_episodes < cfg.num_episodes:
        logger.warning(
            "%s: only %d of %d episodes after %d batches",
            bundle.title,
            num_episodes,
            cfg.num_episodes,
            len(batches),
        )
    return {
        "episodes": num_episodes,
        "frames": sum(b["frames"] for b in batches),
        "rollouts": num_rollouts,
        "success": round(sum(b["successes"] for b in batches) / num_rollouts, 4),
        "task_success": round(sum(b["task_successes"] for b in batches) / num_rollouts, 4),
        "rejected": by_reason,
    }

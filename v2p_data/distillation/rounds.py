"""Training and collecting in turn: each round's student begins the episodes that the next one learns from.

A batch of episodes follows from the seed, the round, the batch's number and the student. It is written down in a
ledger once it is staged, and students are kept until the next one exists, so a killed distillation that is started
again makes the same files as an undisturbed one.
"""

import logging
import shutil
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Protocol, runtime_checkable

import numpy as np
from jaxtyping import Float32, UInt8

from v2p_data.distillation.config import DistillationConfig
from v2p_data.distillation.handover import Handovers, hand_over
from v2p_data.episodes.config import EpisodesConfig
from v2p_data.episodes.rollouts import Lesson
from v2p_data.episodes.staging import Episode, refusals_named, staged_episodes
from v2p_data.errors import V2PError
from v2p_data.json_files import read_object
from v2p_data.pipeline.artifact import write_json_atomically
from v2p_data.play import Policy, VisionActor
from v2p_data.seeds import seed_for
from v2p_data.task.task import TaskBundle

logger = logging.getLogger(__name__)

ROUNDS_FOLDER = "rounds"
STUDENT_FOLDER = "student"
TRAINING_FOLDER = "training"
BATCHES_FOLDER = "batches"
Progress = Callable[[float, str], None]


@runtime_checkable
class LearningStudent(Protocol):
    """A student that acts, takes episodes in, and is kept in folders."""

    def for_task(self, words: str) -> Policy:
        """Return the student, told a task."""
        ...

    def add(
        self,
        labels: UInt8[np.ndarray, "frame h w"],
        state: Float32[np.ndarray, "frame state"],
        action: Float32[np.ndarray, "frame act"],
        task: str,
        lengths: Sequence[int],
    ) -> None:
        """Take in episodes, one after the other, of these lengths."""
        ...

    def save(self, folder: Path) -> None:
        """Write the policy so that it is whole or absent."""
        ...

    def load(self, folder: Path) -> None:
        """Go on from what `save` wrote."""
        ...


Train = Callable[[int, Path, int, Progress], None]
"""Trains the student: gradient steps, folder for the training's state, seed, progress."""


@dataclass(frozen=True, kw_only=True)
class Course:
    """What is distilled."""

    lessons: Mapping[str, Lesson]
    """The tasks by item."""
    cfg: DistillationConfig
    """The recipe."""
    episodes: EpisodesConfig
    """What the demonstrations were recorded under."""
    seed: int
    """Decides everything that is drawn."""
    num_threads: int = 1
    """For physics and masks; changes no result."""


@dataclass(frozen=True, kw_only=True)
class Distilled:
    """What lies in a distillation's folder."""

    paths: tuple[Path, ...]
    """Staged handover episodes, in the order they were collected."""
    num_frames: int
    num_rollouts: int
    recovered: tuple[float, ...]
    """Per round the share of episodes that the expert ended in success after taking over."""

    def counts(self) -> dict[str, Any]:
        """Return it for the record."""
        return {
            "episodes": len(self.paths),
            "frames": self.num_frames,
            "rollouts": self.num_rollouts,
            "recovered": [round(share, 4) for share in self.recovered],
        }


def distill(
    course: Course,
    student: LearningStudent,
    train: Train,
    out: Path,
    on_progress: Progress = lambda share, words: None,
) -> Distilled:
    """Train and collect `course.cfg.rounds` times; go on where an earlier call was stopped.

    Args:
        course: the tasks and the recipe.
        student: knows the demonstrations already; learns further in place.
        train: trains it.
        out: `rounds/`, `student/` and `training/` are written here.
        on_progress: called with the share that is done and a few words.

    Raises:
        V2PError: the pictures are not masks, the disk is full, or `out` cannot be written to.
    """
    demand_masks(course.episodes)
    with refusals_named("distillation", out):
        return _distill(course, student, train, out, on_progress)


def demand_masks(episodes: EpisodesConfig) -> None:
    """Refuse demonstrations with other pictures than masks.

    Raises:
        V2PError: says what they show.
    """
    if episodes.render != "masks":
        raise V2PError(
            f"the demonstrations show '{episodes.render}', and distillation draws masks only; collect them with"
            " --episodes.render=masks, or train without it: --distillation.rounds=0"
        )


def handover_episodes(folder: Path) -> list[Path]:
    """Return the staged episodes under a distillation's folder, in the order they were collected."""
    return [
        path
        for number in sorted((folder / ROUNDS_FOLDER).glob("*"))
        for item in sorted(number.glob("*"))
        for path in staged_episodes(item)
    ]


def take_in(student: LearningStudent, paths: Sequence[Path]) -> None:
    """Let a student learn from staged episodes of one task."""
    if not paths:
        return
    loaded = [Episode.load(path) for path in paths]
    student.add(
        np.concatenate([e.labels for e in loaded]),
        np.concatenate([e.state for e in loaded]),
        np.concatenate([e.action for e in loaded]),
        loaded[0].task,
        [e.num_frames for e in loaded],
    )


def _distill(
    course: Course, student: LearningStudent, train: Train, out: Path, on_progress: Progress
) -> Distilled:
    cfg, lessons = course.cfg, course.lessons
    final = out / STUDENT_FOLDER
    ledgers: list[list[dict[str, Any]]] = []
    for number in range(cfg.rounds):
        here = out / f"{STUDENT_FOLDER}-{number}"
        done = number / cfg.rounds

        def tell(
            share: float, words: str, done: float = done, what: str = f"round {number + 1}"
        ) -> None:
            on_progress(done + share / cfg.rounds, f"{what}: {words}")

        if final.is_dir():
            pass  # all is collected; only the ledgers are read
        elif here.is_dir():
            student.load(here)
        else:
            steps = cfg.round_steps if number else cfg.first_steps
            train(
                steps,
                out / TRAINING_FOLDER / str(number),
                seed_for(course.seed, "training", number),
                lambda share, words: tell(0.5 * share, words),
            )
            student.save(here)
        collected: list[dict[str, Any]] = []
        for k, item in enumerate(lessons):
            folder = out / ROUNDS_FOLDER / f"{number:02d}" / item
            tell(0.5 + 0.5 * k / len(lessons), f"handing over {item}")
            collected += _collect(course, item, number, student, folder)
            if not final.is_dir():
                take_in(student, staged_episodes(folder))
        ledgers.append(collected)
        if number:
            shutil.rmtree(out / f"{STUDENT_FOLDER}-{number - 1}", ignore_errors=True)
    last = out / f"{STUDENT_FOLDER}-{cfg.rounds - 1}"
    if last.is_dir():
        last.rename(final)
    batches = [batch for ledger in ledgers for batch in ledger]
    return Distilled(
        paths=tuple(handover_episodes(out)),
        num_frames=sum(b["frames"] for b in batches),
        num_rollouts=sum(b["rollouts"] for b in batches),
        recovered=tuple(
            sum(b["successes"] for b in ledger) / max(1, sum(b["rollouts"] for b in ledger))
            for ledger in ledgers
        ),
    )


def _collect(
    course: Course, item: str, number: int, student: LearningStudent, folder: Path
) -> list[dict[str, Any]]:
    """Stage one task's handover episodes of one round; return the ledgers of its batches."""
    lesson, cfg, episodes = course.lessons[item], course.cfg, course.episodes
    seed = seed_for(course.seed, item, number)
    ledger_folder = folder / BATCHES_FOLDER
    ledger_folder.mkdir(parents=True, exist_ok=True)
    for leftover in folder.glob("*/*.tmp"):
        leftover.unlink()
    batches: list[dict[str, Any]] = []
    for batch in range(-(-cfg.episodes // cfg.worlds)):
        path = ledger_folder / f"{batch:03d}.json"
        if not path.is_file():
            handovers = hand_over(
                lesson,
                VisionActor(
                    student.for_task(lesson.bundle.description), interface=episodes.interface
                ),
                cfg,
                episodes,
                seed=seed_for(seed, "batch", batch),
                num_threads=course.num_threads,
            )
            first = batch * cfg.worlds
            write_json_atomically(
                path, _stage(lesson.bundle, handovers, episodes, folder, number, first)
            )
        batches.append(read_object(path, "delete it; its batch is made again"))
    return batches


def _stage(
    bundle: TaskBundle,
    handovers: Handovers,
    episodes: EpisodesConfig,
    folder: Path,
    number: int,
    first: int,
) -> dict[str, Any]:
    """Write the successful episodes of a batch; return its ledger."""
    winners = [int(w) for w in np.flatnonzero(handovers.successes)]
    names: list[str] = []
    frames = 0
    for world in winners:
        length = int(handovers.num_frames[world])
        rows = np.arange(length)
        episode_id = f"{bundle.title}_handover{number}_{first + world:05d}"
        Episode(
            id=episode_id,
            item=bundle.title,
            family=bundle.scene.family,
            task=bundle.description,
            seed=handovers.seed,
            labels=handovers.labels[:length, world].copy(),
            state=handovers.state[:length, world].copy(),
            action=handovers.recorded_action[:length, world].copy(),
            success=rows >= handovers.held_at[world],
            simulated=handovers.simulated(world, episodes.size_px),
            intervention=rows >= handovers.taken_over_at[world],
            referee=True,
            objects=tuple(o.name for o in bundle.scene.objects),
            params=handovers.params[world],
            cameras=episodes.cameras,
            actions=handovers.names,
        ).save(folder / "episodes")
        names.append(episode_id)
        frames += length
    return {
        "episodes": names,
        "frames": frames,
        "rollouts": len(handovers.successes),
        "successes": len(winners),
    }

"""One cell of the study: training objects are found, a policy is made and judged on unseen objects.

Everything but the judgement is stages in `<out>/run`, so that arms, numbers and seeds share what
they have in common and a stopped study goes on. A candidate that the engine rejects, at any stage,
is counted and skipped; nothing stands in for it.
"""

import logging
import time
from collections import Counter
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np

from studies.programs import ProgramPolicy
from v2p_data.errors import V2PError
from v2p_data.evaluation.batch import Judged, judge
from v2p_data.evaluation.config import EvaluationConfig
from v2p_data.evaluation.judging import UNSEEN_PX, Play, contestant, play_of
from v2p_data.pipeline.artifact import Record, provenance, read_record
from v2p_data.pipeline.fingerprint import fingerprint
from v2p_data.pipeline.runner import Outcome, Runtime, Stage
from v2p_data.policy.training import POLICY_FOLDER, sources_of
from v2p_data.seeds import rng_for, seed_for
from v2p_data.stages import (
    EngineConfig,
    dataset_stage,
    episodes_stage,
    policy_stage,
    scene_stage,
    task_stage,
    with_cousins,
)
from v2p_data.task.task import TaskBundle

from .config import WITH_COUSINS, Arm, LiftingConfig, Source, source_of
from .objects import (
    Candidate,
    candidate_of,
    clip_stage,
    clips_of_kind,
    demand_apart,
    draw_unseen,
    instructed_stage,
    masses_in,
    scene_of_clip,
    toy_stage,
    unseen_meshes,
    unseen_stage,
)
from .results import Row, letters_of
from .stages import run_shown

FILMS_FOLDER = "films"
Key = tuple[Arm, int, int]

logger = logging.getLogger(__name__)


def cells_of(cfg: LiftingConfig) -> Iterator[Key]:
    """Yield arm, number of tasks and seed of every cell, cheap ones first; what learns nothing has the number 0."""
    for seed in cfg.seeds:
        if "cop" in cfg.arms:
            yield "cop", 0, seed
        for count in cfg.counts:
            for arm in cfg.arms:
                if arm != "cop":
                    yield arm, count, seed


def key_of(row: Row) -> Key:
    return row["arm"], row["n"], row["seed"]


@dataclass(frozen=True, kw_only=True)
class Found:
    """Training objects of a cell, and what it took to find them."""

    candidates: tuple[Candidate, ...]
    episodes: tuple[Stage, ...]
    """Demonstrations of each, as the pool has them."""
    tried: int
    rejected: dict[str, int]
    """How many candidates were rejected, by stage and reason."""


@dataclass(kw_only=True)
class Study:
    """A study's folders and settings."""

    cfg: LiftingConfig
    out: Path
    runtime: Runtime
    """Its root is set here."""
    unseen_folder: Path | None = None
    """Scans; drawn meshes where None."""
    videos: Path | None = None
    """Real clips that join the drawn ones."""
    tell: Callable[[str], None] = field(default=lambda words: None)

    @property
    def root(self) -> Path:
        return self.out / "run"

    def run(self, stages: Sequence[Stage], root: Path | None = None) -> dict[str, Outcome]:
        """Make stages; return the outcome of each by its folder's name."""
        return run_shown(stages, replace(self.runtime, root=root or self.root), self.tell)

    def made(self, stage: Stage) -> Record:
        """Make a stage and return its record.

        Raises:
            V2PError: it cannot be made.
        """
        outcomes = self.run([stage])
        bad = next((o for o in outcomes.values() if o.status in ("failed", "rejected")), None)
        if bad is not None:
            raise V2PError(f"{bad.stage} of {bad.item}: {bad.detail}")
        return record_of(stage.folder(self.root))

    # -- the evaluation's objects

    @cached_property
    def unseen(self) -> dict[str, tuple[str, Path]]:
        """Per unseen object its group (`shape`, `category`) and its task's folder; made at the first question.

        Raises:
            V2PError: a mesh is missing, or the robot cannot do the task.
        """
        folder, names, meshes = self._unseen_meshes
        masses, kind = masses_in(folder), self.cfg.pool.kind
        root = self.out / "unseen"
        tasks = {
            name: instructed_stage(
                _task_of(unseen_stage(name, path, masses.get(name), kind), self.cfg), kind
            )
            for name, path in meshes.items()
        }
        outcomes = self.run(list(tasks.values()), root)
        bad = [o for o in outcomes.values() if o.status in ("failed", "rejected")]
        if bad:
            raise V2PError(
                "; ".join(f"{o.stage} of {o.item}: {o.detail}" for o in bad)
                + "; name other objects in unseen.shapes and unseen.categories"
            )
        group = {n: "shape" for n in names.shapes} | {n: "category" for n in names.categories}
        return {name: (group[name], stage.folder(root)) for name, stage in tasks.items()}

    @cached_property
    def _unseen_meshes(self):  # noqa: ANN202 - private, three things at once
        folder, names = self.unseen_folder, self.cfg.unseen
        if folder is None:
            folder = self.out / "unseen_meshes"
            names = draw_unseen(names, self.cfg.pool.held_out, folder)
        return folder, names, unseen_meshes(folder, names)

    # -- training objects

    def order(self, source: Source, seed: int) -> list[int]:
        """Return a seed's order of a pool: the first usable ones are its tasks, for every N."""
        size = self.cfg.pool.toys if source == "toys" else self.cfg.pool.clips + len(self._real)
        return [int(k) for k in rng_for(seed, "study_lifting", "order", source).permutation(size)]

    @cached_property
    def _real(self):  # noqa: ANN202 - the engine's own type
        if self.videos is None:
            return []
        taken, refused = clips_of_kind(self.videos, self.cfg.pool)
        self.tell(f"{len(taken)} real clips join, {len(refused)} do not: {refused}")
        return taken

    def _candidates(
        self, source: Source, numbers: Sequence[int], engine: EngineConfig
    ) -> list[Candidate | str]:
        """Return candidates by their places in the pool; a word where not even the clip could be drawn."""
        kind = self.cfg.pool.kind
        if source == "toys":
            return [candidate_of(toy_stage(k, self.cfg.pool), engine, kind) for k in numbers]
        real = self._real
        drawn = {k: clip_stage(k - len(real), self.cfg.pool) for k in numbers if k >= len(real)}
        outcomes = self.run(list(drawn.values()))
        out: list[Candidate | str] = []
        for k in numbers:
            if k < len(real):
                out.append(candidate_of(scene_stage(real[k], engine), engine, kind))
            elif outcomes[drawn[k].folder_name].is_usable:
                out.append(
                    candidate_of(scene_of_clip(drawn[k].folder(self.root), engine), engine, kind)
                )
            else:
                out.append("clip: not drawn")
        return out

    def find(
        self, source: Source, count: int, seed: int, engine: EngineConfig | None = None
    ) -> Found:
        """Return the first `count` objects of a seed's order that have a task, an expert and demonstrations.

        Raises:
            V2PError: the pool is too small.
        """
        engine = engine or self.cfg.pool_engine
        order = self.order(source, seed)
        kept: list[tuple[Candidate, Stage]] = []
        rejected: Counter[str] = Counter()
        tried = 0
        while len(kept) < count:
            numbers = order[tried : tried + max(count - len(kept), self.runtime.workers)]
            if not numbers:
                raise V2PError(
                    f"only {len(kept)} of {tried} {source} became tasks with an expert (rejected: "
                    f"{dict(rejected)}), and "
                    f"N is {count}; raise pool.{'toys' if source == 'toys' else 'clips'}"
                )
            found = self._candidates(source, numbers, engine)
            stages = {
                k: episodes_stage(c.task, c.expert, engine)
                for k, c in zip(numbers, found, strict=True)
                if isinstance(c, Candidate)
            }
            outcomes = self.run(list(stages.values()))
            for number, candidate in zip(numbers, found, strict=True):
                if len(kept) == count:
                    break
                tried += 1
                if isinstance(candidate, str):
                    rejected[candidate] += 1
                elif outcomes[stages[number].folder_name].is_usable:
                    kept.append((candidate, stages[number]))
                else:
                    rejected[_why(stages[number], outcomes)] += 1
        return Found(
            candidates=tuple(c for c, _ in kept),
            episodes=tuple(e for _, e in kept),
            tried=tried,
            rejected=dict(rejected.most_common()),
        )

    # -- a cell

    def cell(self, arm: Arm, count: int, seed: int) -> Row:
        """Make and judge one cell; return its line.

        Raises:
            V2PError: there are too few training objects, or a stage failed.
        """
        began = time.monotonic()
        row: Row = {"arm": arm, "n": count, "seed": seed, "study": self.identity}
        row["kind"] = self.cfg.pool.kind
        if arm == "cop":
            play: Play = _programs
            row["seconds"] = {}
        else:
            policy, about = self._policy(arm, count, seed)
            row |= about
            play = play_of(contestant(policy), seed, self.runtime.device)
        judging = time.monotonic()
        row["objects"] = self._judged(play, arm, count, seed)
        row["seconds"]["judging"] = round(time.monotonic() - judging, 1)
        row["wall_s"] = round(time.monotonic() - began, 1)
        about = provenance()
        row |= {"commit": about["commit"][:12], "machine": about["machine"]}
        return row

    @property
    def identity(self) -> str:
        """A digest of what all cells of a study must have in common."""
        _, names, meshes = self._unseen_meshes
        return fingerprint(
            {
                "pool": self.cfg.pool,
                "engine": self.cfg.engine,
                "paper": self.cfg.paper_policy,
                "unseen": replace(names, films=0),
                "meshes": {name: path.stat().st_size for name, path in meshes.items()},
                "least": self.cfg.counts[0],
                "max_training": self.cfg.max_training,
                "cousins": self.cfg.cousins,
                "videos": [v.item for v in self._real],
            }
        )

    def _policy(self, arm: Arm, count: int, seed: int) -> tuple[Path, Row]:
        """Return the folder of a cell's policy, and what became of its training."""
        source = source_of(arm)
        pool = self.cfg.pool_engine_of(arm)
        found = self.find(source, count, seed, pool)
        engine = self.cfg.engine_for(arm, count, seed)
        of_arm = replace(pool, episodes=self.cfg.episodes_for(arm))
        demonstrations = [
            stage
            for c in found.candidates
            for stage in with_cousins(episodes_stage(c.task, c.expert, of_arm), pool)
        ]
        rejected = dict(found.rejected)
        if arm in WITH_COUSINS:
            outcomes = self.run(demonstrations)
            bad = [s for s in demonstrations if not outcomes[s.folder_name].is_usable]
            reasons = Counter(rejected) + Counter(_why(s, outcomes) for s in bad)
            rejected = dict(reasons.most_common())
            demonstrations = [s for s in demonstrations if s not in bad]
        trajectories = engine.episodes.num_episodes
        who = arm if arm in WITH_COUSINS else source
        repo = f"study/{who}_n{count}_s{seed}_t{trajectories}"
        tasks = [stage.inputs["task"] for stage in demonstrations]
        trained = [task.folder(self.root) for task in tasks]
        demand_apart(trained, self._unseen_meshes[2])
        dataset = dataset_stage(demonstrations, repo)
        of_dataset = self.made(dataset)
        folder = dataset.folder(self.root)
        distils = engine.distillation.rounds > 0
        policy = policy_stage(
            folder, of_dataset, engine, sources_of(folder, self.root) if distils else ()
        )
        of_policy = self.made(policy)
        experts = {
            e.folder_name: e for s in demonstrations if (e := s.inputs.get("expert")) is not None
        }
        chains = {
            name: [record_of(stage.folder(self.root)) for stage in stages]
            for name, stages in {
                "scene": [c.scene for c in found.candidates],
                "task": [task.inputs["task"] for task in tasks],
                "expert": list(experts.values()) or [c.expert for c in found.candidates],
                "episodes": demonstrations,
            }.items()
        }
        single = {"dataset": of_dataset, "policy": of_policy} | {
            name: record_of(stage.folder(self.root)) for name, stage in policy.inputs.items()
        }
        rates = [r.counts["success"]["rate"] for r in chains["expert"]]
        return policy.folder(self.root) / POLICY_FOLDER, {
            "tasks": [task.item for task in tasks],
            "tried": found.tried,
            "rejected": rejected,
            "expert": {
                "mean": round(float(np.mean(rates)), 4),
                "least": round(min(rates), 4),
            },
            "trajectories": trajectories,
            "episodes": of_dataset.counts["episodes"],
            "demonstrated_frames": of_dataset.counts["frames"],
            "frames": of_policy.counts["frames"],
            "handovers": single["distillation"].counts if "distillation" in single else None,
            "steps": of_policy.counts["steps"],
            "samples_per_s": of_policy.counts["samples_per_s"],
            "seconds": {
                **{name: round(sum(r.seconds for r in rs), 1) for name, rs in chains.items()},
                **{name: round(r.seconds, 1) for name, r in single.items()},
            },
        }

    def _judged(self, play: Play, arm: str, count: int, seed: int) -> Row:
        from v2p_data.report.sheet import FilmConfig, write_films

        cfg = self.cfg.unseen
        rows: Row = {}
        for name, (group, folder) in self.unseen.items():
            bundle = TaskBundle.load(folder)
            actor, size_px = play(bundle)
            judged = judge(
                bundle,
                actor,
                first_seed=first_start(name, seed),
                cfg=EvaluationConfig(episodes=cfg.episodes),
                num_threads=self.runtime.num_threads,
                size_px=size_px,
            )
            rows[name] = {"group": group, **judged_row(judged)}
            self.tell(f"{arm} N={count} seed {seed}, {name}: {judged.successes.mean():.0%}")
            if cfg.films:
                films = self.out / FILMS_FOLDER / f"{arm}_{count}_{seed}" / name
                shown = FilmConfig(successes=cfg.films, failures=cfg.films, size_px=128)
                write_films(bundle, judged.shown, films, shown)
        return rows


def first_start(name: str, seed: int) -> int:
    """Return the seed of an object's first episode: the same in every arm and for every N."""
    return seed_for(seed, "study_lifting", "judge", name) % 2**31


def judged_row(judged: Judged) -> Row:
    """Return what became of an object's episodes, one letter each in the order of their starts."""
    at_end = judged.at_end
    assert at_end is not None
    return {
        "once": letters_of(judged.successes),
        "at_end": letters_of(at_end),
        "failures": judged.failure_counts(),
        "median_success_s": judged.median_success_s,
    }


def record_of(folder: Path) -> Record:
    """Return the record of a result that is there."""
    record = read_record(folder)
    assert record is not None, folder
    return record


def _task_of(scene: Stage, cfg: LiftingConfig) -> Stage:
    return task_stage(scene, cfg.pool_engine)


def _why(stage: Stage, outcomes: Mapping[str, Outcome]) -> str:
    """Return which stage before this one, or it itself, came to nothing, and why."""
    for needed in stage.inputs.values():
        if not outcomes[needed.folder_name].is_usable:
            return _why(needed, outcomes)
    outcome = outcomes[stage.folder_name]
    return f"{outcome.stage}: {outcome.reason or outcome.status}"


# --- Code-as-Policies ------------------------------------------------------------------------------------------


def _programs(bundle: TaskBundle) -> tuple[Any, int]:
    del bundle
    return ProgramPolicy(), UNSEEN_PX

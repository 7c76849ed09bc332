"""Rounds of rewards, trained against each other: the worse half stops early, the best of all rounds is never lost.

Everything is a function of the files in the search's folder: what is there is not done again, what is half done
goes on from its checkpoint. A search that is killed and started again ends with the same answer.

    recipe.json                 what is searched; another recipe is refused
    bundle/                     the task whose reward is searched
    taught/                     what candidates start from, where they do not start from nothing
    candidates/000/ ...         see `candidate`
    rounds/0.json ...           which candidates make up a round; written once they all are
    search.json                 the table so far, and in the end the choice
"""

import fcntl
import logging
import shutil
from collections.abc import Callable, Generator, Sequence
from contextlib import contextmanager, suppress
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from v2p_data.errors import V2PError
from v2p_data.json_files import json_or_none, read_object
from v2p_data.pipeline.artifact import write_json_atomically
from v2p_data.pipeline.fingerprint import canonical
from v2p_data.reward.candidate import (
    DONE_FILE,
    TRAIN_FOLDER,
    TRAJECTORIES_FILE,
    Candidate,
    Fault,
    Training,
)
from v2p_data.reward.config import Limits, RewardConfig
from v2p_data.reward.drafts import RoundWriter
from v2p_data.reward.jobs import Job, Jobs
from v2p_data.reward.methods import (
    Prepared,
    RewardWriter,
    prepare,
    save_bundle,
)
from v2p_data.reward.screening import screened
from v2p_data.reward.trajectories import Trajectories
from v2p_data.seeds import rng_for, seed_for
from v2p_data.task.sandbox.sandbox import class_name
from v2p_data.task.task import TaskBundle

logger = logging.getLogger(__name__)

SEARCH_FILE = "search.json"
RECIPE_FILE = "recipe.json"
BUNDLE_FOLDER = "bundle"
TAUGHT_FOLDER = "taught"

Progress = Callable[[float, str], None]


@dataclass(frozen=True, kw_only=True)
class How:
    """How a search is run; never part of what it finds."""

    workers: int = 1
    """Candidates that train at the same time."""
    num_threads: int = 1
    """For the physics and torch of one candidate."""
    limits: Limits = field(default_factory=Limits)
    jobs: Jobs | None = None
    """Processes to use, instead of new ones."""


@dataclass(frozen=True, kw_only=True)
class Found:
    """What a search came to."""

    chosen: int
    """Number of the candidate."""
    code: str = field(repr=False)
    """Its task code."""
    class_name: str
    origin: str
    """Who wrote its reward, see `Candidate.origin`."""
    success: float
    """Mean over the confirmed seeds of the mean over the last evaluations."""
    per_seed: tuple[float, ...]
    policy: Path
    """The chosen candidate's policy at the end of its first training."""
    stopped_by: str
    """`target` or `rounds`."""
    trained_steps: int
    evaluated_steps: int
    taught_steps: int
    full_steps: int
    """What training every candidate to the end, with all its evaluations, would have taken."""
    faults: dict[str, int]
    """Candidates without a result, by kind."""

    @property
    def cost_share(self) -> float:
        """Steps of the search over those of training every candidate of the rounds that took place to the end."""
        return (self.trained_steps + self.evaluated_steps) / max(self.full_steps, 1)

    def as_dict(self) -> dict[str, Any]:
        """Return it for JSON."""
        known = asdict(self)
        return {k: v for k, v in known.items() if k not in {"code", "class_name", "policy"}} | {
            "cost_share": self.cost_share
        }


def search_reward(
    bundle: TaskBundle,
    cfg: RewardConfig,
    out: Path,
    *,
    seed: int,
    how: How | None = None,
    writer: RewardWriter | None = None,
    on_progress: Progress = lambda share, words: None,
) -> Found:
    """Return the best reward that the budget finds; go on with a search that was stopped.

    Args:
        bundle: the task, audited.
        cfg: what is searched.
        out: folder of the search.
        seed: of everything that is drawn.
        how: processes, threads and limits.
        writer: a model, which writes all rewards; without it templates write the first ones and rules the later ones,
            as they do where it gives too few that can be used.
        on_progress: told the share that is done and a few words.

    Raises:
        V2PError: the folder holds another search or is being searched, or no candidate can be trained at all.
    """
    if cfg.method == "code_as_policy":
        raise V2PError(
            "code_as_policy searches no reward, it plays programs: see scripts/compare_reward_methods.py"
        )
    if cfg.iterations < 1:
        raise V2PError("a reward search needs at least one round: --reward.iterations 5")
    how = how or How()
    out.mkdir(parents=True, exist_ok=True)
    with _alone_in(out):
        _check_recipe(bundle, cfg, seed, out)
        search = _Search(bundle, cfg, out, seed, how, writer, on_progress)
        try:
            return search.run()
        finally:
            if how.jobs is None:
                search.jobs.close()


class _Search:
    def __init__(
        self,
        bundle: TaskBundle,
        cfg: RewardConfig,
        out: Path,
        seed: int,
        how: How,
        writer: RewardWriter | None,
        on_progress: Progress,
    ) -> None:
        self.cfg, self.out, self.seed, self.how = cfg, out, seed, how
        self.writer, self.on_progress = writer, on_progress
        self.jobs = how.jobs or Jobs(workers=how.workers, limits=how.limits)
        made = TaskBundle.load(out / BUNDLE_FOLDER) if (out / BUNDLE_FOLDER).is_dir() else None
        self.prepared: Prepared = prepare(
            bundle, cfg, rng_for(seed, "first rewards"), writer, made
        )
        self.base = self.prepared.bundle
        self.rounds: list[list[Candidate]] = []
        self.warm_start: Path | None = None
        if made is None:
            save_bundle(self.base, out / BUNDLE_FOLDER)

    def run(self) -> Found:
        self._teach()
        stopped_by = "rounds"
        for iteration in range(self.cfg.num_iterations):
            self.rounds.append(self._round(iteration))
            self._halve(iteration)
            self._write_table(None)
            if self._best().success >= self.cfg.target_success:
                stopped_by = "target"
                break
        best = self._best().candidate
        marks = self.cfg.marks[-1]
        confirmations = [self._job(best, k, marks) for k in range(1, self.cfg.confirm_seeds)]
        self.jobs.run(confirmations, on_wait=lambda _: self._tell("confirming the choice"))
        trainings = [best.training(k) for k in range(self.cfg.confirm_seeds)]
        # A seed on which the choice fails counts as what it is: no success.
        per_seed = tuple(0.0 if t.fault else t.success(self.cfg.evaluations) for t in trainings)
        found = self._found(best, per_seed, stopped_by)
        self._write_table(found)
        self.on_progress(1.0, f"success {found.success:.0%}")
        return found

    # -- rounds

    def _round(self, iteration: int) -> list[Candidate]:
        """Return a round's candidates: those that were written before, or new ones."""
        path = self.out / "rounds" / f"{iteration}.json"
        folder = self.out / "candidates"
        numbers = json_or_none(path)
        if isinstance(numbers, list):
            return [Candidate.load(folder / f"{n:03d}") for n in numbers]
        self._tell(f"round {iteration + 1}: writing rewards")
        writing = RoundWriter(
            prepared=self.prepared,
            cfg=self.cfg,
            seed=self.seed,
            writer=self.writer,
            tried=tuple(c.code for r in self.rounds for c in r),
        )
        elites = [standing.candidate for standing in self._elites()]
        drafts = writing.first() if iteration == 0 else writing.children(iteration, elites)
        start = sum(len(r) for r in self.rounds)
        made: list[Candidate] = []
        faults = screened(drafts, self.base.scene, self._stored_trajectories(), self.seed)
        for k, (draft, fault) in enumerate(zip(drafts, faults, strict=True)):
            place = folder / f"{start + k:03d}"
            shutil.rmtree(place, ignore_errors=True)  # of a round that a kill cut short
            candidate = Candidate(
                folder=place,
                number=start + k,
                iteration=iteration,
                code=draft.code,
                parent=draft.parent,
                origin=draft.origin,
                reasons=draft.reasons,
            )
            candidate.save()
            if fault is not None:
                candidate.fail(fault)
            made.append(candidate)
        path.parent.mkdir(exist_ok=True)
        write_json_atomically(path, [c.number for c in made])
        return made

    def _stored_trajectories(self) -> list[Trajectories]:
        """Return what the elites' policies did, successes and failures."""
        stored: list[Trajectories] = []
        for standing in self._elites():
            path = standing.training.folder / TRAJECTORIES_FILE
            with suppress(V2PError):
                stored.append(Trajectories.load(path))
        return stored

    # -- halving

    def _halve(self, iteration: int) -> None:
        """Train a round's candidates; after each rung the better part of them goes on."""
        marks = self.cfg.marks
        alive = [c for c in self.rounds[-1] if c.training().fault is None]
        rivals = self._standings(self.rounds[:-1])
        for k, mark in enumerate(marks):
            words = f"round {iteration + 1}: {len(alive)} candidates to {mark}/{marks[-1]}"
            share = (iteration + k / len(marks)) / self.cfg.num_iterations
            self.jobs.run(
                [self._job(c, 0, mark) for c in alive],
                on_wait=lambda _, s=share, w=words: self._tell(w, s),
            )
            standing = {c.number: c.training() for c in alive}
            alive = [c for c in alive if standing[c.number].fault is None]
            if mark == marks[-1]:
                return
            count = self.cfg.evaluations
            alive.sort(key=lambda c: (-standing[c.number].rank(count, mark), c.number))
            enough = [c for c in alive if standing[c.number].reached]
            alive = alive[: max(1, int(len(alive) * self.cfg.keep))]
            if marks[k + 1] == marks[-1] and rivals and not enough:
                line = max(r.training.rank(count, mark) for r in rivals) - self.cfg.gate
                alive = [c for c in alive if standing[c.number].rank(count, mark) >= line]
            if enough:  # nothing is left to be found: the others need not go on
                return

    def _job(self, candidate: Candidate, seed: int, mark: int) -> Job:
        cfg = self.cfg
        return Job(
            folder=candidate.training_folder(seed),
            mark=mark,
            request={
                "job": "train",
                "bundle": str((self.out / BUNDLE_FOLDER).resolve()),
                "code": str((candidate.folder / "code.py").resolve()),
                # The same worlds and weights for all candidates: their difference is the reward's.
                "seed": seed_for(self.seed, "training", seed),
                "eval_seed": seed_for(self.seed, "evaluation", seed),
                "steps_per_mark": self._steps_per_mark,
                "bonus_ratio": cfg.paid_bonus_ratio,
                "num_envs": cfg.num_envs,
                "num_threads": self.how.num_threads,
                "eval_worlds": cfg.eval_worlds,
                "evaluations": cfg.evaluations,
                "target_success": cfg.target_success,
                "sees_video": self.prepared.seen is self.base.scene,
                "warm_start": str(self.warm_start.resolve()) if self.warm_start else None,
            },
        )

    @property
    def _steps_per_mark(self) -> int:
        return max(1, round(self.cfg.steps * self.cfg.rungs[0]))

    def _teach(self) -> None:
        """Have the policy made that candidates start from."""
        if self.cfg.start == "nothing":
            return
        folder = self.out / TAUGHT_FOLDER
        self._tell("imitating a program")
        code = self.out / BUNDLE_FOLDER / "task.py"
        request = {
            "job": "teach",
            "bundle": str((self.out / BUNDLE_FOLDER).resolve()),
            "code": str(code.resolve()),
            "seed": seed_for(self.seed, "teach"),
            "rounds": self.cfg.taught_rounds,
            "num_envs": self.cfg.num_envs,
            "num_threads": self.how.num_threads,
            "eval_worlds": self.cfg.eval_worlds,
        }
        self.jobs.run([Job(folder=folder, request=request)])
        fault = Fault.read(folder / "fault.json")
        if fault is not None:
            raise V2PError(f"no policy to start from could be taught: {fault.reason}")
        done = json_or_none(folder / DONE_FILE) or {}
        if done.get("teacher"):
            self.warm_start = folder / TRAIN_FOLDER

    # -- who is where

    def _standings(self, rounds: Sequence[Sequence[Candidate]]) -> list["Standing"]:
        return standings([c for r in rounds for c in r], self.cfg)

    def _elites(self) -> list["Standing"]:
        return self._standings(self.rounds)[: self.cfg.elites]

    def _best(self) -> "Standing":
        ordered = self._standings(self.rounds)
        if not ordered:
            reasons = [
                f"{c.number}: {t.fault.kind}, {t.fault.reason}"
                for c in self.rounds[-1]
                if (t := c.training()).fault is not None
            ]
            raise V2PError(
                f"none of {len(self.rounds[-1])} candidates in {self.out} could be trained; "
                + "; ".join(reasons[:3])
            )
        return ordered[0]

    def _found(self, best: Candidate, per_seed: tuple[float, ...], stopped_by: str) -> Found:
        trained = evaluated = 0
        faults: dict[str, int] = {}
        candidates = [c for r in self.rounds for c in r]
        per_evaluation = self.cfg.eval_worlds * self.base.horizon_steps
        for candidate in candidates:
            for k in range(self.cfg.confirm_seeds):
                training = candidate.training(k)
                trained += len(training.evaluations) * self._steps_per_mark
                evaluated += sum(e.control_steps for e in training.evaluations)
            fault = candidate.training().fault
            if fault is not None:
                faults[fault.kind] = faults.get(fault.kind, 0) + 1
        marks = self.cfg.marks[-1]
        worth = [c for c in candidates if not _is_screened(c.training())]
        taught = json_or_none(self.out / TAUGHT_FOLDER / DONE_FILE) or {}
        return Found(
            chosen=best.number,
            code=best.code,
            class_name=class_name(best.code),
            origin=best.origin,
            success=float(np.mean(per_seed)),
            per_seed=per_seed,
            policy=best.policy_folder(),
            stopped_by=stopped_by,
            trained_steps=trained,
            evaluated_steps=evaluated,
            taught_steps=int(taught.get("control_steps", 0)),
            full_steps=len(worth) * marks * (self._steps_per_mark + per_evaluation),
            faults=faults,
        )

    def _write_table(self, found: Found | None) -> None:
        rows = [candidate_row(c, self.cfg) for r in self.rounds for c in r]
        table = {
            "method": self.cfg.method,
            "without": list(self.cfg.without),
            "title": self.base.title,
            "marks": list(self.cfg.marks),
            "steps_per_mark": self._steps_per_mark,
            "candidates": rows,
            "found": None if found is None else found.as_dict(),
        }
        write_json_atomically(self.out / SEARCH_FILE, table)

    def _tell(self, words: str, share: float | None = None) -> None:
        self._share = max(share or 0.0, getattr(self, "_share", 0.0))
        self.on_progress(self._share, words)


@dataclass(frozen=True, kw_only=True)
class Standing:
    """A candidate and how far its first training came."""

    candidate: Candidate
    training: Training
    cfg: RewardConfig

    @property
    def is_finished(self) -> bool:
        return self.training.reached or self.training.done >= self.cfg.marks[-1]

    @property
    def rank(self) -> float:
        return self.training.rank(self.cfg.evaluations)

    @property
    def success(self) -> float:
        return self.training.success(self.cfg.evaluations)


def standings(candidates: Sequence[Candidate], cfg: RewardConfig) -> list[Standing]:
    """Return the candidates that trained, the best one first: those trained to the end before those that were stopped."""
    found = [Standing(candidate=c, training=c.training(), cfg=cfg) for c in candidates]
    trained = [s for s in found if s.training.fault is None and s.training.evaluations]
    return sorted(trained, key=lambda s: (not s.is_finished, -s.rank, s.candidate.number))


def candidate_row(candidate: Candidate, cfg: RewardConfig) -> dict[str, Any]:
    """Return a candidate's line of `search.json`."""
    training = candidate.training()
    standing = Standing(candidate=candidate, training=training, cfg=cfg)
    if training.fault is not None:
        state = training.fault.kind
    elif standing.is_finished:
        state = "reached" if training.reached else "finished"
    else:
        state = "stopped"
    return {
        "number": candidate.number,
        "round": candidate.iteration,
        "parent": candidate.parent,
        "origin": candidate.origin,
        "reasons": list(candidate.reasons),
        "state": state,
        "why": "" if training.fault is None else training.fault.reason,
        "marks": len(training.evaluations),
        "success": standing.success,
        "rank": standing.rank,
        "successes": [e.success for e in training.evaluations],
        "seconds": round(training.seconds, 1),
    }


def _is_screened(training: Training) -> bool:
    return training.fault is not None and training.fault.kind in ("refused", "prescreened")


@contextmanager
def _alone_in(out: Path) -> Generator[None]:
    with (out / ".lock").open("a") as stream:
        try:
            fcntl.flock(stream, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except OSError as error:
            raise V2PError(f"another search is at work in {out}; wait for it") from error
        yield


def _check_recipe(bundle: TaskBundle, cfg: RewardConfig, seed: int, out: Path) -> None:
    recipe = {
        "config": canonical(cfg),
        "seed": seed,
        "title": bundle.title,
        "code": bundle.code,
        "horizon_steps": bundle.horizon_steps,
    }
    path = out / RECIPE_FILE
    if not path.is_file():
        write_json_atomically(path, recipe)
        return
    saved = read_object(path, f"clear {out} away, or choose another folder")
    if saved == recipe:
        return
    changed = [k for k in recipe if saved.get(k) != recipe[k]]
    if changed == ["config"]:
        was, now = saved["config"], recipe["config"]
        changed = [f"{k} was {was.get(k)}, is {now[k]}" for k in now if was.get(k) != now[k]]
    raise V2PError(f"{out} holds another search ({', '.join(changed)}); choose another folder")

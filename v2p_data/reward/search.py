"""Rounds of rewards, trained against each other: the worse half stops early, the best of all rounds is never lost.

The search's folder is a run folder of its own: a candidate's rung is one result in it. A search
that is killed and started again keeps what is complete and goes on from checkpoints. Rewards are
written again from the model's stored answers.

    candidate/000-rung-0-1a2b3c4d/ ...   see `candidate`
    search.json                          the table so far, and in the end the choice
"""

import logging
from collections.abc import Callable
from contextlib import closing
from dataclasses import replace
from pathlib import Path
from typing import Any

from v2p_data.errors import V2PError
from v2p_data.pipeline.artifact import read_record, write_json_atomically
from v2p_data.pipeline.runner import Runtime
from v2p_data.pipeline.workers import Pool, only_run_in, run_stages
from v2p_data.reward.candidate import Candidate, candidate_stage
from v2p_data.reward.config import RewardConfig
from v2p_data.seeds import seed_for
from v2p_data.task.llm.client import UnusableAnswersError
from v2p_data.task.llm.writer import ModelWriter
from v2p_data.task.sandbox.splice import SpliceError, reward_part, with_reward
from v2p_data.task.sandbox.trial import demand_trial
from v2p_data.task.task import TaskBundle
from v2p_data.task.templates.variants import VARIANTS
from v2p_data.task.templates.write import write_task

logger = logging.getLogger(__name__)

SEARCH_FILE = "search.json"
CANDIDATE_LIMIT_S = 3600.0
"""A candidate that takes longer from one rung to the next has failed, and the search goes on."""


class RewardSearch:
    """Searches the reward of one task.

    Args:
        bundle: the task, audited.
        cfg: what is searched.
        out: folder of the search.
        seed: of everything that is drawn.
        runtime: as many candidates train at the same time as it has threads.
        writer: a model; it writes the first rewards beside the task's own, and all later ones. Without it, and where it
            gives too few at first, templates write, and there is one round.
    """

    def __init__(
        self,
        bundle: TaskBundle,
        cfg: RewardConfig,
        out: Path,
        *,
        seed: int,
        runtime: Runtime,
        writer: ModelWriter | None = None,
    ) -> None:
        self.bundle, self.cfg, self.out, self.seed = bundle, cfg, out, seed
        self.on_progress, self.writer = runtime.progress, writer
        self.runtime = replace(
            runtime,
            root=out,
            workers=runtime.num_threads,
            num_threads=1,
            engine="local",
            store="",
            limit_s=CANDIDATE_LIMIT_S,
        )
        self.num_rounds = max(1, cfg.iterations) if writer else 1
        self.candidates: list[Candidate] = []
        self.stopped_by = ""
        """`target` or `rounds`; empty while it goes on."""

    def run(self) -> Candidate:
        """Return the best reward that the budget finds; go on with a search that was stopped.

        Raises:
            V2PError: the folder is being searched, or no candidate can be trained at all.
        """
        demand_trial(self.bundle)
        pool = Pool(self.runtime, size=min(self.runtime.workers, self.cfg.candidates))
        with only_run_in(self.out), closing(pool):
            for iteration in range(self.num_rounds):
                made = self._first() if iteration == 0 else self._children(iteration)
                self.candidates += made
                self._halve(iteration, made, pool)
                if self.best().success >= self.cfg.target_success:
                    self.stopped_by = "target"
                    break
            self.stopped_by = self.stopped_by or "rounds"
            self._write_table()
        return self.best()

    def best(self) -> Candidate:
        """Return the best candidate of all rounds: one that trained to the end before one that was stopped."""
        trained = [c for c in self.candidates if c.results]
        if not trained:
            reasons = "; ".join(f"{c.number}: {c.why}" for c in self.candidates[:3])
            raise V2PError(f"no candidate in {self.out} could be trained; {reasons}")
        return min(
            trained, key=lambda c: (not c.is_finished(self.cfg), -c.results[-1]["rank"], c.number)
        )

    def summary(self) -> dict[str, Any]:
        """Return what a finished search came to, for the record."""
        best = self.best()
        return {
            "chosen": best.number,
            "origin": best.origin,
            "success": best.success,
            "stopped_by": self.stopped_by,
            "rewards": len(self.candidates),
            "rounds": 1 + max(c.iteration for c in self.candidates),
            "failed": sum(not c.results for c in self.candidates),
            "steps": sum(c.results[-1]["steps"] for c in self.candidates if c.results),
        }

    # -- writing

    def _first(self) -> list[Candidate]:
        """Return the task's own reward, the model's, and templates over the same success in place of missing ones."""
        given = Candidate(number=0, iteration=0, code=self.bundle.code, origin="given")
        made = [given]
        said = self._ask(made, 0, lambda w, n: w.first_rewards(self.bundle, n))
        for variant in VARIANTS:
            code = write_task(self.bundle.scene, variant)
            self._add(made, 0, code, "template", reasons=(*said, variant.idea))
        return made

    def _children(self, iteration: int) -> list[Candidate]:
        """Return what the model makes of the best reward so far, from what training showed."""
        best, made = self.best(), list[Candidate]()
        words = best.results[-1]["feedback_text"]
        self._ask(
            made,
            iteration,
            lambda w, n: w.better_rewards(self.bundle, best.code, words, n, iteration),
            parent=best.number,
        )
        return made

    def _ask(
        self,
        made: list[Candidate],
        iteration: int,
        ask: Callable[[ModelWriter, int], list[str]],
        parent: int | None = None,
    ) -> tuple[str, ...]:
        """Add what the model writes, if there is one; return in words how much of it is missing."""
        count = self.cfg.candidates - len(made)
        if self.writer is None or not count:
            return ()
        before, fault = len(made), "the others do not run, or were tried before"
        try:
            codes = ask(self.writer, count)
        except UnusableAnswersError as error:
            codes, fault = [], str(error)
        for code in codes:
            self._add(made, iteration, code, "model", parent)
        if len(made) == before + count:
            return ()
        words = (
            f"the model gave {len(made) - before} of {count} rewards that could be used ({fault})"
        )
        logger.warning("%s: %s", self.bundle.title, words)
        return (f"not by the model: {words}",)

    def _add(
        self,
        made: list[Candidate],
        iteration: int,
        code: str,
        origin: str,
        parent: int | None = None,
        reasons: tuple[str, ...] = (),
    ) -> None:
        """Add a candidate with a code's reward, unless the round is full or that reward is known."""
        known = {reward_part(c.code) for c in (*self.candidates, *made)}
        if len(made) == self.cfg.candidates or reward_part(code) in known:
            return
        try:
            code = with_reward(self.bundle.code, code)
        except SpliceError:
            logger.info("a reward by a %s cannot be put into the task", origin)
            return
        number = len(self.candidates) + len(made)
        made.append(
            Candidate(
                number=number,
                iteration=iteration,
                code=code,
                origin=origin,
                parent=parent,
                reasons=reasons,
            )
        )

    # -- halving

    def _halve(self, iteration: int, alive: list[Candidate], pool: Pool) -> None:
        """Train a round's candidates; after each rung the better part of them goes on."""
        rivals = [c for c in self.candidates if c.iteration < iteration]
        for rung in range(len(self.cfg.rungs)):
            self._train(alive, iteration, rung, pool)
            alive = [c for c in alive if len(c.results) > rung]
            if any(c.success >= self.cfg.target_success for c in alive):
                return  # nothing is left to be found: the others need not go on
            alive.sort(key=lambda c: (-c.results[rung]["rank"], c.number))
            alive = alive[: max(1, int(len(alive) * self.cfg.keep))]
            at_rung = [c.results[rung]["rank"] for c in rivals if len(c.results) > rung]
            if rung == len(self.cfg.rungs) - 2 and at_rung:
                line = max(at_rung) - self.cfg.gate
                alive = [c for c in alive if c.results[rung]["rank"] >= line]

    def _train(self, alive: list[Candidate], iteration: int, rung: int, pool: Pool) -> None:
        """Bring candidates up to a rung, each in a process of its own."""
        self._write_table()
        seed = seed_for(self.seed, "training")
        for each in alive:
            each.stage = candidate_stage(each, self.bundle, self.cfg, rung, seed)
        share = (iteration + rung / len(self.cfg.rungs)) / self.num_rounds
        words = f"round {iteration + 1}: {len(alive)} rewards to {self.cfg.rungs[rung]:.0%} of their steps"
        outcomes = run_stages(
            [c.stage for c in alive if c.stage],
            self.runtime,
            lambda event: self.on_progress(share, words),
            pool,
        )
        for each in alive:
            assert each.stage is not None
            outcome = outcomes[(each.stage.name, each.stage.folder_name)]
            record = read_record(outcome.folder) if outcome.is_usable else None
            if record is None:
                each.why = f"{outcome.reason}: {outcome.detail}"
            else:
                place = {"folder": outcome.folder.name, "seconds": outcome.seconds}
                each.results.append(record.counts | place)
        self._write_table()

    def _write_table(self) -> None:
        """Write what is known for a reader: every candidate with its code, and the choice once there is one."""
        rows = [
            {
                **{k: v for k, v in vars(c).items() if k not in {"results", "stage"}},
                "results": [
                    {k: r[k] for k in ("steps", "success", "rank", "seconds", "folder")}
                    for r in c.results
                ],
                "is_finished": c.is_finished(self.cfg),
            }
            for c in self.candidates
        ]
        found = self.summary() if self.stopped_by else None
        write_json_atomically(
            self.out / SEARCH_FILE,
            {
                "title": self.bundle.title,
                "rungs": self.cfg.rungs,
                "candidates": rows,
                "found": found,
            },
        )

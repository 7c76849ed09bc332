"""The rewards of a round before they are candidates: from templates, a model, and rules that reflect on the best ones so far."""

import logging
from collections.abc import Callable, Sequence
from contextlib import suppress
from dataclasses import dataclass, field, replace

import numpy as np

from v2p_data.errors import V2PError
from v2p_data.json_files import json_or_none
from v2p_data.reward import redesign
from v2p_data.reward.candidate import FEEDBACK_FILE, Candidate
from v2p_data.reward.code.function_body import UnreadableError
from v2p_data.reward.config import RewardConfig
from v2p_data.reward.feedback import Feedback
from v2p_data.reward.methods import Prepared, RewardWriter, in_place_of_reward
from v2p_data.reward.reflect import reflect
from v2p_data.seeds import rng_for
from v2p_data.task.llm.client import UnusableAnswersError
from v2p_data.task.sandbox.splice import SpliceError, reward_part
from v2p_data.task.task import TaskBundle
from v2p_data.task.templates.variants import NUM_VARIANTS

logger = logging.getLogger(__name__)


@dataclass(frozen=True, kw_only=True)
class Draft:
    """A reward that is about to become a candidate."""

    code: str
    origin: str
    parent: int | None = None
    reasons: tuple[str, ...] = ()


@dataclass(frozen=True, kw_only=True)
class Asked:
    """What came of asking the model."""

    drafts: list[Draft] = field(default_factory=list[Draft])
    said: tuple[str, ...] = ()
    """Why others write the rest, for their reasons."""


@dataclass(frozen=True, kw_only=True)
class Family:
    """One of the best rewards, and what its children are written from."""

    told: TaskBundle
    """The task as the writer sees it."""
    parent: Candidate
    feedback: Feedback
    rng: np.random.Generator


@dataclass(frozen=True, kw_only=True)
class RoundWriter:
    """Writes the rewards of one round."""

    prepared: Prepared
    cfg: RewardConfig
    seed: int
    writer: RewardWriter | None
    tried: tuple[str, ...] = ()
    """Task code of all earlier rounds."""

    @property
    def base(self) -> TaskBundle:
        return self.prepared.bundle

    def first(self) -> list[Draft]:
        """Return the first rewards: the method's and the model's, filled up with templates whose weights vary."""
        prepared, count = self.prepared, self.cfg.num_candidates
        drafts = [
            Draft(code=code, origin=origin)
            for code, origin in zip(prepared.codes, prepared.origins, strict=True)
        ]
        new = self._new_ones(drafts)[:count]
        base = self.base
        asked = self._asked(lambda w, n: w.first_rewards(base, n), None, count - len(new), new)
        new += asked.drafts
        rng = rng_for(self.seed, "more first rewards")
        for index in range(NUM_VARIANTS, NUM_VARIANTS + 2 * count):
            if len(new) == count:
                break
            with suppress(UnreadableError):
                design = redesign.from_template(self.base.code, prepared.seen, rng, index)
                reasons = (*asked.said, design.words)
                more = Draft(code=design.code, origin="template", reasons=reasons)
                new += self._new_ones([more], besides=new)
        return new

    def children(self, iteration: int, elites: Sequence[Candidate]) -> list[Draft]:
        """Return rewards written from what the best ones so far did, as many from each of them as can be.

        Where there is nothing more to be made of one, the others fill the round.
        """
        families = self._families(iteration, elites)
        count = self.cfg.num_candidates
        new: list[Draft] = []
        for rank, family in enumerate(families):
            share = count // len(families) + (rank < count % len(families))
            asked = self._better(family, share, besides=new)
            said = asked.said
            new += asked.drafts
            new += self._by_rule(family, share - len(asked.drafts), besides=new, said=said)
        for family in families:
            new += self._by_rule(family, count - len(new), besides=new)
        return new

    def _better(self, family: Family, count: int, besides: Sequence[Draft]) -> Asked:
        """Return what the model makes of a parent's reward."""
        code, words = family.parent.code, family.feedback.text()
        return self._asked(
            lambda w, n: w.better_rewards(self.base, code, words, n),
            family.parent.number,
            count,
            besides,
        )

    def _families(self, iteration: int, elites: Sequence[Candidate]) -> list[Family]:
        told = replace(self.base, scene=self.prepared.seen)
        families: list[Family] = []
        for parent in elites:
            try:
                feedback = Feedback.from_dict(
                    json_or_none(parent.training().folder / FEEDBACK_FILE)
                )
            except V2PError:  # its process ran generated code
                logger.warning("candidate %d left no readable feedback", parent.number)
                continue
            rng = rng_for(self.seed, "reflect", iteration, parent.number)
            families.append(Family(told=told, parent=parent, feedback=feedback, rng=rng))
        return families

    def _by_rule(
        self,
        family: Family,
        count: int,
        besides: Sequence[Draft],
        said: tuple[str, ...] = (),
    ) -> list[Draft]:
        """Return rewards that rules make of a parent's, other ones than all before and besides them."""
        if count < 1:
            return []
        parent = family.parent
        tried = [*self.tried, *(d.code for d in besides)]
        children = reflect(
            family.told, parent.code, family.feedback, family.rng, count, tried=tried
        )
        drafts = [
            Draft(
                code=child.code,
                origin="reflection",
                parent=parent.number,
                reasons=(*said, *child.reasons),
            )
            for child in children
        ]
        return self._new_ones(drafts, besides)

    def _asked(
        self,
        ask: Callable[[RewardWriter, int], list[str]],
        parent: int | None,
        count: int,
        besides: Sequence[Draft],
    ) -> Asked:
        """Return what the model wrote, if there is one, and in words how much of it is missing."""
        if self.writer is None or count < 1:
            return Asked()
        fault = "the others do not run, or were tried before"
        try:
            codes = ask(self.writer, count)
        except UnusableAnswersError as error:
            codes, fault = [], str(error)
        drafts = [Draft(code=c, origin="model", parent=parent) for c in codes]
        drafts = self._new_ones(drafts, besides)[:count]
        if len(drafts) == count:
            return Asked(drafts=drafts)
        words = f"the model gave {len(drafts)} of {count} rewards that could be used ({fault})"
        logger.warning("%s: %s", self.base.title, words)
        return Asked(drafts=drafts, said=(f"not by the model: {words}",))

    def _new_ones(self, drafts: Sequence[Draft], besides: Sequence[Draft] = ()) -> list[Draft]:
        """Return the drafts without rewards that were tried before or are among the others of this round.

        Whoever wrote them, all they bring into the task is their reward.
        """
        known = {reward_part(code) for code in (*self.tried, *(d.code for d in besides))}
        new: list[Draft] = []
        for each in drafts:
            try:
                draft = replace(each, code=in_place_of_reward(self.base.code, each.code))
            except SpliceError:
                logger.info("a reward of %s cannot be put into the task", each.origin)
                continue
            part = reward_part(draft.code)
            if part not in known:
                known.add(part)
                new.append(draft)
        return new

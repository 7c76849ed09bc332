"""A model writes task codes until enough of them run, chooses among them, and writes rewards for a task that exists.

Whatever it writes is tried in the sandbox before anybody sees it, and goes back to it with the
error and the line where it does not run. Nothing it says overrules the audit: it chooses among
codes that the audit finds acceptable.
"""

import logging
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field, replace
from pathlib import Path

from v2p_data.scene.scene import Scene
from v2p_data.task.audit.audit import Audit
from v2p_data.task.llm.answers import choice_in, reward_code_in, task_code_in
from v2p_data.task.llm.client import FaultyAnswerError, UnusableAnswersError, VlmClient
from v2p_data.task.llm.example_refinements import REFINEMENTS
from v2p_data.task.llm.example_tasks import Example
from v2p_data.task.llm.pictures import scene_pictures
from v2p_data.task.llm.pool import examples_for, read_pool
from v2p_data.task.llm.prompts import (
    TASK_QUESTION,
    Message,
    better_reward_question,
    fault_message,
    first_reward_question,
    objection_message,
    pick_message,
    sample_words,
    scene_message,
    system_message,
)
from v2p_data.task.sandbox.smoke import SmokeResult, smoke_run_all
from v2p_data.task.sandbox.splice import SpliceError, reward_part, reward_source, with_reward
from v2p_data.task.task import TaskBundle
from v2p_data.task.templates.variants import VARIANTS

logger = logging.getLogger(__name__)

TryAll = Callable[[list[str]], list[SmokeResult]]
"""Runs task codes in the sandbox, one result each."""
Written = tuple[str, SmokeResult]
Objections = Callable[[Sequence[Written]], list[str]]
"""Says of each code what an audit has against it; empty where it is acceptable."""
STRONGER = "Try a stronger model, or --task.vlm.max-regenerations"
IDEAS = tuple(v.idea for v in VARIANTS if not v.is_naive)
"""For variety among samples: what each reward may be like."""


@dataclass(frozen=True, kw_only=True)
class WrittenSamples:
    """What the model wrote, in the order of the samples."""

    first: tuple[Written, ...] = field(repr=False)
    """Each sample's first answer: what there is without sending anything back."""
    final: tuple[Written, ...] = field(repr=False)
    """After regeneration."""
    answers: int
    """Codes that were asked for, with those that were sent back."""


@dataclass(frozen=True, kw_only=True)
class Pick:
    """Which sample was chosen, by whom, and why."""

    index: int
    by: str
    """`vlm` or `audit`."""
    reasons: dict[str, str]

    def as_dict(self) -> dict[str, object]:
        """Return it for JSON."""
        return {"by": self.by, "reasons": self.reasons}


@dataclass(kw_only=True)
class _Draft:
    """One sample on its way: the conversation about it and where it stands."""

    number: int
    talk: list[Message]
    code: str = ""
    result: SmokeResult = field(
        default_factory=lambda: SmokeResult(runnable=False, error="no code was written")
    )

    @property
    def written(self) -> Written:
        return self.code, self.result


# --- task codes ----------------------------------------------------------------------------------------------


def write_samples(
    client: VlmClient,
    scene: Scene,
    count: int,
    examples: Sequence[Example],
    try_all: TryAll,
    objections: Objections,
) -> WrittenSamples:
    """Return `count` task codes for a scene, sent back with their errors until they run, a bounded number of times.

    Where all run and none is acceptable, they go back once with what the audit has against them.

    Args:
        client: the model.
        scene: what was understood of the video.
        count: how many.
        examples: solved tasks to show.
        try_all: the sandbox.
        objections: the audit.

    Raises:
        BudgetError: the budget is used up.
        V2PError: the server cannot be asked.
    """
    cfg = client.cfg
    system = system_message([o.name for o in scene.objects], examples)
    drafts = _drafts(client, scene, system, count, TASK_QUESTION)
    first: tuple[Written, ...] = ()
    answers, is_objected = 0, False
    for turn in range(cfg.max_regenerations + 1):
        ahead = _not_running(drafts)
        # The audit speaks of the video.
        if not ahead and not is_objected and cfg.tells_shapes:
            is_objected = True
            ahead = _objected_to(drafts, objections)
        if not ahead:
            break
        _ask_all(client, ahead, f"task {scene.title}, turn {turn}", task_code_in, try_all)
        answers += len(ahead)
        first = first or tuple(d.written for d in drafts)
    broken = len(_not_running(drafts))
    if broken:
        logger.warning(
            "%d of %d samples for '%s' still do not run after %d regenerations",
            *(broken, count, scene.title, cfg.max_regenerations),
        )
    return WrittenSamples(first=first, final=tuple(d.written for d in drafts), answers=answers)


def _drafts(
    client: VlmClient, scene: Scene, system: Message, count: int, question: str
) -> list[_Draft]:
    """Return the samples' conversations, each begun with the question about the scene."""
    cfg = client.cfg
    pictures = scene_pictures(scene, cfg.image_side_px, cfg.sheet_frames) if cfg.images else []
    asked = [
        scene_message(
            scene,
            pictures,
            tracking=cfg.tracking,
            shapes=cfg.tells_shapes,
            then=question,
            end=sample_words(i, count, IDEAS[i % len(IDEAS)]),
        )
        for i in range(count)
    ]
    return [_Draft(number=i, talk=[system, asked[i]]) for i in range(count)]


def _not_running(drafts: list[_Draft]) -> list[_Draft]:
    return [d for d in drafts if not d.result.runnable]


def _objected_to(drafts: list[_Draft], objections: Objections) -> list[_Draft]:
    """Tell each sample what the audit has against it, where it has something against all; return those to ask again."""
    faults = objections([d.written for d in drafts])
    if not all(faults):
        return []
    for draft, fault in zip(drafts, faults, strict=True):
        draft.talk = [*draft.talk, objection_message(fault)]
    return drafts


def _ask_all(
    client: VlmClient,
    drafts: list[_Draft],
    what_for: str,
    read: Callable[[str], str],
    try_all: TryAll,
) -> None:
    """Ask for each draft's code at the same time, try them all, and add what is wrong to their conversations."""

    def ask(draft: _Draft) -> None:
        try:
            purpose = f"{what_for}, sample {draft.number}"
            draft.code, draft.talk = client.ask(draft.talk, purpose, read)
            draft.result = SmokeResult(runnable=True)
        except FaultyAnswerError as fault:
            draft.result = SmokeResult(runnable=False, error=f"no usable answer: {fault}")

    with ThreadPoolExecutor(max_workers=client.cfg.parallel) as threads:
        list(threads.map(ask, drafts))
    written = [d for d in drafts if d.result.runnable]
    for draft, result in zip(written, try_all([d.code for d in written]), strict=True):
        draft.result = result
        if not result.runnable:
            draft.talk = [*draft.talk, fault_message(result.error, draft.code)]


# --- the pick ------------------------------------------------------------------------------------------------


def pick_sample(
    client: VlmClient,
    scene: Scene,
    samples: Sequence[tuple[str, Audit]],
    *,
    audits_pick: int,
) -> Pick:
    """Return the model's choice among the acceptable samples.

    The audit's where there is nothing to choose, or no answer.

    Args:
        client: the model.
        scene: what was understood of the video.
        samples: codes and their audits; those that are not acceptable are not shown.
        audits_pick: index of the acceptable sample that the audit alone would take.

    Raises:
        BudgetError: the budget is used up.
        V2PError: the server cannot be asked.
    """
    acceptable = {i: s for i, s in enumerate(samples) if s[1].is_acceptable}
    why = ""
    if client.cfg.pick == "audit":
        why = "the settings leave it to the audit"
    elif len(acceptable) == 1:
        why = "no other sample is acceptable"
    if why:
        return Pick(index=audits_pick, by="audit", reasons={"why": why})
    cfg = client.cfg
    question = pick_message(scene, acceptable, tracking=cfg.tracking, shapes=cfg.tells_shapes)
    allowed = list(acceptable)
    try:
        (index, reasons), _ = client.ask(
            [question],
            f"pick for {scene.title}",
            lambda text: choice_in(text, allowed),
        )
    except FaultyAnswerError as fault:
        words = f"the model gave no usable choice, so the audit's was taken; the last answer's fault: {fault}"
        logger.warning("%s: %s", scene.title, words)
        return Pick(index=audits_pick, by="audit", reasons={"why": words})
    return Pick(index=index, by="vlm", reasons=reasons)


# --- rewards -------------------------------------------------------------------------------------------------


@dataclass(frozen=True, kw_only=True)
class ModelWriter:
    """A model as the writer of a reward search: it sees what its settings let it see.

    Every code that it gives has run in the sandbox on the task's scene.
    """

    client: VlmClient
    pools: tuple[Path, ...] = ()
    """Of solved tasks, whose rewards are shown as good ones."""

    def first_rewards(self, bundle: TaskBundle, count: int) -> list[str]:
        """Return the task's code with up to `count` other rewards, before anything was trained.

        Raises:
            BudgetError: the budget is used up.
            UnusableAnswersError: no answer could be used.
            V2PError: the server cannot be asked.
        """
        return self._rewards(
            bundle, bundle.code, first_reward_question(bundle.code), count, "first reward"
        )

    def better_rewards(
        self, bundle: TaskBundle, code: str, feedback_text: str, count: int, iteration: int
    ) -> list[str]:
        """Return `code` with up to `count` better rewards; everything else is the same, so success cannot move.

        They differ from `code` and from each other.

        Args:
            bundle: the task, for its scene and its words.
            code: the task code that was trained with.
            feedback_text: what the training showed, component by component.
            count: how many.
            iteration: the round, from 0; a later one asks anew where the best reward is still the same.

        Raises:
            BudgetError: the budget is used up.
            UnusableAnswersError: no answer could be used.
            V2PError: the code's success depends on its reward, or the server cannot be asked.
        """
        question = better_reward_question(code, feedback_text)
        return self._rewards(
            bundle, code, question, count, f"better reward of round {iteration + 1}"
        )

    def _examples(self, bundle: TaskBundle) -> list[Example]:
        cfg = self.client.cfg
        pools = [*self.pools, *([cfg.pool] if cfg.pool else [])]
        return examples_for(bundle.scene, read_pool(*pools), cfg.num_examples)

    def _rewards(
        self, bundle: TaskBundle, parent: str, question: str, count: int, what: str
    ) -> list[str]:
        client, scene = self.client, bundle.scene
        system = system_message(
            [o.name for o in scene.objects],
            [replace(e, code=reward_source(e.code)) for e in self._examples(bundle)],
            REFINEMENTS,
        )
        drafts = _drafts(client, scene, system, count, question)

        def read(text: str) -> str:
            try:
                return with_reward(parent, reward_code_in(text))
            except SpliceError as fault:
                raise FaultyAnswerError(str(fault)) from fault

        for turn in range(client.cfg.max_regenerations + 1):
            ahead = _not_running(drafts)
            if not ahead:
                break
            purpose = f"{what} for {bundle.title}, turn {turn}"
            _ask_all(client, ahead, purpose, read, lambda codes: smoke_run_all(codes, scene))
            _send_back_twins(drafts)
        made = [d.code for d in drafts if d.result.runnable]
        if not made:
            raise UnusableAnswersError(
                f"no {what} for '{bundle.title}' could be used; the last one's fault: {drafts[-1].result.error}. "
                f"{STRONGER}"
            )
        return made


def _send_back_twins(drafts: list[_Draft]) -> None:
    """Mark rewards that an earlier sample has too as not done."""
    seen: set[str] = set()
    for draft in drafts:
        if draft.result.runnable:
            part = reward_part(draft.code)
            if part in seen:
                fault = "another sample has the same reward; write a different one"
                draft.result = SmokeResult(runnable=False, error=fault)
                draft.talk = [*draft.talk, {"role": "user", "content": f"{fault.capitalize()}."}]
            seen.add(part)

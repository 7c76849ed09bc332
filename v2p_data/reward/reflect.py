"""What was learned from one reward becomes the next ones: as code, each with its reasons.

First come repairs that the numbers suggest (`rules`), all together and one by one. Where no episode succeeded, repairs
alternate with redesigns (`redesign`), as the paper asks for. Nothing but the reward changes; every child was
read by the guard and has run in the sandbox, and no two pay the same.
"""

from collections.abc import Iterator, Sequence
from contextlib import suppress
from dataclasses import dataclass

import numpy as np

from v2p_data.errors import V2PError
from v2p_data.reward import redesign, rules
from v2p_data.reward.code.function_body import UnreadableError, function_of
from v2p_data.reward.code.parts import Reward
from v2p_data.reward.code.slopes import kernels_of
from v2p_data.reward.feedback import Feedback
from v2p_data.seeds import rng_for
from v2p_data.task.sandbox.probes import random_states
from v2p_data.task.sandbox.reader.check import check_code
from v2p_data.task.sandbox.reader.refusal import TaskCodeError
from v2p_data.task.sandbox.smoke import SmokeResult, smoke_run_all
from v2p_data.task.sandbox.splice import reward_part
from v2p_data.task.task import TaskBundle

PROBES = 64
"""States on which two rewards must differ somewhere."""
MAX_CANDIDATES = 200
STRENGTHS = (1.0, 0.5, 1.5)
SPARE = 3
"""So many more are tried at once than are wanted: starting the sandbox takes longer than a trial."""


@dataclass(frozen=True, kw_only=True)
class Reflection:
    """One next reward."""

    code: str
    """The whole task code; only its reward differs from the parent's."""
    reasons: tuple[str, ...]
    """In words, with the numbers that decided."""


def reflect(
    bundle: TaskBundle,
    code: str,
    feedback: Feedback,
    rng: np.random.Generator,
    count: int,
    *,
    tried: Sequence[str] = (),
) -> list[Reflection]:
    """Return the next rewards, the most promising first.

    Args:
        bundle: the task; its scene says what the states are.
        code: task code whose reward was trained with.
        feedback: what came of it.
        rng: varies weights where the numbers leave them open.
        count: how many are wanted.
        tried: task codes whose rewards are known already.

    Returns:
        `count` rewards, or fewer where no more runnable ones were found that differ from the parent, each other and
        what was tried.
    """
    found: list[Reflection] = []
    seen = {_shape(c) for c in (code, *tried)}
    paid: list[np.ndarray] = []
    candidates = proposals(bundle, code, feedback, rng)
    parent_is_run = False
    while len(found) < count:
        fresh: list[Reflection] = []
        for candidate in candidates:
            shape = _shape(candidate.code)
            if shape not in seen:
                seen.add(shape)
                fresh.append(candidate)
            if len(fresh) == count - len(found) + SPARE:
                break
        if not fresh:
            break
        # The parent runs along the first time, so that children that pay the same are known.
        parent = [] if parent_is_run else [code]
        results = _run([*parent, *(c.code for c in fresh)], bundle)
        if not parent_is_run:
            parent_is_run = True
            paid.append(np.array(results.pop(0).probe_reward))
        for candidate, result in zip(fresh, results, strict=True):
            pays = np.array(result.probe_reward)
            is_new = all(len(p) != len(pays) or not np.allclose(p, pays) for p in paid)
            if result.runnable and is_new and len(found) < count:
                found.append(candidate)
                paid.append(pays)
    return found


def proposals(
    bundle: TaskBundle, code: str, feedback: Feedback, rng: np.random.Generator
) -> Iterator[Reflection]:
    """Yield next rewards that the guard accepts, the most promising first; they have not run yet and may repeat."""
    try:
        reward, trouble = Reward(code), ""
    except UnreadableError as error:
        reward, trouble = None, str(error)
    if reward is None:
        streams = [
            _wrapped(bundle, code, feedback, trouble, rng),
            _redesigns(bundle, code, feedback, rng),
        ]
    elif feedback.num_successes == 0:
        streams = [
            _repairs(reward, feedback, bundle, rng),
            _redesigns(bundle, code, feedback, rng),
        ]
    else:
        both = _chained(_repairs(reward, feedback, bundle, rng), _varied(reward, feedback, rng))
        streams = [both, _rarely(_redesigns(bundle, code, feedback, rng))]
    count = 0
    while streams and count < MAX_CANDIDATES:
        for stream in list(streams):
            candidate = next(stream, None)
            if candidate is None:
                streams.remove(stream)
                continue
            count += 1
            if candidate.code and _is_accepted(candidate.code):
                yield candidate


# --- streams of candidates -----------------------------------------------------------------------------------


def _repairs(
    reward: Reward, feedback: Feedback, bundle: TaskBundle, rng: np.random.Generator
) -> Iterator[Reflection]:
    """Yield all changes together, then each alone, then random halves, more or less strongly."""
    known = rules.changes(reward, feedback, bundle.scene)
    if not known:
        return
    for strength in STRENGTHS:
        yield _with_changes(reward, known, strength)
        if len(known) > 1:
            for change in known:
                yield _with_changes(reward, [change], strength)
    for _ in range(2 * len(known)):
        some = [c for c in known if rng.random() < 0.5]
        if some:
            yield _with_changes(reward, some, float(rng.uniform(0.4, 1.6)))


def _with_changes(reward: Reward, known: list[rules.Change], strength: float) -> Reflection:
    reasons: list[str] = []
    # Temperatures first: they change lines, and the code is read again after that.
    for change in sorted(known, key=lambda c: c.rule != "change a temperature"):
        try:
            reward = change.apply(reward, strength)
            reasons.append(change.reason)
        except UnreadableError as error:
            reasons.append(f"{change.reason} - not done: {error}")
    if strength != 1.0:
        reasons.append(f"all of this {strength:.2f} times as strongly")
    return Reflection(code=reward.code(), reasons=tuple(reasons))


def _varied(reward: Reward, feedback: Feedback, rng: np.random.Generator) -> Iterator[Reflection]:
    """Yield the reward with other weights and temperatures: a search around what works already."""
    names = [p.name for p in reward.parts if p.is_paid and reward.states_of(p)]
    start = f"success in {feedback.success_rate:.0%} of {feedback.num_episodes} episodes: a search around it"
    for _ in range(MAX_CANDIDATES // 4):
        new, reasons = reward, [start]
        for name in names:
            if rng.random() < 0.5:
                factor = float(np.exp(rng.normal(0.0, 0.5)))
                new = new.scaled(name, factor, f"varied: times {factor:.2f}")
                reasons.append(f"'{name}' times {factor:.2f}")
        sloped = [n for n in names if (p := new.part(n)) is not None and kernels_of(new, p)]
        if sloped and rng.random() < 0.5:
            name = str(rng.choice(sloped))
            part, factor = new.part(name), float(np.exp(rng.normal(0.0, 0.4)))
            with suppress(UnreadableError):  # then its temperature stays
                if part is not None:
                    new = kernels_of(new, part)[0].changed(new, name, factor)
                    reasons.append(f"temperature of '{name}' times {factor:.2f}")
        if len(reasons) > 1:
            yield Reflection(code=new.code(), reasons=tuple(reasons))


def _redesigns(
    bundle: TaskBundle, code: str, feedback: Feedback, rng: np.random.Generator
) -> Iterator[Reflection]:
    """Yield rewards that are written anew."""
    rate = f"success in {feedback.num_successes} of {feedback.num_episodes} episodes"
    order = [0, *(int(i) for i in 1 + rng.permutation(len(redesign.VARIANTS) - 1))]
    order += list(range(len(order), MAX_CANDIDATES // 4))
    for turn, index in enumerate(order):
        if turn % 4 == 1 or turn == 0:
            staged = redesign.from_success(code, bundle.scene, rng if turn else None)
            if staged is not None:
                yield _as_reflection(staged, rate)
        try:
            design = redesign.from_template(code, bundle.scene, rng, index)
        except UnreadableError:
            continue
        yield _as_reflection(design, rate)


def _as_reflection(design: redesign.Design, rate: str) -> Reflection:
    return Reflection(code=design.code, reasons=(f"{rate}: redesigned, {design.words}",))


def _wrapped(
    bundle: TaskBundle, code: str, feedback: Feedback, trouble: str, rng: np.random.Generator
) -> Iterator[Reflection]:
    """Yield a reward that cannot be taken apart, called by a new one that scales it and adds a stage."""
    sentence = f"the reward cannot be taken apart ({trouble}), so it stays whole"
    whole = feedback.reward.overall
    size = 0.0 if whole is None else max(abs(whole.mean), whole.std)
    scale = 50.0 / size if size > rules.MAX_TOTAL else 1.0
    stages = rules.stages(bundle.scene, code, feedback)
    added = [(name, share, text) for name, share, text, _ in stages if share < rules.STAGE_REACHED]
    goal = redesign.goal_text(code)
    if goal:
        added.append(("goal", feedback.success_rate, f"0.6 * {goal}"))
    added = added[:1]
    plans = [
        (
            scale,
            f"stage_{name}",
            text,
            f"only {share:.0%} of {feedback.num_episodes} episodes reach the stage '{name}': added",
        )
        for name, share, text in added
    ]
    if scale != 1.0:
        words = f"it is about {size:.3g} per step, a full reward is {rules.MAX_TOTAL:g}: times {scale:.2g}"
        plans.append((scale, "", "", words))
    for _ in range(MAX_CANDIDATES // 4):
        factor = scale * float(np.exp(rng.normal(0.0, 0.5)))
        plans.append((factor, "", "", f"varied: all of it times {factor:.2f}"))
        for name, _, text in added:
            share = float(rng.uniform(0.4, 1.6))
            words = f"{plans[-1][-1]}, with {share:.2f} times the stage '{name}'"
            plans.append((factor, f"stage_{name}", f"{share:.2f} * ({text})", words))
    for factor, name, text, reason in plans:
        try:
            new = redesign.wrapped(code, factor, name, text)
        except UnreadableError:
            return
        yield Reflection(code=new, reasons=(sentence, reason))


def _chained(*streams: Iterator[Reflection]) -> Iterator[Reflection]:
    for stream in streams:
        yield from stream


def _rarely(stream: Iterator[Reflection]) -> Iterator[Reflection]:
    """Yield nothing three times out of four."""
    for candidate in stream:
        for _ in range(3):
            yield Reflection(code="", reasons=())
        yield candidate


# --- checks --------------------------------------------------------------------------------------------------


def _is_accepted(code: str) -> bool:
    try:
        check_code(code)
    except TaskCodeError:
        return False
    return True


def _shape(code: str) -> str:
    """Return what is the same for codes whose rewards differ in comments only."""
    try:
        function_of(code)
    except UnreadableError:
        return code
    return reward_part(code)


def _run(codes: list[str], bundle: TaskBundle) -> list[SmokeResult]:
    probes = random_states(bundle.scene, PROBES, rng_for(0, "reflection", bundle.scene.title))
    try:
        return smoke_run_all(codes, bundle.scene, probes=probes)
    except V2PError:
        return [SmokeResult(runnable=False, error="the trial run gave no answer")] * len(codes)

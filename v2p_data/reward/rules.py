"""The analysis of the paper's figure 9 by rule: what is wrong with a reward, by which numbers, and what to do.

A rule looks at one part of a reward and at what the feedback says of it, and proposes changes; each has its reason in
words with the numbers that decided.
"""

import ast
from collections.abc import Callable, Iterator
from dataclasses import dataclass

from v2p_data.kinds import KINDS
from v2p_data.reward import redesign
from v2p_data.reward.code.expressions import split_constant
from v2p_data.reward.code.parts import Reward
from v2p_data.reward.code.slopes import centring_factor, kernels_of, simple_kind
from v2p_data.reward.code.soften import gates_softened
from v2p_data.reward.code.terms import Part
from v2p_data.reward.feedback import ComponentFeedback, Feedback
from v2p_data.scene.scene import Scene
from v2p_data.task.task import FULL_REWARD

DWARFS = 0.65
"""A part with more of the total's magnitude than this drowns the others."""
WANTED_SHARE = 0.35
"""What it is scaled down to."""
TELLS = 0.3
"""Correlation with success from which a part counts as telling success from failure."""
SILENT = 0.1
"""Below, it does not tell."""
SATURATED = 0.9
"""Share of steps at one end of its range."""
FEW = 3
"""Episodes of a kind that are needed to compare successes with failures."""
FLAT_LOW, FLAT_HIGH = 0.15, 0.85
"""Kernels whose values lie beyond, in parts of their range, are flat where the trajectories are."""
MAX_TOTAL = FULL_REWARD
"""Mean magnitude of the total from which the bonus for success counts for less than was chosen."""
WEAK_SHARE = 0.1
"""A part with less of the magnitude is too weak for what it should do."""
STAGE_REACHED = 0.25
"""A stage that fewer episodes reach is missing."""


@dataclass(frozen=True, kw_only=True)
class Change:
    """One proposal."""

    rule: str
    part: str
    """The part it concerns; empty for the whole reward."""
    reason: str
    apply: Callable[[Reward, float], Reward]
    """Takes a strength: 1 is what the numbers say, 0.5 half of it, in the logarithm where it is a factor."""


def changes(reward: Reward, feedback: Feedback, scene: Scene) -> list[Change]:
    """Return what the numbers suggest, the gravest first, at most one change per part."""
    shares = shares_of(reward, feedback)
    found: list[Change] = []
    for rule in (_scale_of_total, _missing_stage):
        found += rule(reward, feedback, scene)
    done = {c.part for c in found}
    for part in reward.parts:
        numbers = _numbers(feedback, part.name)
        if numbers is None or not part.is_paid or part.name in done:
            continue
        for rule in (_pays_failures, _dead, _dwarfs, _flat, _uninformative, _too_weak):
            proposed = list(rule(reward, part, numbers, shares.get(part.name, 0.0), feedback))
            if proposed:
                found += proposed
                break
    return found


def shares_of(reward: Reward, feedback: Feedback) -> dict[str, float]:
    """Return each paid part's share of the total magnitude, sums of other parts left out."""
    shares = {
        p.name: numbers.share
        for p in reward.parts
        if p.is_paid and (numbers := _numbers(feedback, p.name)) is not None
    }
    total = sum(shares.values())
    return {k: v / total for k, v in shares.items()} if total > 0 else shares


def _numbers(feedback: Feedback, name: str) -> ComponentFeedback | None:
    return next((c for c in feedback.components if c.name == name), None)


# --- of the whole --------------------------------------------------------------------------------------------


def _scale_of_total(reward: Reward, feedback: Feedback, scene: Scene) -> Iterator[Change]:
    del reward, scene
    whole = feedback.reward.overall
    size = 0.0 if whole is None else max(abs(whole.mean), whole.std)
    if size > MAX_TOTAL:
        factor = 0.5 * MAX_TOTAL / size
        yield Change(
            rule="rescale the total",
            part="",
            reason=f"the total is about {size:.3g} per step, more than a full reward of {MAX_TOTAL:g}: "
            f"all of it times {factor:.2g}",
            apply=lambda r, s: r.with_scale(factor**s),
        )


def stages(scene: Scene, code: str, feedback: Feedback) -> list[tuple[str, float, str, set[str]]]:
    """Return the stages before success: name, share of episodes that reach it, what pays for it, its states."""
    name, _ = redesign.target_of(scene)
    obj = next((o for o in feedback.objects if o.name == name), None)
    if obj is None:
        return []
    position = {f"{name}_pos", "eef_pos"}
    found = [("reach", obj.reached, f"0.3 * ({redesign.reach_text(scene)})", position)]
    if redesign.must_grasp(scene, code):
        found.append(
            ("grasp", obj.grasped, f"0.3 * {redesign.grasp_text(scene)}", {f"{name}_grasped"})
        )
        if KINDS[scene.kind].grasps != "tool":
            keys = {f"{name}_pos", f"{name}_start_pos"}
            found.append(("raise", obj.raised, f"0.6 * {redesign.raise_text(scene)}", keys))
    else:
        found.append(
            ("touch", obj.touched, f"0.1 * {redesign.touch_text(scene)}", {f"{name}_touched"})
        )
    return found


def _missing_stage(reward: Reward, feedback: Feedback, scene: Scene) -> Iterator[Change]:
    steps = stages(scene, reward.source, feedback)
    for name, share, text, keys in steps:
        if share >= STAGE_REACHED:
            continue
        paying = [p.name for p in reward.parts if p.is_paid and keys <= reward.states_of(p)]
        words = f"only {share:.0%} of {feedback.num_episodes} episodes come as far as the stage '{name}'"
        # Contact pays at once or not at all: a policy that never had it needs a slope towards it.
        if not paying or (name == "grasp" and reward.part("stage_grasp") is None):
            what = "what pays for it is sparse" if paying else "nothing pays for it"
            yield Change(
                rule="add the missing stage",
                part=f"stage_{name}",
                reason=f"{words}, and {what}: add 'stage_{name}'",
                apply=_adding(f"stage_{name}", text, f"{words}: new"),
            )
        elif len(paying) == 1 and (part := reward.part(paying[0])) is not None:
            numbers = _numbers(feedback, part.name)
            if numbers is not None and not numbers.is_dead and numbers.share < WEAK_SHARE:
                reason = f"{words}, and '{part.name}', which pays for it, has {numbers.share:.0%} of the magnitude"
                yield Change(
                    rule="rescale what is too weak",
                    part=part.name,
                    reason=f"{reason}: times 3",
                    apply=_scaling(part.name, 3.0, f"{words}: times 3"),
                )
        return
    if feedback.success_rate < STAGE_REACHED and (goal := redesign.goal_text(reward.source)):
        reached = (
            ", ".join(f"{n} in {s:.0%}" for n, s, _, _ in steps) or "what it reached is not known"
        )
        words = f"success in {feedback.success_rate:.0%} of {feedback.num_episodes} episodes ({reached})"
        already = reward.part("stage_goal") is not None
        if not already:
            yield Change(
                rule="add the missing stage",
                part="stage_goal",
                reason=f"{words}: add the success function itself as a slope, 'stage_goal'",
                apply=_adding("stage_goal", f"0.6 * {goal}", f"{words}: new"),
            )


def _adding(name: str, text: str, note: str) -> Callable[[Reward, float], Reward]:
    def add(reward: Reward, strength: float) -> Reward:
        weight, _, rest = text.partition(" * ")
        sized = f"{float(weight) * strength:.3g} * {rest}"
        # Where the total has no factor of its own, parts are of its own size already.
        if reward.part(name) is not None:
            return reward.scaled(name, 1.0 + strength, note)
        return reward.with_part(name, sized, note)

    return add


# --- of one part ---------------------------------------------------------------------------------------------


def _scaling(name: str, factor: float, note: str) -> Callable[[Reward, float], Reward]:
    return lambda reward, strength: reward.scaled(name, factor**strength, note)


def _comparable(feedback: Feedback) -> bool:
    return min(feedback.num_successes, feedback.num_episodes - feedback.num_successes) >= FEW


def _pays_failures(
    reward: Reward, part: Part, n: ComponentFeedback, share: float, feedback: Feedback
) -> Iterator[Change]:
    del reward
    if not _comparable(feedback) or n.successful is None or n.failed is None or n.is_dead:
        return
    corr = n.episode_correlation
    pays_more = n.failed.mean > n.successful.mean and n.failed.mean > 0
    if corr is not None and corr < -TELLS and pays_more and share > 0.05:
        words = (
            f"pays failures more than successes ({n.failed.mean:.3g} against {n.successful.mean:.3g} per step, "
            f"correlation {corr:.2f})"
        )
        yield Change(
            rule="rescale what pays failures",
            part=part.name,
            reason=f"'{part.name}' {words}: times 0.3",
            apply=_scaling(part.name, 0.3, f"{words}: times 0.3"),
        )


def _dead(
    reward: Reward, part: Part, n: ComponentFeedback, share: float, feedback: Feedback
) -> Iterator[Change]:
    del share
    if not n.is_dead or n.overall is None:
        return
    if not reward.states_of(part):
        return  # a constant by intention, such as a price per step
    value = n.overall.mean
    weight, _ = split_constant(reward.inlined(part.expr, part.position))
    if value == 0 and weight < 0:
        return  # a penalty that was never due
    soft, count = gates_softened(part.expr, _definitions(reward, part))
    words = f"never leaves {value:.3g} in {feedback.num_episodes} episodes"
    if count:
        text = ast.unparse(ast.fix_missing_locations(soft))
        yield Change(
            rule="rewrite a dead component",
            part=part.name,
            reason=f"'{part.name}' {words}: {count} of its conditions become slopes",
            apply=lambda r, s: r.rewritten(
                part.name, text, f"{words}: conditions have become slopes"
            ),
        )
        return
    kernels = kernels_of(reward, part)
    if kernels:
        simple = simple_kind(reward, part)
        factor = (
            None if simple is None else centring_factor(simple[0], abs(value / (simple[1] or 1)))
        )
        yield _gentler(part, words, min(max(factor or 0.3, 0.1), 4.0))
    else:
        yield _dropping(part, f"{words}, and nothing in it can be made smoother")


def _dwarfs(
    reward: Reward, part: Part, n: ComponentFeedback, share: float, feedback: Feedback
) -> Iterator[Change]:
    others = [p for p in reward.parts if p.is_paid and p.name != part.name]
    tells = (n.step_correlation or 0.0) > TELLS and _comparable(feedback)
    if share > DWARFS and others and not tells:
        factor = WANTED_SHARE * (1 - share) / (share * (1 - WANTED_SHARE))
        factor = min(max(factor, 0.02), 0.8)
        words = f"has {share:.0%} of the total's magnitude"
        if n.step_correlation is not None:
            words += f" and a correlation of {n.step_correlation:.2f} with success"
        yield Change(
            rule="rescale what dwarfs the rest",
            part=part.name,
            reason=f"'{part.name}' {words}: times {factor:.2g}",
            apply=_scaling(part.name, factor, f"{words}: times {factor:.2g}"),
        )


def _flat(
    reward: Reward, part: Part, n: ComponentFeedback, share: float, feedback: Feedback
) -> Iterator[Change]:
    del share
    simple = simple_kind(reward, part)
    numbers = n.failed or n.overall
    if simple is None or numbers is None or simple[1] == 0 or not kernels_of(reward, part):
        return
    kind, weight = simple
    level = abs(numbers.mean / weight)
    spread = numbers.std / abs(weight)
    if level > FLAT_HIGH and feedback.success_rate > 0.5:
        return  # it is solved
    if FLAT_LOW <= level <= FLAT_HIGH or spread > 0.25:
        return
    factor = centring_factor(kind, level)
    if factor is None:
        return
    factor = min(max(factor, 0.2), 4.0)
    words = f"is flat where the trajectories are (mean {level:.2f} of its range, deviation {spread:.2f})"
    yield _gentler(part, words, factor)


def _uninformative(
    reward: Reward, part: Part, n: ComponentFeedback, share: float, feedback: Feedback
) -> Iterator[Change]:
    del share
    saturated = max(n.saturated_high, n.saturated_low)
    silent = all(abs(c or 0.0) < SILENT for c in (n.step_correlation, n.episode_correlation))
    others = [p for p in reward.parts if p.is_paid and p.name != part.name]
    if saturated > SATURATED and silent and _comparable(feedback) and others:
        yield _dropping(
            part,
            f"is saturated in {saturated:.0%} of steps and does not tell success from failure "
            f"(correlation {n.step_correlation or 0.0:.2f} per step, {n.episode_correlation or 0.0:.2f} per episode)",
        )


def _too_weak(
    reward: Reward, part: Part, n: ComponentFeedback, share: float, feedback: Feedback
) -> Iterator[Change]:
    del reward
    corr = n.step_correlation
    if corr is not None and corr > TELLS and share < WEAK_SHARE and _comparable(feedback):
        words = (
            f"goes with success (correlation {corr:.2f}) but has only {share:.0%} of the magnitude"
        )
        yield Change(
            rule="rescale what is too weak",
            part=part.name,
            reason=f"'{part.name}' {words}: times 3",
            apply=_scaling(part.name, 3.0, f"{words}: times 3"),
        )


def _gentler(part: Part, words: str, factor: float) -> Change:
    way = "gentler" if factor < 1 else "steeper"

    def apply(reward: Reward, strength: float) -> Reward:
        now = reward.part(part.name)
        kernels = [] if now is None else kernels_of(reward, now)
        if not kernels:
            return reward
        note = f"{words}: temperature times {factor**strength:.2g}"
        return kernels[0].changed(reward, part.name, factor**strength).noted(part.name, note)

    return Change(
        rule="change a temperature",
        part=part.name,
        reason=f"'{part.name}' {words}: {way}, temperature times {factor:.2g}",
        apply=apply,
    )


def _dropping(part: Part, words: str) -> Change:
    return Change(
        rule="drop a component",
        part=part.name,
        reason=f"'{part.name}' {words}: dropped",
        apply=lambda reward, strength: reward.without(part.name),
    )


def _definitions(reward: Reward, part: Part) -> Callable[[str], ast.expr | None]:
    return lambda name: reward.lasting_definition(name, part.position)

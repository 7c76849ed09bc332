"""From trajectories to what can be said about a reward: a table per component, successes and failures apart.

The numbers go onto the page and, as text, to a language model: the paper's figure 9 is an answer to such a text.
Splitting them by the episode's outcome is the paper's addition to Eureka; correlation, saturation and shares are ours.
"""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float, Float32

from v2p_data.reward.trajectories import Trajectories
from v2p_data.sim.env.task_code import HELD_STEPS

DEAD_SPREAD = 1e-6
"""A component whose values differ by less than this, or by less than this part of their size, says nothing."""
SATURATED_MARGIN = 0.05
"""Values within this part of the observed range from its end count as saturated."""
REACHED_MARGIN_M = 0.03
RAISED_M = 0.03
CURVE_POINTS = 10
"""Values of a training curve that go into the text (Eureka's number)."""


@dataclass(frozen=True, kw_only=True)
class Spread:
    """Values of a component over all steps of some episodes; None where there are none."""

    mean: float
    std: float
    min: float
    max: float


@dataclass(frozen=True, kw_only=True)
class ComponentFeedback:
    """What one component of the reward did."""

    name: str
    overall: Spread | None
    successful: Spread | None
    """Over the steps of episodes that succeeded."""
    failed: Spread | None
    is_dead: bool
    """Its values do not vary."""
    share: float
    """Share of the total magnitude: mean absolute value, divided by the sum of those of all components."""
    step_correlation: float | None
    """Correlation of its value with the success of the same step; None where one of the two does not vary."""
    episode_correlation: float | None
    """Correlation of its mean over an episode with the episode's outcome."""
    saturated_high: float
    """Share of steps within 5 % of the observed range from its maximum."""
    saturated_low: float
    rise: float
    """Mean over episodes of the mean of the last quarter minus that of the first."""
    curve: tuple[float, ...] = ()
    """Its mean over the course of training, if known."""


@dataclass(frozen=True, kw_only=True)
class ObjectFeedback:
    """How far the policy came with one object, whatever the reward says."""

    name: str
    nearest_m: float
    """Median over episodes of the smallest distance between tool and centre."""
    reached: float
    """Share of episodes in which the tool came into the object or within 3 cm of it."""
    touched: float
    """Share of episodes, as the next two."""
    grasped: float
    raised: float
    """By 3 cm or more."""
    moved_m: float
    """Median over episodes of how far it was carried from its start, at most."""


@dataclass(frozen=True, kw_only=True)
class Feedback:
    """What can be said about a reward after a policy was trained with it."""

    num_episodes: int
    num_successes: int
    ever_success: float
    """Share of episodes with at least one step of success, held or not."""
    time_to_success_s: float | None
    """Median over successful episodes until success is held for the first time."""
    episode_s: float
    """Median length."""
    reward: ComponentFeedback
    """The whole generated reward, likewise; its share is 1."""
    components: tuple[ComponentFeedback, ...]
    reward_ranks: float | None
    """Probability that a successful episode earned more generated reward per step than a failed one; 0.5 is chance."""
    success_curve: tuple[float, ...] = ()
    objects: tuple[ObjectFeedback, ...] = ()
    """Objects in the moments whose states were kept, the manipulated one first."""

    @property
    def success_rate(self) -> float:
        """Share of episodes that succeeded."""
        return self.num_successes / self.num_episodes if self.num_episodes else 0.0

    def text(self) -> str:
        """Return what is told to a language model."""
        lines = [
            f"success rate: {self.success_rate:.3f} ({self.num_successes} of {self.num_episodes} episodes; "
            f"success at some step in {self.ever_success:.3f})",
            f"episode length: {self.episode_s:.2f} s",
            "time to success: "
            + (
                "never"
                if self.time_to_success_s is None
                else f"{self.time_to_success_s:.2f} s (median of successful episodes)"
            ),
        ]
        if self.success_curve:
            lines.append(f"success rate in the course of training: {_curve(self.success_curve)}")
        if self.reward_ranks is not None:
            lines.append(
                "a successful episode earned more generated reward than a failed one with probability "
                f"{self.reward_ranks:.2f} (0.5 is chance)"
            )
        for part in (*self.components, self.reward):
            lines += ["", *_part_lines(part)]
        lines += [""] * bool(self.objects) + [_object_line(o) for o in self.objects]
        return "\n".join(lines)


def feedback_of(
    trajectories: Trajectories,
    dt_s: float,
    *,
    curves: Mapping[str, Sequence[float]] | None = None,
) -> Feedback:
    """Return what can be said about the reward that a policy was trained with.

    Args:
        trajectories: what the policy did.
        dt_s: duration of one control step.
        curves: per component, and for `success`, its mean in the course of training.
    """
    t, curves = trajectories, curves or {}
    succeeded = t.succeeded
    magnitudes = {k: _magnitude(v, t.played) for k, v in t.components.items()}
    total = sum(magnitudes.values())
    firsts = _first_held(t)[succeeded]
    played = t.length > 0
    return Feedback(
        num_episodes=t.num_episodes,
        num_successes=int(succeeded.sum()),
        ever_success=float(t.success.any(0).mean()) if t.num_episodes else 0.0,
        time_to_success_s=float(np.median(firsts + 1)) * dt_s if len(firsts) else None,
        episode_s=float(np.median(t.length[played])) * dt_s if played.any() else 0.0,
        reward=_component("total", t.reward, t, succeeded, 1.0, ()),
        components=tuple(
            _component(
                name,
                values,
                t,
                succeeded,
                magnitudes[name] / total if total > 0 else 0.0,
                _thinned(curves.get(name, ())),
            )
            for name, values in t.components.items()
        ),
        reward_ranks=reward_ranks(t),
        success_curve=_thinned(curves.get("success", ())),
        objects=_objects(t),
    )


def reward_ranks(t: Trajectories) -> float | None:
    """Return the probability that a successful episode earned more generated reward per step than a failed one."""
    played = t.length > 0
    rewards = _episode_means(t.reward, t.played)
    return ranking(rewards[t.succeeded & played], rewards[~t.succeeded & played])


def ranking(
    high: Float[np.ndarray, "n"] | Float32[np.ndarray, "n"],
    low: Float[np.ndarray, "m"] | Float32[np.ndarray, "m"],
) -> float | None:
    """Return the probability that one of `high` is above one of `low`, ties counted half; None where one is empty.

    Source: the area under the ROC curve as the Mann-Whitney statistic (Hanley & McNeil 1982).
    """
    if not len(high) or not len(low):
        return None
    below = np.searchsorted(np.sort(low), high, "left")
    not_above = np.searchsorted(np.sort(low), high, "right")
    return float((below + not_above).sum() / (2 * len(high) * len(low)))


# --- one component -------------------------------------------------------------------------------------------


def _component(
    name: str,
    values: Float32[np.ndarray, "step env"],
    t: Trajectories,
    succeeded: Bool[np.ndarray, "env"],
    share: float,
    curve: tuple[float, ...],
) -> ComponentFeedback:
    valid = t.played & np.isfinite(values)
    flat = values[valid].astype(float)
    overall = _spread(flat)
    is_dead = overall is None or _is_flat(overall.min, overall.max)
    high = low = 0.0
    if overall is not None and not is_dead:
        margin = SATURATED_MARGIN * (overall.max - overall.min)
        high = float((flat >= overall.max - margin).mean())
        low = float((flat <= overall.min + margin).mean())
    means = _episode_means(values, valid)
    played = valid.any(0)
    return ComponentFeedback(
        name=name,
        overall=overall,
        successful=_spread(values[valid & succeeded].astype(float)),
        failed=_spread(values[valid & ~succeeded].astype(float)),
        is_dead=is_dead,
        share=share,
        step_correlation=None if is_dead else _correlation(flat, t.success[valid].astype(float)),
        episode_correlation=_correlation(means[played], succeeded[played].astype(float)),
        saturated_high=high,
        saturated_low=low,
        rise=_rise(values, t, valid),
        curve=curve,
    )


def _spread(values: Float[np.ndarray, "n"]) -> Spread | None:
    if not len(values):
        return None
    return Spread(
        mean=float(values.mean()),
        std=float(values.std()),
        min=float(values.min()),
        max=float(values.max()),
    )


def _is_flat(low: float, high: float) -> bool:
    return high - low <= DEAD_SPREAD * max(1.0, abs(low), abs(high))


def _correlation(a: Float[np.ndarray, "n"], b: Float[np.ndarray, "n"]) -> float | None:
    if len(a) < 2 or _is_flat(float(a.min()), float(a.max())) or b.min() == b.max():
        return None
    return float(np.corrcoef(a, b)[0, 1])


def _magnitude(
    values: Float32[np.ndarray, "step env"], played: Bool[np.ndarray, "step env"]
) -> float:
    flat = values[played & np.isfinite(values)]
    return float(np.abs(flat.astype(float)).mean()) if len(flat) else 0.0


def _episode_means(
    values: Float32[np.ndarray, "step env"], valid: Bool[np.ndarray, "step env"]
) -> Float[np.ndarray, "env"]:
    total = np.where(valid, values, 0.0).astype(float).sum(0)
    return total / np.maximum(valid.sum(0), 1)


def _rise(
    values: Float32[np.ndarray, "step env"], t: Trajectories, valid: Bool[np.ndarray, "step env"]
) -> float:
    """Return how much higher a component is at the end of episodes than at their start."""
    steps = np.arange(len(values))[:, None]
    quarter = np.maximum(t.length // 4, 1)
    begins, ends = valid & (steps < quarter), valid & (steps >= t.length - quarter)
    both = begins.any(0) & ends.any(0)
    if not both.any():
        return 0.0
    return float((_episode_means(values, ends) - _episode_means(values, begins))[both].mean())


def _first_held(t: Trajectories) -> Float[np.ndarray, "env"]:
    """Return the step at which success has been held for the first time, infinity where it never was."""
    held = np.zeros(t.num_episodes, int)
    first = np.full(t.num_episodes, np.inf)
    for step, is_now in enumerate(t.success):
        held = np.where(is_now, held + 1, 0)
        first = np.where((held >= HELD_STEPS) & np.isinf(first), step, first)
    return first


def _objects(t: Trajectories) -> tuple[ObjectFeedback, ...]:
    names = [k.removesuffix("_start_pos") for k in t.states if k.endswith("_start_pos")]
    inside = (t.moments[:, None] < t.length)[..., None]
    if not inside.any(0).all() or "eef_pos" not in t.states:
        return ()
    found: list[ObjectFeedback] = []
    for name in names:
        pos, start, size, touched, grasped = (
            t.states[f"{name}_{key}"].astype(float)
            for key in ("pos", "start_pos", "size", "touched", "grasped")
        )
        pos = np.where(inside, pos, start)
        away = np.where(inside[..., 0], np.linalg.norm(pos - t.states["eef_pos"], axis=-1), np.inf)
        held, felt = (np.where(inside[..., 0], x, 0.0) for x in (grasped, touched))
        found.append(
            ObjectFeedback(
                name=name,
                nearest_m=float(np.median(away.min(0))),
                reached=float((away < size.max(-1) / 2 + REACHED_MARGIN_M).any(0).mean()),
                touched=float((felt > 0.5).any(0).mean()),
                grasped=float((held > 0.5).any(0).mean()),
                raised=float(((pos - start)[..., 2] > RAISED_M).any(0).mean()),
                moved_m=float(np.median(np.linalg.norm(pos - start, axis=-1).max(0))),
            )
        )
    return tuple(found)


# --- text ----------------------------------------------------------------------------------------------------


def _part_lines(part: ComponentFeedback) -> list[str]:
    # Names come from task code.
    name = "".join(c if c.isprintable() else "?" for c in part.name[:100])
    head = f"{name}: share of the total magnitude {part.share:.3f}"
    if part.is_dead:
        value = "never finite" if part.overall is None else f"always {part.overall.mean:.4f}"
        return [f"{head}, dead ({value})"]
    lines = [
        head,
        f"  all trajectories:        {_spread_text(part.overall)}",
        f"  successful trajectories: {_spread_text(part.successful)}",
        f"  failed trajectories:     {_spread_text(part.failed)}",
        f"  correlation with success: per step {_number(part.step_correlation)}, "
        f"per episode {_number(part.episode_correlation)}",
        f"  saturated: {part.saturated_high:.2f} of steps at its maximum, "
        f"{part.saturated_low:.2f} at its minimum; rises by {part.rise:.4f} within an episode",
    ]
    if part.curve:
        lines.append(f"  mean in the course of training: {_curve(part.curve)}")
    return lines


def _object_line(obj: ObjectFeedback) -> str:
    return (
        f"{obj.name}: the gripper came within {100 * obj.nearest_m:.1f} cm of its centre; share of episodes in which "
        f"it was reached {obj.reached:.2f}, touched {obj.touched:.2f}, grasped {obj.grasped:.2f}, "
        f"raised {obj.raised:.2f}; it moved by {100 * obj.moved_m:.1f} cm"
    )


def _spread_text(spread: Spread | None) -> str:
    if spread is None:
        return "none"
    return (
        f"mean {spread.mean:.4f}, std {spread.std:.4f}, min {spread.min:.4f}, max {spread.max:.4f}"
    )


def _number(value: float | None) -> str:
    return "undefined" if value is None else f"{value:.2f}"


def _curve(values: Sequence[float]) -> str:
    return ", ".join(f"{v:.4f}" for v in values)


def _thinned(values: Sequence[float]) -> tuple[float, ...]:
    """Return at most `CURVE_POINTS` finite values, evenly spaced, the last one among them."""
    finite = [float(v) for v in values if math.isfinite(v)]
    if len(finite) <= CURVE_POINTS:
        return tuple(finite)
    places = np.linspace(0, len(finite) - 1, CURVE_POINTS).round().astype(int)
    return tuple(finite[i] for i in places)

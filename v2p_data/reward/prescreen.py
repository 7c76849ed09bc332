"""Turns away rewards that a look at stored episodes condemns, before anything is trained with them.

A reward under which failed episodes earn more than successful ones teaches to fail. The stored states of earlier
episodes are put before the candidates in `task.smoke`'s confined child, which is the only place where their code runs;
actions are not part of what that child is told, so what a reward pays or fines for actions alone counts
the same for all.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float

from v2p_data.reward.feedback import ranking
from v2p_data.reward.trajectories import Trajectories
from v2p_data.scene.scene import Scene
from v2p_data.task.audit.rewards import reward_fault
from v2p_data.task.sandbox.smoke import smoke_run_all


@dataclass(frozen=True, kw_only=True)
class PrescreenConfig:
    """How rewards are judged by stored episodes."""

    min_auc: float = 0.4
    """Below this probability that a success earns more than a failure a reward is rejected. A half is chance; what is
    a little below may still lead somewhere, for stored episodes are few and come from other rewards."""
    min_each: int = 8
    """With fewer stored successes or failures nobody is rejected for their order."""
    max_each: int = 32
    """So many successes and failures are looked at, spread over all that is stored."""
    max_moments: int = 20
    """So many moments of each, evenly spread."""
    gamma: float = 0.99
    """Discount per control step; nearer to 1 than in training, so that how an episode ends still counts."""
    seconds_each: float = 20.0
    """Wall-clock limit per candidate."""

    def __post_init__(self) -> None:
        if not 0 <= self.min_auc <= 1:
            raise ValueError(f"min_auc must be between 0 and 1, got {self.min_auc}")
        if not 0 < self.gamma <= 1:
            raise ValueError(f"gamma must be above 0 and at most 1, got {self.gamma}")


@dataclass(frozen=True, kw_only=True)
class Verdict:
    """What became of one candidate."""

    accepted: bool
    reason: str = ""
    """A slug where it is rejected: `not_runnable`, `ranks_failures_first` or one of `reward_check`'s."""
    detail: str = ""
    """One sentence."""
    auc: float | None = None
    """Probability that a stored success earns more than a stored failure; None with too few of either."""


@dataclass(frozen=True, kw_only=True)
class Stored:
    """The moments of some episodes, one below the other, episode by episode."""

    states: dict[str, np.ndarray]
    """Each `(n, ...)`."""
    weights: Float[np.ndarray, "episode moment"]
    """What a reward of that moment contributes to its episode's discounted return; 0 beyond its end."""
    succeeded: Bool[np.ndarray, "episode"]

    def returns(self, rewards: Float[np.ndarray, "n"]) -> Float[np.ndarray, "episode"]:
        """Return discounted returns per step from the rewards of all moments."""
        weighted = rewards.reshape(self.weights.shape) * self.weights
        return weighted.sum(1) / np.maximum(self.weights.sum(1), 1e-9)


def prescreen(
    codes: Sequence[str],
    scene: Scene,
    trajectories: Sequence[Trajectories],
    cfg: PrescreenConfig | None = None,
) -> list[Verdict]:
    """Return per task code whether it is worth a training.

    Args:
        codes: task codes whose rewards are asked.
        scene: whose objects the states describe.
        trajectories: earlier episodes of the same task with states, under whichever reward.
        cfg: the thresholds.
    """
    cfg = cfg or PrescreenConfig()
    stored = stored_moments(trajectories, cfg)
    if stored is None or not codes:
        return [Verdict(accepted=True, detail="there are no stored states to ask")] * len(codes)
    results = smoke_run_all(
        list(codes),
        scene,
        probes=stored.states,
        seconds_each=cfg.seconds_each,
        timeout_s=30.0 + cfg.seconds_each * len(codes),
    )
    return [
        _verdict(np.array(r.probe_reward), stored, cfg)
        if r.runnable
        else Verdict(
            accepted=False,
            reason="not_runnable",
            detail=f"it does not run on stored states: {r.error}",
        )
        for r in results
    ]


def stored_moments(trajectories: Sequence[Trajectories], cfg: PrescreenConfig) -> Stored | None:
    """Return a fair choice of stored moments, or None where no states are stored."""
    usable = [t for t in trajectories if len(t.moments) and t.states]
    if not usable:
        return None
    keys = set.intersection(*(set(t.states) for t in usable))
    pieces: dict[str, list[np.ndarray]] = {key: [] for key in sorted(keys)}
    weights: list[np.ndarray] = []
    succeeded: list[bool] = []
    for outcome in (True, False):
        episodes = [
            (t, env)
            for t in usable
            for env in np.flatnonzero((t.succeeded == outcome) & (t.length > t.moments[0]))
        ]
        for t, env in _spread(episodes, cfg.max_each):
            chosen = _spread(list(range(len(t.moments))), cfg.max_moments)
            steps = t.moments[chosen]
            is_in = steps < t.length[env]
            for key, states in pieces.items():
                states.append(t.states[key][chosen, env])
            # Each moment stands for the steps up to the one before it.
            stands_for = np.diff(steps, prepend=-1)
            row = np.zeros(cfg.max_moments)
            row[: len(chosen)] = cfg.gamma**steps * stands_for * is_in
            short = cfg.max_moments - len(chosen)
            if short:  # rows are of one length; what is repeated weighs nothing
                for key, states in pieces.items():
                    states.append(np.repeat(t.states[key][chosen[-1:], env], short, axis=0))
            weights.append(row)
            succeeded.append(outcome)
    if not weights:
        return None
    return Stored(
        states={key: np.concatenate(states) for key, states in pieces.items()},
        weights=np.array(weights),
        succeeded=np.array(succeeded, bool),
    )


def _verdict(rewards: Float[np.ndarray, "n"], stored: Stored, cfg: PrescreenConfig) -> Verdict:
    counted = rewards[(stored.weights > 0).ravel()]
    fault = reward_fault(counted, "stored moments")
    if fault is not None:
        return Verdict(accepted=False, reason=fault.reason, detail=f"it {fault.words}")
    returns = stored.returns(rewards)
    high, low = returns[stored.succeeded], returns[~stored.succeeded]
    if min(len(high), len(low)) < cfg.min_each:
        return Verdict(
            accepted=True,
            detail=f"{len(high)} successes and {len(low)} failures are too few to judge it by",
        )
    auc = ranking(high, low)
    assert auc is not None
    words = (
        f"a success earns more than a failure with probability {auc:.2f} "
        f"({len(high)} stored successes, {len(low)} failures)"
    )
    if auc < cfg.min_auc:
        return Verdict(
            accepted=False,
            reason="ranks_failures_first",
            detail=f"{words}, wanted at least {cfg.min_auc:.2f}",
            auc=auc,
        )
    return Verdict(accepted=True, detail=words, auc=auc)


def _spread[T](items: list[T], count: int) -> list[T]:
    """Return at most `count` of them, evenly spread, the first and the last among them."""
    if len(items) <= count:
        return items
    return [items[i] for i in np.linspace(0, len(items) - 1, count).round().astype(int)]

"""Stored episodes judge rewards before anything is trained with them."""

import numpy as np
import pytest

from v2p_data.reward.prescreen import PrescreenConfig, prescreen, stored_moments
from v2p_data.reward.redesign import transplanted
from v2p_data.reward.trajectories import Trajectories
from v2p_data.task.sandbox.probes import at_rest
from v2p_data.task.templates.write import write_samples

EPISODES = 20
HEIGHT = 'h = states["box_pos"][:, 2] - states["box_start_pos"][:, 2]'


def stored_lifts(scene, succeeded):
    """Five moments of episodes in which the box rises by 3 cm per moment where they succeed, and stays where not."""
    n = len(succeeded)
    moments = np.array([3, 7, 11, 15, 19])
    success = np.zeros((20, n), bool)
    success[12:] = succeeded
    rows = []
    for k in range(5):
        probe = at_rest(scene, n)
        probe.objects["box"].pos[:, 2] += 0.03 * (k + 1) * succeeded
        probe.progress = k / 5
        rows.append(probe.states())
    states = {key: np.stack([r[key] for r in rows]).astype(np.float32) for key in rows[0]}
    zeros = np.zeros((20, n), np.float32)
    return Trajectories(
        components={"x": zeros}, reward=zeros, success=success, length=np.full(n, 20),
        moments=moments, states=states, actions=np.zeros((5, n, 7), np.float32),
    )  # fmt: skip


def test_rewards_that_rank_failures_first_or_say_nothing_are_turned_away(scenes):
    scene = scenes["lift_up"]
    stored = stored_lifts(scene, np.arange(EPISODES) < EPISODES // 2)
    base = write_samples(scene)[0]
    formulas = (
        "h",
        "-h",
        "h * 0 + 2.0",
        "h * 1.0e6",
        "torch.log(0.2 - h * (h > 0.1).float() * 3)",
    )
    codes = [
        transplanted(base, f"def reward_function(actions, states):\n    {HEIGHT}\n    r = {f}\n    return r, {{'r': r}}\n")
        for f in formulas
    ]  # fmt: skip

    verdicts = prescreen(codes, scene, [stored])

    assert [v.accepted for v in verdicts] == [True, False, False, False, False]
    assert [v.reason for v in verdicts[1:]] == [
        "ranks_failures_first",
        "constant",
        "unbounded",
        "not_runnable",
    ]
    assert (verdicts[0].auc, verdicts[1].auc) == (1.0, 0.0)
    assert "0.00" in verdicts[1].detail
    assert "finite" in verdicts[4].detail


def test_returns_are_discounted_and_every_moment_stands_for_the_steps_before_it(scenes):
    trajectories = stored_lifts(scenes["lift_up"], np.array([True, False]))

    stored = stored_moments([trajectories], PrescreenConfig(gamma=0.5, max_moments=6))

    assert stored is not None
    weights = [4 * 0.5**s for s in (3, 7, 11, 15, 19)] + [0.0]
    np.testing.assert_allclose(stored.weights, [weights] * 2)
    assert stored.succeeded.tolist() == [True, False]
    rewards = np.array([1.0, 0, 0, 0, 0, 99, 0, 0, 0, 0, 2.0, 99])
    np.testing.assert_allclose(
        stored.returns(rewards), [weights[0] / sum(weights), 2 * weights[4] / sum(weights)]
    )


def test_successes_and_failures_are_chosen_evenly(scenes):
    many = stored_lifts(scenes["lift_up"], np.arange(100) < 90)

    stored = stored_moments([many], PrescreenConfig(max_each=12, max_moments=2))

    assert stored is not None
    assert (stored.succeeded.sum(), (~stored.succeeded).sum()) == (12, 10)
    assert len(stored.states["box_pos"]) == 22 * 2


def test_without_stored_states_nothing_is_turned_away(scenes):
    assert [v.accepted for v in prescreen(["not even code"], scenes["lift_up"], [])] == [True]


def test_thresholds_that_make_no_sense_are_refused():
    with pytest.raises(ValueError, match="gamma"):
        PrescreenConfig(gamma=0.0)

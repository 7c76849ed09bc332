"""What candidates are ordered by, and what their settings refuse."""

from dataclasses import replace

import numpy as np
import pytest

from v2p_data.reward.candidate import closeness, rank_of
from v2p_data.reward.config import RewardConfig
from v2p_data.reward.feedback import feedback_of
from v2p_data.reward.trajectories import Trajectories
from v2p_data.task.benchmark import load_benchmark

OBJECT = load_benchmark("lift_up").scene.manipulated
"""The video lifts it by 0.16 m."""


def rank(
    success: float, ranking: float | None = None, lifted_m: float = 0.0, touched: float = 0.0
):
    """The rank of a policy that succeeds in this share of episodes and did this with the object."""
    pos = np.zeros((1, 1, 3), np.float32)
    played = Trajectories(
        components={},
        reward=np.zeros((1, 1), np.float32),
        success=np.zeros((1, 1), bool),
        length=np.array([1]),
        moments=np.array([0]),
        states={
            f"{OBJECT.name}_start_pos": pos,
            f"{OBJECT.name}_pos": pos + np.float32([0, 0, lifted_m]),
            f"{OBJECT.name}_touched": np.full((1, 1), touched, np.float32),
        },
    )
    feedback = replace(
        feedback_of(replace(played, states={}), 0.05),
        num_episodes=64,
        num_successes=round(64 * success),
        ever_success=success,
        reward_ranks=ranking,
    )
    return rank_of(feedback, played, OBJECT)


def test_where_nobody_succeeds_who_is_on_the_way_ranks_first_but_never_above_a_success():
    assert rank(0.0) < rank(0.0, lifted_m=0.08, touched=1.0) < rank(0.125)


def test_of_rewards_that_succeed_alike_the_one_that_pays_successes_more_than_failures_ranks_first():
    assert rank(0.5, 0.1) < rank(0.48, 0.9) < rank(0.62, 0.1)
    assert rank(0.0) < rank(1 / 64, 0.0)
    assert rank(1.0) > rank(0.98, 1.0)


def test_closeness_is_how_much_of_the_videos_way_was_gone():
    moved = np.array([[0, 0, 0], [0, 0, 0.08], [0, 0, 0.16], [0, 0, -0.2], [0.5, 0, 0.16]])

    np.testing.assert_allclose(closeness(moved, OBJECT), [0, 0.5, 1, 0, 0], atol=1e-6)


@pytest.mark.parametrize("rungs", [(), (0.5,), (0.5, 0.25, 1.0), (0.0, 1.0)])
def test_rungs_that_lead_nowhere_are_refused(rungs: tuple[float, ...]):
    with pytest.raises(ValueError, match="rungs must rise"):
        RewardConfig(rungs=rungs)

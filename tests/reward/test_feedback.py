"""What trajectories tell about a reward, against numbers worked out by hand."""

import numpy as np
import pytest

from v2p_data.play import StateActor
from v2p_data.reward.feedback import feedback_of, ranking
from v2p_data.reward.trajectories import Trajectories, record_trajectories
from v2p_data.sim.env.batch_env import BatchEnv, SimConfig
from v2p_data.sim.env.task_code import HELD_STEPS
from v2p_data.task.task import TaskBundle
from v2p_data.task.templates.write import write_samples


def two_episodes(**changes):
    """Ten steps: the first episode succeeds from step 4 on, the second never does."""
    success = np.zeros((10, 2), bool)
    success[4:, 0] = True
    rising = np.arange(10, dtype=np.float32)
    fields = {
        "components": {
            "rises": np.stack([rising, 0 * rising], 1),
            "fine": np.full((10, 2), -1.5, np.float32),
        },
        "reward": np.stack([rising - 1.5, 0 * rising - 1.5], 1),
        "success": success,
        "length": np.array([10, 10]),
    }
    return Trajectories(**(fields | changes))


def component(feedback, name):
    return next(part for part in feedback.components if part.name == name)


def test_successful_and_failed_trajectories_are_told_apart():
    part = component(feedback_of(two_episodes(), 0.05), "rises")

    assert part.successful is not None
    assert part.failed is not None
    assert part.overall is not None
    assert (part.successful.mean, part.successful.max) == (4.5, 9.0)
    assert (part.failed.mean, part.failed.std) == (0.0, 0.0)
    assert part.overall.mean == 2.25
    # Variance of 0..9 is 8.25.
    assert part.successful.std == pytest.approx(8.25**0.5)


def test_it_counts_successes_and_says_how_long_they_took():
    feedback = feedback_of(two_episodes(), 0.05)

    assert (feedback.num_successes, feedback.num_episodes, feedback.success_rate) == (1, 2, 0.5)
    # True from the fifth step on, held after HELD_STEPS of them.
    assert feedback.time_to_success_s == pytest.approx((4 + HELD_STEPS) * 0.05)
    assert feedback.episode_s == pytest.approx(0.5)


def test_success_must_be_held_at_the_end_as_in_the_simulator():
    late = np.zeros((10, 2), bool)
    late[10 - HELD_STEPS + 1 :, 0] = True
    early = np.zeros((10, 2), bool)
    early[:8, 1] = True

    assert not two_episodes(success=late).succeeded.any()
    assert not two_episodes(success=early).succeeded.any()
    assert feedback_of(two_episodes(success=early), 0.05).ever_success == 0.5


def test_a_component_that_never_varies_is_dead():
    feedback = feedback_of(two_episodes(), 0.05)

    assert component(feedback, "fine").is_dead
    assert not component(feedback, "rises").is_dead
    assert "fine: share of the total magnitude 0.400, dead (always -1.5000)" in feedback.text()


def test_shares_are_of_mean_absolute_values():
    feedback = feedback_of(two_episodes(), 0.05)

    assert component(feedback, "fine").share == pytest.approx(1.5 / (1.5 + 2.25))


def test_saturation_is_the_share_of_steps_at_either_end_of_the_range():
    part = component(feedback_of(two_episodes(), 0.05), "rises")

    # Range 0 to 9, margin 0.45: the 9 alone is high; ten zeros and one more are low.
    assert (part.saturated_high, part.saturated_low) == (1 / 20, 11 / 20)


def test_correlation_with_success_is_pearsons():
    trajectories = two_episodes()
    part = component(feedback_of(trajectories, 0.05), "rises")
    x = trajectories.components["rises"].ravel().astype(float)
    y = trajectories.success.ravel().astype(float)
    by_hand = ((x - x.mean()) * (y - y.mean())).mean() / (x.std() * y.std())

    assert part.step_correlation == pytest.approx(by_hand)
    assert part.episode_correlation == pytest.approx(1.0)


def test_what_comes_after_an_episodes_end_counts_for_nothing():
    trajectories = two_episodes(length=np.array([10, 4]))
    for array in (*trajectories.components.values(), trajectories.reward):
        array[4:, 1] = np.nan

    feedback = feedback_of(trajectories, 0.05)

    part = component(feedback, "rises")
    assert part.overall is not None
    assert part.overall.mean == pytest.approx(45 / 14)
    assert feedback.num_successes == 1
    assert "nan" not in feedback.text()


def test_the_ranking_is_the_share_of_pairs_in_order():
    rng = np.random.default_rng(0)
    high, low = rng.integers(0, 6, 30).astype(float), rng.integers(0, 5, 40).astype(float)

    pairs = [(a > b) + 0.5 * (a == b) for a in high for b in low]

    assert ranking(high, low) == pytest.approx(np.mean(pairs))
    assert ranking(high, np.zeros(0)) is None


def test_how_far_the_policy_came_is_read_from_the_states():
    # One moment; the first episode holds the cube 10 cm up, the second is 20 cm away from it.
    cube = {
        "pos": [[0.5, 0.0, 0.12], [0.5, 0.0, 0.02]],
        "start_pos": [[0.5, 0.0, 0.02]] * 2,
        "size": [[0.04, 0.04, 0.04]] * 2,
        "touched": [1.0, 0.0],
        "grasped": [1.0, 0.0],
    }
    states = {f"cube_{k}": np.array([v], np.float32) for k, v in cube.items()}
    states["eef_pos"] = np.array([[[0.5, 0.0, 0.12], [0.7, 0.0, 0.02]]], np.float32)
    trajectories = two_episodes(moments=np.array([9]), states=states)

    (obj,) = feedback_of(trajectories, 0.05).objects

    assert (obj.name, obj.reached, obj.touched, obj.grasped, obj.raised) == (
        "cube",
        0.5,
        0.5,
        0.5,
        0.5,
    )
    assert obj.nearest_m == pytest.approx(0.1)
    assert obj.moved_m == pytest.approx(0.05)


def test_curves_are_thinned_to_ten_values_with_the_last_one_among_them():
    curve = np.linspace(0, 1, 40).tolist()

    feedback = feedback_of(two_episodes(), 0.05, curves={"rises": curve, "success": curve})

    assert component(feedback, "rises").curve[-1] == 1.0
    assert len(feedback.success_curve) == 10


def test_recorded_states_are_those_that_the_reward_was_paid_for(scene_of):
    scene = scene_of("lift_up")
    bundle = TaskBundle(
        title="lift",
        description="lift",
        kind="lift_up",
        class_name="",
        scene=scene,
        code=write_samples(scene)[0],
        horizon_steps=12,
    )
    env = BatchEnv(bundle, SimConfig(), num_envs=4, seed=0, num_threads=1)

    recorded = record_trajectories(
        env, StateActor(lambda obs: np.full((len(obs), 7), 0.5)), num_moments=5
    )

    assert recorded.moments.tolist() == [0, 3, 6, 8, 11]
    # The effort is -0.005 |a|^2 with |a|^2 = 7 / 4; the reach follows from the states that were kept.
    np.testing.assert_allclose(recorded.components["effort"], -0.005 * 7 / 4, rtol=1e-5)
    # From beside it, the point to reach for lies above the box, by its height at most.
    away = recorded.states["box_pos"] - recorded.states["eef_pos"]
    beside = np.linalg.norm(away[..., :2], axis=-1)
    height = 2 * recorded.states["box_start_pos"][..., 2]
    above = np.minimum(1.5 * np.maximum(beside - 0.01, 0), height)
    away = np.hypot(beside, away[..., 2] + above)
    paid = recorded.components["reach"][recorded.moments]
    np.testing.assert_allclose(paid, 0.2 * (1 - np.tanh(8 * away)), atol=1e-5)
    total = 100 * sum(recorded.components.values())
    np.testing.assert_allclose(recorded.reward, total, rtol=1e-4, atol=1e-3)

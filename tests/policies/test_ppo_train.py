"""PPO learns, repeats itself, survives a kill, and tells time limits from terminations."""

import csv
from dataclasses import replace
from pathlib import Path

import pytest
import torch
from point_mass import PointMass, success_rate
from tensordict import TensorDict
from tensordict.nn import TensorDictModule

from policies.ppo.config import ActorConfig, PPOConfig
from policies.ppo.policy import Expert, weights_of
from policies.ppo.train import NotFiniteError, advantage_estimator, outcome, train_expert

SMALL = PPOConfig(
    batch_time=8,
    minibatch=128,
    num_deterministic=16,
    window_episodes=32,
    min_window_episodes=16,
    # The last action of the point mass is no gripper.
    actor=ActorConfig(hidden=(32, 32), gripper_mean_bound=1.5, gripper_min_std=0.1),
)
BATCH = 64 * 8


def steps(num_batches: int) -> PPOConfig:
    return replace(SMALL, total_steps=num_batches * BATCH, target_success=2.0)


def weights_in(folder: Path) -> dict[str, torch.Tensor]:
    return weights_of(Expert.load(folder / "last").model)


def are_equal(a: dict[str, torch.Tensor], b: dict[str, torch.Tensor]) -> bool:
    return a.keys() == b.keys() and all(torch.equal(a[k], b[k]) for k in a)


def rows_of(folder: Path) -> list[dict[str, str]]:
    with (folder / "curve.csv").open() as file:
        return list(csv.DictReader(file))


def test_a_time_limit_bootstraps_and_a_termination_does_not():
    # Values: 1 everywhere. Rewards 1, 1, 1; the second of three steps ends the episode.
    gae = advantage_estimator(
        TensorDictModule(lambda obs: torch.ones_like(obs), ["observation"], ["state_value"]),
        replace(SMALL, gamma=0.5, gae_lambda=0.5),
    )
    ends = torch.tensor([[False, True, False]])[..., None].expand(2, 3, 1)
    terminated = ends.clone()
    terminated[0] = False
    batch = TensorDict(
        {
            "observation": torch.zeros(2, 3, 1),
            "next": {
                "observation": torch.zeros(2, 3, 1),
                "reward": torch.ones(2, 3, 1),
                "done": ends,
                "terminated": terminated,
            },
        },
        [2, 3],
    )

    advantage = gae(batch)["advantage"][..., 0]

    # delta = r + .5 V' - V: .5 where the next value counts, 0 where the episode terminated.
    # Time limit: A = [.5 + .25 * .5, .5, .5]; termination: A = [.5 + .25 * 0, 0, .5].
    torch.testing.assert_close(advantage, torch.tensor([[0.625, 0.5, 0.5], [0.5, 0.0, 0.5]]))


@pytest.mark.slow
def test_a_point_learns_to_reach_its_goal(tmp_path: Path):
    cfg = replace(SMALL, total_steps=400_000, plateau_steps=20_000)

    result = train_expert(PointMass(64, seed=1), cfg, tmp_path)

    assert result.stopped_by == "plateau"
    assert success_rate(Expert.load(tmp_path).act) > 0.85
    assert (tmp_path / "curve.png").stat().st_size > 1000


@pytest.mark.parametrize(
    ("batches", "target", "stopped_by"), [(6, 2.0, "steps"), (60, 0.0, "plateau")]
)
def test_a_plateau_ends_a_training_that_is_good_enough_only(
    tmp_path: Path, batches: int, target: float, stopped_by: str
):
    cfg = replace(steps(batches), target_success=target, plateau_steps=BATCH, plateau_gain=1.0)

    result = train_expert(PointMass(64, seed=1), cfg, tmp_path)

    assert result.stopped_by == stopped_by
    assert (result.steps < batches * BATCH) == (stopped_by == "plateau")


def test_the_same_seed_makes_the_same_weights_and_another_seed_others(tmp_path: Path):
    for name, seed in (("a", 3), ("b", 3), ("c", 4)):
        train_expert(PointMass(64, seed=1), steps(3), tmp_path / name, seed=seed)

    assert are_equal(weights_in(tmp_path / "a"), weights_in(tmp_path / "b"))
    assert not are_equal(weights_in(tmp_path / "a"), weights_in(tmp_path / "c"))


class KilledError(Exception):
    pass


def test_a_kill_after_the_last_checkpoint_changes_nothing(tmp_path: Path):
    def kill(done: int, total: int, success: float) -> None:
        if done == 3 * BATCH:
            raise KilledError

    train_expert(PointMass(64, seed=1), steps(5), tmp_path / "whole")

    train_expert(PointMass(64, seed=1), steps(2), tmp_path / "killed")
    with pytest.raises(KilledError):
        train_expert(PointMass(64, seed=1), steps(5), tmp_path / "killed", on_progress=kill)
    train_expert(PointMass(64, seed=1), steps(5), tmp_path / "killed")

    assert are_equal(weights_in(tmp_path / "whole"), weights_in(tmp_path / "killed"))
    for whole, part in zip(rows_of(tmp_path / "whole"), rows_of(tmp_path / "killed"), strict=True):
        assert {**whole, "seconds": ""} == {**part, "seconds": ""}


def test_a_finished_training_is_left_as_it_is(tmp_path: Path):
    train_expert(PointMass(64, seed=1), steps(2), tmp_path)
    weights, rows = weights_in(tmp_path), rows_of(tmp_path)

    result = train_expert(PointMass(64, seed=1), steps(2), tmp_path)

    assert result.stopped_by == "steps"
    assert are_equal(weights, weights_in(tmp_path))
    assert rows == rows_of(tmp_path)


def test_a_checkpoint_of_another_recipe_is_refused_by_name(tmp_path: Path):
    train_expert(PointMass(64, seed=1), steps(1), tmp_path)

    with pytest.raises(ValueError, match=r"gamma was 0\.97, is 0\.5"):
        train_expert(PointMass(64, seed=1), replace(steps(2), gamma=0.5), tmp_path)


def test_a_nan_is_named_by_key_world_and_step(tmp_path: Path):
    with pytest.raises(
        NotFiniteError,
        match="'next/observation' of world 5 is not finite at step 2 of iteration 1",
    ):
        train_expert(PointMass(64, seed=1, nan_at=8 + 3), steps(3), tmp_path)

    assert (tmp_path / "not_finite.pt").is_file()


def test_a_warm_start_begins_where_the_other_expert_ended(tmp_path: Path):
    train_expert(PointMass(64, seed=1), steps(4), tmp_path / "first")
    first = weights_in(tmp_path / "first")

    # No budget: what is saved is what the run started from.
    train_expert(
        PointMass(64, seed=2),
        steps(0),
        tmp_path / "second",
        warm_start=tmp_path / "first" / "last",
    )
    second = weights_in(tmp_path / "second")

    actor = [k for k in first if k.startswith(("actor.net", "normaliser"))]
    assert are_equal({k: first[k] for k in actor}, {k: second[k] for k in actor})
    torch.testing.assert_close(
        second["actor.log_std"].exp(), torch.full((2,), SMALL.warm_start_std)
    )


def test_worlds_that_are_all_deterministic_are_refused(tmp_path: Path):
    with pytest.raises(ValueError, match="64 worlds leave none to learn from"):
        train_expert(PointMass(64), replace(SMALL, num_deterministic=64), tmp_path)


def test_the_curve_holds_every_reward_component_by_name(tmp_path: Path):
    train_expert(PointMass(64, seed=1), steps(2), tmp_path)

    near = [float(row["reward_near"]) for row in rows_of(tmp_path)]
    # Two points drawn evenly in a square of side 2 are 1.04 apart on average.
    assert -1.5 < near[0] < -0.7


def test_success_that_lasted_decides_over_success_of_the_moment():
    moment = TensorDict({"success": torch.tensor([[True], [True]])}, [2])
    lasting = moment.clone().set("held", torch.tensor([[False], [True]]))

    assert outcome(moment).flatten().tolist() == [True, True]
    assert outcome(lasting).flatten().tolist() == [False, True]

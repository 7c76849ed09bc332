"""A task becomes an expert: by a teacher and PPO, or by PPO alone."""

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch

from policies.evaluation.paired import Difference
from policies.evaluation.rate import wilson
from policies.ppo.config import ActorConfig, ImitationConfig, PPOConfig
from policies.ppo.policy import ActorCritic, Expert, weights_of
from policies.ppo.train import ExpertResult
from v2p_data.errors import ItemRejectedError
from v2p_data.experts.config import ExpertConfig
from v2p_data.experts.learning import (
    TAUGHT_FOLDER,
    Worlds,
    better_of_ppo,
    keep_better,
    learn,
    success_of,
)
from v2p_data.experts.record import Comparison, Learned, PolicyScore
from v2p_data.experts.teacher import EpisodeOutcomes
from v2p_data.play import StateActor
from v2p_data.sim.env.batch_env import BatchEnv, SimConfig
from v2p_data.task.benchmark import load_benchmark
from v2p_data.task.task import TaskBundle

TINY = ExpertConfig(
    start="program",
    trial_worlds=8,
    compare_worlds=16,
    num_envs=48,
    imitation=ImitationConfig(rounds=2, least_rounds=2, round_steps=30, epochs=2, minibatch=256),
    ppo=PPOConfig(
        total_steps=48 * 16 * 2,
        target_success=2.0,
        num_deterministic=8,
        window_episodes=16,
        min_window_episodes=8,
        warm_start_critic_batches=1,
    ),
)


@pytest.fixture(scope="module")
def bundle() -> TaskBundle:
    return load_benchmark("lift_up")


@pytest.fixture(scope="module")
def learned(bundle: TaskBundle, tmp_path_factory) -> tuple[Learned, Path]:
    out = tmp_path_factory.mktemp("learned")
    return learn(Worlds(bundle=bundle, seed=3, num_threads=1), TINY, out), out


def weights_in(folder: Path) -> dict[str, torch.Tensor]:
    return weights_of(Expert.load(folder).model)


def actor_in(folder: Path) -> dict[str, torch.Tensor]:
    return {k: v for k, v in weights_in(folder).items() if k.startswith("actor.net")}


def save_random_expert(folder: Path, obs_dim: int, *, seed: int) -> None:
    generator = torch.Generator().manual_seed(seed)
    Expert(ActorCritic(obs_dim, 7, ActorConfig(), generator)).save(folder)


def improved_in(folder: Path) -> ExpertResult:
    return ExpertResult(
        folder=folder,
        success=1.0,
        actor_updates=7,
        last_actor_updates=9,
        steps=1,
        seconds=1.0,
        stopped_by="steps",
    )


def who_acts_so(obs: np.ndarray, wanted: np.ndarray) -> Callable[[StateActor], EpisodeOutcomes]:
    """Return what plays 16 episodes, which succeed with the policy that answers `obs` with `wanted` only."""

    def play(actor: StateActor) -> EpisodeOutcomes:
        succeeds = np.full(16, np.array_equal(actor.function(obs), wanted))
        return EpisodeOutcomes(at_end=succeeds, steps=np.where(succeeds, 10, 101), horizon=100)

    return play


def are_equal(a: dict[str, torch.Tensor], b: dict[str, torch.Tensor]) -> bool:
    return a.keys() == b.keys() and all(torch.equal(a[k], b[k]) for k in a)


def test_a_task_becomes_an_expert_by_way_of_a_teacher(learned: tuple[Learned, Path]):
    result, out = learned

    assert result.teacher == "lift"
    assert Expert.load(out).model.act_dim == Expert.load(out / TAUGHT_FOLDER).model.act_dim == 7
    assert (out / "curve.csv").is_file()


def test_every_step_of_every_world_is_counted(learned: tuple[Learned, Path]):
    result, _ = learned

    trials = len(result.trials) * 8 * 60  # worlds, steps of an episode of lifting
    imitation = 2 * 30 * 48
    ppo = 2 * 16 * 48
    assert result.steps == trials + imitation + ppo
    assert result.stopped_by == "steps"


def test_the_better_one_of_pupil_and_ppo_is_kept_and_called_by_its_maker(
    learned: tuple[Learned, Path],
):
    result, out = learned

    assert result.comparison is not None
    is_ppo_better = result.comparison.ppo.score > result.comparison.taught.score
    assert result.kept == ("ppo" if is_ppo_better else "taught")
    assert are_equal(actor_in(out), actor_in(out / TAUGHT_FOLDER)) == (not is_ppo_better)
    assert (result.actor_updates > 0) == is_ppo_better
    assert ("PPO" in result.made_by) == is_ppo_better


def test_without_a_gradient_step_of_the_actor_the_expert_is_the_taught_one(
    bundle: TaskBundle, tmp_path: Path
):
    only_the_value = replace(TINY.ppo, warm_start_critic_batches=9)

    result = learn(Worlds(bundle=bundle, seed=3), replace(TINY, ppo=only_the_value), tmp_path)

    assert (result.kept, result.actor_updates, result.comparison) == ("taught", 0, None)
    assert result.made_by == "taught: imitation of the program 'lift'"
    assert are_equal(actor_in(tmp_path), actor_in(tmp_path / TAUGHT_FOLDER))


def test_a_budget_that_ends_before_the_first_gradient_step_makes_no_expert(
    bundle: TaskBundle, tmp_path: Path
):
    nothing = replace(TINY, start="none", ppo=replace(TINY.ppo, total_steps=0))

    with pytest.raises(ItemRejectedError, match=r"before the best policy of 'lift_up' had"):
        learn(Worlds(bundle=bundle, seed=3), nothing, tmp_path)


def test_a_policy_that_meets_itself_on_the_same_episodes_is_exactly_as_good(
    bundle: TaskBundle, tmp_path: Path
):
    cfg = replace(TINY, compare_worlds=16)
    worlds = Worlds(bundle=bundle, seed=3)
    for name in ("taught", "ppo", "ppo/last"):
        save_random_expert(tmp_path / name, worlds.make(1, "shape").obs_dim, seed=1)
    improved = improved_in(tmp_path / "ppo")

    compared, updates = keep_better(worlds, cfg, tmp_path / "taught", tmp_path / "ppo", improved)

    assert updates == 0
    assert compared.taught == compared.ppo
    assert (compared.success_gain.value, compared.moved) == (0.0, 0.0)


@pytest.mark.parametrize(("better", "updates"), [("ppo", 7), ("ppo/last", 9)])
def test_of_the_best_in_training_and_the_last_policy_the_one_that_does_better_on_fresh_episodes_is_kept(
    better: str, updates: int, tmp_path: Path
):
    for seed, name in enumerate(("ppo", "ppo/last")):
        save_random_expert(tmp_path / name, 5, seed=seed)
    obs = np.ones((16, 5), np.float32)
    wanted = Expert.load(tmp_path / better).act(obs)

    kept = better_of_ppo(who_acts_so(obs, wanted), tmp_path / "ppo", improved_in(tmp_path / "ppo"))

    assert np.array_equal(kept[0].act(obs), wanted)
    assert kept[1] == updates


@pytest.mark.parametrize(
    ("gain", "saved_s", "is_better"),
    [
        ((0.05, 0.01, 0.09), (-0.1, -0.2, 0.0), True),
        ((0.05, -0.01, 0.11), (0.0, 0.0, 0.0), False),
        ((0.0, -0.01, 0.01), (0.05, 0.05, 0.05), True),
        ((-0.004, -0.02, 0.01), (0.1, 0.1, 0.1), False),
        ((0.0, -0.01, 0.01), None, False),
    ],
)
def test_ppo_counts_as_better_only_where_an_interval_says_so(
    gain: tuple[float, float, float], saved_s: tuple[float, float, float] | None, is_better: bool
):
    def difference(value: float, low: float, high: float) -> Difference:
        return Difference(value=value, low=low, high=high, pairs=256)

    judged = PolicyScore(success=wilson(250, 256), median_s=1.0, score=0.9)

    compared = Comparison(
        taught=judged,
        ppo=judged,
        success_gain=difference(*gain),
        time_saved_s=difference(*saved_s) if saved_s else None,
        moved=0.03,
    )

    assert compared.is_better == is_better


@pytest.mark.slow
def test_the_same_seed_learns_the_same_weights_and_another_seed_others(
    bundle: TaskBundle, learned: tuple[Learned, Path], tmp_path: Path
):
    first, out = learned

    again = learn(Worlds(bundle=bundle, seed=3, num_threads=2), TINY, tmp_path / "again")
    learn(Worlds(bundle=bundle, seed=4, num_threads=1), TINY, tmp_path / "other")

    assert are_equal(weights_in(out / "last"), weights_in(tmp_path / "again" / "last"))
    assert not are_equal(weights_in(out / "last"), weights_in(tmp_path / "other" / "last"))
    assert replace(again, seconds=0.0) == replace(first, seconds=0.0)


def test_without_a_teacher_ppo_learns_from_nothing(bundle: TaskBundle, tmp_path: Path):
    told: list[float] = []

    result = learn(
        Worlds(bundle=bundle, seed=3),
        replace(TINY, start="none"),
        tmp_path,
        on_progress=lambda share, words: told.append(share),
    )

    assert (result.teacher, result.trials, result.kept) == ("", (), "ppo")
    assert result.comparison is None
    assert result.made_by == f"{result.actor_updates} gradient steps of PPO"
    assert result.steps == 2 * 16 * 48
    assert not (tmp_path / TAUGHT_FOLDER).exists()
    assert told == [0.5, 1.0]


def test_a_program_that_hardly_succeeds_teaches_nothing(bundle: TaskBundle, tmp_path: Path):
    unreachable = replace(TINY, least_teacher_success=1.01)

    result = learn(Worlds(bundle=bundle, seed=3), unreachable, tmp_path)

    assert result.teacher == ""
    assert len(result.trials) >= 1
    assert result.steps == len(result.trials) * 8 * 60 + 2 * 16 * 48
    assert not (tmp_path / TAUGHT_FOLDER).exists()


@pytest.mark.slow
def test_a_taught_expert_lifts_the_box_at_the_fine_time_step(bundle: TaskBundle, tmp_path: Path):
    cfg = replace(
        TINY,
        num_envs=128,
        imitation=ImitationConfig(rounds=6, least_rounds=5, target_success=0.9),
        ppo=replace(TINY.ppo, total_steps=0),
    )

    learn(Worlds(bundle=bundle, seed=3), cfg, tmp_path)

    worlds = BatchEnv(bundle, SimConfig(fine=True), num_envs=32, seed=99, num_threads=1)
    assert success_of(worlds, Expert.load(tmp_path)) >= 0.7

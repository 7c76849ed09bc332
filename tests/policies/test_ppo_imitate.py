"""A learner does as it is told, and PPO goes on from there without losing it."""

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from point_mass import PointMass, success_rate

from policies.ppo.config import ActorConfig, ImitationConfig, PPOConfig
from policies.ppo.imitate import imitate
from policies.ppo.policy import Expert, weights_of
from policies.ppo.train import train_expert

NUM_ENVS = 64
# The last action of the point mass is no gripper.
ACTOR = ActorConfig(hidden=(32, 32), gripper_mean_bound=1.5, gripper_min_std=0.1)
CFG = ImitationConfig(
    rounds=6, least_rounds=3, round_steps=20, teacher_rounds=4, minibatch=256, actor=ACTOR
)
PPO = PPOConfig(
    batch_time=8,
    minibatch=128,
    num_deterministic=16,
    window_episodes=32,
    min_window_episodes=16,
    target_success=2.0,
    actor=ACTOR,
)
BATCH = NUM_ENVS * 8


class RecordedPoints(PointMass):
    """Remembers the actions that were carried out."""

    def __init__(self, num_envs: int, seed: int = 0):
        super().__init__(num_envs, seed)
        self.actions: list[torch.Tensor] = []
        self.staggered_from: list[int] = []

    def stagger(self, first: int = 0) -> None:
        self.staggered_from.append(first)

    def _step(self, tensordict):
        self.actions.append(tensordict["action"].clone())
        return super()._step(tensordict)


class UnwantedGoal(PointMass):
    """Pays for being far from the goal."""

    def _step(self, tensordict):
        after = super()._step(tensordict)
        return after.set("reward", -after["reward"])


def straight_to(env: PointMass) -> Callable[[], np.ndarray]:
    """A linear teacher: its advice is within the bounds for all distances in the square."""
    return lambda: (0.6 * (env.goal - env.pos)).numpy()


def taught(folder: Path, cfg: ImitationConfig = CFG, *, seed: int = 0, check=None) -> Path:
    env = PointMass(NUM_ENVS, seed=1)
    return imitate(env, straight_to(env), cfg, folder, seed=seed, check=check).folder


def weights_in(folder: Path) -> dict[str, torch.Tensor]:
    return weights_of(Expert.load(folder).model)


def same(a: dict[str, torch.Tensor], b: dict[str, torch.Tensor], part: str = "") -> bool:
    return all(torch.equal(a[k], b[k]) for k in a if k.startswith(part))


def success(folder: Path) -> float:
    return success_rate(Expert.load(folder).act, seed=9)


@pytest.fixture(scope="module")
def pupil(tmp_path_factory) -> Path:
    return taught(tmp_path_factory.mktemp("pupil"))


def test_a_linear_teacher_is_learned(pupil: Path):
    rng = np.random.default_rng(0)
    pos, goal = rng.uniform(-1, 1, (2, 500, 2))
    obs = np.concatenate([1000 + 50 * pos, goal - pos], axis=1).astype(np.float32)

    error = np.abs(Expert.load(pupil).act(obs) - np.clip(0.6 * (goal - pos), -1, 1))

    assert error.mean() < 0.05
    # Twenty steps, each leaving 0.88 of the distance: 0.077 of at most 2.8 m.
    assert success(pupil) > 0.8


def test_imitation_ends_with_the_first_round_that_succeeds_often_enough(tmp_path: Path):
    env = PointMass(NUM_ENVS, seed=1)
    rates = iter([0.5, 0.99, 1.0, 1.0])

    result = imitate(
        env, straight_to(env), CFG, tmp_path, seed=0, check=lambda expert: next(rates)
    )

    # Three rounds before the first trial, and one more.
    assert result.steps == 4 * 20 * NUM_ENVS
    assert list(rates) == [1.0, 1.0]


def test_the_round_that_succeeded_most_is_kept(tmp_path: Path):
    seen: list[dict[str, torch.Tensor]] = []
    rates = [0.2, 0.9, 0.5, 0.9]

    def check(expert: Expert) -> float:
        seen.append(weights_of(expert.model))
        return rates[len(seen) - 1]

    kept = weights_in(taught(tmp_path, replace(CFG, epochs=1), check=check))

    assert len(seen) == 4
    assert [same(kept, weights) for weights in seen] == [False, True, False, False]


def test_the_same_seed_teaches_the_same_weights_and_another_seed_others(tmp_path: Path):
    quick = replace(CFG, rounds=2, epochs=1)

    a, b, c = (
        weights_in(taught(tmp_path / name, quick, seed=seed))
        for name, seed in (("a", 3), ("b", 3), ("c", 4))
    )

    assert same(a, b)
    assert not same(a, c)


def test_the_teacher_moves_all_worlds_at_first_and_its_least_share_in_the_end(tmp_path: Path):
    env = RecordedPoints(200, seed=1)
    said: list[torch.Tensor] = []

    def teacher() -> np.ndarray:
        said.append(0.6 * (env.goal - env.pos))
        return said[-1].numpy()

    cfg = replace(CFG, rounds=3, teacher_rounds=2, least_teacher=0.2, noise=0.0, epochs=1)
    imitate(env, teacher, cfg, tmp_path, seed=0)

    follows = [
        torch.stack([(a == s).all(1) for a, s in zip(env.actions, said, strict=True)][k : k + 20])
        for k in (0, 20, 40)
    ]
    shares = [float(f.float().mean()) for f in follows]
    # Within a round a world is led by one of the two all the time.
    assert all(bool((f == f[0]).all()) for f in follows)
    assert shares[0] == 1.0
    # 200 worlds: four standard deviations are 0.14 and 0.11.
    assert shares[1:] == pytest.approx([0.5, 0.2], abs=0.14)


def test_a_warm_start_first_teaches_the_value_and_leaves_the_actor_untouched(
    pupil: Path, tmp_path: Path
):
    begin, end, later = (
        weights_in(_went_on(pupil, tmp_path / str(batches), batches) / "last")
        for batches in (0, 3, 4)
    )

    assert same(begin, end, "actor.net")
    assert not same(begin, end, "critic.net")
    assert not same(begin, later, "actor.net")


def _went_on(pupil: Path, out: Path, batches: int) -> Path:
    cfg = replace(PPO, total_steps=batches * BATCH, warm_start_critic_batches=3)
    return train_expert(PointMass(NUM_ENVS, seed=2), cfg, out, warm_start=pupil).folder


def test_a_warm_start_sees_through_the_eyes_it_was_taught_with(pupil: Path, tmp_path: Path):
    folder = _went_on(pupil, tmp_path, 8)

    assert same(weights_in(pupil), weights_in(folder / "last"), "normaliser")


def test_the_actor_s_first_step_after_a_warm_start_is_a_careful_one(pupil: Path, tmp_path: Path):
    def moved(name: str, rate: float) -> float:
        cfg = replace(
            PPO,
            total_steps=2 * BATCH,
            epochs=1,
            minibatch=BATCH,
            warm_start_critic_batches=1,
            warm_start_learning_rate=rate,
        )
        out = train_expert(
            PointMass(NUM_ENVS, seed=2), cfg, tmp_path / name, warm_start=pupil
        ).folder
        after, before = weights_in(out / "last"), weights_in(pupil)
        key = "actor.net.0.weight"
        return float((after[key] - before[key]).abs().max())

    # Adam's first step is as long as the learning rate, whatever the gradient.
    assert moved("a", 2e-4) == pytest.approx(2e-4, rel=0.05)
    assert moved("b", 5e-5) == pytest.approx(5e-5, rel=0.05)


@pytest.mark.slow
def test_going_on_does_not_lose_a_policy_that_succeeds(pupil: Path, tmp_path: Path):
    before = success(pupil)

    result = train_expert(
        PointMass(NUM_ENVS, seed=2),
        replace(PPO, total_steps=60 * BATCH),
        tmp_path,
        warm_start=pupil,
    )

    assert result.stopped_by == "steps"
    assert success(tmp_path) > before - 0.05
    assert success(tmp_path / "last") > before - 0.1


def test_a_warm_training_that_unlearns_is_stopped_and_its_best_is_kept(
    pupil: Path, tmp_path: Path
):
    result = train_expert(
        UnwantedGoal(NUM_ENVS, seed=2),
        replace(PPO, total_steps=200 * BATCH, warm_start_learning_rate=1e-3),
        tmp_path,
        warm_start=pupil,
    )

    assert result.stopped_by == "decline"
    assert result.steps < 200 * BATCH
    assert success(tmp_path) > 0.8
    assert success(tmp_path / "last") < success(tmp_path)


def test_the_deterministic_worlds_start_at_the_start(tmp_path: Path):
    env = RecordedPoints(NUM_ENVS, seed=1)

    train_expert(env, replace(PPO, total_steps=BATCH), tmp_path)

    assert env.staggered_from == [16]

"""The expert's folder, its normalisation and the bounds of its Gaussian."""

from pathlib import Path

import numpy as np
import pytest
import torch

from policies.ppo.config import ActorConfig
from policies.ppo.policy import ActorCritic, Expert, Normaliser


def expert(seed: int = 0) -> Expert:
    return Expert(
        ActorCritic(5, 7, ActorConfig(hidden=(16,)), torch.Generator().manual_seed(seed))
    )


def test_an_expert_read_back_acts_the_same(tmp_path: Path):
    saved = expert()
    saved.model.normaliser.update(torch.arange(50.0).reshape(10, 5))
    obs = np.linspace(0, 50, 15, dtype=np.float32).reshape(3, 5)

    saved.save(tmp_path)

    np.testing.assert_array_equal(Expert.load(tmp_path).act(obs), saved.act(obs))
    assert {p.name for p in tmp_path.iterdir()} == {"expert.json", "weights.safetensors"}


def test_a_folder_without_expert_says_so(tmp_path: Path):
    with pytest.raises(FileNotFoundError, match="it is no expert"):
        Expert.load(tmp_path)


def test_statistics_gathered_in_parts_equal_those_of_the_whole():
    rng = torch.Generator().manual_seed(0)
    data = torch.randn(100, 3, generator=rng) * torch.tensor([1.0, 5.0, 0.2]) + 7
    normaliser = Normaliser(3, clip=5.0)

    for part in data.split([10, 60, 30]):
        normaliser.update(part)

    torch.testing.assert_close(normaliser.mean, data.mean(0))
    torch.testing.assert_close(normaliser.var, data.var(0, correction=0))


def test_normalised_observations_are_clipped_and_a_constant_stays_small():
    normaliser = Normaliser(2, clip=5.0)
    normaliser.update(torch.tensor([[0.0, 3.0], [2.0, 3.0]]))

    # mean 1, std 1; the second never moved, so its std is taken as 0.05.
    out = normaliser(torch.tensor([[2.0, 3.1], [100.0, 3.0]]))

    torch.testing.assert_close(out, torch.tensor([[1.0, 2.0], [5.0, 0.0]]))


def test_means_stay_in_their_bounds_however_large_the_network_output():
    model = expert().model
    with torch.no_grad():
        for parameter in model.actor.net.parameters():
            parameter.mul_(1000)

    with torch.no_grad():
        mean, std = model.actor(torch.randn(50, 5, generator=torch.Generator().manual_seed(1)))

    assert mean[:, :6].abs().max().item() == pytest.approx(1.5, abs=1e-3)
    assert mean[:, 6].abs().max().item() == pytest.approx(0.8, abs=1e-3)
    assert std.min().item() == pytest.approx(0.6)


def test_the_gripper_keeps_exploring_when_the_optimiser_shrinks_every_std():
    actor = expert().model.actor
    with torch.no_grad():
        actor.log_std.fill_(-10.0)

    actor.clamp_std()

    torch.testing.assert_close(actor.log_std.exp(), torch.tensor([0.1] * 6 + [0.6]))


def test_actions_are_within_the_action_range_and_samples_come_from_the_given_generator():
    policy, obs = expert(), np.zeros((200, 5), np.float32)

    a = policy.act(obs, deterministic=False, generator=torch.Generator().manual_seed(1))
    b = policy.act(obs, deterministic=False, generator=torch.Generator().manual_seed(1))

    np.testing.assert_array_equal(a, b)
    assert np.abs(a).max() == 1.0
    assert a.dtype == np.float32

"""PPO learns on a GPU what it learns on the CPU: all that is random is drawn on the CPU."""

from pathlib import Path

import pytest
import torch
from point_mass import PointMass

from policies.ppo.config import ActorConfig, PPOConfig
from policies.ppo.policy import ActorCritic, Expert, weights_of
from policies.ppo.train import train_expert

CFG = PPOConfig(
    batch_time=8,
    minibatch=128,
    num_deterministic=16,
    total_steps=3 * 64 * 8,
    target_success=2.0,
    # The last action of the point mass is no gripper.
    actor=ActorConfig(hidden=(32, 32), gripper_mean_bound=1.5, gripper_min_std=0.1),
)


def weights_after_three_batches(device: str, out: Path) -> dict[str, torch.Tensor]:
    train_expert(PointMass(64, seed=1, device=device), CFG, out, seed=3)
    return {k: v.cpu().float() for k, v in weights_of(Expert.load(out / "last").model).items()}


@pytest.mark.gpu
def test_three_batches_on_a_gpu_teach_what_they_teach_on_the_cpu(tmp_path: Path, gpu: str):
    before = weights_of(ActorCritic(4, 2, CFG.actor, torch.Generator().manual_seed(3)))
    there = weights_after_three_batches(gpu, tmp_path / "there")
    here = weights_after_three_batches("cpu", tmp_path / "here")

    for name in here:
        if name.startswith("normaliser"):
            torch.testing.assert_close(there[name], here[name], atol=0, rtol=1e-4)
        else:
            # Adam turns rounding of a gradient near zero into a whole step of the learning rate.
            assert (there[name] - here[name]).abs().mean() < 1e-4, name
    for layer in ("actor.net.0.weight", "critic.net.0.weight"):
        assert (here[layer] - before[layer]).abs().mean() > 5e-3, layer

"""Worlds of several tasks as one batch: each part is as it is alone, and every part is among the first worlds."""

import numpy as np
import pytest
import torch
from torchrl.envs.utils import check_env_specs

from v2p_data.errors import V2PError
from v2p_data.sim.env.batch_env import BatchEnv
from v2p_data.sim.wrappers.joined_worlds import JoinedWorlds
from v2p_data.sim.wrappers.torchrl_env import TorchRLEnv
from v2p_data.task.benchmark import load_benchmark
from v2p_data.task.task import BASE_OBSERVATION_DIM

COUNT = 3


def parts_of(*tasks: str) -> list[BatchEnv]:
    return [
        BatchEnv(load_benchmark(t), num_envs=COUNT, seed=k, num_threads=1)
        for k, t in enumerate(tasks)
    ]


@pytest.fixture
def joined() -> JoinedWorlds:
    return JoinedWorlds(parts_of("lift_up", "tip_over"))


def test_each_world_goes_as_in_its_own_environment(joined: JoinedWorlds):
    alone = parts_of("lift_up", "tip_over")
    action = np.random.default_rng(0).uniform(-1, 1, (2 * COUNT, 7))
    result = joined.step(action)

    for k, part in enumerate(alone):
        own = part.step(action[k::2])
        assert np.array_equal(result.obs[k::2], own.obs[:, :BASE_OBSERVATION_DIM])
        assert np.array_equal(result.reward[k::2], own.reward)
        assert np.array_equal(result.truncated[k::2], own.truncated)
        shared = joined.component_names
        assert all(np.array_equal(result.components[n][k::2], own.components[n]) for n in shared)
    assert np.array_equal(joined.observe(), result.obs)


def test_a_reset_reaches_the_worlds_that_are_named_and_no_others(joined: JoinedWorlds):
    for _ in range(4):
        joined.step(np.full((2 * COUNT, 7), 0.4))
    before = joined.observe()
    joined.reset(np.array([1, 4]))  # world 0 of the second part, world 2 of the first

    changed = (joined.observe() != before).any(1)
    assert changed.tolist() == [False, True, False, False, True, False]


def test_torchrl_takes_them_and_a_saved_state_goes_on_the_same_way(joined: JoinedWorlds):
    env = TorchRLEnv(joined)
    check_env_specs(env)
    env.reset()
    env.stagger(2)
    saved = env.state_dict()
    action = torch.full((2 * COUNT, 7), 0.2).numpy()
    first = joined.step(action)
    env.load_state_dict(saved)

    assert np.array_equal(joined.step(action).obs, first.obs)


def test_tasks_of_another_length_are_refused_by_name():
    with pytest.raises(V2PError, match="one policy learns tasks of one length"):
        JoinedWorlds(parts_of("lift_up", "insert"))

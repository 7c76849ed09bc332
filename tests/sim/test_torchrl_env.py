from collections.abc import Callable

import pytest
import torch
from tensordict import TensorDict
from torchrl.envs.utils import check_env_specs

from v2p_data.sim.env.batch_env import BatchEnv
from v2p_data.sim.wrappers.torchrl_env import TorchRLEnv
from v2p_data.task.task import Task, TaskBundle


@pytest.fixture
def env(make_bundle: Callable[..., TaskBundle], lift_task: type[Task]) -> TorchRLEnv:
    return TorchRLEnv(
        BatchEnv(make_bundle(horizon=6), num_envs=4, seed=0, num_threads=1, task=lift_task)
    )


def still(env: TorchRLEnv) -> TensorDict:
    return TensorDict({"action": torch.zeros(4, 7)}, [4])


def test_the_specifications_hold(env: TorchRLEnv):
    check_env_specs(env)


def test_time_running_out_is_a_truncation_and_no_termination(env: TorchRLEnv):
    env.reset()

    last = [env.step(still(env))["next"] for _ in range(6)][-1]

    assert last["truncated"].all()
    assert last["done"].all()
    assert not last["terminated"].any()


def test_a_broken_world_is_a_termination_and_no_truncation(env: TorchRLEnv):
    env.reset()
    env.worlds._sim.qvel[1, 0] = 1e13

    after = env.step(still(env))["next"]

    assert after["terminated"].flatten().tolist() == [False, True, False, False]
    assert not after["truncated"].any()


def test_a_partial_reset_starts_only_the_marked_worlds_anew(env: TorchRLEnv):
    env.reset()
    for _ in range(3):
        env.step(still(env))
    mask = torch.tensor([[True], [False], [False], [True]])

    env.reset(TensorDict({"_reset": mask}, [4]))

    progress = env.worlds.states()["progress"]
    assert progress.tolist() == pytest.approx([0, 0.5, 0.5, 0])


def test_the_parts_of_the_reward_come_with_it(env: TorchRLEnv):
    env.reset()

    after = env.step(still(env))["next"]

    assert sorted(after["components"].keys()) == ["alive", "height"]
    expected = (after["components", "height"] + 1) / 100
    torch.testing.assert_close(after["reward"][:, 0], expected)


def test_its_state_can_be_saved_with_a_checkpoint_and_restored(env: TorchRLEnv, tmp_path):
    env.reset()
    env.step(still(env))
    torch.save(dict(env.state_dict()), tmp_path / "checkpoint.pt")
    expected = env.step(still(env))["next", "observation"]

    env.reset()
    env.load_state_dict(torch.load(tmp_path / "checkpoint.pt", weights_only=True))

    torch.testing.assert_close(
        env.step(still(env))["next", "observation"], expected, rtol=0, atol=0
    )

"""The Gymnasium vector environment."""

from dataclasses import replace

import gymnasium as gym
import numpy as np
import pytest

from v2p_data.errors import V2PError
from v2p_data.sim.wrappers import vector_env

CODE = """
from factory.tasks.task import Task

class LiftCube(Task):
    def __init__(self, envs, urdf_assets_root):
        super().__init__(envs, urdf_assets_root, {})
        self.task_description = "lifting a cube"

    def compute_success(self, states):
        return (states["cube_pos"][:, 2] > 0.01) & (states["progress"] > 0.2)

    def compute_reward(self, actions, states):
        height = states["cube_pos"][:, 2]
        return height, {"height": height}
"""


@pytest.fixture
def env(make_bundle, tmp_path):
    scene_folder = tmp_path / "scene"
    scene_folder.mkdir()
    bundle = make_bundle(folder=scene_folder, horizon=6)
    bundle.scene.save(scene_folder)
    replace(bundle, code=CODE).save(tmp_path / "task")
    made = gym.make_vec(
        vector_env.ENV_ID,
        num_envs=3,
        vectorization_mode="vector_entry_point",
        task_folder=str(tmp_path / "task"),
        num_threads=1,
    )
    yield made
    made.close()


def test_what_it_gives_lies_in_its_spaces(env):
    obs, _ = env.reset(seed=1)
    stepped, reward, terminated, truncated, _ = env.step(env.action_space.sample())

    assert obs in env.observation_space
    assert stepped in env.observation_space
    assert reward.shape == terminated.shape == truncated.shape == (3,)


def test_a_seed_repeats_the_same_worlds(env):
    first, _ = env.reset(seed=5)
    other, _ = env.reset(seed=6)
    again, _ = env.reset(seed=5)

    np.testing.assert_array_equal(first, again)
    assert not np.array_equal(first, other)


def test_each_world_starts_as_its_seed_in_a_list_says(env):
    first, _ = env.reset(seed=[5, 6, 5])
    again, _ = env.reset(seed=[7, 6, 5])

    np.testing.assert_array_equal(first[0], first[2])
    assert not np.array_equal(first[0], first[1])
    np.testing.assert_array_equal(first[1:], again[1:])
    assert not np.array_equal(first[0], again[0])


@pytest.mark.parametrize(
    ("asked", "words"),
    [
        ({"seed": [5, 6]}, "one for each of the 3 worlds"),
        ({"seed": [5, None, 6]}, "one for each of the 3 worlds"),
        ({"options": {"reset_mask": np.ones(3, bool)}}, "no options, got reset_mask"),
    ],
)
def test_what_a_reset_would_not_heed_is_refused(env, asked, words):
    with pytest.raises(V2PError, match=words):
        env.reset(**asked)


def test_the_step_after_an_end_starts_the_next_episode_and_ignores_its_action(env):
    env.reset(seed=2)
    still = np.zeros((3, 7), np.float32)
    for _ in range(5):
        *_, truncated, _ = env.step(still)
        assert not truncated.any()
    *_, truncated, info = env.step(still)
    assert truncated.all()
    assert info["is_success"].all()  # true from the second of six steps on, and five are asked for

    obs, reward, terminated, truncated, info = env.step(np.ones((3, 7), np.float32))

    assert not reward.any()
    assert not (terminated | truncated | info["is_success"]).any()
    progress = 72
    np.testing.assert_array_equal(obs[:, progress], 0.0)

"""Worlds of a batch, each seeded by itself, go through what single environments go through."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch

from v2p_data.sim.env.batch_env import BatchEnv, SimConfig
from v2p_data.sim.wrappers.gym_env import V2PEnv, stream_seed
from v2p_data.task.task import TaskBundle

LIFT = """
from factory.tasks.task import Task

class LiftCube(Task):
    def __init__(self, envs, urdf_assets_root):
        super().__init__(envs, urdf_assets_root, {})

    def compute_success(self, states):
        return states["cube_pos"][:, 2] > 0.12

    def compute_reward(self, actions, states):
        height = states["cube_pos"][:, 2]
        return height, {"height": height}
"""
SEEDS = (7, 8, 9, 2**31)


@pytest.fixture
def folder(make_bundle, make_object, tmp_path) -> Path:
    cup = make_object("cup", "cylinder", (0.06, 0.06, 0.1), role="reference", pos=(0.1, 0, 0.05))
    (tmp_path / "scene").mkdir()
    bundle = make_bundle(make_object(), cup, folder=tmp_path / "scene")
    bundle.scene.save(tmp_path / "scene")
    replace(bundle, code=LIFT).save(tmp_path / "lift")
    return tmp_path / "lift"


def batch_of(folder: Path, num_envs: int) -> BatchEnv:
    sim = SimConfig(fine=True)
    bundle = TaskBundle.load(folder)
    return BatchEnv(bundle, sim, num_envs=num_envs, seed=0, num_threads=1)


def state_of(env: BatchEnv, world: int) -> dict[str, np.ndarray]:
    saved = {name: value for name, value in env.state_dict().items() if torch.is_tensor(value)}
    shared = ("drawn.prepared", "drawn.num_used")
    return {name: v.numpy()[world] for name, v in saved.items() if not name.startswith(shared)}


def test_each_world_goes_through_what_a_single_environment_does(folder):
    batch = batch_of(folder, len(SEEDS))
    batch.step(np.ones((len(SEEDS), 7)))  # what was before leaves no trace
    batch.reset_seeded(np.arange(len(SEEDS)), [stream_seed(s) for s in SEEDS])
    actions = np.random.default_rng(0).uniform(-1, 1, (25, len(SEEDS), 7)).astype(np.float32)
    for action in actions:
        batch.step(action)

    for world, seed in enumerate(SEEDS):
        single = V2PEnv(str(folder), size_px=16)
        single.reset(seed=seed)
        for action in actions:
            single.step(action[world])
        mine, other = state_of(batch, world), state_of(single._world, 0)
        for name, value in mine.items():
            np.testing.assert_array_equal(value, other[name], err_msg=f"{name}, seed {seed}")
        single.close()


def test_worlds_that_stand_still_change_nothing_for_the_others(folder):
    ways = []
    for moving in (None, np.array([0, 2])):
        env = batch_of(folder, 4)
        env.reset_seeded(np.arange(4), range(4))
        start = state_of(env, 1)["batch.qpos"]
        for _ in range(6):
            env.step(np.full((4, 7), 0.4), moving)
        ways.append([state_of(env, world)["batch.qpos"] for world in (0, 2)])

    np.testing.assert_array_equal(*ways)
    np.testing.assert_array_equal(state_of(env, 1)["batch.qpos"], start)


def test_a_reset_without_a_seed_draws_from_the_shared_stream_as_before(folder):
    plain, seeded = batch_of(folder, 2), batch_of(folder, 2)
    seeded.reset_seeded(np.array([0]), [5])

    for env in (plain, seeded):
        env.seed(3)
        env.reset(np.arange(2))
        for _ in range(3):
            env.step(np.zeros((2, 7)))

    for world in range(2):
        mine = state_of(plain, world)
        for name, value in state_of(seeded, world).items():
            np.testing.assert_array_equal(value, mine[name], err_msg=name)

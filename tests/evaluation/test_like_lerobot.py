"""The batch judge and LeRobot's own evaluation see the same episodes and say the same of them."""

from pathlib import Path

import numpy as np
import pytest

from v2p_data.evaluation.batch import judge
from v2p_data.evaluation.config import EvaluationConfig
from v2p_data.play import VisionActor
from v2p_data.sim.render.masks import PALETTE
from v2p_data.task.task import TaskBundle

EPISODES = 6
FIRST_SEED = 40
LEFT = """
from factory.tasks.task import Task

class Left(Task):
    def __init__(self, envs, urdf_assets_root):
        super().__init__(envs, urdf_assets_root, {})

    def compute_success(self, states):
        return states["eef_pos"][:, 1] > 0.06

    def compute_reward(self, actions, states):
        left = states["eef_pos"][:, 1]
        return left, {"left": left}
"""

pytestmark = pytest.mark.slow


@pytest.fixture
def left_folder(benchmark_folder: Path, agreeing_referee: None) -> Path:
    """Return a task that about half of the worlds do: the tool is at the left, and the object rests."""
    from dataclasses import replace

    bundle = TaskBundle.load(benchmark_folder)
    still = replace(
        bundle.scene.manipulated,
        poses_world=bundle.scene.manipulated.poses_world[:1] * 2,
        frames=(0, 1),
        confidences=(1.0, 1.0),
    )
    scene = replace(
        bundle.scene, kind="generic", objects=(still,), folder=benchmark_folder.parent / "resting"
    )
    scene.folder.mkdir()
    scene.save(scene.folder)
    folder = benchmark_folder.parent / "left"
    replace(bundle, title="left", kind="generic", class_name="Left", code=LEFT, scene=scene).save(
        folder
    )
    return folder


def recorded(policy, monkeypatch) -> list[np.ndarray]:
    """Return a list to which every action of the policy will be added."""
    actions, select = [], policy.select_action

    def note(observation):
        action = select(observation)
        actions.append(action.numpy().copy())
        return action

    monkeypatch.setattr(policy, "select_action", note)
    return actions


@pytest.mark.parametrize(
    ("task", "at_end", "policy"),
    [
        ("left_folder", True, "policy_folder"),
        ("left_folder", False, "policy_folder"),
        ("benchmark_folder", True, "wrist_policy_folder"),
        ("benchmark_folder", False, "wrist_policy_folder"),
        ("left_folder", True, "rgb_policy_folder"),
    ],
)
def test_the_same_seeds_give_the_same_actions_and_the_same_successes(
    task, at_end, policy, request, monkeypatch
):
    from policies.evaluation import rollout
    from policies.evaluation.actor import load_actor

    folder, policy_folder = request.getfixturevalue(task), request.getfixturevalue(policy)
    wrist = policy == "wrist_policy_folder"
    bundle = TaskBundle.load(folder)
    actor = load_actor(policy_folder, greys=PALETTE, task=bundle.description)
    ours = recorded(actor.loaded.policy, monkeypatch)

    judged = judge(
        bundle,
        VisionActor(actor, wrist=wrist, rgb=policy == "rgb_policy_folder"),
        first_seed=FIRST_SEED,
        cfg=EvaluationConfig(episodes=EPISODES, worlds=EPISODES, at_end=at_end),
        size_px=actor.size_px,
    )

    config = rollout.env_config(folder, size_px=64)
    loaded = rollout.load_policy(policy_folder, config)
    theirs = recorded(loaded.policy, monkeypatch)
    envs = config.create_envs(n_envs=EPISODES)
    flags = rollout.roll_out(loaded, envs, config, episodes=EPISODES, first_seed=FIRST_SEED)[0]
    assert judged.successes.tolist() == flags
    if task == "left_folder":
        assert 0 < sum(flags) < EPISODES
    for world, step in enumerate(judged.success_step):
        end = judged.horizon_steps if step < 0 else step + 1
        mine, other = ([a[world] for a in actions[:end]] for actions in (ours, theirs))
        np.testing.assert_array_equal(mine, other, err_msg=f"world {world}")

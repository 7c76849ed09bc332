"""The judge on tasks whose success can be told in advance; no policy is loaded."""

from dataclasses import replace
from pathlib import Path
from typing import Literal

import numpy as np
import pytest

from v2p_data.errors import V2PError
from v2p_data.evaluation.batch import NEVER, Judged, judge
from v2p_data.evaluation.config import EvaluationConfig
from v2p_data.evaluation.judging import own_reset_rate
from v2p_data.experts.actors import ProgramActor
from v2p_data.pipeline.runner import Runtime
from v2p_data.play import StateActor, View, VisionActor
from v2p_data.sim.env.batch_env import BatchEnv
from v2p_data.sim.env.task_code import HELD_STEPS
from v2p_data.task.audit.resets import has_own_reset
from v2p_data.task.benchmark import load_benchmark
from v2p_data.task.task import TaskBundle

SIZE_PX = 32


HIGH_TOOL = """
from factory.tasks.task import Task

class HighTool(Task):
    def __init__(self, envs, urdf_assets_root):
        super().__init__(envs, urdf_assets_root, {})

    def compute_success(self, states):
        return states["eef_pos"][:, 2] > 0.27

    def compute_reward(self, actions, states):
        height = states["eef_pos"][:, 2]
        return height, {"height": height}
"""
"""Success while the tool is above a height."""


class Drive:
    """Goes up for some steps and then down; remembers what it saw."""

    def __init__(self, up: int = 10**6) -> None:
        self.up = up
        self.labels: list[np.ndarray] = []
        self.states: list[np.ndarray] = []

    def reset(self, n: int) -> None:
        self.labels, self.states = [], []

    def act(self, labels, state):
        action = np.zeros((len(state), 7), np.float32)
        action[:, 2] = 0.5 if len(self.labels) < self.up else -1.0
        self.labels.append(labels.copy())
        self.states.append(state.copy())
        return action


@pytest.fixture
def bundle(agreeing_referee: None) -> TaskBundle:
    found = load_benchmark("lift_up")
    thing = found.scene.manipulated
    still = replace(
        thing, poses_world=thing.poses_world[:1] * 2, frames=(0, 1), confidences=(1.0, 1.0)
    )
    scene = replace(found.scene, kind="generic", objects=(still,))
    task = replace(found, code=HIGH_TOOL, class_name="HighTool")
    return replace(task, kind="generic", scene=scene, horizon_steps=12)


def judged(bundle, actor, **settings) -> Judged:
    cfg = replace(EvaluationConfig(episodes=5, worlds=8), **settings)
    return judge(bundle, actor, first_seed=3, cfg=cfg, size_px=SIZE_PX)


RESET = """
    def reset_objects_states(self, env_ids):
        poses = self.envs.sample_object_poses(env_ids)
        poses["tea_box"][:, :2] = poses["tea_box"][:, :2] * 0.01 + torch.tensor([0.6, 0.2])
        return poses
"""


def test_an_evaluation_may_begin_where_the_environment_says_and_shows_both_rates(tmp_path: Path):
    base = """
    def reset_objects_states(self, env_ids):
        return super().reset_objects_states(env_ids)
"""
    found = load_benchmark("lift_up")
    own = replace(found, code=found.code.replace(base, RESET), horizon_steps=6)
    cfg = EvaluationConfig(worlds=4, episodes=4, reset="base")

    def first_places(bundle: TaskBundle, reset: Literal["task", "base"]) -> np.ndarray:
        how = replace(cfg, reset=reset)
        played = judge(bundle, VisionActor(Drive()), first_seed=3, cfg=how, size_px=SIZE_PX)
        return played.shown.snapshots[0].qpos[:, -7:-4]

    assert np.array_equal(first_places(own, "base"), first_places(found, "task"))
    assert np.abs(first_places(own, "task")[:, 1] - 0.2).max() < 0.01
    assert (has_own_reset(own.code), has_own_reset(found.code)) == (True, False)
    both = [
        own_reset_rate(
            lambda _: (VisionActor(Drive()), SIZE_PX), b, cfg, 3, Runtime(root=tmp_path)
        )
        for b in (own, found)
    ]
    assert both[0] is not None
    assert both[0]["trials"] == 4
    assert both[1] is None


def test_success_is_lost_again_at_the_end_and_counts_once(bundle):
    result = judged(bundle, VisionActor(Drive(up=14)))
    stays = judged(bundle, VisionActor(Drive()))

    assert result.horizon_steps == 24
    assert result.successes.all()
    assert result.at_end is not None
    assert not result.at_end.any()
    assert stays.at_end is not None
    assert stays.at_end.all()
    assert (result.success_step >= HELD_STEPS - 1).all()
    assert result.median_success_s == np.median(result.success_step + 1) / 20
    assert result.failures == ("",) * 5


def test_worlds_at_a_time_change_no_episode(bundle):
    together, in_turn = (
        judged(bundle, VisionActor(Drive())),
        judged(bundle, VisionActor(Drive()), worlds=2),
    )

    np.testing.assert_array_equal(together.success_step, in_turn.success_step)
    assert len(in_turn.shown.successes) == 2


def test_without_at_end_an_episode_is_over_with_its_success_and_its_picture_stays(bundle):
    drive = Drive()
    result = judged(bundle, VisionActor(drive), at_end=False)

    first, last = sorted(set(result.success_step))[:1][0], result.success_step.max()
    assert result.at_end is None
    assert len(drive.states) == last + 1  # nobody acts once all are over
    early = int(np.argmin(result.success_step))
    assert first < last
    np.testing.assert_array_equal(drive.states[-1][early], drive.states[first][early])
    np.testing.assert_array_equal(drive.labels[-1][early], drive.labels[first][early])
    late = int(np.argmax(result.success_step))
    assert (drive.states[-1][late] != drive.states[first][late]).any()


def test_without_success_episodes_last_to_the_horizon_and_say_what_went_wrong(bundle):
    result = judged(bundle, VisionActor(Drive(up=0)), horizon_scale=1.0)

    assert result.horizon_steps == 12
    assert (result.success_step == NEVER).all()
    assert result.failure_counts() == {"never_reached": 5}
    assert result.as_dict()["median_success_s"] is None
    assert (result.shown.num_frames == 13).all()


def test_a_simulation_that_breaks_ends_its_episode_as_a_failure(bundle):
    class Breaks:
        def reset(self, worlds: BatchEnv) -> None:
            self.steps = 0

        def act(self, view: View) -> np.ndarray:
            self.steps += 1
            if self.steps == 2:
                view.worlds._sim.qvel[1] = np.nan
            action = np.zeros((view.worlds.num_envs, 7))
            action[:, 2] = 0.5
            return action

    result = judged(bundle, Breaks())

    assert result.broke.tolist() == [False, True, False, False, False]
    assert result.failures == ("", "simulation_broke", "", "", "")


def test_another_tasks_expert_is_turned_away(bundle):
    with pytest.raises(V2PError, match="length 93, and task 'lift_up' makes ones of length 90"):
        judged(bundle, StateActor(lambda obs: obs[:, :7], obs_dim=93))


def test_actions_that_are_no_numbers_are_turned_away(bundle):
    class Odd(Drive):
        def act(self, labels, state):
            return np.full((len(state), 7), np.nan, np.float32)

    with pytest.raises(V2PError, match="in world 0 of task 'lift_up' is not finite"):
        judged(bundle, VisionActor(Odd()))


@pytest.mark.slow
def test_scripted_programs_push_to_the_left():
    actor = ProgramActor(seed=0)
    cfg = EvaluationConfig(episodes=8)

    result = judge(load_benchmark("push_left"), actor, first_seed=0, cfg=cfg)

    assert actor.name == "push as in the video"
    assert result.successes.mean() >= 0.9

"""The Gymnasium environment of one task, and the same as a LeRobot environment."""

import multiprocessing
import subprocess
import sys
import tempfile
import warnings
from pathlib import Path

import gymnasium as gym
import numpy as np
import pytest
from gymnasium.utils.env_checker import check_env

from v2p_data.errors import V2PError
from v2p_data.sim.render.masks import rgb_to_labels
from v2p_data.sim.wrappers.gym_env import V2PEnv

LIFT = """
from factory.tasks.task import Task

class LiftCube(Task):
    def __init__(self, envs, urdf_assets_root):
        super().__init__(envs, urdf_assets_root, {})
        self.task_description = "lifting a cube"

    def compute_success(self, states):
        return (states["cube_pos"][:, 2] > HEIGHT) & (states["progress"] > AFTER)

    def compute_reward(self, actions, states):
        height = states["cube_pos"][:, 2]
        return height, {"height": height}
"""


@pytest.fixture
def write_task(make_bundle, tmp_path):
    """Write a task folder whose success is the cube's centre being above some height."""
    from dataclasses import replace

    def write(
        folder: Path,
        height: float = 0.12,
        horizon: int = 6,
        kind: str = "lift_up",
        after: float = -1.0,
    ) -> Path:
        scene_folder = tmp_path / "scene"
        scene_folder.mkdir(exist_ok=True)
        bundle = make_bundle(folder=scene_folder, horizon=horizon, kind=kind)
        bundle.scene.save(scene_folder)
        folder.mkdir(parents=True)
        code = LIFT.replace("HEIGHT", str(height)).replace("AFTER", str(after))
        replace(bundle, code=code, title=folder.name).save(folder)
        return folder

    return write


@pytest.fixture
def env(write_task, tmp_path):
    env = V2PEnv(str(write_task(tmp_path / "lift")))
    yield env
    env.close()


def test_gymnasium_accepts_the_environment(env):
    with warnings.catch_warnings():
        # It was not made by gym.make; that has a test of its own.
        warnings.filterwarnings("ignore", message=".*not initialized through.*|.*spec is None.*")
        warnings.filterwarnings("ignore", message=".*render mode.*|.*alternative render.*")
        check_env(env)


@pytest.mark.parametrize(
    ("name", "settings", "shown"),
    [
        ("Task", {"wrist": True, "rgb": True}, {"pixels", "agent_pos"}),
        ("Task", {"observation": "flat", "rgb": True}, {"mask", "rgb", "agent_pos"}),
        ("States", {}, None),
    ],
)
def test_a_clean_gymnasium_makes_it_and_knows_its_longest_episode(
    write_task, tmp_path, name, settings, shown
):
    """In a process that imported nothing of ours, as a user's first line does."""
    code = f"""
import gymnasium as gym, numpy as np
made = gym.make("v2p_data.sim.wrappers:v2p/{name}-v0", task_folder=r"{write_task(tmp_path / "lift")}",
                size_px=16, **{settings})
seen, info = made.reset(seed=3)
assert seen in made.observation_space and info["is_success"] is False
shown = {shown}
if shown is None:
    assert seen.ndim == 1
else:
    assert set(seen) == shown
    assert isinstance(made.observation_space["agent_pos"], gym.spaces.Box)
assert made.spec.max_episode_steps == 12, made.spec
ends = [made.step(made.action_space.sample())[3] for _ in range(12)]
assert ends == [False] * 11 + [True]
assert gym.make(made.spec).spec.max_episode_steps == 12
assert gym.make(made.spec.id, task_folder=made.spec.kwargs["task_folder"], max_episode_steps=5).spec.max_episode_steps == 5
"""
    subprocess.run([sys.executable, "-W", "ignore", "-c", code], check=True)


def test_a_flat_observation_is_what_stable_baselines3_takes(write_task, tmp_path):
    """Its rules: no space within a space's space, pictures uint8 from 0 to 255 with channels last, bounded actions."""
    env = V2PEnv(
        str(write_task(tmp_path / "lift")), observation="flat", wrist=True, rgb=True, size_px=36
    )

    seen, _ = env.reset(seed=0)

    assert {k: s.shape for k, s in env.observation_space.spaces.items()} == {
        **dict.fromkeys(("mask", "mask_wrist", "rgb"), (36, 36, 3)),
        "agent_pos": (11,),
    }
    assert all(isinstance(s, gym.spaces.Box) for s in env.observation_space.spaces.values())
    assert seen in env.observation_space
    with pytest.raises(V2PError, match="one of pictures, flat, states, got 'nested'"):
        V2PEnv(str(tmp_path / "lift"), observation="nested")


def test_the_colour_picture_is_what_the_renderer_draws_and_shows_the_red_cube(
    write_task, tmp_path
):
    env = V2PEnv(str(write_task(tmp_path / "lift")), rgb=True)

    pixels = env.reset(seed=0)[0]["pixels"]

    assert (pixels["rgb"] == env.render()).all()
    is_cube = rgb_to_labels(pixels["mask"]) == 2
    colours = pixels["rgb"].astype(int)
    assert np.ptp(colours[is_cube].mean(0)) > np.ptp(colours[~is_cube].mean(0)) + 20
    env.close()


def test_the_same_seed_gives_the_same_episode_and_another_seed_another(env):
    action = np.full(7, 0.5, np.float32)

    def episode(seed):
        first, _ = env.reset(seed=seed)
        return [first, env.step(action)[0]]

    once, again, other = episode(1), episode(1), episode(2)

    for a, b in zip(once, again, strict=True):
        np.testing.assert_array_equal(a["pixels"]["mask"], b["pixels"]["mask"])
        np.testing.assert_array_equal(a["agent_pos"], b["agent_pos"])
    assert not np.array_equal(once[0]["agent_pos"], other[0]["agent_pos"])


def test_options_of_a_reset_and_a_window_are_refused(env, tmp_path):
    with pytest.raises(V2PError, match="no options, got height_m"):
        env.reset(options={"height_m": 0.1})
    with pytest.raises(V2PError, match="render_mode is 'rgb_array' or None, got 'human'"):
        V2PEnv(str(tmp_path), render_mode="human")


def test_the_policy_sees_robot_and_cube_as_greys(env):
    observation, _ = env.reset(seed=0)

    mask = observation["pixels"]["mask"]
    assert mask.shape == (256, 256, 3)
    assert set(np.unique(rgb_to_labels(mask))) == {0, 1, 2}
    assert (mask[..., 0] == mask[..., 1]).all()
    assert (mask[..., 0] == mask[..., 2]).all()


def test_the_policy_sees_through_a_camera_that_is_moved_at_each_reset(write_task, tmp_path, env):
    moved = V2PEnv(str(write_task(tmp_path / "moved")), camera_angle_rad=0.05)

    seen = [moved.reset(seed=seed)[0] for seed in (3, 3, 4)]
    fixed, _ = env.reset(seed=3)

    masks = [s["pixels"]["mask"] for s in seen]
    assert (masks[0] == masks[1]).all()
    assert (masks[0] != masks[2]).any()
    assert (masks[0] != fixed["pixels"]["mask"]).any()
    np.testing.assert_array_equal(seen[0]["agent_pos"], fixed["agent_pos"])
    moved.close()


def test_moving_up_raises_the_tool_in_the_state(env):
    before, _ = env.reset(seed=0)
    for _ in range(3):
        after, *_ = env.step(np.array([0, 0, 1, 0, 0, 0, -1], np.float32))

    # three commands of 3 cm; the servo lags behind by at most 6 cm
    assert 0.02 < after["agent_pos"][2] - before["agent_pos"][2] < 0.095


@pytest.mark.parametrize(("scale", "steps"), [(2.0, 12), (1.0, 6)])
def test_an_episode_without_success_ends_at_a_multiple_of_the_horizon(
    write_task, tmp_path, scale, steps
):
    env = V2PEnv(str(write_task(tmp_path / "lift")), size_px=16, horizon_scale=scale)
    env.reset(seed=0)
    ends = [env.step(np.zeros(7, np.float32))[2:4] for _ in range(steps)]

    assert ends == [(False, False)] * (steps - 1) + [(False, True)]
    env.close()


def test_success_counts_when_held_and_ends_the_episode(write_task, tmp_path, agreeing_referee):
    """From the second of 20 steps on the cube is above -1 m."""
    folder = write_task(tmp_path / "easy", height=-1.0, horizon=20, kind="generic", after=0.06)
    env = V2PEnv(str(folder))
    env.reset(seed=0)

    steps = [env.step(np.zeros(7, np.float32)) for _ in range(6)]

    assert [info["is_success"] for *_, info in steps] == [False] * 5 + [True]
    assert [terminated for _, _, terminated, *_ in steps] == [False] * 5 + [True]
    env.close()


def test_what_the_referee_denies_is_no_success(write_task, tmp_path):
    """The task's code calls a cube on the table lifted."""
    env = V2PEnv(str(write_task(tmp_path / "wrong", height=-1.0, horizon=8, kind="lift_up")))
    env.reset(seed=0)

    steps = [env.step(np.zeros(7, np.float32)) for _ in range(8)]

    assert not any(info["is_success"] for *_, info in steps)
    assert [terminated for _, _, terminated, *_ in steps] == [False] * 8
    env.close()


def test_a_picture_for_people_has_the_size_of_the_mask(env):
    env.reset(seed=0)

    picture = env.render()

    assert picture.shape == (256, 256, 3)
    assert picture.dtype == np.uint8


def test_a_folder_without_a_task_is_refused(tmp_path):
    with pytest.raises(V2PError, match=r"holds no task\.json"):
        V2PEnv(str(tmp_path))


@pytest.mark.slow
def test_lerobot_gets_one_environment_per_task_and_finished_ones_stand_still(
    write_task, tmp_path, agreeing_referee
):
    from lerobot.envs.factory import make_env_config

    import lerobot_policy_v2p  # noqa: F401 - registers the environment

    run = tmp_path / "run" / "task"
    for name in ("b-push", "a-lift"):
        write_task(run / name, height=-1.0, kind="generic", after=0.2)
    write_task(run / "c-torn.partial")
    config = make_env_config("v2p", tasks=str(run))

    envs = config.create_envs(n_envs=2)

    assert {i: e.call("task")[0] for i, e in envs["v2p"].items()} == {0: "a-lift", 1: "b-push"}
    env = envs["v2p"][0]
    assert env.call("task_description") == ("lifting a cube",) * 2
    assert env.call("_max_episode_steps") == (12, 12)
    env.reset(seed=[1, 2])
    infos = [env.step(np.zeros((2, 7), np.float32))[4] for _ in range(8)]
    assert "final_info" not in infos[4]
    assert infos[5]["final_info"]["is_success"].tolist() == [True, True]
    assert infos[7]["final_info"]["is_success"].tolist() == [True, True]
    for env in envs["v2p"].values():
        env.close()


@pytest.mark.long
def test_environments_run_in_processes_of_their_own_however_long_the_temporary_folder_is(
    write_task, tmp_path, monkeypatch
):
    from v2p_data.sim.wrappers.lerobot_env import V2PEnvConfig

    far = tmp_path / ("x" * 120)
    far.mkdir()
    monkeypatch.setattr(tempfile, "tempdir", str(far))
    monkeypatch.setitem(multiprocessing.process.current_process()._config, "tempdir", str(far))
    write_task(tmp_path / "tasks" / "lift")

    envs = V2PEnvConfig(tasks=str(tmp_path / "tasks")).create_envs(2, use_async_envs=True)

    assert envs["v2p"][0].reset(seed=[0, 1])[0]["pixels"]["mask"].shape[0] == 2
    envs["v2p"][0].close()


@pytest.mark.slow
def test_a_folder_without_tasks_is_refused_with_the_way_out(tmp_path):
    from v2p_data.sim.wrappers.lerobot_env import V2PEnvConfig

    with pytest.raises(V2PError, match="v2p task"):
        V2PEnvConfig(tasks=str(tmp_path)).create_envs(1)
    with pytest.raises(V2PError, match=r"--env\.tasks"):
        V2PEnvConfig().create_envs(1)

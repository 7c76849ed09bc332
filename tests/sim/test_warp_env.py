"""The GPU backend against the CPU's, on Warp's CPU device, or with `--device=cuda` on a GPU; the kernels are the same.

The first run compiles kernels for about a minute; Warp keeps them in its cache folder (`WARP_CACHE_PATH`).
"""

import importlib.util
import sys
from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest
import torch
import trimesh
from scipy.spatial.transform import Rotation

from v2p_data.errors import V2PError
from v2p_data.scene.scene import SceneObject
from v2p_data.sim.env import ranges
from v2p_data.sim.env.batch_env import BatchEnv, SimConfig
from v2p_data.sim.env.ranges import RandomizationConfig
from v2p_data.task.benchmark import benchmark_names, load_benchmark
from v2p_data.task.task import Task, TaskBundle

needs_warp = pytest.mark.skipif(
    importlib.util.find_spec("mujoco_warp") is None,
    reason="MuJoCo Warp is not installed: the extra 'gpu'",
)
ON_CUDA = SimConfig(backend="warp")
NOISELESS = replace(RandomizationConfig(), action_noise=0.0)
DOWN = Rotation.from_quat((0, 1, 0, 0), scalar_first=True)

Pair = tuple[BatchEnv, BatchEnv]
"""The same worlds on Warp and on the CPU."""


@pytest.fixture
def make_pair(
    make_bundle: Callable[..., TaskBundle], lift_task: type[Task], device: str
) -> Callable[..., Pair]:
    def make(
        *objects: SceneObject,
        fine: bool = False,
        randomization: ranges.RandomizationConfig = NOISELESS,
        num_envs: int = 8,
        task: type[Task] = lift_task,
        **options,
    ) -> Pair:
        bundle = make_bundle(*objects, **options)
        cfg = SimConfig(fine=fine, randomization=randomization)
        cpu = BatchEnv(bundle, cfg, num_envs=num_envs, seed=0, num_threads=1, task=task)
        warp = replace(cfg, backend="warp", device=device)
        gpu = BatchEnv(bundle, warp, num_envs=num_envs, seed=0, task=task)
        return gpu, cpu

    return make


def play(pair: Pair, action: np.ndarray) -> tuple[float, float]:
    """Carry out an action in both and return the tools' largest distance [mm] and angle [degrees]."""
    for env in pair:
        env.step(action)
    ours, theirs = (env._sim.tool for env in pair)
    mm = float(np.linalg.norm(ours.pos - theirs.pos, axis=1).max()) * 1000
    turns = [Rotation.from_quat(tool.quat_wxyz, scalar_first=True) for tool in (ours, theirs)]
    return mm, float(np.degrees((turns[0] * turns[1].inv()).magnitude().max()))


def continue_from(pair: Pair) -> None:
    """Put the GPU's worlds into the state of the CPU's: impacts amplify every difference."""
    ours, theirs = (env._sim for env in pair)
    for name in ("qpos", "qvel", "target_pos", "target_quat", "target_finger"):
        getattr(ours, name)[:] = getattr(theirs, name)
    ours.state()["warp.qacc_warmstart"][:] = theirs.state()["batch.qacc_warmstart"]
    ours.resume()


def away_mm(gpu: BatchEnv, cpu: BatchEnv) -> np.ndarray:
    """Return how far the first object is from where it is on the CPU, in each world."""
    apart = gpu._sim.object_qpos[:, 0, :3] - cpu._sim.object_qpos[:, 0, :3]
    return 1000 * np.linalg.norm(apart, axis=1)


def smooth_actions(steps: int, num_envs: int, *, turning: float, seed: int = 0) -> np.ndarray:
    """Return actions that change every 8 steps; `turning` bounds the rotations."""
    rng = np.random.default_rng(seed)
    actions = rng.uniform(-1, 1, (-(-steps // 8), num_envs, 7))
    actions[..., 3:6] *= turning
    return actions.repeat(8, axis=0)[:steps]


def test_without_mujoco_warp_one_sentence_names_the_extra(
    make_bundle: Callable[..., TaskBundle], monkeypatch: pytest.MonkeyPatch
):
    monkeypatch.setitem(sys.modules, "mujoco_warp", None)
    monkeypatch.delitem(sys.modules, "v2p_data.sim.env.warp_physics", raising=False)

    with pytest.raises(V2PError, match="run 'make setup'"):
        BatchEnv(make_bundle(), ON_CUDA, num_envs=2, seed=0)


@needs_warp
@pytest.mark.skipif(torch.cuda.is_available(), reason="there is a CUDA device")
def test_without_a_cuda_device_one_sentence_says_what_to_do(
    make_bundle: Callable[..., TaskBundle],
):
    with pytest.raises(V2PError, match="no CUDA device; use the backend 'cpu'"):
        BatchEnv(make_bundle(), ON_CUDA, num_envs=2, seed=0)


@needs_warp
def test_a_task_made_for_another_arm_is_refused(make_bundle: Callable[..., TaskBundle]):
    bundle = replace(make_bundle(), robot={"path": "other_arm.xml"})

    with pytest.raises(V2PError, match="built-in arm only"):
        BatchEnv(bundle, ON_CUDA, num_envs=2, seed=0)


@needs_warp
@pytest.mark.parametrize("fine", [False, True])
def test_the_tool_follows_as_on_the_cpu_within_a_hundredth_of_a_millimetre(
    make_pair: Callable[..., Pair], fine: bool
):
    pair = make_pair(fine=fine)
    start = pair[0]._sim.tool.pos.copy()

    apart = [play(pair, 0.4 * action) for action in smooth_actions(24, 8, turning=0.2)]

    mm, degrees = np.max(apart, axis=0)
    assert mm < 0.01
    assert degrees < 0.01
    assert np.linalg.norm(pair[0]._sim.tool.pos - start, axis=1).min() > 0.03


@needs_warp
@pytest.mark.parametrize(("fine", "most_mm", "most_degrees"), [(False, 15, 12), (True, 5, 6)])
def test_with_the_rotation_servo_at_its_limit_it_stays_within_millimetres(
    make_pair: Callable[..., Pair], fine: bool, most_mm: float, most_degrees: float
):
    """There the CPU's own integrator treats the servo one way or the other by a rounding error."""
    pair = make_pair(fine=fine)

    apart = [play(pair, action) for action in smooth_actions(20, 8, turning=1.0)]

    mm, degrees = np.max(apart, axis=0)
    assert mm < most_mm
    assert degrees < most_degrees


@needs_warp
def test_a_dropped_object_comes_to_rest_where_it_does_on_the_cpu(
    make_pair: Callable[..., Pair], make_object: Callable[..., SceneObject]
):
    gpu, cpu = make_pair(make_object("cube", size_m=(0.03, 0.05, 0.04)))
    adr = cpu.world.objects[0].qpos_adr
    fallen = np.random.default_rng(0).normal(0, 0.05, (8, 4)) + np.array([1, 0, 0, 0])
    fallen /= np.linalg.norm(fallen, axis=1, keepdims=True)
    for env in (gpu, cpu):
        env._sim.qpos[:, adr + 2] = 0.06
        env._sim.qpos[:, adr + 3 : adr + 7] = fallen

    for _ in range(12):
        play((gpu, cpu), np.zeros((8, 7)))

    assert away_mm(gpu, cpu).max() < 0.05
    np.testing.assert_allclose(gpu.states()["cube_up"], 1.0, atol=1e-3)


@needs_warp
def test_a_pushed_object_moves_as_on_the_cpu_from_step_to_step(
    make_pair: Callable[..., Pair],
):
    none = replace(ranges.none(), mass_scale=(0.6, 1.6), friction_scale=(0.8, 1.2))
    pair = make_pair(randomization=none)
    start = pair[1]._sim.object_qpos[:, 0, :3].copy()

    def towards(goal: np.ndarray) -> np.ndarray:
        action = np.zeros((8, 7))
        action[:, :3] = np.clip((goal - pair[1]._sim.tool.pos) / 0.03, -1, 1)
        action[:, 6] = 1.0
        return action

    for height in [0.12] * 8 + [0.02] * 8:
        play(pair, towards(start + np.array([0.0, 0.07, height - 0.02])))
    apart = []
    for _ in range(16):
        action = np.zeros((8, 7))
        action[:, 1], action[:, 6] = -0.2, 1.0
        continue_from(pair)
        play(pair, action)
        apart.append(away_mm(*pair))

    pushed = pair[1]._sim.object_qpos[:, 0, :3] - start
    assert (pushed[:, 1] < -0.03).all()
    assert np.median(apart) < 0.01
    assert np.max(apart) < 3.0  # an impact that comes a time step sooner or later


@needs_warp
def test_a_scripted_grasp_lifts_as_often_as_on_the_cpu(make_pair: Callable[..., Pair]):
    gpu, cpu = make_pair(num_envs=16)
    lifted = []
    for env in (gpu, cpu):
        for t in range(60):
            states = env.states()
            error = states["cube_pos"] - states["eef_pos"]
            action = torch.zeros(16, 7)
            action[:, :2] = error[:, :2] / 0.03
            quarter_turns = states["base_observation"][:, 80]
            action[:, 5] = quarter_turns * (np.pi / 2) / 0.4
            if t >= 10:
                action[:, 2] = error[:, 2] / 0.03
            if t >= 25:
                action[:, 6] = 1.0
            if t >= 35:
                action[:, 2] = 0.5
            result = env.step(action.numpy())
        states = env.states()
        lifted.append(states["cube_pos"][:, 2] > 0.12)
        # Touches are one time step old: a pad may let go for a moment.
        assert states["cube_grasped"][lifted[-1]].mean() > 0.8
        assert result.held[lifted[-1].numpy()].all()

    ours, theirs = lifted
    assert ours.float().mean() > 0.8
    assert (
        abs(ours.float().mean() - theirs.float().mean()) < 0.2
    )  # grasps at corners slip or do not


@needs_warp
def test_resetting_some_worlds_leaves_the_others_alone(make_pair: Callable[..., Pair]):
    gpu, cpu = make_pair()
    for action in smooth_actions(5, 8, turning=0.2):
        play((gpu, cpu), 0.4 * action)

    for env in (gpu, cpu):
        env.reset(np.array([1, 6]))
    apart = [play((gpu, cpu), 0.4 * action) for action in smooth_actions(5, 8, turning=0.2)]

    assert np.max(apart, axis=0)[0] < 0.01
    assert gpu.states()["progress"].tolist() == cpu.states()["progress"].tolist()


@needs_warp
def test_a_reset_starts_at_rest_whatever_the_delay(make_pair: Callable[..., Pair]):
    gpu, _ = make_pair(randomization=replace(ranges.none(), delay_s=(0.02, 0.02)))
    start = gpu._sim.tool.pos.copy()

    gpu.step(np.zeros((8, 7)))

    assert np.abs(gpu._sim.tool.pos - start).max() < 1e-4


@needs_warp
def test_a_broken_world_ends_without_reward_and_the_others_go_on(
    make_pair: Callable[..., Pair],
):
    gpu, cpu = make_pair()
    gpu._sim.qvel[2, 3] = 1e13

    broken = gpu.step(np.zeros((8, 7)))
    cpu.step(np.zeros((8, 7)))
    gpu.reset(np.flatnonzero(broken.terminated))
    after = gpu.step(np.zeros((8, 7)))
    cpu.step(np.zeros((8, 7)))

    assert broken.terminated.tolist() == [i == 2 for i in range(8)]
    assert broken.reward[2] == 0
    assert np.isfinite(broken.obs).all()
    assert gpu.broken_count == 1
    assert not after.terminated.any()
    others = [0, 1, 3, 4, 5, 6, 7]
    np.testing.assert_allclose(gpu._sim.tool.pos[others], cpu._sim.tool.pos[others], atol=5e-5)


@needs_warp
def test_meshes_of_several_sizes_stand_at_their_own_heights(
    make_pair: Callable[..., Pair], make_object: Callable[..., SceneObject], tmp_path
):
    trimesh.creation.icosphere(subdivisions=1, radius=0.03).export(tmp_path / "ball.obj")
    gpu, cpu = make_pair(
        make_object("cube", "mesh", (0.06, 0.06, 0.06), mesh="ball.obj", quat=(1, 0, 0, 0)),
        folder=tmp_path,
        fine=True,
    )

    for _ in range(6):
        play((gpu, cpu), np.zeros((8, 7)))

    heights = gpu._sim.object_qpos[:, 0, 2]
    np.testing.assert_allclose(heights, cpu._sim.object_qpos[:, 0, 2], atol=1e-3)
    assert np.ptp(heights) > 0.002


@needs_warp
def test_random_actions_and_resets_stay_finite(
    make_pair: Callable[..., Pair], make_object: Callable[..., SceneObject]
):
    gpu, _ = make_pair(
        make_object("cube"),
        make_object("box", "box", (0.14, 0.12, 0.06), hollow=True, pos=(0, 0.2, 0.03)),
        randomization=RandomizationConfig(),
        horizon=15,
    )
    gpu.stagger()

    for action in smooth_actions(30, 8, turning=1.0):
        result = gpu.step(action)
        assert np.abs(result.obs).max() <= 5
        gpu.reset(np.flatnonzero(result.truncated | result.terminated))

    assert gpu.broken_count == 0


@needs_warp
@pytest.mark.slow
@pytest.mark.parametrize("name", benchmark_names())
def test_a_benchmark_task_has_the_same_observation_and_reward_on_both(name: str, device: str):
    cfg = SimConfig(randomization=NOISELESS)
    bundle = load_benchmark(name)
    gpu = BatchEnv(bundle, replace(cfg, backend="warp", device=device), num_envs=4, seed=0)
    cpu = BatchEnv(bundle, cfg, num_envs=4, seed=0, num_threads=1)

    for action in smooth_actions(5, 4, turning=0.2):
        ours, theirs = gpu.step(0.4 * action), cpu.step(0.4 * action)

    np.testing.assert_allclose(ours.obs, theirs.obs, atol=2e-3)
    np.testing.assert_allclose(ours.reward, theirs.reward, atol=1e-4)
    assert ours.success.tolist() == theirs.success.tolist()


@needs_warp
def test_torchrl_and_checkpoints_take_it_as_they_take_the_cpus(make_pair: Callable[..., Pair]):
    from tensordict import TensorDict
    from torchrl.envs.utils import check_env_specs

    from v2p_data.sim.wrappers.torchrl_env import TorchRLEnv

    gpu, _ = make_pair(horizon=6, randomization=RandomizationConfig())
    env = TorchRLEnv(gpu)
    check_env_specs(env)
    still = TensorDict({"action": torch.zeros(8, 7)}, [8], device=gpu.device)
    env.reset()
    env.step(still)
    saved = env.state_dict()
    expected = env.step(still)["next", "observation"].clone()
    env.reset()

    env.load_state_dict(saved)

    again = env.step(still)["next", "observation"]
    torch.testing.assert_close(again, expected, atol=1e-6, rtol=0)


@needs_warp
@pytest.mark.gpu
def test_cuda_does_as_warps_cpu_device(
    make_bundle: Callable[..., TaskBundle], lift_task: type[Task], gpu: str
):
    cfg = SimConfig(randomization=NOISELESS)
    bundle = make_bundle()
    ours, theirs = (
        BatchEnv(
            bundle, replace(cfg, backend="warp", device=device), num_envs=8, seed=0, task=lift_task
        )
        for device in (gpu, "cpu")
    )

    for action in smooth_actions(32, 8, turning=0.15):
        ours.step(action)
        theirs.step(action)

    assert ours.device.type == torch.device(gpu).type
    assert np.linalg.norm(ours._sim.tool.pos - theirs._sim.tool.pos, axis=1).max() < 5e-5

"""The GPU backend against the CPU's, on Warp's CPU device, or with `--device=cuda` on a GPU; the kernels are the same.

The first run compiles kernels for about a minute; Warp keeps them in its cache folder (`WARP_CACHE_PATH`).
"""

import sys
from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest
import torch
import trimesh
from scipy.spatial.transform import Rotation

from v2p_data.errors import ItemRejectedError, V2PError
from v2p_data.scene.scene import SceneObject
from v2p_data.sim.env import ranges
from v2p_data.sim.env.backends import make_batch_env
from v2p_data.sim.env.batch_env import BatchEnv, SimConfig
from v2p_data.task.benchmark import benchmark_names, load_benchmark
from v2p_data.task.task import Task, TaskBundle

try:
    from v2p_data.sim.env.warp_env import WarpBatchEnv
except V2PError:
    WarpBatchEnv = None

needs_warp = pytest.mark.skipif(
    WarpBatchEnv is None, reason="MuJoCo Warp is not installed: the extra 'gpu'"
)
NOISELESS = replace(ranges.training(), action_noise=0.0)
DOWN = Rotation.from_quat((0, 1, 0, 0), scalar_first=True)

Pair = tuple["WarpBatchEnv", BatchEnv]


@pytest.fixture
def make_pair(
    make_bundle: Callable[..., TaskBundle], lift_task: type[Task], device: str
) -> Callable[..., Pair]:
    """Return the same worlds on both backends."""

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
        gpu = WarpBatchEnv(bundle, cfg, num_envs=num_envs, seed=0, device=device, task=task)
        cpu = BatchEnv(bundle, cfg, num_envs=num_envs, seed=0, num_threads=1, task=task)
        return gpu, cpu

    return make


def seen(env: "WarpBatchEnv | BatchEnv") -> dict[str, torch.Tensor]:
    """Return the states of all worlds, on the CPU."""
    return {name: value.cpu() for name, value in env.states().items()}


def qpos_of(env: "WarpBatchEnv | BatchEnv") -> torch.Tensor:
    """Return the positions of all joints, to be written to."""
    return (
        torch.from_numpy(env._sim.qpos) if isinstance(env, BatchEnv) else env._sim.state()["qpos"]
    )


def play(pair: Pair, action: np.ndarray) -> tuple[float, float]:
    """Carry out an action in both and return the tools' largest distance [mm] and angle [degrees]."""
    gpu, cpu = pair
    gpu.step(torch.from_numpy(action))
    cpu.step(action)
    ours, theirs = seen(gpu), seen(cpu)
    mm = float((ours["eef_pos"] - theirs["eef_pos"]).norm(dim=1).max()) * 1000
    turns = [Rotation.from_quat(s["eef_quat"].numpy(), scalar_first=True) for s in (ours, theirs)]
    return mm, float(np.degrees((turns[0] * turns[1].inv()).magnitude().max()))


def continue_from(pair: Pair) -> None:
    """Put the GPU's worlds into the state of the CPU's: impacts amplify every difference."""
    sim, cpu = pair[0]._sim, pair[1]
    state = sim.state()
    for name in ("qpos", "qvel", "qacc_warmstart"):
        state[name].copy_(torch.from_numpy(np.array(cpu._sim.batch.bind(name))))
    for name in ("target_pos", "target_quat", "target_finger"):
        there = torch.from_numpy(np.array(getattr(cpu._sim, name)))
        getattr(pair[0], f"_{name}").copy_(there)
    sim.refresh()


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
    for name in ("v2p_data.sim.env.warp_env", "v2p_data.sim.env.warp_physics"):
        monkeypatch.delitem(sys.modules, name, raising=False)

    with pytest.raises(V2PError, match="install the extra 'gpu'"):
        make_batch_env(make_bundle(), num_envs=2, seed=0, backend="warp")


@needs_warp
@pytest.mark.skipif(torch.cuda.is_available(), reason="there is a CUDA device")
def test_without_a_cuda_device_one_sentence_says_what_to_do(
    make_bundle: Callable[..., TaskBundle],
):
    with pytest.raises(V2PError, match="no CUDA device; use the backend 'cpu'"):
        make_batch_env(make_bundle(), num_envs=2, seed=0, backend="warp")


@needs_warp
def test_a_task_made_for_another_arm_is_refused(make_bundle: Callable[..., TaskBundle]):
    bundle = replace(make_bundle(), robot={"path": "other_arm.xml"})

    with pytest.raises(V2PError, match="built-in arm only"):
        WarpBatchEnv(bundle, num_envs=2, seed=0, device="cpu")


@needs_warp
def test_a_seed_gives_the_same_first_worlds(
    make_pair: Callable[..., Pair], make_object: Callable[..., SceneObject]
):
    gpu, cpu = make_pair(
        make_object("cube"),
        make_object("bowl", "cylinder", (0.12, 0.12, 0.05), hollow=True, pos=(0, 0.2, 0.02)),
    )

    ours, theirs = seen(gpu), seen(cpu)

    assert set(ours) == set(theirs)
    for key, value in theirs.items():
        torch.testing.assert_close(ours[key], value, atol=2e-5, rtol=1e-5, msg=key)
    assert (gpu.obs_dim, gpu.horizon, gpu.component_names) == (
        cpu.obs_dim,
        cpu.horizon,
        cpu.component_names,
    )


@needs_warp
@pytest.mark.parametrize("fine", [False, True])
def test_the_tool_follows_as_on_the_cpu_within_a_hundredth_of_a_millimetre(
    make_pair: Callable[..., Pair], fine: bool
):
    pair = make_pair(fine=fine)
    start = seen(pair[0])["eef_pos"].clone()

    apart = [play(pair, 0.4 * action) for action in smooth_actions(24, 8, turning=0.2)]

    mm, degrees = np.max(apart, axis=0)
    assert mm < 0.01
    assert degrees < 0.01
    assert (seen(pair[0])["eef_pos"] - start).norm(dim=1).min() > 0.03


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
    for qpos in (qpos_of(gpu), qpos_of(cpu)):
        qpos[:, adr + 2] = 0.06
        qpos[:, adr + 3 : adr + 7] = torch.from_numpy(fallen)

    for _ in range(12):
        play((gpu, cpu), np.zeros((8, 7)))

    away = (seen(gpu)["cube_pos"] - seen(cpu)["cube_pos"]).norm(dim=1) * 1000
    assert away.max() < 0.05
    np.testing.assert_allclose(seen(gpu)["cube_up"], 1.0, atol=1e-3)


@needs_warp
def test_a_pushed_object_moves_as_on_the_cpu_from_step_to_step(
    make_pair: Callable[..., Pair],
):
    none = replace(ranges.none(), mass_scale=(0.6, 1.6), friction_scale=(0.8, 1.2))
    pair = make_pair(randomization=none)
    start = seen(pair[1])["cube_pos"].clone()

    def towards(goal: torch.Tensor) -> np.ndarray:
        action = np.zeros((8, 7))
        action[:, :3] = np.clip((goal - seen(pair[1])["eef_pos"]).numpy() / 0.03, -1, 1)
        action[:, 6] = 1.0
        return action

    for height in [0.12] * 8 + [0.02] * 8:
        play(pair, towards(start + torch.tensor([0.0, 0.07, height - 0.02])))
    apart = []
    for _ in range(16):
        action = np.zeros((8, 7))
        action[:, 1], action[:, 6] = -0.2, 1.0
        continue_from(pair)
        play(pair, action)
        away = seen(pair[0])["cube_pos"] - seen(pair[1])["cube_pos"]
        apart.append(away.norm(dim=1).numpy() * 1000)

    pushed = seen(pair[1])["cube_pos"] - start
    assert (pushed[:, 1] < -0.03).all()
    assert np.median(apart) < 0.01
    assert np.max(apart) < 3.0  # an impact that comes a time step sooner or later


@needs_warp
def test_a_scripted_grasp_lifts_as_often_as_on_the_cpu(make_pair: Callable[..., Pair]):
    gpu, cpu = make_pair(num_envs=16)
    lifted = []
    for env in (gpu, cpu):
        for t in range(60):
            states = seen(env)
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
            result = env.step(action if env is gpu else action.numpy())
        states = seen(env)
        lifted.append(states["cube_pos"][:, 2] > 0.12)
        # Touches are one time step old: a pad may let go for a moment.
        assert states["cube_grasped"][lifted[-1]].mean() > 0.8
        assert torch.as_tensor(result.held).cpu()[lifted[-1]].all()

    ours, theirs = lifted
    assert ours.float().mean() > 0.8
    assert (
        abs(ours.float().mean() - theirs.float().mean()) < 0.2
    )  # grasps at corners slip or do not


@needs_warp
def test_the_same_states_give_the_same_reward_and_success(make_pair: Callable[..., Pair]):
    gpu, cpu = make_pair()
    adr = cpu.world.objects[0].qpos_adr
    for qpos in (qpos_of(gpu), qpos_of(cpu)):
        qpos[::4, adr : adr + 3] = torch.tensor([0.9, 0.6, 0.5])  # out of the arm's reach

    ours, theirs = gpu.step(torch.zeros(8, 7)), cpu.step(np.zeros((8, 7)))

    assert ours.success.tolist() == theirs.success.tolist() == [True, False, False, False] * 2
    np.testing.assert_allclose(ours.reward.cpu(), theirs.reward, atol=1e-5)
    assert ours.components.keys() == theirs.components.keys()
    for name, values in theirs.components.items():
        np.testing.assert_allclose(ours.components[name].cpu(), values, atol=1e-4)
    assert not ours.truncated.any()
    assert not ours.terminated.any()


@needs_warp
def test_success_is_held_after_five_steps_and_time_runs_out_at_the_horizon(
    make_pair: Callable[..., Pair], lift_task: type[Task]
):
    class FromTheSecondStep(lift_task):
        def compute_success(self, states: dict[str, torch.Tensor]) -> torch.Tensor:
            return states["progress"] > 1.5 / 7

    gpu, _ = make_pair(task=FromTheSecondStep, horizon=7)

    results = [gpu.step(torch.zeros(8, 7)) for _ in range(7)]

    assert [bool(r.held.all()) for r in results] == [False] * 5 + [True] * 2
    assert [bool(r.truncated.all()) for r in results] == [False] * 6 + [True]


@needs_warp
def test_an_episode_that_begins_in_success_never_counts_and_many_end_the_training(
    make_pair: Callable[..., Pair], lift_task: type[Task]
):
    class Always(lift_task):
        def compute_success(self, states: dict[str, torch.Tensor]) -> torch.Tensor:
            return states["progress"] > -1

    gpu, _ = make_pair(task=Always)

    assert not any(gpu.step(torch.zeros(8, 7)).held.any() for _ in range(7))
    with pytest.raises(ItemRejectedError, match="starts solved: its success is true at 8 of 8"):
        gpu.reset(torch.arange(8))


@needs_warp
def test_resetting_some_worlds_leaves_the_others_alone(make_pair: Callable[..., Pair]):
    gpu, _ = make_pair()
    for action in smooth_actions(5, 8, turning=1.0):
        gpu.step(torch.from_numpy(action))
    before = {key: value.clone() for key, value in gpu._state().items()}
    obs = gpu.observe().clone()

    gpu.reset(torch.tensor([1, 6]))

    others = [0, 2, 3, 4, 5, 7]
    after = gpu._state()
    for key, value in before.items():
        if value.ndim and len(value) == 8:
            assert torch.equal(after[key][others], value[others]), key
    assert torch.equal(gpu.observe()[others], obs[others])
    assert (gpu.observe()[[1, 6]] != obs[[1, 6]]).any(1).all()
    assert seen(gpu)["progress"][[1, 6]].tolist() == [0, 0]


@needs_warp
def test_a_reset_starts_at_rest_whatever_the_delay(make_pair: Callable[..., Pair]):
    gpu, _ = make_pair(randomization=replace(ranges.none(), delay_s=(0.02, 0.02)))
    start = seen(gpu)["eef_pos"].clone()

    gpu.step(torch.zeros(8, 7))

    assert (seen(gpu)["eef_pos"] - start).abs().max() < 1e-4


@needs_warp
def test_a_broken_world_ends_without_reward_and_the_others_go_on(
    make_pair: Callable[..., Pair],
):
    gpu, cpu = make_pair()
    gpu._sim.qvel[2, 3] = 1e13

    broken = gpu.step(torch.zeros(8, 7))
    cpu.step(np.zeros((8, 7)))
    gpu.reset(broken.terminated.nonzero()[:, 0])
    after = gpu.step(torch.zeros(8, 7))
    cpu.step(np.zeros((8, 7)))

    assert broken.terminated.tolist() == [i == 2 for i in range(8)]
    assert not broken.truncated.any()
    assert broken.reward[2] == 0
    assert torch.isfinite(broken.obs).all()
    assert gpu.broken_count == 1
    assert not after.terminated.any()
    others = [0, 1, 3, 4, 5, 6, 7]
    torch.testing.assert_close(
        seen(gpu)["eef_pos"][others], seen(cpu)["eef_pos"][others], atol=5e-5, rtol=0
    )


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

    heights = seen(gpu)["cube_pos"][:, 2]
    np.testing.assert_allclose(heights, seen(cpu)["cube_pos"][:, 2], atol=1e-3)
    assert np.ptp(heights.numpy()) > 0.002


@needs_warp
def test_random_actions_and_resets_stay_finite(
    make_pair: Callable[..., Pair], make_object: Callable[..., SceneObject]
):
    gpu, _ = make_pair(
        make_object("cube"),
        make_object("box", "box", (0.14, 0.12, 0.06), hollow=True, pos=(0, 0.2, 0.03)),
        randomization=ranges.training(),
        horizon=15,
    )
    gpu.stagger()

    for action in smooth_actions(30, 8, turning=1.0):
        result = gpu.step(torch.from_numpy(action))
        assert torch.isfinite(result.obs).all()
        assert result.obs.abs().max() <= 5
        gpu.reset((result.truncated | result.terminated).nonzero()[:, 0])

    assert gpu.broken_count == 0


@needs_warp
@pytest.mark.slow
@pytest.mark.parametrize("name", benchmark_names())
def test_a_benchmark_task_has_the_same_observation_and_reward_on_both(name: str, device: str):
    cfg = SimConfig(randomization=NOISELESS)
    gpu = make_batch_env(
        load_benchmark(name), cfg, num_envs=4, seed=0, backend="warp", device=device
    )
    cpu = make_batch_env(load_benchmark(name), cfg, num_envs=4, seed=0, num_threads=1)

    for action in smooth_actions(5, 4, turning=0.2):
        ours, theirs = gpu.step(torch.from_numpy(0.4 * action)), cpu.step(0.4 * action)

    np.testing.assert_allclose(ours.obs.cpu(), theirs.obs, atol=2e-3)
    np.testing.assert_allclose(ours.reward.cpu(), theirs.reward, atol=1e-4)
    assert ours.success.tolist() == theirs.success.tolist()


@needs_warp
def test_tensors_share_memory_with_warp(make_pair: Callable[..., Pair]):
    gpu, _ = make_pair()

    gpu._object_qpos[3, 0, 2] = 0.7

    assert gpu._sim._d.qpos.numpy()[3, gpu.world.objects[0].qpos_adr + 2] == np.float32(0.7)
    assert gpu._sim.qpos.data_ptr() == gpu._sim._d.qpos.ptr


@needs_warp
def test_torchrl_and_checkpoints_take_it_as_they_take_the_cpus(make_pair: Callable[..., Pair]):
    from tensordict import TensorDict
    from torchrl.envs.utils import check_env_specs

    from v2p_data.sim.wrappers.torchrl_env import TorchRLEnv

    gpu, _ = make_pair(horizon=6, randomization=ranges.training())
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
    envs = [
        WarpBatchEnv(make_bundle(), cfg, num_envs=8, seed=0, device=device, task=lift_task)
        for device in ("cpu", gpu)
    ]

    for action in smooth_actions(32, 8, turning=0.15):
        for env in envs:
            result = env.step(torch.from_numpy(action).to(env.device))
            assert result.obs.device.type == env.device.type

    ours, theirs = (seen(env)["eef_pos"] for env in envs)
    assert (ours - theirs).norm(dim=1).max() < 5e-5

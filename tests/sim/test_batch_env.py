from collections.abc import Callable
from dataclasses import replace

import mujoco
import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation

from v2p_data.errors import V2PError
from v2p_data.scene.scene import SceneObject
from v2p_data.sim.env import ranges
from v2p_data.sim.env.batch_env import BatchEnv, SimConfig
from v2p_data.sim.env.ranges import RandomizationConfig
from v2p_data.sim.env.task_code import HELD_STEPS
from v2p_data.sim.render.masks import FIRST_OBJECT, MaskRenderer
from v2p_data.task.sandbox.reader.refusal import TaskCodeError
from v2p_data.task.task import BASE_OBSERVATION_DIM, OBJECT_STATES, ROBOT_STATES, Task, TaskBundle

CALM = SimConfig(fine=True, randomization=ranges.none())


@pytest.fixture
def make_env(
    make_bundle: Callable[..., TaskBundle], lift_task: type[Task]
) -> Callable[..., BatchEnv]:
    def make(
        *objects: SceneObject,
        cfg: SimConfig | None = None,
        num_envs: int = 8,
        seed: int = 0,
        num_threads: int = 1,
        horizon: int = 60,
        task: type[Task] = lift_task,
    ) -> BatchEnv:
        return BatchEnv(
            make_bundle(*objects, horizon=horizon),
            cfg,
            num_envs=num_envs,
            seed=seed,
            num_threads=num_threads,
            task=task,
        )

    return make


def scripted_lift(env: BatchEnv, steps: int = 60) -> list:
    """Drive the gripper over the object, down, shut and up, by the states alone."""
    results = []
    for t in range(steps):
        states = env.states()
        error = (states["cube_pos"] - states["eef_pos"]).numpy()
        action = np.zeros((env.num_envs, 7))
        action[:, :2] = error[:, :2] / 0.03
        if t >= 10:
            action[:, 2] = error[:, 2] / 0.03
        if t >= 25:
            action[:, 6] = 1.0
        if t >= 35:
            action[:, 2] = 0.5
        results.append(env.step(action))
    return results


def test_states_have_the_documented_keys_and_shapes(
    make_env: Callable[..., BatchEnv], make_object: Callable[..., SceneObject]
):
    env = make_env(make_object("cube"), make_object("can", role="reference", pos=(0, 0.15, 0.02)))

    states = env.states()

    n = env.num_envs
    documented = {k: shape for k, (shape, _, _) in ROBOT_STATES.items()}
    for name in ("cube", "can"):
        documented |= {f"{name}_{k}": shape for k, (shape, _, _) in OBJECT_STATES.items()}
    assert set(states) == set(documented)
    for key, shape in documented.items():
        assert str(tuple(states[key].shape)).replace(str(n), "env", 1) == shape
        assert states[key].dtype == torch.float32


def test_the_first_states_are_those_of_the_placed_objects(
    make_env: Callable[..., BatchEnv], make_object: Callable[..., SceneObject]
):
    env = make_env(make_object("cube", size_m=(0.03, 0.04, 0.05)), cfg=CALM)

    states = env.states()

    np.testing.assert_allclose(states["cube_pos"][0], (0.5, 0.0, 0.0255), atol=1e-6)
    np.testing.assert_allclose(states["cube_size"][0], (0.03, 0.04, 0.05), atol=1e-6)
    np.testing.assert_allclose(states["cube_up"], 1.0)
    np.testing.assert_allclose(states["gripper_width"], 0.085, atol=1e-6)
    np.testing.assert_allclose(states["cube_pos"], states["cube_start_pos"])
    assert not states["cube_touched"].any()


def test_velocities_are_in_the_world_frame(make_env: Callable[..., BatchEnv]):
    env = make_env(cfg=CALM, num_envs=2)
    obj = env.world.objects[0]
    env._sim.qpos[:, obj.qpos_adr : obj.qpos_adr + 3] = 0.5, 0.3, 0.4
    env._sim.qpos[:, obj.qpos_adr + 3 : obj.qpos_adr + 7] = 0.5, 0.5, 0.5, 0.5
    env._sim.qvel[:, obj.dof_adr : obj.dof_adr + 6] = 0.1, 0.2, 0.3, 1.0, 0.0, 0.0

    env.step(np.zeros((2, 7)))

    model, data = env.world.model, mujoco.MjData(env.world.model)
    data.qpos[:], data.qvel[:] = env._sim.qpos[0], env._sim.qvel[0]
    mujoco.mj_forward(model, data)
    velocity = np.zeros(6)
    mujoco.mj_objectVelocity(model, data, mujoco.mjtObj.mjOBJ_XBODY, obj.body_id, velocity, 0)
    np.testing.assert_allclose(env.states()["cube_vel_angular"][0], velocity[:3], atol=1e-5)
    np.testing.assert_allclose(env.states()["cube_vel_linear"][0], velocity[3:], atol=1e-5)


def test_observations_are_bounded_and_of_the_common_length(make_env: Callable[..., BatchEnv]):
    env = make_env()
    rng = np.random.default_rng(0)

    for _ in range(20):
        obs = env.step(rng.uniform(-1, 1, (8, 7))).obs

    assert obs.shape == (8, BASE_OBSERVATION_DIM)
    assert obs.dtype == np.float32
    assert np.abs(obs).max() <= 5


def test_results_depend_on_the_seed_and_not_on_the_number_of_threads(
    make_env: Callable[..., BatchEnv],
):
    def trace(seed: int, num_threads: int) -> bytes:
        env = make_env(seed=seed, num_threads=num_threads, num_envs=16, horizon=12)
        rng = np.random.default_rng(7)
        parts = []
        for _ in range(30):
            result = env.step(rng.uniform(-1, 1, (16, 7)))
            env.reset(np.flatnonzero(result.truncated))
            parts += [result.obs.tobytes(), result.reward.tobytes(), env.observe().tobytes()]
        return b"".join(parts)

    one = trace(3, 1)

    assert trace(3, 2) == one
    assert trace(3, 4) == one
    assert trace(4, 1) != one


def test_resetting_some_worlds_leaves_the_others_alone(make_env: Callable[..., BatchEnv]):
    env = make_env()
    for _ in range(5):
        env.step(np.full((8, 7), 0.5))
    before, obs = env._sim.batch.state.copy(), env.observe()

    env.reset(np.array([1, 6]))

    others = [0, 2, 3, 4, 5, 7]
    np.testing.assert_array_equal(env._sim.batch.state[others], before[others])
    np.testing.assert_array_equal(env.observe()[others], obs[others])
    assert env.states()["progress"][1] == 0
    assert (env.observe()[[1, 6]] != obs[[1, 6]]).any(1).all()


def test_a_reset_world_is_in_the_state_that_mujocos_own_reset_gives(
    make_env: Callable[..., BatchEnv],
):
    env = make_env(num_envs=4)
    env._sim.qvel[1, 0] = 1e13
    assert env.step(np.zeros((4, 7))).terminated[1]

    env.reset(np.array([1, 2]))

    untouched = ("time", "qacc_warmstart", "qvel")
    own = {name: env._sim.batch.bind(name)[1:3].copy() for name in untouched}
    env._sim.batch.reset(np.array([1, 2]), stage=int(mujoco.mjtStage.mjSTAGE_NONE))
    for name, value in own.items():
        np.testing.assert_array_equal(value, env._sim.batch.bind(name)[1:3])
    assert not env._sim.batch.warning[1:3].any()
    assert not env.step(np.zeros((4, 7))).terminated.any()


def test_a_restarted_stream_draws_the_same_whatever_was_drawn_before(
    make_env: Callable[..., BatchEnv],
):
    def drawn(resets_before: int) -> tuple[bytes, bytes]:
        env = make_env()
        for k in range(resets_before):
            env.reset(np.arange(k % 3 + 1))
        env.seed(5)
        env.reset(np.arange(8))
        return env.observe().tobytes(), env.randomizer.mass_kg.tobytes()

    assert drawn(0) == drawn(7)


def test_a_reset_starts_at_rest_whatever_the_delay(make_env: Callable[..., BatchEnv]):
    cfg = SimConfig(fine=True, randomization=replace(ranges.none(), delay_s=(0.02, 0.02)))
    env = make_env(cfg=cfg)
    start = env.states()["eef_pos"].clone()

    env.step(np.zeros((8, 7)))

    assert (env.states()["eef_pos"] - start).abs().max() < 1e-4


def test_delayed_worlds_answer_later_to_the_same_action(make_env: Callable[..., BatchEnv]):
    moved = []
    for delay in (0.0, 0.02):
        cfg = replace(CALM, randomization=replace(ranges.none(), delay_s=(delay, delay)))
        env = make_env(cfg=cfg)
        start = env.states()["eef_pos"].clone()
        action = np.zeros((8, 7))
        action[:, 1] = 1.0
        env.step(action)
        moved.append(float((env.states()["eef_pos"] - start)[0, 1]))

    assert 0 < moved[1] < 0.8 * moved[0]


def test_a_scripted_grasp_lifts_the_object_and_counts_as_success(
    make_env: Callable[..., BatchEnv],
):
    env = make_env(cfg=SimConfig(fine=True), num_envs=16)

    results = scripted_lift(env)

    states = env.states()
    lifted = states["cube_pos"][:, 2] > 0.12
    assert lifted.float().mean() > 0.8  # any yaw: some grasps meet a corner
    assert (states["cube_grasped"][lifted] == 1).all()
    assert results[-1].held[lifted.numpy()].all()
    assert not results[20].success.any()
    # Nothing sinks into the pads: the opening is the object's width, between its side and its diagonal.
    width = states["gripper_width"][lifted]
    side = states["cube_size"][lifted][:, :2]
    assert (width > 0.98 * side.min(1).values).all()
    assert (width < 1.02 * side.norm(dim=1)).all()
    assert (
        env._sim.target_finger >= env._sim.qpos[:, 7:9].mean(1) - env.cfg.finger_leash_m - 0.002
    ).all()


def test_success_is_held_after_five_steps_on_end(make_env: Callable[..., BatchEnv]):
    class SuccessFromHalf(Task):
        def compute_success(self, states: dict[str, torch.Tensor]) -> torch.Tensor:
            return states["progress"] > 0.5

        def compute_reward(
            self, actions: torch.Tensor, states: dict[str, torch.Tensor]
        ) -> tuple[torch.Tensor, dict[str, torch.Tensor]]:
            return states["progress"] * 0, {}

    env = make_env(horizon=20, task=SuccessFromHalf)

    results = [env.step(np.zeros((8, 7))) for _ in range(20)]

    assert [bool(r.success[0]) for r in results] == [False] * 10 + [True] * 10
    assert [bool(r.held[0]) for r in results].index(True) == 10 + HELD_STEPS - 1


def test_the_reward_is_the_tasks_in_full_rewards_of_100_plus_the_bonus_ratio_per_success(
    make_env: Callable[..., BatchEnv],
):
    env = make_env(cfg=replace(CALM, bonus_ratio=10.0))

    calm = env.step(np.zeros((8, 7)))
    env._sim.qpos[:, env.world.objects[0].qpos_adr + 2] = 0.5
    high = env.step(np.zeros((8, 7)))

    assert not calm.success.any()
    np.testing.assert_allclose(calm.reward, (1 + calm.components["height"]) / 100, rtol=1e-5)
    assert high.success.all()
    np.testing.assert_allclose(high.reward, (1 + high.components["height"]) / 100 + 10, rtol=1e-5)
    np.testing.assert_allclose(high.components["alive"], 1)


def test_an_episode_is_cut_off_at_the_horizon_and_not_before(make_env: Callable[..., BatchEnv]):
    env = make_env(horizon=7)

    truncated = [env.step(np.zeros((8, 7))).truncated.all() for _ in range(7)]

    assert truncated == [False] * 6 + [True]


def test_task_code_is_run_through_the_guard(make_bundle: Callable[..., TaskBundle]):
    code = """
import torch
from factory.tasks.task import Task

class Height(Task):
    def __init__(self, envs, urdf_assets_root):
        super().__init__(envs, urdf_assets_root, {})

    def compute_observation_key(self, states):
        states["height"] = states["cube_pos"][:, 2]
        return ["base_observation", "height"]

    def get_observation_space(self):
        return 91

    def compute_success(self, states):
        return states["height"] > 0.1

    def compute_reward(self, actions, states):
        return states["cube_pos"][:, 2], {"height": states["cube_pos"][:, 2]}
"""
    bundle = replace(make_bundle(), code=code)
    env = BatchEnv(bundle, num_envs=4, seed=0, num_threads=1)

    result = env.step(np.zeros((4, 7)))

    assert env.obs_dim == BASE_OBSERVATION_DIM + 1
    np.testing.assert_allclose(result.obs[:, -1], env.states()["cube_pos"][:, 2])
    with pytest.raises(TaskCodeError, match="os"):
        BatchEnv(replace(bundle, code=code + "\nimport os\n"), num_envs=4, seed=0)


def test_a_broken_world_ends_without_reward_and_can_start_anew(make_env: Callable[..., BatchEnv]):
    env = make_env(num_threads=2)
    env._sim.qvel[2, 3] = 1e13

    broken = env.step(np.zeros((8, 7)))
    env.reset(np.flatnonzero(broken.terminated))
    after = env.step(np.zeros((8, 7)))

    assert broken.terminated.tolist() == [i == 2 for i in range(8)]
    assert not broken.truncated.any()
    assert broken.reward[2] == 0
    assert np.isfinite(broken.obs).all()
    assert env.broken_count == 1
    assert not after.terminated.any()
    assert after.reward[2] != 0


def test_a_reward_that_is_not_a_number_is_named(
    make_env: Callable[..., BatchEnv], lift_task: type[Task]
):
    class Broken(lift_task):
        def compute_reward(
            self, actions: torch.Tensor, states: dict[str, torch.Tensor]
        ) -> tuple[torch.Tensor, dict[str, torch.Tensor]]:
            total, parts = super().compute_reward(actions, states)
            return total / 0.0 * 0.0, parts

    env = make_env(task=Broken)

    with pytest.raises(V2PError, match="reward of task 'test' is nan"):
        env.step(np.zeros((8, 7)))


def test_a_wrong_observation_length_is_one_clear_error(
    make_env: Callable[..., BatchEnv], lift_task: type[Task]
):
    class Wrong(lift_task):
        def compute_observation_key(self, states: dict[str, torch.Tensor]) -> list[str]:
            states["height"] = states["cube_pos"][:, 2]
            return ["base_observation", "height"]

    with pytest.raises(V2PError, match="length 91 but says 90"):
        make_env(task=Wrong)


def test_the_gripper_leans_no_further_than_its_limit(make_env: Callable[..., BatchEnv]):
    env = make_env(cfg=CALM)
    action = np.zeros((8, 7))
    action[:, 3] = 1.0

    for _ in range(30):
        env.step(action)

    tilt = np.linalg.norm(env.robot_state()[:, 3:5], axis=1)
    assert tilt == pytest.approx(env.cfg.tilt_limit_rad, abs=0.02)


def test_robot_state_is_pose_from_straight_down_opening_and_command(
    make_env: Callable[..., BatchEnv],
):
    env = make_env(cfg=CALM)
    assert env.robot_state()[0, 3:] == pytest.approx([0, 0, 0, 1, 0, 0, 0, 1], abs=1e-6)
    action = np.zeros((8, 7))
    action[:, [0, 3, 5, 6]] = 0.3, 0.4, 0.8, 0.5

    for _ in range(4):
        env.step(action)

    tool = Rotation.from_quat(env.states()["eef_quat"][0].numpy(), scalar_first=True).as_matrix()
    down = np.diag([1.0, -1.0, -1.0])
    state = env.robot_state()[0]
    np.testing.assert_allclose(state[:3], env.states()["eef_pos"][0], atol=1e-6)
    np.testing.assert_allclose(
        state[3:6], Rotation.from_matrix(down.T @ tool).as_rotvec(), atol=1e-5
    )
    assert state[6] == pytest.approx(float(env.states()["gripper_width"][0]) / 0.085, abs=1e-5)
    base = env.states()["base_observation"][0].numpy()  # its own way to the same numbers
    np.testing.assert_allclose(state[7:10], base[11:14] / 20, atol=1e-6)
    assert state[10] == pytest.approx(base[14], abs=1e-6)
    assert state[7] > 0.002
    assert state[10] < 1


def test_a_delta_action_moves_the_tool_by_its_metres_and_radians(
    make_env: Callable[..., BatchEnv],
):
    env = make_env(cfg=CALM)
    start = env.robot_state()[0]
    action = np.zeros((8, 7))
    action[:, 1], action[:, 5] = 0.5, -0.5
    env.step(action)

    for _ in range(20):
        env.step(np.zeros((8, 7)))

    moved = env.robot_state()[0] - start
    assert moved[1] == pytest.approx(0.5 * 0.03, abs=2e-4)
    # Turned by -0.1 rad about the world's z, which points against the gripper's own.
    assert moved[5] == pytest.approx(0.5 * 0.2, abs=2e-3)


def test_a_snapshot_draws_the_same_world(
    make_env: Callable[..., BatchEnv], make_object: Callable[..., SceneObject]
):
    env = make_env(
        make_object("cube"),
        make_object("bowl", "cylinder", (0.12, 0.12, 0.05), hollow=True, pos=(0, 0.2, 0.02)),
    )
    for _ in range(3):
        env.step(np.full((8, 7), 0.3))

    taken = env.snapshot(np.array([5, 2]))

    expected = env._sim.batch.get_model(2)
    seen = mujoco.MjData(expected)
    seen.qpos[:] = env._sim.qpos[2]
    mujoco.mj_kinematics(expected, seen)
    model, data = env.world.model, mujoco.MjData(env.world.model)
    taken.write(model, data, 1)
    np.testing.assert_allclose(data.geom_xpos, seen.geom_xpos, atol=1e-12)
    np.testing.assert_array_equal(model.geom_size, expected.geom_size)
    np.testing.assert_array_equal(taken.rows(np.array([0])).qpos[0], env._sim.qpos[5])


def ball_at(env: BatchEnv, pos: tuple[float, float, float], size_px: int) -> list[np.ndarray]:
    """Return label images of all worlds, a ball where it hides behind nothing."""
    env._sim.object_qpos[:, 0, :3] = pos
    snapshot = env.snapshot(np.arange(env.num_envs))
    with MaskRenderer(env.world, size_px) as renderer:
        return [renderer.draw(snapshot, k) for k in range(env.num_envs)]


def test_a_moved_camera_shows_the_ball_where_a_pinhole_projects_it(
    make_env: Callable[..., BatchEnv], make_object: Callable[..., SceneObject]
):
    moved = RandomizationConfig(camera_pos_m=0.05, camera_angle_rad=0.05, camera_fovy_deg=5.0)
    env = make_env(make_object("cube", "sphere"), cfg=SimConfig(fine=True, randomization=moved))
    ball, size_px = np.array([0.5, -0.25, 0.02]), 160

    masks = ball_at(env, tuple(ball), size_px)

    expected, seen = [], []
    for k, labels in enumerate(masks):
        view = env.episode_params(k)["camera"]
        R_world_cam = Rotation.from_quat(view["quat_wxyz"], scalar_first=True)
        x, y, z = R_world_cam.inv().apply(ball - view["pos_m"])  # looks along -z, y is up
        focal_px = size_px / 2 / np.tan(np.radians(view["fovy_deg"]) / 2)
        expected.append([size_px / 2 - focal_px * x / z, size_px / 2 + focal_px * y / z])
        rows, columns = np.nonzero(labels == FIRST_OBJECT)
        seen.append([columns.mean() + 0.5, rows.mean() + 0.5])
    assert np.ptp(expected, axis=0).min() > 10
    np.testing.assert_allclose(seen, expected, atol=0.7)


def test_a_saved_environment_goes_on_exactly(make_env: Callable[..., BatchEnv]):
    rng = np.random.default_rng(0)
    actions = rng.uniform(-1, 1, (20, 8, 7))

    def play(env: BatchEnv, part: np.ndarray) -> bytes:
        parts = []
        for action in part:
            result = env.step(action)
            env.reset(np.flatnonzero(result.truncated))
            parts += [result.obs.tobytes(), result.reward.tobytes()]
        return b"".join(parts)

    first = make_env(horizon=8)
    play(first, actions[:11])
    saved = first.state_dict()
    rest = play(first, actions[11:])

    second = make_env(horizon=8)
    play(second, actions[:5])
    second.load_state_dict(saved)

    assert play(second, actions[11:]) == rest


@pytest.mark.parametrize(("away_m", "touches"), [(0.0, True), (0.004, False)])
def test_a_knock_of_the_palm_counts_as_the_arms_although_it_is_over_at_the_steps_end(
    make_env: Callable[..., BatchEnv], away_m: float, touches: bool
):
    env = make_env(cfg=CALM, num_envs=2)
    data = mujoco.MjData(env.world.model)
    data.qpos[:] = env.motion()[0][0]
    mujoco.mj_forward(env.world.model, data)
    palm, half_m = data.geom("palm"), env.world.model.geom("palm").size[0]
    aside = palm.xmat.reshape(3, 3)[:, 0]
    cube_m = env.states()["cube_size"][0].norm().item() / 2
    env._sim.object_qpos[0, 0, :3] = palm.xpos + aside * (half_m + 0.02 + away_m)
    env._sim.object_qvel[0, 0, :3] = 2.0 * aside

    env.step(np.zeros((2, 7)))

    assert np.linalg.norm(env.object_poses()[0, 0, :3] - palm.xpos) > half_m + cube_m
    assert env.arm_touches()[:, 0].tolist() == [touches, False]
    assert env.touches()[:, 0].tolist() == [[False, False, touches], [False] * 3]

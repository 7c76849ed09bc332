"""LeRobot's own tools find our policy, environment and robot, and run them."""

import json
import logging
import warnings
from pathlib import Path

import numpy as np
import pytest

from v2p_data.errors import V2PError
from v2p_data.geometry.camera import Camera
from v2p_data.scene.scene import Scene, SceneObject
from v2p_data.task.task import TaskBundle

pytestmark = pytest.mark.slow

STATE_NAMES = [
    *(f"eef_{k}.pos" for k in ("x", "y", "z", "rx", "ry", "rz")),
    "gripper.pos",
    *(f"lead_{k}.pos" for k in ("x", "y", "z")),
    "target_gripper.pos",
]
ACTION_NAMES = [f"delta_{k}.pos" for k in ("x", "y", "z", "rx", "ry", "rz")] + [
    "gripper_close.pos"
]
SOON_DONE = """
from factory.tasks.task import Task

class Rest(Task):
    def __init__(self, envs, urdf_assets_root):
        super().__init__(envs, urdf_assets_root, {})

    def compute_success(self, states):
        return (states["cube_pos"][:, 2] > -1.0) & (states["progress"] > 0.15)

    def compute_reward(self, actions, states):
        height = states["cube_pos"][:, 2]
        return height, {"height": height}
"""


@pytest.fixture(scope="session")
def task_folder(tmp_path_factory) -> Path:
    """Return a task whose success is certain from the second step on: it is the plumbing that is tried."""
    folder = tmp_path_factory.mktemp("task")
    pose = (0.0, 0.0, 0.02, 1.0, 0.0, 0.0, 0.0)
    cube = SceneObject(
        name="cube",
        label="cube",
        role="manipulated",
        shape="box",
        size_m=(0.04, 0.04, 0.04),
        mass_kg=0.1,
        friction=0.8,
        frames=(0, 1),
        poses_world=(pose, pose),
        confidences=(1.0, 1.0),
    )
    camera = Camera(
        width_px=64,
        height_px=48,
        K=np.array([[60.0, 0, 32], [0, 60, 24], [0, 0, 1]]),
        T_world_cam=np.eye(4),
    )
    scene = Scene(
        title="rest",
        video="rest.mp4",
        description="leaving the cube alone",
        kind="generic",
        objects=(cube,),
        camera=camera,
        fps=20.0,
        num_frames=2,
        confidence=1.0,
        folder=folder / "scene",
    )
    scene.folder.mkdir()
    scene.save(scene.folder)
    TaskBundle(
        title="rest",
        description=scene.description,
        kind="generic",
        class_name="Rest",
        code=SOON_DONE,
        scene=scene,
        horizon_steps=8,
    ).save(folder / "rest")
    return folder / "rest"


@pytest.fixture(scope="session")
def dataset(tmp_path_factory) -> Path:
    """Return a dataset of two short episodes with lossless 64 x 64 masks."""
    from lerobot.configs import RGBEncoderConfig
    from lerobot.datasets.lerobot_dataset import LeRobotDataset

    root = tmp_path_factory.mktemp("data") / "dummy"
    writer = LeRobotDataset.create(
        "v2p/dummy",
        fps=20,
        root=root,
        robot_type="v2p_franka",
        features={
            "observation.images.mask": {
                "dtype": "video",
                "shape": (64, 64, 3),
                "names": ["height", "width", "channels"],
            },
            "observation.state": {"dtype": "float32", "shape": (11,), "names": STATE_NAMES},
            "action": {"dtype": "float32", "shape": (7,), "names": ACTION_NAMES},
        },
        rgb_encoder=RGBEncoderConfig(vcodec="h264", crf=0, pix_fmt="yuv420p"),
    )
    rng = np.random.default_rng(0)
    greys = np.array([0, 64, 128], np.uint8)
    for _ in range(2):
        for _ in range(6):
            writer.add_frame(
                {
                    "observation.images.mask": greys[rng.integers(0, 3, (64, 64, 1))].repeat(3, 2),
                    "observation.state": rng.normal(size=11).astype(np.float32),
                    "action": rng.uniform(-1, 1, 7).astype(np.float32),
                    "task": "leaving the cube alone",
                }
            )
        writer.save_episode()
    writer.finalize()
    return root


@pytest.fixture
def run_tool(monkeypatch):
    """Run one of LeRobot's tools in this process: importing LeRobot anew costs half a minute."""
    root, level, handlers = (
        logging.getLogger(),
        logging.getLogger().level,
        logging.getLogger().handlers[:],
    )

    def run(main, *arguments: str) -> None:
        monkeypatch.setattr("sys.argv", ["lerobot", *arguments])
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            main()

    yield run
    root.handlers[:] = handlers
    root.setLevel(level)


def trained(run_tool, dataset, out, *arguments) -> Path:
    from lerobot.scripts.lerobot_train import main

    run_tool(
        main,
        f"--dataset.repo_id=v2p/{dataset.name}",
        f"--dataset.root={dataset}",
        "--policy.device=cpu",
        "--policy.push_to_hub=false",
        "--batch_size=2",
        "--num_workers=0",
        "--env_eval_freq=0",
        f"--output_dir={out}",
        *arguments,
    )
    return out / "checkpoints" / "last" / "pretrained_model"


def test_lerobot_discovers_policy_environment_and_robot():
    from lerobot.configs import PreTrainedConfig
    from lerobot.envs import EnvConfig
    from lerobot.robots import RobotConfig
    from lerobot.utils.import_utils import register_third_party_plugins

    register_third_party_plugins()

    assert "v2p_bc" in PreTrainedConfig.get_known_choices()
    assert "v2p" in EnvConfig.get_known_choices()
    assert "v2p_franka" in RobotConfig.get_known_choices()


def test_lerobots_own_trainer_makes_the_small_preset(run_tool, dataset, tmp_path):
    from lerobot.configs import PreTrainedConfig

    checkpoint = trained(
        run_tool,
        dataset,
        tmp_path / "run",
        "--policy.type=v2p_bc",
        "--policy.preset=small",
        "--steps=2",
        "--save_freq=2",
    )

    cfg = PreTrainedConfig.from_pretrained(checkpoint)
    assert (cfg.preset, cfg.encoder, cfg.head) == ("small", "none", "bins")
    assert (checkpoint / "model.safetensors").is_file()


def test_lerobots_own_trainer_trains_a_policy_of_ours_anew(run_tool, dataset, tmp_path):
    from lerobot.scripts.lerobot_train import main

    from policies.bc.configuration_v2p_bc import V2PBCConfig
    from policies.bc.student import DatasetPlace, Student
    from policies.bc.trainer import TrainerConfig, write_train_config

    cfg = V2PBCConfig(preset="small", device="cpu", push_to_hub=False)
    place = DatasetPlace(folder=dataset, repo_id="v2p/dummy", cache=tmp_path / "cache")
    student = Student.of_dataset(place, cfg, seed=0)
    recipe = TrainerConfig(steps=2, batch_size=2)
    student.train(recipe, tmp_path / "training", seed=0)
    student.save(tmp_path / "policy")
    write_train_config(tmp_path / "policy", student.policy, dataset, "v2p/dummy", recipe, 0)

    run_tool(
        main,
        f"--config_path={tmp_path / 'policy' / 'train_config.json'}",
        f"--output_dir={tmp_path / 'run'}",
        "--num_workers=0",
    )

    checkpoint = tmp_path / "run" / "checkpoints" / "last"
    assert checkpoint.resolve().name == "000002"
    assert (checkpoint / "pretrained_model" / "model.safetensors").is_file()


def test_training_resuming_and_evaluating_with_lerobots_own_tools(
    run_tool, dataset, task_folder, tmp_path, agreeing_referee
):
    from lerobot.scripts.lerobot_eval import main as lerobot_eval
    from lerobot.scripts.lerobot_train import main as lerobot_train

    checkpoint = trained(
        run_tool,
        dataset,
        tmp_path / "run",
        "--policy.type=v2p_bc",
        "--policy.input_size_px=32",
        "--policy.pretrained_backbone_weights=null",
        "--steps=2",
        "--save_freq=1",
    )
    assert checkpoint.resolve().parent.name == "000002"
    run_tool(
        lerobot_train,
        f"--config_path={checkpoint / 'train_config.json'}",
        "--resume=true",
        "--steps=3",
    )
    assert checkpoint.resolve().parent.name == "000003"

    run_tool(
        lerobot_eval,
        f"--policy.path={checkpoint}",
        "--policy.device=cpu",
        "--env.type=v2p",
        f"--env.tasks={task_folder}",
        "--env.size_px=64",
        "--eval.n_episodes=3",
        "--eval.batch_size=2",
        "--eval.use_async_envs=false",
        f"--output_dir={tmp_path / 'eval'}",
    )

    info = json.loads((tmp_path / "eval" / "eval_info.json").read_text())
    assert info["overall"]["pc_success"] == 100.0
    assert info["overall"]["n_episodes"] == 3
    assert (tmp_path / "eval" / "videos" / "v2p_0" / "eval_episode_0.mp4").stat().st_size > 1000


RECIPES = [
    line.split()[1:]
    for line in (Path(__file__).parents[1] / "docs/policies.md").read_text().splitlines()
    if line.startswith("lerobot-train ")
]


@pytest.mark.parametrize("recipe", RECIPES, ids=lambda r: next(w for w in r if ".type=" in w)[14:])
def test_each_recipe_of_the_docs_trains_three_steps(recipe, run_tool, dataset, tmp_path):
    if "--policy.type=diffusion" in recipe:
        pytest.importorskip("diffusers", reason="LeRobot's extra for diffusion policies")
    ours = ("--dataset.r", "--policy.push", "--batch_size", "--steps")

    checkpoint = trained(
        run_tool,
        dataset,
        tmp_path / "run",
        *[word for word in recipe if not word.startswith(ours)],
        "--steps=3",
    )

    assert (checkpoint / "model.safetensors").is_file()


def test_lerobot_rolls_the_policy_out_on_the_simulated_robot_and_on_the_twin(
    run_tool, dataset, task_folder, tmp_path, caplog, agreeing_referee
):
    from lerobot.scripts.lerobot_rollout import main

    checkpoint = trained(
        run_tool,
        dataset,
        tmp_path / "run",
        "--policy.type=v2p_bc",
        "--policy.input_size_px=32",
        "--policy.pretrained_backbone_weights=null",
        "--steps=1",
    )

    # LeRobot replaces the root logger's handlers, so the robot's own logger is listened to.
    log = logging.getLogger("lerobot_policy_v2p.robot.simulated")
    for robot in ("v2p_franka", "v2p_twin"):
        log.addHandler(caplog.handler)
        try:
            run_tool(
                main,
                "--strategy.type=base",
                f"--policy.path={checkpoint}",
                f"--robot.type={robot}",
                f"--robot.task_folder={task_folder}",
                f"--robot.calibration_dir={tmp_path}",
                "--task=leaving the cube alone",
                "--duration=4",
                "--fps=20",
                "--device=cpu",
                "--play_sounds=false",
                "--return_to_initial_position=false",
            )
        finally:
            log.removeHandler(caplog.handler)

    assert caplog.text.count("task 'rest' succeeded after 6 steps") == 2


def test_the_robots_entries_are_the_datasets_in_the_same_order(task_folder, tmp_path):
    from lerobot_policy_v2p.robot.config_v2p_franka import V2PFrankaConfig
    from lerobot_policy_v2p.robot.v2p_franka import V2PFranka

    robot = V2PFranka(V2PFrankaConfig(task_folder=str(task_folder), calibration_dir=tmp_path))

    robot.connect()
    before = robot.get_observation()
    sent = [robot.send_action(dict.fromkeys(ACTION_NAMES, 0.0) | {"delta_z.pos": 7.0})]
    sent += [robot.send_action(sent[0]) for _ in range(2)]
    after = robot.get_observation()
    robot.disconnect()

    assert [*robot.observation_features] == [*STATE_NAMES, "mask"] == [*before]
    assert [*robot.action_features] == ACTION_NAMES
    assert sent[0]["delta_z.pos"] == 1.0
    assert after["eef_z.pos"] > before["eef_z.pos"] + 0.02
    assert after["mask"].shape == robot.observation_features["mask"]
    assert not robot.is_connected


def test_a_robot_that_lacks_something_says_what(task_folder, tmp_path):
    from lerobot_policy_v2p.robot.config_v2p_franka import V2PFrankaConfig
    from lerobot_policy_v2p.robot.v2p_franka import V2PFranka

    with pytest.raises(ValueError, match="task_folder"):
        V2PFrankaConfig(backend="sim")
    with pytest.raises(ValueError, match=r"robot\.masks"):
        V2PFrankaConfig(backend="franky", ip="10.0.0.1")
    real = V2PFrankaConfig(
        backend="franky", ip="10.0.0.1", masks="os:getcwd", calibration_dir=tmp_path
    )
    with pytest.raises(V2PError, match="franky-control"):
        V2PFranka(real).connect()


def test_the_twin_is_a_lerobot_robot_that_gives_what_a_real_arm_gives(task_folder, tmp_path):
    from lerobot.robots import make_robot_from_config

    from lerobot_policy_v2p.robot.config_v2p_twin import V2PTwinConfig
    from v2p_data.twin.interface import RobotWithCamera

    robot = make_robot_from_config(
        V2PTwinConfig(task_folder=str(task_folder), pictures="rgb", calibration_dir=tmp_path)
    )
    assert isinstance(robot, RobotWithCamera)
    with pytest.raises(V2PError, match="connect"):
        robot.send_action(dict.fromkeys(ACTION_NAMES, 0.0))

    robot.connect()
    try:
        before = robot.get_observation()
    except V2PError as error:
        pytest.skip(str(error))  # no OpenGL
    sent = [robot.send_action(dict.fromkeys(ACTION_NAMES, 0.0) | {"delta_z.pos": 7.0})]
    sent += [robot.send_action(sent[0]) for _ in range(5)]
    after = robot.get_observation()
    camera, joints = robot.calibration(), robot.joints()
    robot.disconnect()

    assert [*robot.observation_features] == [*STATE_NAMES, "rgb"] == [*before]
    assert [*robot.action_features] == ACTION_NAMES
    assert sent[0]["delta_z.pos"] == 1.0
    assert after["eef_z.pos"] > before["eef_z.pos"] + 0.02
    assert after["rgb"].shape == robot.observation_features["rgb"]
    assert (camera.width_px, camera.K.shape, camera.T_world_cam.shape) == (256, (3, 3), (4, 4))
    assert joints.shape == (7,)
    assert not robot.is_connected


def test_a_twin_without_a_task_or_with_an_unknown_number_says_so(task_folder, tmp_path):
    from lerobot_policy_v2p.robot.config_v2p_twin import V2PTwinConfig
    from lerobot_policy_v2p.robot.v2p_twin import V2PTwin

    with pytest.raises(ValueError, match="task_folder"):
        V2PTwinConfig()
    odd = V2PTwinConfig(
        task_folder=str(task_folder), change={"latency": 1.0}, calibration_dir=tmp_path
    )
    with pytest.raises(V2PError, match="command_latency_s"):
        V2PTwin(odd).connect()


def test_targets_move_by_the_action_scale_and_stay_on_their_leashes():
    from scipy.spatial.transform import Rotation

    from v2p_data.sim.env.batch_env import SimConfig
    from v2p_data.sim.env.targets import DOWN, ToolPose, next_target

    measured = ToolPose(pos=np.array([0.5, 0.0, 0.2]), rotation=DOWN, opening=1.0)

    def after(action, times):
        target = measured
        for _ in range(times):
            target = next_target(target, measured, np.array(action, float), SimConfig(), 0.04)
        return target

    np.testing.assert_allclose(after([1, 0, -0.5, 0, 0, 0, 0], 1).pos, [0.53, 0, 0.185])
    np.testing.assert_allclose(after([1, 0, 0, 0, 0, 0, 0], 9).pos, [0.56, 0, 0.2])  # 6 cm
    yaw = [(DOWN.inv() * after([0, 0, 0, 0, 0, 1, 0], n).rotation).magnitude() for n in (1, 9)]
    np.testing.assert_allclose(yaw, [0.2, 0.5])
    lean = after([0, 0, 0, 1, 0, 0, 0], 9).rotation.apply([0, 0, 1])
    np.testing.assert_allclose(np.arccos(-lean[2]), 0.35)
    # 12 mm of 40 mm a step, at most 8 mm ahead of fingers that do not move
    np.testing.assert_allclose(after([0, 0, 0, 0, 0, 0, 1], 1).opening, 0.8)
    np.testing.assert_allclose(after([0, 0, 0, 0, 0, 0, 1 / 3], 1).opening, 0.9)
    turned = ToolPose(
        pos=measured.pos, rotation=Rotation.from_rotvec([0, 0, 0.3]) * DOWN, opening=0.0
    )
    np.testing.assert_allclose(turned.state(turned)[3:7], [0, 0, -0.3, 0], atol=1e-12)

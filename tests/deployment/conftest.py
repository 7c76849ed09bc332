"""A simulated arm before a red box and a blue one, as a robot with a camera; and a tiny policy for it."""

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

from v2p_data.deployment.rig import Rig
from v2p_data.deployment.robot import Reading
from v2p_data.errors import V2PError
from v2p_data.geometry.camera import Camera
from v2p_data.scene.scene import Scene, SceneObject
from v2p_data.task.task import TaskBundle

CODE = """
from factory.tasks.task import Task

class Rest(Task):
    def __init__(self, envs, urdf_assets_root):
        super().__init__(envs, urdf_assets_root, {})

    def compute_success(self, states):
        return states["box_pos"][:, 2] > 0.5

    def compute_reward(self, actions, states):
        height = states["box_pos"][:, 2]
        return height, {"height": height}
"""
"""A success that does not come by accident: the loop is tried, not the task."""


def thing(name: str, rgba: tuple[float, ...], y: float, role: str) -> SceneObject:
    pose = (0.0, y, 0.04, 1.0, 0.0, 0.0, 0.0)
    return SceneObject(
        name=name,
        label=name,
        role=role,  # type: ignore[arg-type]
        shape="box",
        size_m=(0.05, 0.06, 0.08),
        mass_kg=0.15,
        friction=0.8,
        rgba=rgba,  # type: ignore[arg-type]
        frames=(0, 1),
        poses_world=(pose, pose),
        confidences=(1.0, 1.0),
    )


def write_task(folder: Path, *objects: SceneObject) -> Path:
    camera = Camera(
        width_px=64,
        height_px=48,
        K=np.array([[60.0, 0, 32], [0, 60, 24], [0, 0, 1]]),
        T_world_cam=np.eye(4),
    )
    scene = Scene(
        title="rest",
        video="rest.mp4",
        description="lifting the red box",
        kind="generic",
        objects=objects,
        camera=camera,
        fps=20.0,
        num_frames=2,
        confidence=1.0,
        folder=folder / "scene",
    )
    scene.folder.mkdir(parents=True)
    scene.save(scene.folder)
    TaskBundle(
        title="rest",
        description=scene.description,
        kind="generic",
        class_name="Rest",
        code=CODE,
        scene=scene,
        horizon_steps=100,
    ).save(folder / "rest")
    return folder / "rest"


@pytest.fixture(scope="session")
def task_folder(tmp_path_factory) -> Path:
    red = thing("box", (0.8, 0.1, 0.1, 1.0), 0.0, "manipulated")
    return write_task(tmp_path_factory.mktemp("task"), red)


@pytest.fixture(scope="session")
def two_objects(tmp_path_factory) -> Path:
    red = thing("box", (0.8, 0.1, 0.1, 1.0), 0.0, "manipulated")
    blue = thing("brick", (0.1, 0.2, 0.8, 1.0), 0.15, "reference")
    return write_task(tmp_path_factory.mktemp("two"), red, blue)


@pytest.fixture(scope="session")
def make_robot(tmp_path_factory) -> Callable[..., Any]:
    """Return a maker of connected simulated arms; without OpenGL those with pictures skip their test."""
    from lerobot_policy_v2p.robot.config_v2p_franka import V2PFrankaConfig
    from lerobot_policy_v2p.robot.v2p_franka import V2PFranka

    calibration = tmp_path_factory.mktemp("calibration")

    def make(task: Path, **settings: Any) -> Any:
        robot = V2PFranka(
            V2PFrankaConfig(task_folder=str(task), calibration_dir=calibration, **settings)
        )
        robot.connect()
        if settings.get("pictures") == "rgb":
            try:
                robot.get_observation()
            except V2PError as error:
                if "OpenGL" in str(error):
                    pytest.skip(str(error))
                raise
        return robot

    return make


@pytest.fixture
def twin(task_folder, tmp_path):
    """Return a maker of twins; each is disconnected in the end."""
    from lerobot_policy_v2p.robot.config_v2p_twin import V2PTwinConfig
    from lerobot_policy_v2p.robot.v2p_twin import V2PTwin

    made = []

    def make(**settings):
        config = V2PTwinConfig(task_folder=str(task_folder), calibration_dir=tmp_path, **settings)
        made.append(V2PTwin(config))
        return made[-1]

    yield make
    for robot in made:
        robot.disconnect()


@pytest.fixture(scope="session")
def blind_robot(make_robot, task_folder) -> Any:
    """Return an arm that gives true masks; `restarted` before use."""
    return make_robot(task_folder)


@pytest.fixture(scope="session")
def seeing_robot(make_robot, task_folder) -> Any:
    """Return an arm that gives colour pictures."""
    return make_robot(task_folder, pictures="rgb")


@pytest.fixture
def restarted() -> Callable[..., Rig]:
    def restart(robot: Any, seed: int = 0) -> Rig:
        robot.arm.restart(seed)
        return Rig(robot)

    return restart


class Steady:
    """A policy that always wants the same."""

    def __init__(self, *action: float) -> None:
        self.action = np.array([action], np.float32)

    def reset(self, n: int) -> None: ...

    def act(self, labels: np.ndarray, state: np.ndarray) -> np.ndarray:
        return self.action


@pytest.fixture
def steady() -> type[Steady]:
    return Steady


def clicked(robot: Any, label: int = 2) -> tuple[float, float]:
    """Return the middle of an object, as a person would click it."""
    from v2p_data.scene.backends.segment import points_inside
    from v2p_data.sim.render.masks import rgb_to_labels

    u, v = points_inside(rgb_to_labels(robot.arm.mask()) == label, 1)[0]
    return float(u), float(v)


@pytest.fixture
def click_on() -> Callable[..., tuple[float, float]]:
    return clicked


@pytest.fixture(scope="session")
def policy_folder(tmp_path_factory) -> Path:
    """Return a checkpoint of an untrained v2p_bc policy for masks of 256 px that hardly moves."""
    from lerobot.configs import FeatureType, PolicyFeature
    from lerobot.policies.factory import make_pre_post_processors

    from policies.bc.configuration_v2p_bc import V2PBCConfig
    from policies.bc.modeling_v2p_bc import V2PBCPolicy

    folder = tmp_path_factory.mktemp("policy")
    config = V2PBCConfig(
        preset="small",
        input_features={
            "observation.images.mask": PolicyFeature(FeatureType.VISUAL, (3, 256, 256)),
            "observation.state": PolicyFeature(FeatureType.STATE, (11,)),
        },
        output_features={"action": PolicyFeature(FeatureType.ACTION, (7,))},
        num_labels=4,
        head_dim=16,
        state_dim=16,
        device="cpu",
        push_to_hub=False,
    )
    with torch.random.fork_rng():
        torch.random.default_generator.manual_seed(0)
        V2PBCPolicy(config).save_pretrained(folder)
    one = torch.ones(7)
    stats = {
        "observation.state": {"mean": torch.zeros(11), "std": torch.ones(11)},
        "action": {"mean": 0 * one, "std": one, "min": -one, "max": one},
    }
    for processor in make_pre_post_processors(config, dataset_stats=stats):
        processor.save_pretrained(folder)
    return folder


@pytest.fixture
def reading() -> Callable[..., Reading]:
    """Return a maker of readings of a tool at a place, its target there too."""

    def make(pos=(0.5, 0.0, 0.2), lead=(0, 0, 0), turn=(0, 0, 0), force=None) -> Reading:
        state = np.array([*pos, *turn, 1.0, *lead, 1.0], float)
        return Reading(
            state=state, picture=None, labels=None, joints_rad=None, opening=1.0, force_n=force
        )

    return make

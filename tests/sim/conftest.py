"""Small scenes, and a task that is nothing but lifting, for the simulator's tests."""

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
import torch

from v2p_data.geometry.camera import Camera
from v2p_data.scene.scene import Scene, SceneObject
from v2p_data.task.task import Task, TaskBundle

UPRIGHT = (1.0, 0.0, 0.0, 0.0)


def scene_object(
    name: str = "cube",
    shape: str = "box",
    size_m: tuple[float, float, float] = (0.04, 0.04, 0.04),
    *,
    role: str = "manipulated",
    mass_kg: float = 0.12,
    pos: tuple[float, float, float] = (0.0, 0.0, 0.02),
    quat: tuple[float, float, float, float] = UPRIGHT,
    hollow: bool = False,
    mesh: str = "",
) -> SceneObject:
    pose = tuple(float(v) for v in (*pos, *quat))
    return SceneObject(
        name=name,
        label=name,
        role=role,
        shape=shape,
        size_m=size_m,
        mass_kg=mass_kg,
        friction=0.8,
        hollow=hollow,
        mesh=mesh,
        frames=(0, 10),
        poses_world=(pose, pose),
        confidences=(1.0, 1.0),
    )


def scene_of(*objects: SceneObject, kind: str = "lift_up", folder: Path | None = None) -> Scene:
    camera = Camera(
        width_px=64,
        height_px=48,
        K=np.array([[60.0, 0, 32], [0, 60.0, 24], [0, 0, 1]]),
        T_world_cam=np.eye(4),
    )
    return Scene(
        title="test",
        video="test.mp4",
        description="lifting a cube",
        kind=kind,
        objects=objects,
        camera=camera,
        fps=20.0,
        num_frames=11,
        confidence=1.0,
        folder=folder or Path(),
    )


class LiftTask(Task):
    """Success 10 cm above the start; the reward is the height, and a part of it that is always 1."""

    def compute_success(self, states: dict[str, torch.Tensor]) -> torch.Tensor:
        return states["cube_pos"][:, 2] > states["cube_start_pos"][:, 2] + 0.10

    def compute_reward(
        self, actions: torch.Tensor, states: dict[str, torch.Tensor]
    ) -> tuple[torch.Tensor, dict[str, torch.Tensor]]:
        height = states["cube_pos"][:, 2] - states["cube_start_pos"][:, 2]
        return height + 1, {"height": height, "alive": torch.ones_like(height)}


@pytest.fixture
def make_object() -> Callable[..., SceneObject]:
    return scene_object


@pytest.fixture
def make_scene() -> Callable[..., Scene]:
    return scene_of


@pytest.fixture
def make_bundle() -> Callable[..., TaskBundle]:
    def make(
        *objects: SceneObject, kind: str = "lift_up", horizon: int = 60, folder: Path | None = None
    ) -> TaskBundle:
        scene = scene_of(*(objects or (scene_object(),)), kind=kind, folder=folder)
        return TaskBundle(
            title="test",
            description=scene.description,
            kind=kind,
            class_name="LiftTask",
            code="",
            scene=scene,
            horizon_steps=horizon,
        )

    return make


@pytest.fixture
def lift_task() -> type[Task]:
    return LiftTask

"""A task an expert can be scripted for: bring the open gripper to the left of where it was."""

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import torch

from v2p_data.episodes.collect import EpisodesConfig, collect
from v2p_data.episodes.rollouts import Lesson, Referee
from v2p_data.geometry.camera import Camera
from v2p_data.play import Actor, StateActor
from v2p_data.scene.scene import Scene, SceneObject
from v2p_data.task.task import Task, TaskBundle

POSE = (0.0, 0.0, 0.02, 1.0, 0.0, 0.0, 0.0)


class PushTask(Task):
    """Done while the tool is 8 cm to the left of the middle, above a cube's side of the table."""

    def compute_success(self, states: dict[str, torch.Tensor]) -> torch.Tensor:
        return (states["eef_pos"][:, 1] > 0.08) & (states["cube_pos"][:, 0] < 0.55)

    def compute_reward(
        self, actions: torch.Tensor, states: dict[str, torch.Tensor]
    ) -> tuple[torch.Tensor, dict[str, torch.Tensor]]:
        left = states["eef_pos"][:, 1]
        return left, {"left": left}


def bundle() -> TaskBundle:
    cube = SceneObject(
        name="cube",
        label="cube",
        role="manipulated",
        shape="box",
        size_m=(0.04, 0.04, 0.04),
        mass_kg=0.1,
        friction=0.8,
        frames=(0,),
        poses_world=(POSE,),
        confidences=(1.0,),
    )
    scene = Scene(
        title="toy",
        video="toy.mp4",
        description="pushing a cube",
        kind="push_left",
        objects=(cube,),
        camera=Camera(width_px=64, height_px=48, K=np.eye(3), T_world_cam=np.eye(4)),
        fps=20.0,
        num_frames=2,
        confidence=1.0,
    )
    return TaskBundle(
        title="toy",
        description="push the cube to the left",
        kind="push_left",
        class_name="PushTask",
        code="",
        scene=scene,
        horizon_steps=30,
    )


def act(obs: np.ndarray) -> np.ndarray:
    """Go left at a speed that depends on what is seen, so that worlds differ."""
    action = np.zeros((len(obs), 7), np.float32)
    action[:, 1] = np.clip(0.5 + 0.1 * obs[:, 1] + 2 * (obs[:, 1] < 0.3), -1, 0.9)
    return action


def agree(_: object, trajectory: Mapping[str, np.ndarray]) -> np.ndarray:
    return np.ones(trajectory["eef_pos"].shape[1], bool)


def lesson(expert: Actor, referee: Referee | None = agree) -> Lesson:
    return Lesson(bundle=bundle(), expert=expert, task=PushTask, referee=referee)


def collect_toys(out: Path, cfg: EpisodesConfig, num_threads: int = 1) -> dict[str, Any]:
    return collect(lesson(StateActor(act)), cfg, out, 11, num_threads=num_threads)

"""The interface of task code, as printed in the paper's appendix, and the folder a finished task lives in.

Task code is a Python text with six parts: scene information, `reset_objects_states`, `compute_success`,
`compute_observation_key`, `get_observation_space`, and `compute_reward` with a module-level
`reward_function`. It sees the world only through `states`: a dict of batched float32 torch tensors on one
device, whose keys `states_table` lists.
"""

import json
import shutil
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from typing import Any, Protocol, runtime_checkable

import torch

from v2p_data.errors import V2PError
from v2p_data.scene.scene import Scene

TASK_FILE = "task.json"
CODE_FILE = "task.py"
SCENE_FOLDER = "scene"
BASE_OBSERVATION_DIM = 90
"""Length of `states['base_observation']`, the same for every task so that experts can warm-start each other."""

POLICY_HORIZON_SCALE = 2.0
"""A policy gets this multiple of the task's horizon: experts need about half of theirs, the paper gives 300 steps."""

ROBOT_STATES = {
    "eef_pos": ("(env, 3)", "m", "gripper's tool centre point, world frame"),
    "eef_quat": ("(env, 4)", "wxyz", "orientation of the gripper, world frame"),
    "eef_vel_linear": ("(env, 3)", "m/s", "velocity of the tool centre point, world frame"),
    "eef_vel_angular": ("(env, 3)", "rad/s", "angular velocity of the gripper, world frame"),
    "gripper_width": ("(env,)", "m", "distance between the pads: 0 closed, 0.085 open"),
    "table_height": ("(env,)", "m", "height of the table top, world frame"),
    "progress": ("(env,)", "1", "share of the episode that has passed, 0 to 1"),
    "base_observation": (f"(env, {BASE_OBSERVATION_DIM})", "scaled", "what every policy sees"),
}
OBJECT_STATES = {
    "pos": ("(env, 3)", "m", "centre of the object's bounding box, world frame"),
    "quat": ("(env, 4)", "wxyz", "orientation, world frame"),
    "vel_linear": ("(env, 3)", "m/s", "velocity of the centre, world frame"),
    "vel_angular": ("(env, 3)", "rad/s", "angular velocity, world frame"),
    "size": ("(env, 3)", "m", "full extents along the object's own axes"),
    "start_pos": ("(env, 3)", "m", "`pos` at the start of the episode"),
    "start_quat": ("(env, 4)", "wxyz", "`quat` at the start of the episode"),
    "up": (
        "(env,)",
        "1",
        "cosine between the object's own z axis and world up: 1 upright, 0 on its side",
    ),
    "grasped": (
        "(env,)",
        "0 or 1",
        "both pads touch the object, and the gripper is not fully open",
    ),
    "touched": ("(env,)", "0 or 1", "at least one pad touches the object"),
}


def states_table(object_names: list[str]) -> str:
    """Return every key of `states` with shape, unit and meaning, as Markdown."""
    lines = ["| key | shape | unit | meaning |", "|---|---|---|---|"]
    lines += [f"| `{k}` | {s} | {u} | {m} |" for k, (s, u, m) in ROBOT_STATES.items()]
    for name in object_names:
        lines += [f"| `{name}_{k}` | {s} | {u} | {m} |" for k, (s, u, m) in OBJECT_STATES.items()]
    return "\n".join(lines)


@runtime_checkable
class Placer(Protocol):
    """What task code may ask of the environment at a reset."""

    @property
    def num_envs(self) -> int: ...

    def sample_object_poses(self, env_ids: torch.Tensor) -> dict[str, torch.Tensor]:
        """Return per object `(n, 7)` poses `[x, y, z, qw, qx, qy, qz]`: resting on the table, apart from each other."""
        ...


class Task:
    """Base class of task code (the paper's `factory.tasks.task.Task`).

    Args:
        envs: the batched environment, of which task code sees `num_envs` and `sample_object_poses`.
        urdf_assets_root: folder of the object files; kept for the paper's signature.
        scene_info: the task JSON as a dict.
    """

    def __init__(self, envs: Placer, urdf_assets_root: str, scene_info: dict[str, Any]) -> None:
        self.envs = envs
        self.urdf_assets_root = urdf_assets_root
        self.scene_info = scene_info
        self.task_description = ""

    def reset_objects_states(self, env_ids: torch.Tensor) -> dict[str, torch.Tensor]:
        """Return the objects' poses `(n, 7)` for the environments that start anew."""
        return self.envs.sample_object_poses(env_ids)

    def compute_observation_key(self, states: dict[str, torch.Tensor]) -> list[str]:
        """Return the keys that make up the observation, in order; may add entries to `states`."""
        return ["base_observation"]

    def get_observation_space(self) -> int:
        """Return the length of the observation."""
        return BASE_OBSERVATION_DIM

    def compute_success(self, states: dict[str, torch.Tensor]) -> torch.Tensor:
        """Return a bool per environment."""
        raise NotImplementedError

    def compute_reward(
        self, actions: torch.Tensor, states: dict[str, torch.Tensor]
    ) -> tuple[torch.Tensor, dict[str, torch.Tensor]]:
        """Return the reward per environment and its named components."""
        raise NotImplementedError


@dataclass(frozen=True, kw_only=True)
class TaskBundle:
    """A task as it lies on disk: code, audit and a copy of its scene; a simulator needs nothing else."""

    title: str
    description: str
    """The caption; the episodes' language instruction."""
    kind: str
    class_name: str
    code: str
    scene: Scene
    horizon_steps: int = 100
    """Control steps (20 Hz) until an episode is cut off."""
    motion_scale: float = 1.0
    """How much further than usual an action moves the gripper's target: throwing needs speed."""
    robot: dict[str, Any] = field(default_factory=dict[str, Any])
    """Another arm than the built-in one: the fields of `sim.arms.RobotConfig`."""
    audit: dict[str, Any] = field(default_factory=dict[str, Any])
    folder: Path = Path()

    def policy_steps(self, scale: float = POLICY_HORIZON_SCALE) -> int:
        """Return how many control steps a policy gets: this multiple of the task's own horizon."""
        return max(1, round(scale * self.horizon_steps))

    def save(self, folder: Path) -> None:
        """Write the task and copy its scene's files."""
        shutil.copytree(
            self.scene.folder,
            folder / SCENE_FOLDER,
            ignore=shutil.ignore_patterns("record.json", "*.mp4", "*.partial"),
        )
        (folder / CODE_FILE).write_text(self.code)
        data = {
            k: v
            for k, v in asdict(replace(self, scene=replace(self.scene, folder=Path()))).items()
            if k not in {"scene", "folder", "code"}
        }
        (folder / TASK_FILE).write_text(json.dumps(data, indent=1))

    @staticmethod
    def load(folder: Path) -> "TaskBundle":
        """Read a task folder.

        Raises:
            V2PError: it holds no task.
        """
        path = folder / TASK_FILE
        if not path.is_file():
            raise V2PError(
                f"{folder} holds no {TASK_FILE}: it is no task; make one with 'v2p task'"
            )
        return TaskBundle(
            **json.loads(path.read_text()),
            code=(folder / CODE_FILE).read_text(),
            scene=Scene.load(folder / SCENE_FOLDER),
            folder=folder,
        )

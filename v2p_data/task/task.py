"""The interface of task code, as printed in the paper's appendix, and the folder a finished task lives in.

Task code is a Python text with six parts: scene information, `reset_objects_states`, `compute_success`,
`compute_observation_key`, `get_observation_space`, and `compute_reward` with a module-level
`reward_function`. It sees the world only through `states`: a dict of batched float32 torch tensors on one
device, whose keys `states_table` lists.
"""

import json
import os
import shutil
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path, PurePosixPath
from typing import Any, Protocol, runtime_checkable

import torch

from v2p_data.errors import ItemRejectedError, V2PError
from v2p_data.kinds import Kind, kind_named
from v2p_data.scene.files import copy_folder, own_file, read_own_text
from v2p_data.scene.scene import SCENE_FILE, Scene, SceneObject

TASK_FILE = "task.json"
CODE_FILE = "task.py"
SCENE_FOLDER = "scene"
REWARD_SEARCH_FOLDER = "search"
"""What was tried to find the reward, where it was searched."""
BASE_OBSERVATION_DIM = 90
"""Length of `states['base_observation']`, the same for every task so that experts can warm-start each other."""

FULL_REWARD = 100.0
"""What a task's reward is written to add up to just before success; values are divided by it in training."""
MAX_REWARD = 100 * FULL_REWARD
"""A reward beyond this, either way, is a fault: beside it neither success nor any other part counts."""

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
    kind: Kind
    class_name: str
    code: str
    scene: Scene
    horizon_steps: int = 100
    """Control steps (20 Hz) until an episode is cut off."""
    motion_scale: float = 1.0
    """How much further than usual an action moves the gripper's target: throwing needs speed."""
    robot: dict[str, Any] = field(default_factory=dict[str, Any])
    """Another arm than the built-in one: the fields of `sim.arms.RobotConfig`; on disk its path is in `robot/`."""
    audit: dict[str, Any] = field(default_factory=dict[str, Any])
    folder: Path = Path()

    def policy_steps(self, scale: float = POLICY_HORIZON_SCALE) -> int:
        """Return how many control steps a policy gets: this multiple of the task's own horizon."""
        return max(1, round(scale * self.horizon_steps))

    def save(self, folder: Path) -> None:
        """Write the task and copy its scene's files and its robot's.

        Raises:
            V2PError: the scene's folder holds links, or the robot is not described as it should be.
        """
        from v2p_data.task.robot_files import ROBOT_FOLDER, copy_robot

        place = folder / SCENE_FOLDER
        if self.scene.folder == Path() and not Path(SCENE_FILE).is_file():
            place.mkdir(
                parents=True
            )  # never on disk: the folder without a name is where the process runs
            self.scene.save(place)
        else:
            left_out = shutil.ignore_patterns("record.json", "*.mp4", "*.partial")
            copy_folder(self.scene.folder, place, ignore=left_out)
        robot = self.robot
        if robot:
            main = copy_robot(Path(robot["path"]), folder / ROBOT_FOLDER)
            robot = {**robot, "path": str(PurePosixPath(ROBOT_FOLDER) / main)}
        (folder / CODE_FILE).write_text(self.code, encoding="utf-8")
        data = {
            k: v
            for k, v in asdict(replace(self, scene=replace(self.scene, folder=Path()))).items()
            if k not in {"scene", "folder", "code"}
        }
        (folder / TASK_FILE).write_text(
            json.dumps({**data, "robot": robot}, indent=1), encoding="utf-8"
        )

    @staticmethod
    def load(folder: Path) -> "TaskBundle":
        """Read a task folder, whoever made it; nothing outside of it is read, and none of its code is run.

        Raises:
            V2PError: it holds no task, or something that a task may not hold.
        """
        from v2p_data.task.schema import MAX_CODE_BYTES, read_task_file

        if not (folder / TASK_FILE).exists():
            raise V2PError(
                f"{folder} holds no {TASK_FILE}: it is no task; make one with 'v2p task'"
            )
        if (folder / SCENE_FOLDER).is_symlink():
            raise V2PError(
                f"{folder / SCENE_FOLDER} is a link; a task folder holds its scene itself"
            )
        read = read_task_file(folder, TASK_FILE)
        robot = read.robot.model_dump()
        if robot:
            robot["path"] = str(_own_robot(folder, robot["path"]))
        return TaskBundle(
            title=read.title,
            description=read.description,
            kind=kind_named(read.kind, str(folder / TASK_FILE)),
            class_name=read.class_name,
            horizon_steps=read.horizon_steps,
            motion_scale=read.motion_scale,
            robot=robot,
            audit=read.audit.model_dump(mode="json"),
            code=read_own_text(folder, CODE_FILE, MAX_CODE_BYTES),
            scene=Scene.load(folder / SCENE_FOLDER),
            folder=folder if folder != Path() else Path.cwd(),
        )

    def files(self) -> list[str]:
        """Return the files that it consists of, relative to its folder: what others need to run it."""
        scene = [o for thing in self.scene.objects for o in _files_of(thing)]
        there = [name for name in dict.fromkeys(scene) if (self.scene.folder / name).exists()]
        return [TASK_FILE, CODE_FILE, f"{SCENE_FOLDER}/{SCENE_FILE}"] + [
            f"{SCENE_FOLDER}/{name}" for name in there
        ]

    def paths(self) -> list[Path]:
        """Return where these files lie, and those of another arm than the built-in one."""
        from v2p_data.task.robot_files import robot_files

        arm = robot_files(Path(self.robot["path"])) if self.robot else []
        return [*(self.folder / name for name in self.files()), *arm]


@contextmanager
def errors_naming(folder: Path) -> Iterator[None]:
    """Let every error of what is done with a task begin with its folder."""
    try:
        yield
    except ItemRejectedError as error:
        if str(folder) in error.detail:
            raise
        raise ItemRejectedError(
            error.reason, f"task {folder}: {error.detail}", error.value
        ) from error
    except V2PError as error:
        if str(folder) in str(error):
            raise
        raise V2PError(f"task {folder}: {error}") from error


def _own_robot(folder: Path, path: str) -> Path:
    """Return a task's own robot file; all that it names must be plain files in the task's folder."""
    from v2p_data.task.robot_files import MAX_FILE_BYTES, ROBOT_FOLDER, robot_files

    main = own_file(folder, path, MAX_FILE_BYTES)
    root = Path(os.path.abspath(folder))  # noqa: PTH100 - links are looked for below
    for file in robot_files(main, root / ROBOT_FOLDER):
        own_file(root, str(PurePosixPath(file.relative_to(root))), MAX_FILE_BYTES)
    return main


def _files_of(thing: SceneObject) -> tuple[str, ...]:
    named = (thing.mesh, thing.mesh_ply, thing.urdf, thing.mjcf, *thing.parts)
    return tuple(name for name in named if name)

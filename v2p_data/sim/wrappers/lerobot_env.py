"""Tasks as a LeRobot environment, `--env.type=v2p --env.tasks=FOLDER`.

The folder is one task, a folder of tasks (a run's `task/`), or a dataset that carries its tasks. LeRobot then
knows them as suite `v2p`, tasks 0, 1, ... in the order of their folders' names.
"""

from collections.abc import Callable
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from typing import Any, cast, get_args

import gymnasium as gym
from lerobot.configs import FeatureType, PolicyFeature
from lerobot.envs import EnvConfig
from lerobot.envs.utils import freeze_after_episode_end
from lerobot.utils.constants import ACTION, OBS_IMAGES, OBS_STATE

from v2p_data.errors import V2PError
from v2p_data.json_files import json_or_none
from v2p_data.sim.render.masks import MASK_CAMERAS, RGB_CAMERA, has_opengl
from v2p_data.sim.robot.action_names import Actions, action_names, actions_named
from v2p_data.sim.robot.robot import NUM_ARM_JOINTS
from v2p_data.sim.wrappers.gym_env import CONTROL_HZ, STATE_LOW, V2PEnv
from v2p_data.task.sandbox.trial import demand_trial
from v2p_data.task.task import POLICY_HORIZON_SCALE, TASK_FILE, TaskBundle, errors_naming

TASKS_IN_DATASET = Path("v2p/tasks")


def find_tasks(folder: Path) -> list[Path]:
    """Return the task folders that `folder` is, or holds.

    Raises:
        V2PError: there is none.
    """
    if (folder / TASK_FILE).is_file():
        return [folder]
    for place in (folder, folder / TASKS_IN_DATASET):
        tasks = [
            path.parent
            for path in sorted(place.glob(f"*/{TASK_FILE}"))
            if path.parent.suffix != ".partial"
        ]
        if tasks:
            return tasks
    raise V2PError(
        f"no task in '{folder}': neither it nor a folder in it holds a {TASK_FILE};"
        " make one with 'v2p task', or point --env.tasks at a dataset that carries its tasks"
    )


def names_of_tasks(folder: Path, key: str) -> tuple[str, ...]:
    """Return the names of the entries of `action` or `observation.state` in the dataset that carries these tasks.

    Nothing where they lie in no dataset of ours.
    """
    for root in (folder, *folder.absolute().parents[:3]):
        if (root / TASKS_IN_DATASET).is_dir():
            info = json_or_none(root / "meta/info.json")
            features = info.get("features") if isinstance(info, dict) else None
            columns = features if isinstance(features, dict) else {}
            names = {k: f.get("names") for k, f in columns.items() if isinstance(f, dict)}
            return tuple(names.get(key) or ()) if actions_named(names.get(ACTION)) else ()
    return ()


@EnvConfig.register_subclass("v2p")
@dataclass
class V2PEnvConfig(EnvConfig):
    """Simulated tasks. LeRobot parses and fills this config, so it is neither frozen nor keyword-only."""

    tasks: str = ""
    """A task folder, a folder of task folders, or a dataset that carries its tasks."""
    fps: int = CONTROL_HZ
    size_px: int = 256
    """Width and height of the mask."""
    camera_pos_m: float = 0.0
    """How far the camera is moved at each reset; see `RandomizationConfig`, as the next two."""
    camera_angle_rad: float = 0.0
    camera_fovy_deg: float = 0.0
    horizon_scale: float = POLICY_HORIZON_SCALE
    """An episode lasts at most this multiple of the task's own horizon."""
    wrist: bool = True
    """Masks of the camera that the hand carries too, for policies trained on datasets of `--episodes.wrist`."""
    rgb: bool | None = None
    """Colour pictures too; by default where there is OpenGL."""
    actions: str = ""
    """What an action says: `delta_tool`, `absolute_tool` or `joints`; by default as in the dataset
    that carries the tasks."""
    joint_state: bool = False
    """Add the angles of the arm's joints to the state. A dataset that was made with
    `--episodes.joint-state` and carries the tasks turns this on."""
    features: dict[str, PolicyFeature] = field(default_factory=dict)
    features_map: dict[str, str] = field(
        default_factory=lambda: {
            ACTION: ACTION,
            "agent_pos": OBS_STATE,
        }
    )

    def __post_init__(self) -> None:
        told, states = (
            names_of_tasks(Path(self.tasks), key) if self.tasks else ()
            for key in (ACTION, OBS_STATE)
        )
        num_joints = max(0, len(states) - len(STATE_LOW))
        self.joint_state = self.joint_state or num_joints > 0
        if self.joint_state:
            num_joints = num_joints or NUM_ARM_JOINTS
        self.actions = self.actions or actions_named(told) or "delta_tool"
        if self.actions not in get_args(Actions):
            raise V2PError(
                f"--env.actions is {', '.join(get_args(Actions))}, got '{self.actions}'"
            )
        names = (
            told
            if actions_named(told) == self.actions
            else action_names(cast(Actions, self.actions))
        )
        mask = PolicyFeature(FeatureType.VISUAL, (self.size_px, self.size_px, 3))
        self.features = {
            ACTION: PolicyFeature(FeatureType.ACTION, (len(names),)),
            "agent_pos": PolicyFeature(FeatureType.STATE, (len(STATE_LOW) + num_joints,)),
        }
        self.rgb = has_opengl() if self.rgb is None else self.rgb
        for camera in (*MASK_CAMERAS[: 1 + self.wrist], *([RGB_CAMERA] if self.rgb else [])):
            self.features[f"pixels/{camera}"] = mask
            self.features_map[f"pixels/{camera}"] = f"{OBS_IMAGES}.{camera}"

    @property
    def gym_kwargs(self) -> dict[str, Any]:
        return {
            "size_px": self.size_px,
            "camera_pos_m": self.camera_pos_m,
            "camera_angle_rad": self.camera_angle_rad,
            "camera_fovy_deg": self.camera_fovy_deg,
            "horizon_scale": self.horizon_scale,
            "wrist": self.wrist,
            "rgb": self.rgb,
            "actions": self.actions,
            "joint_state": self.joint_state,
        }

    def create_envs(
        self, n_envs: int, use_async_envs: bool = False
    ) -> dict[str, dict[int, gym.vector.VectorEnv]]:
        """Return `{"v2p": {index: environments of that task}}`; finished ones cost nothing more."""
        if not self.tasks:
            raise V2PError("say which tasks: --env.tasks=FOLDER")
        folders = find_tasks(Path(self.tasks))
        for folder in folders:  # once here, and not in every process of a vector
            with errors_naming(folder):
                demand_trial(TaskBundle.load(folder))
        return {
            "v2p": {
                index: _vector_env(folder, n_envs, use_async_envs, self.gym_kwargs)
                for index, folder in enumerate(folders)
            }
        }


def environment_maker(folder: Path, gym_kwargs: dict[str, Any]) -> Callable[[], gym.Env[Any, Any]]:
    """Return a function that makes the task's environment; it can be sent to another process."""
    return freeze_after_episode_end(partial(V2PEnv, str(folder), **gym_kwargs))


def _vector_env(
    folder: Path, n_envs: int, use_async_envs: bool, gym_kwargs: dict[str, Any]
) -> gym.vector.VectorEnv:
    makers = [environment_maker(folder, gym_kwargs)] * n_envs
    mode = gym.vector.AutoresetMode.SAME_STEP
    if use_async_envs and n_envs > 1:
        # A fork server listens at a path below TMPDIR, of 108 bytes at most.
        return gym.vector.AsyncVectorEnv(makers, context="spawn", autoreset_mode=mode)
    return gym.vector.SyncVectorEnv(makers, autoreset_mode=mode)

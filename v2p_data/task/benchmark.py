"""The twelve tasks of the paper as scenes without a video, for measuring: `paper_tasks/<task>.yaml`.

A file says what a video would: the caption, the objects with their sizes, and the way each took. The task code
beside it (`<task>.py`) is the reference; without one, the templates' first sample is taken.
"""

from pathlib import Path
from typing import Any

import numpy as np
import yaml
from scipy.spatial.transform import Rotation

from v2p_data.errors import V2PError, did_you_mean
from v2p_data.geometry.camera import Camera
from v2p_data.kinds import KINDS, kind_named
from v2p_data.scene.scene import Scene, SceneObject
from v2p_data.task.generate import TaskConfig
from v2p_data.task.sandbox.sandbox import class_name
from v2p_data.task.task import TaskBundle
from v2p_data.task.templates.write import write_samples

FOLDER = Path(__file__).parent / "paper_tasks"
FPS = 20.0


def benchmark_names(folder: Path = FOLDER) -> list[str]:
    """Return the names of all benchmark tasks."""
    return sorted(path.stem for path in folder.glob("*.yaml"))


def load_benchmark(name: str, folder: Path = FOLDER) -> TaskBundle:
    """Return one benchmark task.

    Raises:
        V2PError: there is no such task, or its file is wrong.
    """
    path = folder / f"{name}.yaml"
    if not path.is_file():
        known = benchmark_names(folder)
        raise V2PError(
            f"there is no benchmark task '{name}' in {folder}.{did_you_mean(name, known)}"
        )
    try:
        scene = _scene(name, yaml.safe_load(path.read_text(encoding="utf-8")))
    except (KeyError, TypeError, ValueError, yaml.YAMLError) as error:
        words = " ".join(str(error).split())
        raise V2PError(f"{path} is no benchmark task: {type(error).__name__}: {words}") from error
    reference = path.with_suffix(".py")
    return task_of(scene, reference.read_text(encoding="utf-8") if reference.is_file() else "")


def task_of(scene: Scene, code: str = "") -> TaskBundle:
    """Return the task of a scene, by its own code or else by the templates' first sample."""
    code = code or write_samples(scene, 1)[0]
    return TaskBundle(
        title=scene.title,
        description=scene.description,
        kind=scene.kind,
        class_name=class_name(code),
        code=code,
        scene=scene,
        horizon_steps=KINDS[scene.kind].horizon_steps or TaskConfig().horizon_steps,
        motion_scale=KINDS[scene.kind].motion_scale,
    )


def _scene(name: str, data: Any) -> Scene:
    if not isinstance(data, dict):
        raise TypeError(f"need a mapping with description, kind and objects, got {data!r}")
    objects = tuple(_object(**entry) for entry in data["objects"])
    if not objects:
        raise ValueError("objects is empty; name at least the manipulated one")
    return Scene(
        title=name,
        video=f"{name}.mp4",
        description=data["description"],
        kind=kind_named(data["kind"], name),
        objects=objects,
        camera=Camera(
            width_px=640,
            height_px=480,
            K=np.array([[600.0, 0.0, 320.0], [0.0, 600.0, 240.0], [0.0, 0.0, 1.0]]),
            T_world_cam=np.eye(4),
        ),
        fps=FPS,
        num_frames=max(len(o.poses_world) for o in objects),
        confidence=1.0,
    )


def _object(
    *,
    name: str,
    shape: str,
    size_m: list[float],
    mass_kg: float,
    friction: float,
    path: list[list[float]],
    role: str = "manipulated",
    hollow: bool = False,
    ends_on_side: bool = False,
) -> SceneObject:
    if len(size_m) != 3 or isinstance(size_m, str):
        raise ValueError(f"size_m of '{name}' must be three lengths, got {size_m!r}")
    if not path or any(not 2 <= len(point) <= 4 for point in path):
        raise ValueError(
            f"path of '{name}' must list points [x, y, z, yaw] (the last two may be left out), got {path!r}"
        )
    poses = [_pose(point, size_m[2]) for point in path]
    if ends_on_side:
        poses[-1] = (*poses[-1][:3], *_quat(Rotation.from_euler("x", -np.pi / 2)))
    return SceneObject(
        name=name,
        label=name.replace("_", " "),
        role=role,  # pyright: ignore[reportArgumentType]
        shape=shape,  # pyright: ignore[reportArgumentType]
        size_m=(float(size_m[0]), float(size_m[1]), float(size_m[2])),
        mass_kg=float(mass_kg),
        friction=float(friction),
        hollow=hollow,
        frames=tuple(range(len(poses))),
        poses_world=tuple(poses),
        confidences=(1.0,) * len(poses),
        source={"size": "benchmark", "mass": "benchmark", "friction": "benchmark"},
    )


def _pose(point: list[float], height_m: float) -> tuple[float, ...]:
    """Return a pose from x, y and, if given, the height above the table's rest pose and the yaw."""
    x, y, z, yaw = [*point, *[0.0] * (4 - len(point))]
    return (x, y, height_m / 2 + z, *_quat(Rotation.from_euler("z", yaw)))


def _quat(rotation: Rotation) -> tuple[float, ...]:
    return tuple(float(v) for v in rotation.as_quat(canonical=True, scalar_first=True))

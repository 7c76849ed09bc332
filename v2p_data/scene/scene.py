"""What was understood from a video: the paper's task JSON, with its files beside it.

The scene's world frame lies on the table: origin under the manipulated object's first position, +z up,
+x away from the camera along the table, +y to the left in the picture. The robot stands at the camera's
side, so the same words (left, right, in front of) mean the same in the video and in the simulator.
"""

import json
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from typing import Any, Literal

import numpy as np
from jaxtyping import Float

from v2p_data.errors import V2PError
from v2p_data.geometry.camera import Camera

Role = Literal["manipulated", "reference", "tool", "container", "cover"]
Shape = Literal["box", "cylinder", "sphere", "mesh"]
Symmetry = Literal["none", "box", "round", "sphere"]
Observed = Literal["full", "no_depth"]
SCENE_FILE = "scene.json"
SCHEMA = 1
FLOOR_MIN_M = 0.006
"""Through thinner floors hard-pressed objects were pushed into the table."""
FLOOR_MAX_M = 0.02


@dataclass(frozen=True, kw_only=True)
class SceneObject:
    """One object: what it is, how large, and where it was in the video."""

    name: str
    """Identifier, unique in the scene, that task code uses: states have `<name>_pos` and so on."""
    label: str
    """The words of the caption."""
    role: Role
    shape: Shape
    """A primitive when it fits within tolerance, else `mesh` (its convex hull collides)."""
    size_m: tuple[float, float, float]
    """Full extents along the object's own x, y, z. Cylinders: (diameter, diameter, height), axis z."""
    mass_kg: float
    friction: float
    hollow: bool = False
    """Open at the top: a bowl, a cup, a box without a lid."""
    mesh: str = ""
    """OBJ file, relative to the scene folder, centred on its bounding box, in metres."""
    urdf: str = ""
    rgba: tuple[float, float, float, float] = (0.8, 0.4, 0.2, 1.0)
    """Mean colour in the video."""
    source: dict[str, str] = field(default_factory=dict[str, str])
    """Where size, mass and friction come from, in words."""
    frames: tuple[int, ...] = ()
    """Video frames with a pose, first and last at least."""
    poses_world: tuple[tuple[float, ...], ...] = ()
    """Per frame `[x, y, z, qw, qx, qy, qz]` of the object's centre [m]."""
    confidences: tuple[float, ...] = ()
    """Per frame, 0 to 1."""

    @property
    def first_pose(self) -> Float[np.ndarray, "7"]:
        return np.asarray(self.poses_world[0], float)

    @property
    def last_pose(self) -> Float[np.ndarray, "7"]:
        return np.asarray(self.poses_world[-1], float)


def hollow_floor_m(height_m: Float[np.ndarray, "*n"]) -> Float[np.ndarray, "*n"]:
    """Return how thick the floor of a hollow object is simulated, given its height [m]."""
    return np.clip(0.2 * height_m, FLOOR_MIN_M, FLOOR_MAX_M)


@dataclass(frozen=True, kw_only=True)
class Scene:
    """One video's scene. Files named in it are relative to the folder that holds `scene.json`."""

    title: str
    """Slug of the video's name."""
    video: str
    """The video's file name."""
    description: str
    """The caption."""
    kind: str
    """Task kind the caption names, e.g. `lift_up`; `generic` when it names none (see task/kinds.py)."""
    objects: tuple[SceneObject, ...]
    """The manipulated object first."""
    camera: Camera
    fps: float
    num_frames: int
    confidence: float
    """0 to 1; below the gate a scene is rejected."""
    warnings: tuple[str, ...] = ()
    folder: Path = Path()
    """Where the files are; set on load, never saved."""

    @property
    def manipulated(self) -> SceneObject:
        return self.objects[0]

    @property
    def others(self) -> tuple[SceneObject, ...]:
        return self.objects[1:]

    def object(self, name: str) -> SceneObject:
        """Return the object with this name.

        Raises:
            V2PError: no such object.
        """
        for candidate in self.objects:
            if candidate.name == name:
                return candidate
        known = ", ".join(o.name for o in self.objects)
        raise V2PError(f"scene '{self.title}' has no object '{name}'; it has {known}")

    def save(self, folder: Path) -> None:
        """Write `scene.json`; meshes and URDFs are written by their makers."""
        data = asdict(replace(self, folder=Path()))
        del data["folder"]
        data["camera"] = {
            "width_px": self.camera.width_px,
            "height_px": self.camera.height_px,
            "K": self.camera.K.tolist(),
            "T_world_cam": self.camera.T_world_cam.tolist(),
        }
        data["schema"] = SCHEMA
        (folder / SCENE_FILE).write_text(json.dumps(data, indent=1))

    @staticmethod
    def load(folder: Path) -> "Scene":
        """Read `folder/scene.json`.

        Raises:
            V2PError: there is none, or it was written by another version.
        """
        path = folder / SCENE_FILE
        if not path.is_file():
            raise V2PError(
                f"{folder} holds no {SCENE_FILE}: it is no scene; make one with 'v2p scene'"
            )
        data: dict[str, Any] = json.loads(path.read_text())
        if data.pop("schema", None) != SCHEMA:
            raise V2PError(f"{path} was written by another version; remake it with 'v2p scene'")
        camera = data.pop("camera")
        objects = tuple(
            SceneObject(
                **{
                    **o,
                    "size_m": tuple(o["size_m"]),
                    "rgba": tuple(o["rgba"]),
                    "frames": tuple(o["frames"]),
                    "poses_world": tuple(tuple(p) for p in o["poses_world"]),
                    "confidences": tuple(o["confidences"]),
                }
            )
            for o in data.pop("objects")
        )
        return Scene(
            **{**data, "warnings": tuple(data["warnings"])},
            objects=objects,
            camera=Camera(
                width_px=camera["width_px"],
                height_px=camera["height_px"],
                K=np.array(camera["K"], float),
                T_world_cam=np.array(camera["T_world_cam"], float),
            ),
            folder=folder,
        )

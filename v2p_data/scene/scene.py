"""What was understood from a video: the paper's task JSON, with its files beside it.

The scene's world frame lies on the table: origin under the manipulated object's first position, +z up,
+x away from the camera along the table, +y to the left in the picture. The robot stands at the camera's
side, so the same words (left, right, in front of) mean the same in the video and in the simulator.
"""

import json
import zipfile
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from typing import Annotated, Literal

import numpy as np
from annotated_types import Ge, Gt, Le, Len
from jaxtyping import Bool, Float
from pydantic import AfterValidator, Field, StringConstraints
from scipy.spatial.transform import Rotation

from v2p_data.errors import V2PError
from v2p_data.geometry.camera import Camera
from v2p_data.kinds import Kind, kind_named
from v2p_data.scene.files import own_file, read_own
from v2p_data.scene.schema import (
    MAX_FILE_BYTES,
    STRICT,
    Count,
    Entry,
    FileModel,
    Length,
    MeshPath,
    Name,
    Observed,
    Place,
    Pose,
    Role,
    Row4,
    Shape,
    Share,
    Slug,
    Symmetry,
    Vector,
    Words,
    of_unit_length,
    parsed,
    path_of_kind,
)

SCENE_FILE = "scene.json"
SCHEMA = 2
GRAVITY_M_S2 = (0.0, 0.0, -9.81)
FLOOR_MIN_M = 0.006
"""Through thinner floors hard-pressed objects were pushed into the table."""
FLOOR_MAX_M = 0.02
MAX_SCENE_BYTES = 32_000_000
"""An hour of two objects at 10 Hz."""
MAX_OBJECTS = 20
MAX_PARTS = 128
"""Most parts of one object."""
MAX_SCENE_PARTS = 512
"""Most parts of all objects together; MuJoCo gets each in seven sizes."""
MAX_FRAMES = 50_000
MAX_MASKS_BYTES = 1_000_000_000
"""Largest unpacked mask track: an hour at 10 Hz, one bit per pixel."""


@dataclass(frozen=True, kw_only=True)
class Plane:
    """All points p of the world frame with normal · p = offset."""

    __pydantic_config__ = STRICT
    normal: Annotated[tuple[float, float, float], AfterValidator(of_unit_length)] = (0.0, 0.0, 1.0)
    """Unit vector."""
    offset_m: Place = 0.0


@dataclass(frozen=True, kw_only=True)
class StageConfidence:
    """How sure one stage of the reconstruction is."""

    __pydantic_config__ = STRICT
    value: Share
    """0 to 1."""
    reason: Words
    """What made it low, in words; empty for a sure one."""


@dataclass(frozen=True, kw_only=True)
class Motion:
    """A move from one pose to another, in the world frame."""

    __pydantic_config__ = STRICT
    translation_m: Vector
    rotation_vector_rad: Vector
    """Axis times angle; of a symmetric object the smallest that looks the same."""


@dataclass(frozen=True, kw_only=True)
class SceneObject:
    """One object: what it is, how large, and where it was in the video."""

    __pydantic_config__ = STRICT
    name: Name
    """Identifier, unique in the scene, that task code uses: states have `<name>_pos` and so on."""
    label: Words
    """The words of the caption."""
    role: Role
    shape: Shape
    """A primitive when it fits within tolerance, else `mesh` (its `parts` collide)."""
    size_m: tuple[Length, Length, Length]
    """Full extents along the object's own x, y, z. Cylinders: (diameter, diameter, height), axis z."""
    mass_kg: Annotated[float, Gt(0), Le(1e4)]
    friction: Annotated[float, Ge(0), Le(100)]
    """Sliding friction on a wooden table."""
    hollow: bool = False
    """Open at the top: a bowl, a cup, a box without a lid."""
    mesh: MeshPath = ""
    """OBJ file, relative to the scene folder, watertight, centred on its bounding box, in metres."""
    mesh_ply: MeshPath = ""
    """The same mesh as PLY."""
    parts: Annotated[tuple[MeshPath, ...], Len(0, MAX_PARTS)] = ()
    """OBJ files of convex solids in the mesh's frame that together are the object: what collides."""
    urdf: Annotated[str, path_of_kind(".urdf")] = ""
    mjcf: Annotated[str, path_of_kind(".xml")] = ""
    mask_track: Annotated[str, path_of_kind(".npz")] = ""
    """File with the object's masks; `Scene.masks` reads it."""
    symmetry: Symmetry = "none"
    """Turns that leave it alike: `box` half turns about its axes, `round` any about its own z, `sphere` all."""
    rgba: tuple[Share, Share, Share, Share] = (0.8, 0.4, 0.2, 1.0)
    """Mean colour in the video."""
    source: Annotated[dict[Words, Words], Len(0, 32)] = field(default_factory=dict[str, str])
    """Where size, mass and friction come from, in words."""
    frames: Annotated[tuple[Count, ...], Len(0, MAX_FRAMES)] = ()
    """Video frames with a pose, first and last at least."""
    poses_world: Annotated[tuple[Pose, ...], Len(0, MAX_FRAMES)] = ()
    """Per frame `[x, y, z, qw, qx, qy, qz]` of the object's centre [m]."""
    confidences: Annotated[tuple[Share, ...], Len(0, MAX_FRAMES)] = ()
    """Per frame, 0 to 1."""
    observed: Annotated[tuple[Observed, ...], Len(0, MAX_FRAMES)] = ()
    """Per frame: `no_depth` where one view does not show how far away it is, as in mid-air; empty: all `full`."""
    first_to_last: Motion | None = field(default=None, compare=False, repr=False)
    """For readers of the file, as `motion`."""

    @property
    def files(self) -> list[str]:
        """The files that it names."""
        named = (self.mesh, self.mesh_ply, self.urdf, self.mjcf, self.mask_track, *self.parts)
        return [file for file in named if file]

    @property
    def first_pose(self) -> Float[np.ndarray, "7"]:
        return np.asarray(self.poses_world[0], float)

    @property
    def laid_pose(self) -> Float[np.ndarray, "7"]:
        """The pose at the start of a task: what a hand holds then lies on its broadest side instead."""
        if self.observed[:1] != ("no_depth",):
            return self.first_pose
        R = Rotation.from_quat(self.first_pose[3:], scalar_first=True).as_matrix()
        long, middle, short = np.argsort(self.size_m)[::-1]
        level = np.array([*R[:2, long], 0.0])
        laid = np.zeros((3, 3))
        laid[:, long] = level / np.linalg.norm(level)
        laid[2, short] = 1.0 if R[2, short] >= 0 else -1.0
        laid[:, middle] = np.cross(laid[:, short], laid[:, long])
        laid[:, middle] *= np.linalg.det(laid)
        quat = Rotation.from_matrix(laid).as_quat(canonical=True, scalar_first=True)
        return np.array([*self.first_pose[:2], self.size_m[short] / 2, *quat])

    @property
    def last_pose(self) -> Float[np.ndarray, "7"]:
        return np.asarray(self.poses_world[-1], float)

    @property
    def motion(self) -> Motion:
        """What the video did to the object."""
        first, last = (
            Rotation.from_quat(p[3:], scalar_first=True) for p in (self.first_pose, self.last_pose)
        )
        move = self.last_pose[:3] - self.first_pose[:3]
        turn = least_turn(first, last, self.symmetry).as_rotvec()
        return Motion(translation_m=_rounded3(move), rotation_vector_rad=_rounded3(turn))


def least_turn(first: Rotation, last: Rotation, symmetry: Symmetry) -> Rotation:
    """Return the smallest rotation, in the world frame, from `first` to what looks like `last`."""
    if symmetry == "sphere":
        return Rotation.identity()
    if symmetry == "round":
        Q = (first.inv() * last).as_matrix()
        spin = np.arctan2(Q[0, 1] - Q[1, 0], Q[0, 0] + Q[1, 1])
        return last * Rotation.from_rotvec([0.0, 0.0, spin]) * first.inv()
    group = Rotation.create_group("D2" if symmetry == "box" else "C1")
    turns = last * group * first.inv()
    return turns[int(np.argmin(turns.magnitude()))]


def write_masks(path: Path, masks: dict[int, Bool[np.ndarray, "h w"]]) -> None:
    """Write masks by clip frame, one bit per pixel and deflated: about 300 bytes each."""
    frames = sorted(masks)
    h, w = masks[frames[0]].shape if frames else (0, 0)
    stack = np.array([masks[f] for f in frames], bool).reshape(len(frames), h * w)
    np.savez_compressed(
        path,
        frames=np.array(frames, np.int32),
        shape=np.array([h, w], np.int32),
        bits=np.packbits(stack, axis=1),
    )


def read_masks(path: Path) -> dict[int, Bool[np.ndarray, "h w"]]:
    """Return what `write_masks` wrote.

    Raises:
        V2PError: there is no such file, or it holds no masks.
    """
    try:
        with np.load(path) as stored:
            _check_unpacked(path)
            h, w = (int(v) for v in stored["shape"])
            pixels = np.unpackbits(stored["bits"], axis=1, count=h * w).astype(bool)
            return {int(f): m.reshape(h, w) for f, m in zip(stored["frames"], pixels, strict=True)}
    except (OSError, ValueError, KeyError, EOFError, zipfile.BadZipFile) as error:
        raise V2PError(
            f"{path} holds no mask track ({type(error).__name__}); remake the scene with 'v2p scene'"
        ) from error


def _check_unpacked(path: Path) -> None:
    """Refuse an archive whose stated size exceeds any mask track. NumPy reads no more than the stated size."""
    with zipfile.ZipFile(path) as archive:
        if sum(entry.file_size for entry in archive.infolist()) > MAX_MASKS_BYTES:
            raise ValueError(f"more than {MAX_MASKS_BYTES / 1e6:.0f} MB when unpacked")


def hollow_floor_m(height_m: Float[np.ndarray, "*n"]) -> Float[np.ndarray, "*n"]:
    """Return how thick the floor of a hollow object is simulated, given its height [m]."""
    return np.clip(0.2 * height_m, FLOOR_MIN_M, FLOOR_MAX_M)


def friction_attribute(sliding: float = 1e-5) -> str:
    """Return MuJoCo's `friction` of an object.

    By default the table's, the least that MuJoCo takes: the larger one of two geoms counts.
    """
    return f"{sliding:.6g} 0.005 0.0001"


@dataclass(frozen=True, kw_only=True)
class Scene:
    """One video's scene. Files named in it are relative to the folder that holds `scene.json`."""

    title: str
    """Slug of the video's name."""
    video: str
    """The video's file name."""
    description: str
    """The caption."""
    kind: Kind
    """Task kind the caption names, e.g. `lift_up`; `generic` when it names none."""
    objects: tuple[SceneObject, ...]
    """The manipulated object first."""
    camera: Camera
    """Camera of the aligned frames, which is the first frame's where the camera moved."""
    fps: float
    num_frames: int
    confidence: float
    """0 to 1; a scene below the threshold is rejected."""
    confidences: dict[str, StageConfidence] = field(default_factory=dict[str, StageConfidence])
    """Per stage of the reconstruction."""
    scale_spread: float = 0.0
    """Standard deviation of the logarithm of all lengths together: one view does not show scale."""
    T_world_cams: Float[np.ndarray, "time 4 4"] | None = None
    """Pose of the camera in each frame as it was filmed; None where the camera stood still."""
    crop_px: tuple[float, float, float, float] | None = None
    """x0, y0, x1, y1 in the file's pixels of what the camera's pictures show, where black bars were cut off."""
    table: Plane = Plane()
    """The table's top."""
    gravity_m_s2: tuple[float, float, float] = GRAVITY_M_S2
    warnings: tuple[str, ...] = ()
    family: str = ""
    """Title of the scene whose cousin this is; empty where a video shows it."""
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

    def masks(self, name: str) -> dict[int, Bool[np.ndarray, "h w"]]:
        """Return the object's masks by clip frame, at the size at which the video was understood.

        Raises:
            V2PError: no such object, or it has no mask track.
        """
        thing = self.object(name)
        if not thing.mask_track:
            raise V2PError(
                f"object '{name}' of scene '{self.title}' has no mask track: it was not made from a video"
            )
        return read_masks(self.folder / thing.mask_track)

    def save(self, folder: Path) -> None:
        """Write `scene.json`; meshes, masks and URDFs are written by their makers."""
        data = asdict(replace(self, folder=Path()))
        del data["folder"], data["T_world_cams"], data["crop_px"]
        data["camera"] = {
            "width_px": self.camera.width_px,
            "height_px": self.camera.height_px,
            "K": self.camera.K.tolist(),
            "T_world_cam": self.camera.T_world_cam.tolist(),
        }
        if self.T_world_cams is not None:
            data["camera"]["T_world_cams"] = np.round(self.T_world_cams, 6).tolist()
        if self.crop_px is not None:
            data["camera"]["crop_px"] = [round(v, 2) for v in self.crop_px]
        for written, thing in zip(data["objects"], self.objects, strict=True):
            del written["first_to_last"]
            if thing.poses_world:
                written["first_to_last"] = asdict(thing.motion)
        data["schema"] = SCHEMA
        (folder / SCENE_FILE).write_text(json.dumps(data, indent=1), encoding="utf-8")

    @staticmethod
    def load(folder: Path) -> "Scene":
        """Read `folder/scene.json`, whoever made it.

        Raises:
            V2PError: there is none, it was written by another version, or it says what `schema` does not allow.
        """
        if not (folder / SCENE_FILE).exists():
            raise V2PError(
                f"{folder} holds no {SCENE_FILE}: it is no scene; make one with 'v2p scene'"
            )
        read = _read(folder)
        same = {name: getattr(read, name) for name in SceneFile.model_fields}
        del same["version"]
        camera = read.camera
        return Scene(
            **same
            | {
                "kind": kind_named(read.kind, str(folder / SCENE_FILE)),
                "camera": Camera(
                    width_px=camera.width_px,
                    height_px=camera.height_px,
                    K=np.array(camera.K, float),
                    T_world_cam=np.array(camera.T_world_cam, float),
                ),
            },
            T_world_cams=np.array(camera.T_world_cams, float) if camera.T_world_cams else None,
            crop_px=camera.crop_px,
            folder=folder,
        )


class CameraEntry(FileModel):
    width_px: Annotated[int, Gt(0), Le(16_384)]
    height_px: Annotated[int, Gt(0), Le(16_384)]
    K: tuple[tuple[Entry, Entry, Entry], tuple[Entry, Entry, Entry], tuple[Entry, Entry, Entry]]
    T_world_cam: tuple[Row4, Row4, Row4, Row4]
    T_world_cams: Annotated[tuple[tuple[Row4, Row4, Row4, Row4], ...], Len(0, MAX_FRAMES)] = ()
    crop_px: tuple[Entry, Entry, Entry, Entry] | None = None


class SceneFile(FileModel):
    """The fields of `Scene`, which says what they mean, with the limits of what a file may say."""

    title: Slug
    video: Words
    description: Words
    kind: Name
    objects: Annotated[tuple[SceneObject, ...], Len(0, MAX_OBJECTS)]
    camera: CameraEntry
    fps: Annotated[float, Gt(0), Le(10_000)]
    num_frames: Count
    confidence: Share
    confidences: Annotated[dict[Words, StageConfidence], Len(0, 32)] = Field(
        default_factory=dict[str, StageConfidence]
    )
    scale_spread: Annotated[float, Ge(0), Le(100)] = 0.0
    table: Plane
    gravity_m_s2: Vector = GRAVITY_M_S2
    warnings: Annotated[tuple[Words, ...], Len(0, 200)] = ()
    family: Annotated[Words, StringConstraints(max_length=200)] = ""
    version: Literal[2] = Field(alias="schema")


def _read(folder: Path) -> SceneFile:
    """Return what a scene file says, as far as it may.

    Raises:
        V2PError: it cannot be read, was written by another version, or says what it may not.
    """
    path = folder / SCENE_FILE
    data = read_own(folder, SCENE_FILE, MAX_SCENE_BYTES)
    found = parsed(data, SceneFile, path, "remake it with 'v2p scene'", version_field="schema")
    if len(found.camera.T_world_cams) not in (0, found.num_frames):
        raise V2PError(
            f"{path}: camera.T_world_cams has {len(found.camera.T_world_cams)} poses, but the "
            f"clip has {found.num_frames} frames"
        )
    if len({o.name for o in found.objects}) < len(found.objects):
        names = ", ".join(o.name for o in found.objects)
        raise V2PError(f"{path}: two objects have one name ({names}); each needs its own")
    if (count := sum(len(o.parts) for o in found.objects)) > MAX_SCENE_PARTS:
        raise V2PError(
            f"{path}: its objects have {count} parts; at most {MAX_SCENE_PARTS} can be simulated"
        )
    for thing in found.objects:
        _check_trajectory(thing, path)
        for file in thing.files:
            if (folder / file).exists():
                own_file(folder, file, MAX_FILE_BYTES)
    return found


def _check_trajectory(thing: SceneObject, path: Path) -> None:
    """Demand that all lists with one entry a frame are equally long."""
    counts = {
        "frames": len(thing.frames),
        "poses_world": len(thing.poses_world),
        "confidences": len(thing.confidences),
        "observed": len(thing.observed),
    }
    given = {name: n for name, n in counts.items() if n}
    if len(set(given.values())) > 1:
        lengths = ", ".join(f"{n} {name}" for name, n in given.items())
        raise V2PError(f"{path}: object '{thing.name}' has {lengths}; there must be one per frame")


def _rounded3(values: Float[np.ndarray, "3"]) -> tuple[float, float, float]:
    x, y, z = (round(float(v), 6) + 0.0 for v in values)
    return x, y, z

"""What a `scene.json` may hold: the one place that says which fields, numbers and texts are taken from a file.

The limits are wide: they keep out what no video can give and what would make this engine hang. Whether a scene suits the
robot is asked later, with sentences of its own (`sim.suitability`).
"""

import difflib
from pathlib import Path
from typing import Annotated, Any, Literal

from annotated_types import Ge, Gt, Le, Len
from pydantic import (
    AfterValidator,
    BaseModel,
    ConfigDict,
    Field,
    StringConstraints,
    ValidationError,
)

from v2p_data.errors import V2PError
from v2p_data.letters import is_shown
from v2p_data.scene.files import is_plain_path, own_file, read_own

Role = Literal["manipulated", "reference", "tool", "container", "cover"]
Shape = Literal["box", "cylinder", "sphere", "mesh"]
Symmetry = Literal["none", "box", "round", "sphere"]
Observed = Literal["full", "no_depth"]
MAX_SCENE_BYTES = 32_000_000
"""An hour of two objects at 10 Hz."""
MAX_FILE_BYTES = 200_000_000
"""Largest mesh or mask track."""
MAX_OBJECTS = 20
MAX_PARTS = 128
"""Most parts of one object."""
MAX_SCENE_PARTS = 512
"""Most parts of all objects together; MuJoCo gets each in seven sizes."""
MAX_FRAMES = 50_000
MESH_KINDS = (".obj", ".stl", ".ply")
ERRORS_SHOWN = 3


def _printable(text: str) -> str:
    if not all(is_shown(c) or c == "\n" for c in text):
        raise ValueError("holds characters that cannot be shown")
    return text


def _identifier(text: str) -> str:
    if not text.isidentifier() or text.startswith("_"):
        raise ValueError("is no identifier: letters, digits and underscores, first a letter")
    return text


def _file_name(text: str) -> str:
    if not is_plain_path(text) or "/" in text or text.startswith("."):
        raise ValueError("is no plain name: no slash, no leading dot, no hidden characters")
    return text


def _path_of_kind(*kinds: str) -> AfterValidator:
    def check(text: str) -> str:
        if text and not is_plain_path(text):
            raise ValueError(
                "does not lie inside the scene's folder: write a relative path without '..'"
            )
        if text and not text.lower().endswith(kinds):
            raise ValueError(f"is no {' or '.join(kinds)} file")
        return text

    return AfterValidator(check)


def _of_unit_length(values: tuple[float, ...]) -> tuple[float, ...]:
    if not 0.81 < sum(v * v for v in values) < 1.21:
        raise ValueError("is not of length 1")
    return values


def _turned(pose: tuple[float, ...]) -> tuple[float, ...]:
    _of_unit_length(pose[3:])
    return pose


Name = Annotated[str, StringConstraints(max_length=64), AfterValidator(_identifier)]
"""What becomes a key of `states` and a name in the model."""
Slug = Annotated[str, StringConstraints(max_length=200), AfterValidator(_file_name)]
"""What becomes part of a path."""
Words = Annotated[str, StringConstraints(max_length=2_000), AfterValidator(_printable)]
Count = Annotated[int, Ge(0), Le(10_000_000)]
Share = Annotated[float, Ge(0), Le(1.001)]
"""0 to 1, and what rounding adds."""
Place = Annotated[float, Ge(-100), Le(100)]
"""Metres from the origin, or a rotation vector's part."""
Entry = Annotated[float, Ge(-1e6), Le(1e6)]
Length = Annotated[float, Gt(0), Le(1e5)]
"""Metres; so many because sizes in millimetres are told of later."""
Vector = tuple[Place, Place, Place]
Row4 = tuple[Entry, Entry, Entry, Entry]
Pose = Annotated[tuple[Place, Place, Place, Place, Place, Place, Place], AfterValidator(_turned)]
MeshPath = Annotated[str, _path_of_kind(*MESH_KINDS)]


class FileModel(BaseModel):
    """Part of a JSON file: unknown fields, other types and numbers that are not finite are errors."""

    model_config = ConfigDict(
        extra="forbid", strict=True, allow_inf_nan=False, frozen=True, hide_input_in_errors=True
    )


class MotionEntry(FileModel):
    translation_m: Vector
    rotation_vector_rad: Vector


class ObjectEntry(FileModel):
    """The fields of `SceneObject`, which says what they mean."""

    name: Name
    label: Words
    role: Role
    shape: Shape
    size_m: tuple[Length, Length, Length]
    mass_kg: Annotated[float, Gt(0), Le(1e4)]
    friction: Annotated[float, Ge(0), Le(100)]
    hollow: bool = False
    mesh: MeshPath = ""
    mesh_ply: MeshPath = ""
    parts: Annotated[tuple[MeshPath, ...], Len(0, MAX_PARTS)] = ()
    urdf: Annotated[str, _path_of_kind(".urdf")] = ""
    mjcf: Annotated[str, _path_of_kind(".xml")] = ""
    mask_track: Annotated[str, _path_of_kind(".npz")] = ""
    symmetry: Symmetry = "none"
    rgba: tuple[Share, Share, Share, Share] = (0.8, 0.4, 0.2, 1.0)
    source: Annotated[dict[Words, Words], Len(0, 32)] = Field(default_factory=dict[str, str])
    frames: Annotated[tuple[Count, ...], Len(0, MAX_FRAMES)] = ()
    poses_world: Annotated[tuple[Pose, ...], Len(0, MAX_FRAMES)] = ()
    confidences: Annotated[tuple[Share, ...], Len(0, MAX_FRAMES)] = ()
    observed: Annotated[tuple[Observed, ...], Len(0, MAX_FRAMES)] = ()
    first_to_last: MotionEntry | None = None
    """For readers of the file; it follows from the poses."""

    @property
    def files(self) -> list[str]:
        """The files that it names."""
        named = (self.mesh, self.mesh_ply, self.urdf, self.mjcf, self.mask_track, *self.parts)
        return [file for file in named if file]


class CameraEntry(FileModel):
    width_px: Annotated[int, Gt(0), Le(16_384)]
    height_px: Annotated[int, Gt(0), Le(16_384)]
    K: tuple[tuple[Entry, Entry, Entry], tuple[Entry, Entry, Entry], tuple[Entry, Entry, Entry]]
    T_world_cam: tuple[Row4, Row4, Row4, Row4]
    T_world_cams: Annotated[tuple[tuple[Row4, Row4, Row4, Row4], ...], Len(0, MAX_FRAMES)] = ()
    crop_px: tuple[Entry, Entry, Entry, Entry] | None = None


class PlaneEntry(FileModel):
    normal: Annotated[tuple[float, float, float], AfterValidator(_of_unit_length)]
    offset_m: Place


class ConfidenceEntry(FileModel):
    value: Share
    reason: Words


class SceneFile(FileModel):
    """The fields of `Scene`, which says what they mean."""

    title: Slug
    video: Words
    description: Words
    kind: Name
    objects: Annotated[tuple[ObjectEntry, ...], Len(0, MAX_OBJECTS)]
    camera: CameraEntry
    fps: Annotated[float, Gt(0), Le(10_000)]
    num_frames: Count
    confidence: Share
    confidences: Annotated[dict[Words, ConfidenceEntry], Len(0, 32)] = Field(
        default_factory=dict[str, ConfidenceEntry]
    )
    scale_spread: Annotated[float, Ge(0), Le(100)] = 0.0
    table: PlaneEntry
    gravity_m_s2: tuple[Place, Place, Place] = (0.0, 0.0, -9.81)
    warnings: Annotated[tuple[Words, ...], Len(0, 200)] = ()
    family: Annotated[str, StringConstraints(max_length=200), AfterValidator(_printable)] = ""
    version: Literal[2] = Field(alias="schema")


def read_scene_file(folder: Path, name: str) -> SceneFile:
    """Return what a scene file says.

    Raises:
        V2PError: it cannot be read, was written by another version, or says what it may not.
    """
    data = read_own(folder, name, MAX_SCENE_BYTES)
    path = folder / name
    found = parsed(data, SceneFile, path, "remake it with 'v2p scene'", version_field="schema")
    if len(found.camera.T_world_cams) not in (0, found.num_frames):
        raise V2PError(
            f"{path}: camera.T_world_cams has {len(found.camera.T_world_cams)} poses, but the clip has {found.num_frames} frames"
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


def parsed[T: FileModel](
    data: bytes, kind: type[T], path: Path, then: str, *, version_field: str = ""
) -> T:
    """Return JSON as a model.

    Args:
        data: the file's content.
        kind: what it should hold.
        path: of the file, for the sentence.
        then: what to do about a file that is wrong.
        version_field: the field that is wrong where another version wrote the file.

    Raises:
        V2PError: names the file and what is wrong in it.
    """
    try:
        return kind.model_validate_json(data)
    except ValidationError as error:
        faults = error.errors(include_url=False, include_context=False)
        if any(f["loc"] == (version_field,) for f in faults):
            raise V2PError(f"{path} was written by another version; {then}") from None
        told = "; ".join(_told(f, kind) for f in faults[:ERRORS_SHOWN])
        more = f"; and {len(faults) - ERRORS_SHOWN} more" if len(faults) > ERRORS_SHOWN else ""
        raise V2PError(f"{path}: {told}{more}; {then}") from None


def _told(fault: Any, kind: type[FileModel]) -> str:
    *_, last = ("", *fault["loc"])
    parts = [str(part) for part in fault["loc"]]
    where = ".".join(p for p in parts if not p.startswith("("))  # names of alternatives
    where = ascii(where[:200])[1:-1]
    if fault["type"] == "extra_forbidden":
        close = difflib.get_close_matches(str(last), _fields(kind), n=1)
        return f"unknown field '{where}'" + (f" (did you mean '{close[0]}'?)" if close else "")
    words = str(fault["msg"]).removeprefix("Value error, ")
    words = words.replace("Input should be", "should be").replace("Field required", "is missing")
    return f"{where}: {words[:300]}" if where else words[:300]


def _fields(kind: type[FileModel]) -> set[str]:
    """Return the names of all fields of a model and of the models of this file."""
    models = (kind, *FileModel.__subclasses__())
    return {field.alias or name for m in models for name, field in m.model_fields.items()}


def _check_trajectory(thing: ObjectEntry, path: Path) -> None:
    """Demand that all lists with one entry a frame are equally long."""
    counts = {
        "frames": len(thing.frames),
        "poses_world": len(thing.poses_world),
        "confidences": len(thing.confidences),
        "observed": len(thing.observed),
    }
    given = {name: n for name, n in counts.items() if n}
    if len(set(given.values())) > 1:
        told = ", ".join(f"{n} {name}" for name, n in given.items())
        raise V2PError(f"{path}: object '{thing.name}' has {told}; there must be one per frame")

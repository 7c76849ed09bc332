"""What a `task.json` may hold: which fields, numbers and texts are taken from a file; see `scene.schema`."""

from pathlib import Path
from typing import Annotated, Any

from annotated_types import Ge, Gt, Le, Len
from pydantic import AfterValidator, Discriminator, Field, StringConstraints, Tag

from v2p_data.scene.files import is_plain_path, read_own
from v2p_data.scene.schema import FileModel, Name, Place, Slug, Words, parsed
from v2p_data.task.robot_files import ROBOT_FOLDER

MAX_TASK_BYTES = 1_000_000
MAX_CODE_BYTES = 200_000
"""Task code itself may have 40,000 characters."""
MAX_HORIZON_STEPS = 2_000
"""100 s; the paper's episodes have 300 steps, of a length that it does not tell. All steps of all
worlds are kept until an episode is judged."""


def _robot_path(text: str) -> str:
    if not is_plain_path(text) or not text.startswith(f"{ROBOT_FOLDER}/"):
        raise ValueError(
            f"the robot's file lies in the task's own folder '{ROBOT_FOLDER}'; another arm is named with "
            "--sim.robot.path when the task is made"
        )
    return text


MjcfName = Annotated[str, StringConstraints(max_length=200)]
Angle = Annotated[float, Ge(-1e3), Le(1e3)]
Amount = Annotated[float, Ge(-1e9), Le(1e9)]


class RobotEntry(FileModel):
    """The fields of `sim.arms.RobotConfig`."""

    path: Annotated[str, AfterValidator(_robot_path)]
    eef_site: MjcfName
    eef_offset_m: tuple[Place, Place, Place]
    eef_turn_wxyz: tuple[Place, Place, Place, Place]
    fingers: tuple[MjcfName, MjcfName]
    pads: tuple[MjcfName, MjcfName]
    home_qpos: Annotated[tuple[Angle, ...], Len(0, 50)]
    base_pos_m: tuple[Place, Place, Place]
    base_yaw_rad: Angle


class CheckEntry(FileModel):
    name: Words
    asks: Words
    passed: bool
    share: Amount
    weight: Amount
    is_veto: bool
    right: Amount | None = None


class AuditEntry(FileModel):
    """The fields of `audit.Audit`."""

    checks: Annotated[tuple[CheckEntry, ...], Len(0, 100)]
    score: Amount
    vetoed: Words
    notes: Annotated[tuple[Words, ...], Len(0, 100)] = ()
    true_from_pose: int | None = None
    threshold_m: Amount | None = None
    acceptable: bool


class NoEntry(FileModel):
    """An empty object."""


def _maybe[T](kind: type[T]) -> Any:
    """Return the type of a field that holds this model or an empty object."""
    return Annotated[
        Annotated[NoEntry, Tag("(none)")] | Annotated[kind, Tag("(given)")],
        Discriminator(lambda value: "(given)" if value else "(none)"),
    ]


class TaskFile(FileModel):
    """The fields of `TaskBundle`, which says what they mean."""

    title: Slug
    description: Words
    kind: Name
    class_name: Annotated[str, StringConstraints(max_length=100, pattern=r"^\w*$")]
    horizon_steps: Annotated[int, Ge(1), Le(MAX_HORIZON_STEPS)] = 100
    motion_scale: Annotated[float, Gt(0), Le(10)] = 1.0
    robot: _maybe(RobotEntry) = Field(default_factory=NoEntry)  # pyright: ignore[reportInvalidTypeForm]
    audit: _maybe(AuditEntry) = Field(default_factory=NoEntry)  # pyright: ignore[reportInvalidTypeForm]


def read_task_file(folder: Path, name: str) -> TaskFile:
    """Return what a task file says.

    Raises:
        V2PError: it cannot be read, or says what it may not.
    """
    data = read_own(folder, name, MAX_TASK_BYTES)
    return parsed(data, TaskFile, folder / name, "make it anew with 'v2p task'")

"""The numbers, texts and paths that a JSON file may hold, and how such a file is read: `scene.json` and those like it.

The limits are wide: they keep out what no video can give and what would make this engine hang.
    Whether a scene suits the
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
    StringConstraints,
    ValidationError,
)

from v2p_data.errors import V2PError
from v2p_data.letters import is_shown
from v2p_data.scene.files import is_plain_path

Role = Literal["manipulated", "reference", "tool", "container", "cover"]
Shape = Literal["box", "cylinder", "sphere", "mesh"]
Symmetry = Literal["none", "box", "round", "sphere"]
Observed = Literal["full", "no_depth"]
MAX_FILE_BYTES = 200_000_000
"""Largest mesh or mask track."""
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


def path_of_kind(*kinds: str) -> AfterValidator:
    def check(text: str) -> str:
        if text and not is_plain_path(text):
            raise ValueError(
                "does not lie inside the scene's folder: write a relative path without '..'"
            )
        if text and not text.lower().endswith(kinds):
            raise ValueError(f"is no {' or '.join(kinds)} file")
        return text

    return AfterValidator(check)


def of_unit_length(values: tuple[float, ...]) -> tuple[float, ...]:
    if not 0.81 < sum(v * v for v in values) < 1.21:
        raise ValueError("is not of length 1")
    return values


def _turned(pose: tuple[float, ...]) -> tuple[float, ...]:
    of_unit_length(pose[3:])
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
Pose = Annotated[tuple[Place, ...], Len(7, 7), AfterValidator(_turned)]
MeshPath = Annotated[str, path_of_kind(*MESH_KINDS)]


STRICT = ConfigDict(
    extra="forbid", strict=True, allow_inf_nan=False, frozen=True, hide_input_in_errors=True
)
"""Unknown fields, other types and numbers that are not finite are errors."""


class FileModel(BaseModel):
    """Part of a JSON file."""

    model_config = STRICT


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
        words = "; ".join(_in_words(f, kind) for f in faults[:ERRORS_SHOWN])
        more = f"; and {len(faults) - ERRORS_SHOWN} more" if len(faults) > ERRORS_SHOWN else ""
        raise V2PError(f"{path}: {words}{more}; {then}") from None


def _in_words(fault: Any, kind: type[FileModel]) -> str:
    *_, last = ("", *fault["loc"])
    parts = [str(part) for part in fault["loc"]]
    where = ".".join(p for p in parts if not p.startswith("("))  # names of alternatives
    where = ascii(where[:200])[1:-1]
    if fault["type"] in ("extra_forbidden", "unexpected_keyword_argument"):
        close = difflib.get_close_matches(str(last), _fields(kind), n=1)
        return f"unknown field '{where}'" + (f" (did you mean '{close[0]}'?)" if close else "")
    words = str(fault["msg"]).removeprefix("Value error, ")
    words = words.replace("Input should be", "should be").replace("Field required", "is missing")
    return f"{where}: {words[:300]}" if where else words[:300]


def _fields(kind: type[FileModel]) -> set[str]:
    """Return the names of all fields of a model and of what it consists of, as a file spells them."""
    schema = kind.model_json_schema()
    parts = (schema, *schema.get("$defs", {}).values())
    return {name for part in parts for name in part.get("properties", {})}

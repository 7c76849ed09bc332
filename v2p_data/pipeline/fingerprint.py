"""What makes a result itself: canonical JSON of a recipe, and its hash.

Only values that are understood are encoded; anything else is refused, because a permissive `str(value)`
would give two names to one recipe (memory addresses) or one name to two.
"""

import dataclasses
import hashlib
import json
import math
from pathlib import Path, PurePath
from typing import Any, cast

FINGERPRINT_LENGTH = 8
UNSAID_BY_DEFAULT = {"unsaid by default": True}
"""Metadata of a dataclass's field that came later: no recipe names it at its default, so that
older results stay theirs."""


def canonical(value: Any) -> Any:
    """Return `value` as JSON data in which equal recipes are equal.

    Raises:
        TypeError: the value has no stable form; the message says what to do.
    """
    if value is None or isinstance(value, bool | str | int):
        return value
    if isinstance(value, float):
        if not math.isfinite(value):
            raise TypeError(f"{value} in a recipe cannot be compared; use None or a finite number")
        return value
    if isinstance(value, PurePath):
        return value.as_posix()
    if dataclasses.is_dataclass(value) and not isinstance(value, type):
        said = {
            f.name: getattr(value, f.name)
            for f in dataclasses.fields(value)
            if not _is_unsaid(f, value)
        }
        return {name: canonical(part) for name, part in said.items()}
    if isinstance(value, dict):
        items = cast(dict[Any, Any], value)
        if not all(isinstance(k, str) for k in items):
            raise TypeError("a recipe's dict needs string keys")
        return {k: canonical(items[k]) for k in sorted(items)}
    if isinstance(value, list | tuple):
        return [canonical(v) for v in cast(list[Any], value)]
    raise TypeError(
        f"{type(value).__name__} cannot be part of a recipe; use plain values, dataclasses or paths"
    )


def _is_unsaid(field: dataclasses.Field[Any], value: Any) -> bool:
    later = UNSAID_BY_DEFAULT.items() <= field.metadata.items()
    return later and getattr(value, field.name) == field.default


def canonical_json(value: Any) -> str:
    """Return the text that is hashed."""
    return json.dumps(canonical(value), sort_keys=True, separators=(",", ":"), ensure_ascii=True)


def fingerprint(value: Any) -> str:
    """Return the first 8 hex digits of the recipe's SHA-256."""
    return hashlib.sha256(canonical_json(value).encode()).hexdigest()[:FINGERPRINT_LENGTH]


def file_digest(path: Path) -> str:
    """Return the first 16 hex digits of a file's SHA-256."""
    with path.open("rb") as stream:
        return hashlib.file_digest(stream, "sha256").hexdigest()[:16]

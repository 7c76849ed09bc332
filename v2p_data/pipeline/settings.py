"""Settings: code default, then a YAML file, then flags; every mistake named with its place."""

import dataclasses
import types
import typing
from pathlib import Path
from typing import Any, Literal, cast

import yaml

from v2p_data.errors import V2PError, did_you_mean


def load_settings[T](path: Path, kind: type[T]) -> T:
    """Return `kind` with the values of a YAML file over its defaults.

    Raises:
        V2PError: no such file, no YAML, an unknown setting, or a value of another type.
    """
    try:
        data = yaml.safe_load(path.read_text(encoding="utf-8"))
    except OSError as error:
        raise V2PError(f"cannot read the settings file {path}: {error.strerror}") from error
    except yaml.YAMLError as error:
        raise V2PError(f"{path} is not valid YAML: {' '.join(str(error).split())}") from error
    if data is None:
        data = {}
    return from_values(kind, data, str(path))


def from_values[T](kind: type[T], data: Any, place: str) -> T:
    """Return the dataclass `kind` filled from nested dicts.

    Raises:
        V2PError: see `load_settings`.
    """
    if not isinstance(data, dict):
        raise V2PError(f"{place} must hold settings as 'name: value', got {type(data).__name__}")
    hints = typing.get_type_hints(kind)
    known = [f.name for f in dataclasses.fields(cast(Any, kind)) if f.init]
    values: dict[str, Any] = {}
    for name, value in cast(dict[str, Any], data).items():
        if name not in known:
            raise V2PError(f"setting '{name}' is not in {place}.{did_you_mean(str(name), known)}")
        values[name] = _convert(value, hints[name], f"{place}:{name}")
    try:
        return kind(**values)
    except ValueError as error:
        raise V2PError(f"{place}: {error}") from error


def _convert(value: Any, hint: Any, place: str) -> Any:
    if dataclasses.is_dataclass(hint) and isinstance(hint, type):
        return from_values(hint, value, place)
    if hint is Any:
        return value
    origin, arguments = typing.get_origin(hint), typing.get_args(hint)
    if origin in (typing.Union, types.UnionType):
        if value is None and type(None) in arguments:
            return None
        return _convert(value, next(a for a in arguments if a is not type(None)), place)
    if origin is Literal:
        if value not in arguments:
            raise V2PError(f"{place} is {value!r}.{did_you_mean(str(value), map(str, arguments))}")
        return value
    if origin is tuple:
        if not isinstance(value, list):
            raise V2PError(f"{place} must be a list, got {value!r}")
        entries = cast(list[Any], value)
        if len(arguments) == 2 and arguments[1] is Ellipsis:
            return tuple(_convert(v, arguments[0], place) for v in entries)
        if len(entries) != len(arguments):
            raise V2PError(f"{place} must have {len(arguments)} entries, got {len(entries)}")
        return tuple(_convert(v, h, place) for v, h in zip(entries, arguments, strict=True))
    if origin is dict:
        if not isinstance(value, dict):
            raise V2PError(f"{place} must hold 'name: value', got {value!r}")
        named = cast(dict[Any, Any], value)
        return {k: _convert(v, arguments[1], f"{place}:{k}") for k, v in named.items()}
    if hint is float and isinstance(value, int) and not isinstance(value, bool):
        return float(value)  # so that 2 and 2.0 are one recipe
    if hint is Path and isinstance(value, str):
        return Path(value)
    if isinstance(hint, type) and (
        not isinstance(value, hint) or (isinstance(value, bool) and hint is not bool)
    ):
        note = ""
        if hint is float and isinstance(value, str):
            note = " (YAML reads 3e-4 as text; write 3.0e-4)"
        raise V2PError(f"{place} must be {hint.__name__}, got {value!r}{note}")
    return value

"""JSON files are read here: strictly, with one sentence on a fault, or leniently, for pages."""

import json
from pathlib import Path
from typing import Any

from v2p_data.errors import V2PError

MAX_BYTES = 20_000_000
"""No file that a page or a search reads is larger; some come from processes that ran generated code."""


def read_json(path: Path, advice: str = "") -> Any:
    """Return the content of a JSON file, which may begin with a byte order mark.

    Args:
        path: the file.
        advice: what to do about a bad file; it ends the sentence.

    Raises:
        V2PError: the file cannot be read, holds no JSON, or gives one object two entries of one name.
    """
    try:
        return json.loads(path.read_text("utf-8-sig"), object_pairs_hook=_no_duplicates)
    except json.JSONDecodeError as error:
        wrong = f", line {error.lineno}, column {error.colno}: {error.msg}; this is not valid JSON"
    except UnicodeDecodeError:
        wrong = " is not UTF-8 text; save it as UTF-8"
    except RecursionError:
        wrong = " is nested too deeply to be read"
    except _DuplicateKeyError as error:
        wrong = f" has two entries for '{error}'; remove one"
    except ValueError as error:  # a number of thousands of digits
        wrong = f" holds a number that cannot be read: {error}"
    except OSError as error:
        wrong = f" cannot be read: {error.strerror}"
    raise V2PError(f"{path}{wrong}{'; ' if advice else ''}{advice}")


def read_object(path: Path, advice: str) -> dict[str, Any]:
    """Return the JSON object in a file.

    Raises:
        V2PError: as `read_json`, or the file holds another type.
    """
    data = read_json(path, advice)
    if not isinstance(data, dict):
        raise V2PError(f"{path} holds no JSON object; {advice}")
    return data


def json_or_none(path: Path, max_bytes: int | None = MAX_BYTES) -> Any:
    """Return the content of a JSON file, None where there is no such file, it is too large, or it is no JSON.

    Args:
        path: the file.
        max_bytes: largest size that is read; None: any size, for files that no generated code could write.
    """
    try:
        if not path.is_file() or (max_bytes is not None and path.stat().st_size > max_bytes):
            return None
        return json.loads(path.read_text("utf-8"))
    except (OSError, ValueError, RecursionError):
        return None


class _DuplicateKeyError(Exception):
    pass


def _no_duplicates(pairs: list[tuple[str, Any]]) -> dict[str, Any]:
    seen: dict[str, Any] = {}
    for key, value in pairs:
        if key in seen:
            raise _DuplicateKeyError(key)
        seen[key] = value
    return seen

"""What can be shown to others: JSON without the places on its maker's disk, which name a user as often as not."""

import re
from pathlib import PurePath
from typing import Any, cast

_PATH = re.compile(
    r"(?P<quote>['\"])(?P<quoted>~?/[^'\"\n]*)(?P=quote)"
    r"|(?<![\w/:.~-])~?/(?:[^\s/'\",;:=()\[\]{}]+/)+[^\s/'\",;:=()\[\]{}]*"
)
"""An absolute path within a text, in quotes or of two or more parts; no part of an address or of a relative path."""


def without_places(value: Any) -> Any:
    """Return JSON in which every absolute path is cut down to its last part.

    A text that is a path, or an option with one (`--out=/home/a/my run`), may hold blanks; a path within a longer
    text ends at the first one, unless it is in quotes.
    """
    if isinstance(value, dict):
        entries = cast(dict[Any, Any], value)
        return {without_places(k): without_places(v) for k, v in entries.items()}
    if isinstance(value, list | tuple):
        return [without_places(v) for v in cast(list[Any], value)]
    if isinstance(value, str):
        option, equals, rest = value.partition("=")
        if equals and option.startswith("-"):
            return f"{option}={without_places(rest)}"
        return _name(value) if _is_place(value) else _PATH.sub(_shown, value)
    return value


def _is_place(text: str) -> bool:
    return text.startswith(("/", "~/")) and "\n" not in text and " /" not in text


def _shown(match: re.Match[str]) -> str:
    if match["quote"]:
        return f"{match['quote']}{_name(match['quoted'])}{match['quote']}"
    return _name(match[0])


def _name(path: str) -> str:
    return PurePath(path).name or "."

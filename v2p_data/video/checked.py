"""Checks of JSON that people wrote: the sentence names the place of what is wrong."""

import json
import re
import unicodedata
from collections.abc import Iterable
from typing import Any

from v2p_data.errors import V2PError, did_you_mean
from v2p_data.letters import JOINERS, UNSEEN, is_shown

MAX_WORDS = 2000
"""Letters; what is longer is no caption and no name."""


def check_keys(data: dict[str, Any], known: tuple[str, ...], where: str) -> None:
    """Raise a V2PError that names the first key that is not known."""
    for key in data:
        if key not in known:
            raise V2PError(f"{where}: unknown key '{key}'.{did_you_mean(key, known)}")


def words(value: Any, what: str) -> str:
    """Return a text in composed Unicode (NFC), with single spaces and nothing that is not shown.

    A joiner stays between two letters or emoji.

    Raises:
        V2PError: it is no text, empty, or as long as a page.
    """
    if not isinstance(value, str):
        raise V2PError(f"{what} must be text, not a {type_of(value)}")
    if len(value) > MAX_WORDS:
        raise V2PError(f"{what} is {len(value)} letters long; at most {MAX_WORDS} are read")
    # marks without width go; control characters, and halves of characters, part words
    seen = (c if is_shown(c) else "" if _is_mark(c) else " " for c in value)
    text = " ".join(unicodedata.normalize("NFC", "".join(seen)).split())
    text = re.sub(
        rf"(?<!\S)[{JOINERS}]+|[{JOINERS}]+(?!\S)|(?<=[{JOINERS}])[{JOINERS}]+", "", text
    )
    if not any(c.isalnum() for c in text):
        raise V2PError(f"{what} is empty; say in words what happens or what it is")
    return text


def _is_mark(char: str) -> bool:
    return unicodedata.category(char) == "Cf" or UNSEEN.match(char) is not None


def numbers(value: Any, count: int, what: str) -> list[float]:
    """Return a list of `count` numbers.

    Raises:
        V2PError: it is none.
    """

    def fits(v: Any) -> bool:
        return isinstance(v, int | float) and not isinstance(v, bool) and abs(v) < 1e6

    if not (isinstance(value, list) and len(value) == count and all(fits(v) for v in value)):
        raise V2PError(f"{what}, {count} numbers, not {shortened(json.dumps(value))}")
    return [float(v) for v in value]


def type_of(value: Any) -> str:
    """Return what JSON calls the type of a value."""
    names = {dict: "object", list: "list", str: "text", bool: "true/false", type(None): "null"}
    return names.get(type(value), "number")


def shortened(text: str, most: int = 200) -> str:
    """Return a text that fits into a sentence."""
    return text if len(text) <= most else f"{text[:most]}..."


def listed(names: Iterable[str], most: int = 6) -> str:
    """Return the first names, and how many more there are."""
    every = list(names)
    more = f" and {len(every) - most} more" if len(every) > most else ""
    return ", ".join(every[:most]) + more


def same_name(name: str, names: Iterable[str]) -> str | None:
    """Return which of `names` is this one, however its accents are encoded (Unicode NFC or NFD); None if none is."""
    every = list(names)
    if name in every:
        return name
    plain = unicodedata.normalize("NFC", name)
    return next((n for n in every if unicodedata.normalize("NFC", n) == plain), None)

"""Looks at a text from a stranger as text: what a reader of it, or a terminal, could be deceived by.

Python reads more characters than people see: marks that turn the direction of writing, line ends that editors
do not show, letters that look like others and that the parser takes for them.
"""

import io
import tokenize
import unicodedata
from contextlib import suppress

MAX_WORD_CHARS = 100
_FINE = frozenset("\n\t")
_HIDDEN = {
    "Cc": "a control character",
    "Cf": "an invisible character",
    "Cs": "half a character",
    "Zl": "a hidden line end",
    "Zp": "a hidden line end",
}
_TURNING = frozenset("\u061c\u200e\u200f\u202a\u202b\u202c\u202d\u202e\u2066\u2067\u2068\u2069")
"""What makes a line read in another order than it runs (Boucher & Anderson 2023, Trojan Source)."""


def hidden_character(source: str) -> tuple[str, int] | None:
    """Return a sentence and a line for the first character that hides something, None where there is none.

    A carriage return before a line feed is fine; alone it ends a line that editors show as going on.
    """
    line = 1
    for k, char in enumerate(source):
        if char == "\n":
            line += 1
        if char in _FINE or (char == "\r" and source[k + 1 : k + 2] == "\n"):
            continue
        what = _HIDDEN.get(unicodedata.category(char))
        if char in _TURNING:
            what = "a mark that turns the direction of writing"
        if what:
            return f"it holds {what} (U+{ord(char):04X}); leave it out", line
    return None


def foreign_name(source: str) -> tuple[str, int] | None:
    """Return a sentence and a line for the first name that is not ASCII, None where there is none.

    The parser takes full-width and other look-alike letters for ASCII ones, so they are gone from its tree.

    Args:
        source: a text that parses.
    """
    if source.isascii():
        return None
    with suppress(tokenize.TokenError, SyntaxError):
        for token in tokenize.generate_tokens(io.StringIO(source).readline):
            if token.type == tokenize.NAME and not token.string.isascii():
                return f"name {token.string[:60]!a} is not ASCII", token.start[0]
    return None


def shown(text: object, most: int) -> str:
    """Return a stranger's text fit for a file and a terminal: one line, no control or half characters."""
    return "".join(c if c.isprintable() else " " for c in str(text)[:most])

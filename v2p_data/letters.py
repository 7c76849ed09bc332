"""Which characters a reader sees: the one rule for texts of people, in captions, scenes and messages."""

import re

JOINERS = "\u200c\u200d"
"""Without width, but part of how Persian, Hindi and many emoji are written."""
UNSEEN = re.compile(
    "[\u034f\u115f\u1160\u17b4\u17b5\u180b-\u180f\u3164\ufe00-\ufe0d\uffa0\U000e0000-\U000e0fff]"
)
"""Letters and marks that Unicode lets everybody leave out (Default_Ignorable), where Python calls them printable."""


def is_shown(char: str) -> bool:
    """Return whether a reader sees a character, or a joiner of those beside it."""
    return (char.isprintable() and not UNSEEN.match(char)) or char in JOINERS

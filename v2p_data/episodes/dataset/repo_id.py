"""The rule for names of repositories on the Hub; of its own, so that a command can check one before it starts."""

import re

from v2p_data.errors import V2PError

_PART = r"[A-Za-z0-9](?:[A-Za-z0-9._-]*[A-Za-z0-9_])?"
_REPO_ID = re.compile(f"{_PART}/{_PART}")
LONGEST = 96
"""Characters of user and name together: what the Hub takes."""


def is_repo_id(text: str) -> bool:
    """Tell whether a text reads `user/name`, as the Hub takes it."""
    return (
        _REPO_ID.fullmatch(text) is not None
        and len(text) <= LONGEST
        and "--" not in text
        and ".." not in text
        and not text.endswith(".git")
    )


def check_repo_id(repo_id: str) -> None:
    """Raise unless `repo_id` reads `user/name`.

    Raises:
        V2PError: it does not.
    """
    if not is_repo_id(repo_id):
        raise V2PError(
            f"'{repo_id}' is no repository id; it reads USER/NAME, of letters, digits, '-', '_' and '.', that begin "
            f"and end with a letter or digit, without '--', '..' and '.git' at the end, {LONGEST} characters at most"
        )

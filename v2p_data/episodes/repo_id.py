"""The rule for names of repositories on the Hub; of its own, so that a command can check one before it starts."""

import re

from v2p_data.errors import V2PError

_REPO_ID = re.compile(r"[A-Za-z0-9][\w.-]*/[A-Za-z0-9][\w.-]*")


def check_repo_id(repo_id: str) -> None:
    """Raise unless `repo_id` reads `user/name`.

    Raises:
        V2PError: it does not.
    """
    if not _REPO_ID.fullmatch(repo_id) or "--" in repo_id or ".." in repo_id:
        raise V2PError(
            f"'{repo_id}' is no repository id; it reads USER/NAME, of letters, digits, '-', '_' and '.', "
            "without '--' or '..'"
        )

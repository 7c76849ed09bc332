"""The errors a user can do something about. Anything else is a bug and keeps its traceback."""

import difflib
import errno
import re
from collections.abc import Iterable
from typing import Any, Literal

from v2p_data.letters import JOINERS

NOTHING = 2
"""Exit code: what was asked for was not made."""
NOT_ALL = 3
"""Exit code: it was made, but something of it failed."""
_REFUSALS = {
    errno.ENOSPC: "no space is left on the disk; free some",
    errno.EDQUOT: "the disk quota is used up; free some space",
    errno.EFBIG: "a file may not grow that large here; raise the limit (ulimit -f)",
    errno.EROFS: "the file system is read-only; make it writable or choose another place",
    errno.EACCES: "there is no permission to write; change it or choose another place",
    errno.EPERM: "writing is not permitted; change that or choose another place",
    errno.EMFILE: "too many files are open; raise the limit (ulimit -n)",
    errno.ENAMETOOLONG: "the path is too long; choose a shorter one",
}
"""What no command can mend by itself -> what it is and what helps."""


class V2PError(Exception):
    """Bad input or a bad setting: one clear sentence for the user, exit code 2.

    Args:
        sentence: may quote files of others: what a terminal would obey, or not show, is written as its code.
    """

    def __init__(self, sentence: str) -> None:
        super().__init__(_shown(sentence))


class NotAllError(V2PError):
    """What was asked for is made, and something beside it is not: exit code 3."""


class ItemRejectedError(V2PError):
    """One item (a video, an episode) cannot go on; the others can.

    Args:
        reason: slug that the report groups by, such as `camera_moves`.
        detail: one sentence for a person.
        value: the number that decided it, where there is one.
    """

    def __init__(self, reason: str, detail: str, value: float | None = None) -> None:
        super().__init__(detail)
        self.reason = reason
        self.detail = str(self)
        self.value = value

    def __reduce__(self) -> tuple[Any, ...]:  # a worker process raises it too
        return type(self), (self.reason, self.detail, self.value)


class UnusableError(V2PError):
    """A result that the engine made earlier cannot be used as it lies there; others can.

    Args:
        reason: `damaged` or `newer_version`.
        detail: one sentence for a person: which file, and what to do.
    """

    def __init__(self, reason: Literal["damaged", "newer_version"], detail: str) -> None:
        super().__init__(detail)
        self.reason = reason
        self.detail = str(self)

    def __reduce__(self) -> tuple[Any, ...]:
        return type(self), (self.reason, self.detail)


def write_refusal(error: BaseException) -> str | None:
    """Return why nothing could be written and what helps, where that is what an error says.

    FFmpeg's errors have an errno and are no OSError; the writers of weights and tables say it in words only.
    """
    if re.search(r"No space left|StorageFull", str(error)):
        return _REFUSALS[errno.ENOSPC]
    return _REFUSALS.get(getattr(error, "errno", None) or 0)


def did_you_mean(word: str, known: Iterable[str]) -> str:
    """Return ` Did you mean 'x'? Known: ...` for an unknown word, to be appended to a message."""
    names = sorted(known)
    close = difflib.get_close_matches(word, names, n=1)
    hint = f" Did you mean '{close[0]}'?" if close else ""
    return f"{hint} Known: {', '.join(names)}."


def _shown(text: str) -> str:
    if text.isprintable():
        return text
    plain = (c.isprintable() or c == "\n" or c in JOINERS for c in text)
    codes = (
        c if ok else c.encode("unicode_escape").decode() for c, ok in zip(text, plain, strict=True)
    )
    return "".join(codes)

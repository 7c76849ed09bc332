"""Says no to task code: the error, and the place in the text that it points at."""

import ast
from typing import NoReturn

from v2p_data.errors import V2PError, did_you_mean

MAX_HINT_CHARS = 400


class TaskCodeError(V2PError):
    """Task code that is refused, with the line and the reason.

    Args:
        reason: one sentence.
        line: line number from 1; None where it is the whole text.
    """

    def __init__(self, reason: str, line: int | None = None) -> None:
        where = f"task code, line {line}" if line else "task code"
        super().__init__(f"{where}: {reason}")
        self.reason = reason
        self.line = line


class Here:
    """Where the reading is, shared by all who read, so that a refusal names the line."""

    def __init__(self) -> None:
        self.line = 1

    def move_to(self, node: ast.AST) -> None:
        """Go to a node; one without a line, such as an operator, is where the last one was."""
        self.line = getattr(node, "lineno", self.line)

    def refuse(
        self, reason: str, *, name: str = "", known: set[str] | frozenset[str] | None = None
    ) -> NoReturn:
        """Raise.

        Args:
            reason: one sentence.
            name: what was written, where something like it is known.
            known: what could have been meant.
        """
        if known:
            hint = did_you_mean(name, known)
            reason += hint if len(hint) < MAX_HINT_CHARS else hint.split(" Known:")[0]
        raise TaskCodeError(reason.strip(), self.line)

"""Task code as a whole: does it parse, is it short, flat and free of hidden characters, is every part allowed?"""

import ast
import warnings

from v2p_data.task.sandbox import allowed, source_text
from v2p_data.task.sandbox.reader.program import read_program
from v2p_data.task.sandbox.reader.refusal import TaskCodeError


def check_code(source: str) -> None:
    """Read task code without running it.

    Raises:
        TaskCodeError: something in it is not on the allow-list.
    """
    checked_tree(source)


def checked_tree(source: str) -> ast.Module:
    """Return the syntax tree of task code that has been read.

    Raises:
        TaskCodeError: something in it is not on the allow-list.
    """
    if len(source) > allowed.MAX_SOURCE_CHARS:
        raise TaskCodeError(
            f"it has {len(source)} characters; {allowed.MAX_SOURCE_CHARS} are allowed"
        )
    _refuse_text(source_text.hidden_character(source))
    try:
        with warnings.catch_warnings():  # a backslash in a docstring is no matter
            warnings.simplefilter("ignore", SyntaxWarning)
            tree = ast.parse(source)
    except SyntaxError as error:
        raise TaskCodeError(f"it is not Python: {error.msg}", error.lineno) from error
    except (ValueError, MemoryError, RecursionError) as error:
        raise TaskCodeError(
            f"it cannot be parsed ({type(error).__name__}: {error}); nest less deeply"
        ) from error
    _refuse_text(source_text.foreign_name(source))
    check_amount(tree)
    read_program(tree)
    return tree


def _refuse_text(found: tuple[str, int] | None) -> None:
    if found:
        raise TaskCodeError(*found)


def check_amount(tree: ast.Module) -> None:
    """Bound nodes, depth and the length of names, without recursion.

    Raises:
        TaskCodeError: there is more of them than is allowed.
    """
    count, level = 0, [tree]
    line = 1
    for _ in range(allowed.MAX_DEPTH):
        count += len(level)
        line = next(filter(None, (getattr(n, "lineno", None) for n in level)), line)
        for node in level:
            longest = max((len(name) for name in _names_of(node)), default=0)
            if longest > source_text.MAX_WORD_CHARS:
                raise TaskCodeError(
                    f"a name of {longest} characters; {source_text.MAX_WORD_CHARS} are allowed",
                    getattr(node, "lineno", line),
                )
        level = [child for node in level for child in ast.iter_child_nodes(node)]
        if count > allowed.MAX_NODES:
            raise TaskCodeError(f"it has more than {allowed.MAX_NODES} syntax nodes; write less")
        if not level:
            return
    raise TaskCodeError(
        f"it is nested more than {allowed.MAX_DEPTH} levels deep; split it up", line
    )


def _names_of(node: ast.AST) -> list[str]:
    """Return the names that a node itself holds."""
    if isinstance(node, ast.Constant):
        return []
    held = (getattr(node, field, None) for field in ("id", "attr", "arg", "name", "module"))
    return [name for name in held if isinstance(name, str)]

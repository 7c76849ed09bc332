"""Count how much there is to read, room by room, and hold it against `[tool.v2p.budget]` of `pyproject.toml`.

A room is a folder; a file belongs to the room with the longest matching name. Python counts as
statements of the syntax tree without docstrings, Markdown as words.

    python scripts/count_statements.py    # exits with 1 where a room has more than its budget
"""

import ast
import sys
import tomllib
from collections import Counter
from pathlib import Path

ROOT = Path(__file__).parents[1]
KINDS = {"statements": "*.py", "words": "*.md"}


def statements(source: str) -> int:
    """Return the number of statements in Python source; docstrings and other bare strings are none."""
    return sum(
        isinstance(node, ast.stmt)
        and not (
            isinstance(node, ast.Expr)
            and isinstance(node.value, ast.Constant)
            and isinstance(node.value.value, str)
        )
        for node in ast.walk(ast.parse(source))
    )


def budget_in(pyproject: str) -> dict[str, dict[str, int]]:
    """Return the budget that the text of a `pyproject.toml` states, by kind and room; empty where it has none."""
    return tomllib.loads(pyproject).get("tool", {}).get("v2p", {}).get("budget", {})


def counted(root: Path, kind: str, rooms: dict[str, int]) -> Counter[str]:
    """Return how many statements or words each room of a tree has."""
    count = {"statements": statements, "words": lambda text: len(text.split())}[kind]
    found: Counter[str] = Counter()
    for top in {Path(room).parts[0] for room in rooms}:
        files = [root / top] if (root / top).is_file() else (root / top).rglob(KINDS[kind])
        for file in files:
            place = file.relative_to(root)
            room = max((r for r in rooms if place.is_relative_to(r)), key=len, default=None)
            found[room or f"{place.parent} (no budget)"] += count(file.read_text("utf-8"))
    return found


def main() -> None:
    """Print each room's count beside its budget."""
    over = False
    for kind, rooms in budget_in((ROOT / "pyproject.toml").read_text("utf-8")).items():
        found = counted(ROOT, kind, rooms)
        for room in sorted(found):
            limit = rooms.get(room, 0)
            over |= found[room] > limit
            print(f"{room}: {found[room]:,} of {limit:,} {kind}")
        print(f"all: {sum(found.values()):,} of {sum(rooms.values()):,} {kind}")
    if over:
        sys.exit(
            "error: a room is larger than its budget in pyproject.toml; make it smaller, or lower "
            "another room's budget by as much"
        )


if __name__ == "__main__":
    main()

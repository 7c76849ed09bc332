"""Count the statements of each package, docstrings aside, and hold them against `[tool.v2p.statements]` of `pyproject.toml`.

python scripts/count_statements.py    # exits with 1 where a package has more than it may
"""

import ast
import sys
import tomllib
from pathlib import Path

ROOT = Path(__file__).parents[1]


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


def main() -> None:
    """Print each package's statements beside what it may have."""
    limits = tomllib.loads((ROOT / "pyproject.toml").read_text())["tool"]["v2p"]["statements"]
    over = False
    for package, limit in limits.items():
        count = sum(statements(p.read_text()) for p in (ROOT / package).rglob("*.py"))
        over |= count > limit
        print(f"{package}: {count:,} of {limit:,} statements")
    if over:
        sys.exit(
            "error: a package is larger than pyproject.toml allows; make it smaller, or raise the number with a reason"
        )


if __name__ == "__main__":
    main()

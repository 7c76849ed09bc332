"""Lines fit a screen, and the formatter leaves only tables of numbers alone."""

import ast
from pathlib import Path

ROOT = Path(__file__).parents[1]
LONGEST = 120
SKIP = "# fmt" + ": skip"
FILES = sorted(
    path
    for top in ("v2p_data", "policies", "lerobot_policy_v2p", "scripts", "tests")
    for path in (ROOT / top).rglob("*.py")
)


def text_lines(tree: ast.Module) -> set[int]:
    """Return the lines of long literal texts, which are data: prompts, word lists, pages."""
    docstrings = {node.value for node in ast.walk(tree) if isinstance(node, ast.Expr)}
    return {
        line
        for node in ast.walk(tree)
        if isinstance(node, ast.JoinedStr | ast.Constant) and node not in docstrings
        for line in range(node.lineno, node.end_lineno + 1)
        if node.end_lineno > node.lineno
    }


def too_long(source: str) -> list[int]:
    """Return the numbers of lines that are too long and neither a table, an address, a rule for a checker nor data."""
    data = text_lines(ast.parse(source))
    return [
        number
        for number, line in enumerate(source.split("\n"), 1)
        if len(line) > LONGEST
        and number not in data
        and not line.lstrip().startswith(("|", "# pyright:"))
        and not any(len(word) > LONGEST // 2 for word in line.split())
    ]


def is_number_table(node: ast.stmt) -> bool:
    inner = list(ast.walk(node))
    numbers = sum(
        isinstance(n, ast.Constant) and type(n.value) in (int, float, complex) for n in inner
    )
    others = sum(
        isinstance(n, ast.Name | ast.Call)
        or (isinstance(n, ast.Constant) and isinstance(n.value, str))
        for n in inner
    )
    return numbers >= 8 and numbers >= 2 * others


def test_no_line_is_longer_than_a_screen_is_wide():
    found = {path: too_long(path.read_text("utf-8")) for path in FILES}

    assert [f"{p.relative_to(ROOT)}:{n}" for p, lines in found.items() for n in lines] == []


def test_the_formatter_passes_over_tables_of_numbers_only():
    for path in FILES:
        source = path.read_text("utf-8")
        skipped = [n for n, line in enumerate(source.split("\n"), 1) if SKIP in line]
        if not skipped:
            continue
        statements = [n for n in ast.walk(ast.parse(source)) if isinstance(n, ast.stmt)]
        for line in skipped:
            ending = [n for n in statements if n.end_lineno == line]
            whole = max(ending, key=lambda n: n.lineno)
            assert is_number_table(whole), f"{path.relative_to(ROOT)}:{line}"


def test_a_long_line_of_code_is_found_and_a_row_of_a_table_is_not():
    row = "|" + " a |" * 40
    words = "word " * 30

    assert too_long(f'"""Says.\n\n{row}\n"""\n') == []
    assert too_long(f'"""{words}"""\n') == [1]
    assert too_long(f'x = "{words}"\n') == [1]
    assert too_long(f'x = """\n{words}\n"""\n') == []

"""Budgets of pyproject.toml only fall, or a commit says what a user gets for the rise."""

import importlib.util
import subprocess
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]
BUDGET = "Budget:"
"""How the message of a commit begins that raises the sum of all budgets."""


def git(*words: str, check: bool = True) -> str:
    done = subprocess.run(["git", *words], cwd=ROOT, capture_output=True, text=True, check=check)
    return done.stdout if done.returncode == 0 else ""


@pytest.fixture(scope="module")
def script():
    spec = importlib.util.spec_from_file_location("counts", ROOT / "scripts/count_statements.py")
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def unearned_rise(old: dict[str, dict[str, int]], new: dict[str, dict[str, int]]) -> int:
    """Return by how much budgets rise beyond what others fall, statements and words apart."""
    rises = 0
    for kind in old:
        before, after = old.get(kind, {}), new.get(kind, {})
        rises += max(0, sum(after.values()) - sum(before.values()))
    return rises


def rises(script, history: list[tuple[str, str, str]]) -> list[str]:
    """Return the messages of commits that raise budgets without the word, of (message, before, after)."""
    return [
        message
        for message, before, after in history
        if script.budget_in(before)  # the first commit with a budget raises nothing
        and unearned_rise(script.budget_in(before), script.budget_in(after))
        and not message.startswith(BUDGET)
    ]


def test_no_commit_raises_a_budget_without_lowering_another_or_saying_why(script):
    commits = git("log", "--format=%H", "--", "pyproject.toml", check=False).split()
    if not commits:
        pytest.skip("not a git checkout")
    history = []
    for commit in commits:
        after = git("show", f"{commit}:pyproject.toml")
        if not script.budget_in(after):
            break  # older than the budgets
        before = git("show", f"{commit}^:pyproject.toml", check=False)
        history.append((git("log", "-1", "--format=%s", commit), before, after))

    assert rises(script, history) == []


def test_a_rise_is_found_unless_it_is_earned_or_named(script):
    def budget(a: int, b: int, words: int = 9) -> str:
        return f"[tool.v2p.budget.statements]\na = {a}\nb = {b}\n[tool.v2p.budget.words]\ndocs = {words}\n"

    history = [
        ("moves a number", budget(5, 5), budget(7, 3)),
        ("raises one", budget(5, 5), budget(6, 5)),
        ("pays with words", budget(5, 5), budget(6, 5, words=1)),
        ("adds a room", budget(5, 5), budget(5, 5) + "more = 2\n"),
        ("Budget: an SO-101", budget(5, 5), budget(9, 5)),
        ("the first one", "", budget(5, 5)),
    ]

    assert rises(script, history) == ["raises one", "pays with words", "adds a room"]


def test_a_file_counts_in_the_room_with_the_longest_name_and_without_a_room_it_is_over(
    script, tmp_path
):
    (tmp_path / "house/room").mkdir(parents=True)
    (tmp_path / "house/a.py").write_text('"""Says nothing."""\nx = 1\n')
    (tmp_path / "house/room/b.py").write_text("def f():\n    return 1\n")
    (tmp_path / "README.md").write_text("three words here\n")

    assert script.counted(tmp_path, "statements", {"house": 1, "house/room": 2}) == {
        "house": 1,
        "house/room": 2,
    }
    assert script.counted(tmp_path, "statements", {"house/room": 2}) == {
        "house (no budget)": 1,
        "house/room": 2,
    }
    assert script.counted(tmp_path, "words", {"README.md": 3}) == {"README.md": 3}

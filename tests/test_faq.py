"""The page of reasons knows every reason that the engine can give, and names only options that exist."""

import ast
import re
from pathlib import Path
from typing import get_args

import pytest

from v2p_data.deployment import loop
from v2p_data.evaluation import failures

ROOT = Path(__file__).parents[1]
PAGE = (ROOT / "docs" / "faq.md").read_text()
LISTED = {
    name
    for line in PAGE.splitlines()
    if line.startswith("| `")
    for name in re.findall(r"`(\w+)`", line.split("|")[1])
}
LEROBOTS = {"--policy.type", "--policy.path", "--policy.push_to_hub", "--policy.device"}
"""Options of LeRobot's commands that sentences name, in a group that we have as well."""
LEROBOTS_COMMAND = re.compile(r"^lerobot-(?:.*\\\n)*.*$", re.MULTILINE)
REASON = re.compile(r"[a-z]+(_[a-z]+)*")


def reasons_of(source: str) -> set[str]:
    """Return the literal reasons of rejected items and episodes in a module's source."""
    found: set[str] = set()
    for node in ast.walk(ast.parse(source)):
        if isinstance(node, ast.Call) and ast.unparse(node.func) == "ItemRejectedError":
            first = node.args[0]
            if isinstance(first, ast.Constant):
                found.add(str(first.value))
        if isinstance(node, ast.Dict):
            for key, value in zip(node.keys, node.values, strict=True):
                named = isinstance(key, ast.Constant) and key.value == "reason"
                if (
                    named
                    and isinstance(value, ast.Constant)
                    and REASON.fullmatch(str(value.value))
                ):
                    found.add(str(value.value))
    return found


def test_every_reason_of_a_rejection_is_on_the_page():
    reasons: set[str] = set()
    for path in sorted((ROOT / "v2p_data").rglob("*.py")):
        reasons |= reasons_of(path.read_text())

    assert len(reasons) > 40
    assert reasons - LISTED == set()


def test_every_kind_of_failure_and_every_ending_of_a_run_is_on_the_page():
    kinds = {
        value
        for name, value in vars(failures).items()
        if name.isupper() and isinstance(value, str) and REASON.fullmatch(value)
    }

    assert len(kinds) == 7
    assert kinds - LISTED == set()
    assert set(get_args(loop.Ending)) - LISTED == set()


@pytest.mark.slow
def test_every_dotted_option_that_a_page_names_exists():
    from v2p_data.cli import options_of
    from v2p_data.commands import deploy, run

    known: set[str] = set()
    for kind in (run.Generate, run.Train, run.Evaluate, deploy.Deploy):
        known |= {option for option in options_of(kind) if "." in option}
    groups = {option.split(".")[0] for option in known}
    unknown: dict[str, set[str]] = {}
    for page in (ROOT / "README.md", *(ROOT / "docs").glob("*.md")):
        text = LEROBOTS_COMMAND.sub("", page.read_text())
        named = set(re.findall(r"--[a-z]+(?:\.[a-z][a-z0-9_-]*)+", text))
        ours = {option for option in named - LEROBOTS if option.split(".")[0] in groups}
        wrong = {o for o in ours if not any(k == o or k.startswith(o + ".") for k in known)}
        if wrong:
            unknown[page.name] = wrong

    assert len(known) > 200
    assert unknown == {}

"""What may not be committed, and what the README promises."""

import ast
import re
import shlex
import subprocess
from pathlib import Path

import pytest

from v2p_data.cli import COMMANDS

ROOT = Path(__file__).parents[1]
LARGEST = 5_000_000


def tracked_files() -> list[Path]:
    listed = subprocess.run(["git", "ls-files", "-z"], cwd=ROOT, capture_output=True, check=False)
    if listed.returncode:
        pytest.skip("not a git checkout")
    return [ROOT / name for name in listed.stdout.decode().split("\0") if name]


def shown_commands(page: str) -> list[str]:
    blocks = re.findall(r"```(?:bash|sh)\n(.*?)```", (ROOT / page).read_text(), re.S)
    lines = "\n".join(blocks).replace("\\\n", " ").splitlines()
    return [line.split("#")[0].strip() for line in lines if line.split("#")[0].strip()]


def test_no_file_is_larger_than_five_megabytes():
    assert [p for p in tracked_files() if p.is_file() and p.stat().st_size > LARGEST] == []


def test_no_text_names_a_package_index_or_a_machine_of_ours():
    hosts = re.compile(rb"pypi\.or" rb"g|pythonhost" rb"ed|(?<![\w.])/(?:wor" rb"k|far" rb"m)/")
    assert [p for p in tracked_files() if p.is_file() and hosts.search(p.read_bytes())] == []


def opens_text_without_encoding(call: ast.Call) -> bool:
    """Return whether a call opens a text file in the encoding of whoever runs it."""
    name = getattr(call.func, "attr", getattr(call.func, "id", ""))
    given = {k.arg: k.value for k in call.keywords}
    mode = given.get(
        "mode",
        next((a for a in call.args if re.fullmatch(r"'[rwaxbt+]{1,3}'", ast.unparse(a))), None),
    )
    is_bytes = mode is not None and "b" in ast.unparse(mode)
    if (
        "encoding" in given
        or is_bytes
        or ast.unparse(call.func).split(".")[0] in ("av", "_av()", "os")
    ):
        return False
    places = {
        "read_text": 0,
        "write_text": 1,
        "open": 99 if isinstance(call.func, ast.Name) or mode else 0,
    }
    return len(call.args) <= places.get(name, -1) or (
        name == "NamedTemporaryFile" and mode is not None
    )


@pytest.mark.parametrize(
    ("call", "is_fault"),
    [
        ("open(path)", True),
        ("path.open()", True),
        ("path.open('a', newline='')", True),
        ("path.open(mode='w')", True),
        ("NamedTemporaryFile('w')", True),
        ("path.read_text(errors='replace')", True),
        ("path.write_text(text)", True),
        ("path.write_text(text, 'utf-8')", False),
        ("path.read_text('utf-8-sig')", False),
        ("path.open('rb')", False),
        ("open(path, 'w', encoding='utf-8')", False),
        ("av.open(buffer, 'w')", False),
        ("Image.open(path)", False),
    ],
)
def test_a_text_file_that_is_opened_without_an_encoding_is_found(call, is_fault):
    assert opens_text_without_encoding(ast.parse(call, mode="eval").body) == is_fault


def test_every_text_file_is_opened_as_utf_8():
    ours = [
        p for p in tracked_files() if p.suffix == ".py" and "tests" not in p.parts and p.is_file()
    ]
    faults = [
        f"{path.relative_to(ROOT)}:{node.lineno}: say encoding='utf-8'"
        for path in ours
        for node in ast.walk(ast.parse(path.read_bytes()))
        if isinstance(node, ast.Call) and opens_text_without_encoding(node)
    ]

    assert faults == []


def test_the_readme_shows_its_two_commands():
    assert {"make demo", "make test"} <= set(shown_commands("README.md"))


def test_the_readme_has_at_most_a_thousand_words_beside_its_code():
    prose = re.sub(r"```.*?```", "", (ROOT / "README.md").read_text(), flags=re.S)

    assert len(prose.split()) <= 1000


@pytest.mark.slow
@pytest.mark.parametrize(
    "page", ["README.md", *sorted(f"docs/{p.name}" for p in (ROOT / "docs").glob("*.md"))]
)
def test_every_v2p_command_in_readme_and_docs_parses(page):
    from v2p_data.cli import parse
    from v2p_data.commands import (
        camera,
        deploy,
        edit,
        gc,
        review,
        reward,
        run,
        setup,
        share,
        show,
        status,
    )

    kinds = {
        "generate": run.Generate,
        "distill": run.Train,
        "train": run.Train,
        "eval": run.Evaluate,
        "deploy": deploy.Deploy,
        "push": share.Push,
        **dict.fromkeys(("scene", "task", "reward", "expert", "episodes"), run.FromVideos),
        "scene camera": camera.OneCamera,
        "scene review": review.ReviewRun,
        "reward search": reward.Search,
        "verify": share.Verify,
        "replay": share.Replay,
        "explain": share.Explain,
        "merge": edit.Merge,
        "drop": edit.Drop,
        "status": status.Status,
        "report": status.Shown,
        "show": show.Show,
        "gc": gc.Gc,
        "setup": setup.Setup,
        "demo": run.Demo,
        "try": run.Try,
    }
    assert set(kinds) == set(COMMANDS)
    for words in map(shlex.split, shown_commands(page)):
        if words[0] == "v2p":
            name = " ".join(words[1:3]) if " ".join(words[1:3]) in COMMANDS else words[1]
            rest = words[1 + len(name.split()) :]
            parse(kinds[name], deploy.robot_settings(rest)[1] if name == "deploy" else rest, name)


def test_links_between_our_pages_lead_somewhere():
    for page in (ROOT / "README.md", *(ROOT / "docs").glob("*.md")):
        text = page.read_text()
        links = re.findall(r"\]\(([^)#:]+)\)", text)
        named = re.findall(r"`((?:docs|scripts|configs)/[\w./]+\.\w+)`", text)

        missing = [link for link in links if not (page.parent / link).exists()]
        assert missing + [path for path in named if not (ROOT / path).exists()] == [], page.name

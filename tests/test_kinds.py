"""A fifteenth kind of task goes through the whole chain, and a kind that lacks a part stops the import."""

import json
import runpy
import subprocess
import sys
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest

from v2p_data.errors import V2PError
from v2p_data.experts import teacher
from v2p_data.kinds import KINDS, TaskKind, check_every_kind, kind_named
from v2p_data.task import referee
from v2p_data.task.templates import recipes
from v2p_data.video import meaning


def test_a_new_kind_goes_from_the_caption_to_a_solved_task():
    script = Path(__file__).with_name("fifteenth_kind.py")

    done = subprocess.run(
        [sys.executable, str(script)], capture_output=True, text=True, check=False
    )

    assert done.returncode == 0, done.stderr
    said = json.loads(done.stdout)
    assert said["kind"] == "put_behind"
    assert said["is_mirrored"]
    assert said["program"] == "put behind mug"
    assert said["task_success"] >= 0.7
    assert said["referee_success"] >= 0.7


@pytest.mark.parametrize(
    ("module", "words"),
    [
        (recipes, "task kind 'put_behind' has no template; add one to RECIPES"),
        (referee, "task kind 'put_behind' has no referee rule; add one to RULES"),
    ],
)
def test_a_kind_without_one_of_its_parts_stops_the_import(
    module: Any, words: str, monkeypatch: pytest.MonkeyPatch
):
    monkeypatch.setitem(KINDS, "put_behind", KINDS["cover"])

    with pytest.raises(ValueError, match=words):
        runpy.run_path(module.__file__)


@pytest.mark.parametrize(
    ("module", "changes", "words"),
    [
        (meaning, {"phrases": (("put", "onto"),)}, "'place_onto' and 'generic' both have the"),
        (meaning, {"phrases": (("juggle", ""),)}, "has the phrase .'juggle', ''.; add its words"),
        (teacher, {"programs": ("juggle",)}, "'generic' prefers the scripted policy 'juggle'"),
    ],
)
def test_a_kind_with_an_unknown_part_stops_the_import(
    module: Any, changes: dict[str, Any], words: str, monkeypatch: pytest.MonkeyPatch
):
    monkeypatch.setitem(KINDS, "generic", replace(KINDS["generic"], **changes))

    with pytest.raises(ValueError, match=words):
        runpy.run_path(module.__file__)


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        ({"other": "ignored"}, "its `other` must be needed"),
        ({"slides": True}, "it cannot grasp what it manipulates"),
        ({"programs": ()}, "names no scripted policy"),
    ],
)
def test_a_row_that_contradicts_itself_is_refused(changes: dict[str, Any], words: str):
    with pytest.raises(ValueError, match=words):
        replace(KINDS["cover"], **changes)


def test_an_entry_of_an_unknown_kind_is_refused():
    with pytest.raises(ValueError, match="TABLE has a part of 'juggle'"):
        check_every_kind([*KINDS, "juggle"], "part", "TABLE")


def test_an_unknown_kind_in_a_file_is_answered_with_the_known_ones():
    with pytest.raises(V2PError, match=r"task.json: there is no task kind 'lift'.*lift_up"):
        kind_named("lift", "task.json")


def test_every_kind_has_its_own_name():
    assert all(isinstance(row, TaskKind) and row.name == name for name, row in KINDS.items())

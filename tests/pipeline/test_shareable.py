"""What is shown to others names no place on its maker's disk."""

import shutil
import subprocess

import pytest

from v2p_data.pipeline import artifact
from v2p_data.pipeline.shareable import without_places


@pytest.mark.parametrize(
    ("private", "public"),
    [
        ("/home/ann/my videos", "my videos"),
        ("/data", "data"),
        ("~/clips/a.mp4", "a.mp4"),
        ("--out=/home/ann/my runs/one", "--out=one"),
        ("--config=~/x.yaml", "--config=x.yaml"),
        ("/home/ann/venv/bin/python /home/ann/worker.py --fast", "python worker.py --fast"),
        ("made from '/home/ann/a b.mp4'", "made from 'a b.mp4'"),
        ("'/home/ann/my env/bin/python' -m \"/home/ann/x.py\"", "'python' -m \"x.py\""),
        ("outputs/demo", "outputs/demo"),
        ("https://api.example.com/v1/chat", "https://api.example.com/v1/chat"),
        ("put it in / onto the box", "put it in / onto the box"),
        ("7/8 of it and/or more", "7/8 of it and/or more"),
        ("x = a/b/c", "x = a/b/c"),
        ("/", "."),
    ],
)
def test_absolute_paths_lose_all_but_their_name(private: str, public: str):
    assert without_places(private) == public


def test_what_holds_no_path_stays_as_it_is():
    data = {"a": [1, 2.5, None, True, "push left"], "b": {"c": "d/e"}}

    assert without_places(data) == data


def test_paths_are_found_however_deep_they_lie():
    told = without_places({"/home/ann/a": [{"argv": ("v2p", "/home/ann/b")}]})

    assert told == {"a": [{"argv": ["v2p", "b"]}]}


@pytest.mark.parametrize(
    ("package", "is_added", "is_ours"),
    [
        (".", True, True),
        (".", False, False),
        (".venv/lib/site-packages", False, False),
        (".venv/lib/site-packages", True, False),
    ],
)
def test_the_commit_is_that_of_a_repository_of_ours(tmp_path, package, is_added, is_ours):
    """The virtual environment often lies inside its user's own repository."""
    root = tmp_path / package
    (root / "v2p_data" / "pipeline").mkdir(parents=True)
    shutil.copy(artifact.__file__, root / "v2p_data" / "pipeline")
    (tmp_path / "notes").write_text("mine")

    def git(*words: str) -> str:
        as_somebody = ("-c", "user.name=a", "-c", "user.email=a@b.c")
        command = ["git", "-C", tmp_path, *as_somebody, *words]
        return subprocess.run(command, check=True, capture_output=True, text=True).stdout.strip()

    git("init", "-q")
    git("add", "." if is_added else "notes")
    git("commit", "-qm", "a commit")

    assert artifact.commit_of(root) == (git("rev-parse", "HEAD") if is_ours else "")

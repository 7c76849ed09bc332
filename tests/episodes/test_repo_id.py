"""One rule for names on the Hub, no laxer than the Hub's own, and asked before anything is made."""

from pathlib import Path

import pytest
from huggingface_hub.utils import HFValidationError, validate_repo_id

from v2p_data.cli import run
from v2p_data.episodes.dataset.repo_id import check_repo_id, is_repo_id
from v2p_data.errors import V2PError
from v2p_data.seeds import rng_for

BAD = (
    *(
        "toys",
        "me/",
        "/toys",
        "a/b/c",
        "me/my toys",
        "-me/toys",
        "me/-toys",
        "me/toys-",
        "me/toys.",
        ".me/toys",
    ),
    *(
        "me/a--b",
        "me/a..b",
        "me/toys.git",
        "me/to\u00f6ys",
        "me/toys\n",
        "",
        "me/" + "x" * 94,
        "http://me/toys",
    ),
)
GOOD = ("me/toys", "a/b", "Me_1/to-ys_2.x", "0/1", "me/toys_", "me/" + "x" * 93)


@pytest.mark.parametrize("repo_id", GOOD)
def test_what_the_hub_takes_is_taken(repo_id: str):
    check_repo_id(repo_id)
    validate_repo_id(repo_id)


@pytest.mark.parametrize("repo_id", BAD)
def test_what_reads_otherwise_is_refused(repo_id: str):
    with pytest.raises(V2PError, match="USER/NAME"):
        check_repo_id(repo_id)


def test_nothing_is_taken_that_the_hub_refuses():
    rng = rng_for(1, "repository ids")
    letters = list("ab0-_./ ")
    taken = 0
    for _ in range(20_000):
        text = "".join(rng.choice(letters, rng.integers(1, 12)))
        if is_repo_id(text):
            taken += 1
            try:
                validate_repo_id(text)
            except HFValidationError as error:
                pytest.fail(f"{text!r}: {error}")
    assert taken > 100


@pytest.mark.parametrize("repo_id", ["toys", "me/a--b", "me/toys.git", "me/toys-"])
@pytest.mark.parametrize(
    "command",
    [
        ("generate", "{videos}", "--out", "{out}"),
        ("merge", "{dataset}", "{dataset}", "--out", "{out}"),
        ("drop", "{dataset}", "--tasks", "lift the toy up", "--out", "{out}"),
        ("push", "{dataset}"),
        ("push", "{dataset}", "--envhub"),
    ],
    ids=lambda c: " ".join(c[::3]),
)
def test_each_command_asks_before_anything_is_made(
    capsys, packed: Path, tmp_path: Path, command: tuple[str, ...], repo_id: str
):
    out = tmp_path / "out"
    samples = Path(__file__).parents[2] / "datasets" / "sample_videos"
    before = {p: p.stat().st_mtime_ns for p in packed.rglob("*")}

    words = [w.format(videos=samples, dataset=packed, out=out) for w in command]
    code = run([*words, f"--repo-id={repo_id}"])

    assert code == 2
    assert f"'{repo_id}' is no repository id" in capsys.readouterr().err
    assert not out.exists()
    assert {p: p.stat().st_mtime_ns for p in packed.rglob("*")} == before

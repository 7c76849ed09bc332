"""A dataset from elsewhere is read in bounded memory and time, or refused in one sentence that names the file."""

import resource
import shutil
import sys
import time
from pathlib import Path

import pytest

from v2p_data.cli import run
from v2p_data.episodes.dataset.verify import verify

sys.path.insert(0, str(Path(__file__).parent))
import strange_datasets

pytestmark = pytest.mark.slow
COMMANDS = {
    "verify": [],
    "explain": [],
    "drop": ["--tasks", "lift the toy up", "--out", "{out}"],
    "merge": ["--out", "{out}", "--repo-id", "user/made"],
    "push": ["--repo-id", "user/pushed"],
}


@pytest.fixture(scope="module")
def good(tmp_path_factory: pytest.TempPathFactory) -> Path:
    made = strange_datasets.good_dataset(tmp_path_factory.mktemp("strange"))
    assert verify(made).is_good
    return made


@pytest.fixture
def spoiled(good: Path, tmp_path: Path) -> Path:
    return Path(shutil.copytree(good, tmp_path / "spoiled"))


@pytest.mark.parametrize("name", strange_datasets.REFUSED)
def test_no_command_reads_what_asks_for_too_much(
    name: str,
    spoiled: Path,
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
    monkeypatch: pytest.MonkeyPatch,
):
    monkeypatch.delenv("HF_TOKEN", raising=False)
    strange_datasets.REFUSED[name](spoiled)
    began = time.process_time()
    memory = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss

    for command, more in COMMANDS.items():
        code = run([command, str(spoiled), *(w.format(out=tmp_path / "out") for w in more)])

        words = capsys.readouterr().err
        assert code == 2, (command, words)
        assert "Traceback" not in words
        assert str(spoiled) in words
        assert not (tmp_path / "out").exists()
    assert time.process_time() - began < 10
    assert resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - memory < 2**20  # 1 GB, in KiB


@pytest.mark.parametrize("name", strange_datasets.FOUND)
def test_what_can_be_read_and_is_wrong_is_listed(
    name: str, spoiled: Path, capsys: pytest.CaptureFixture[str]
):
    strange_datasets.FOUND[name](spoiled)

    assert run(["verify", str(spoiled)]) == 1
    assert "problem" in capsys.readouterr().out


@pytest.mark.parametrize("name", strange_datasets.UNSOUND)
def test_no_dataset_is_made_of_one_that_is_not_sound(
    name: str, spoiled: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
):
    (spoiled / "record.json").unlink(missing_ok=True)
    strange_datasets.UNSOUND[name](spoiled)

    for command, more in COMMANDS.items():
        if command in ("drop", "merge"):
            code = run([command, str(spoiled), *(w.format(out=tmp_path / "out") for w in more)])
            assert code == 2
            assert "is not sound" in capsys.readouterr().err

"""`v2p distill`, made by worker processes as a user has it, and what it says to bad input."""

import shutil
from collections.abc import Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path

import pytest
import toy_run
from toy_run import dataset_of, record_of

from v2p_data.cli import run
from v2p_data.commands import run as commands
from v2p_data.pipeline.runner import Runtime, Stage
from v2p_data.pipeline.workers import run_stages

QUICK = (
    *("--policy.preset", "small", "--policy.batch-size", "8"),
    *("--distillation.rounds", "1", "--distillation.episodes", "2", "--distillation.worlds", "4"),
    *("--distillation.takeover", "0.1", "0.5", "--distillation.first-steps", "2"),
)


def agreeing(stage: Stage) -> Stage:
    """Return the stage for a process of its own, where nobody has told the referee to agree."""
    inputs = {name: agreeing(needed) for name, needed in stage.inputs.items()}
    return replace(stage, inputs=inputs, make=partial(toy_run.make_agreeing, stage.make))


@pytest.fixture
def root(finished: Path, tmp_path: Path) -> Path:
    return Path(shutil.copytree(finished, tmp_path / "run"))


def only(root: Path, pattern: str) -> Path:
    (found,) = root.glob(pattern)
    return found


@pytest.mark.long
@pytest.mark.e2e
def test_worker_processes_distil_and_pack_and_the_next_command_is_told(
    capsys, root: Path, monkeypatch: pytest.MonkeyPatch
):
    def in_workers(stages: Sequence[Stage], runtime: Runtime, display):
        return run_stages([agreeing(stage) for stage in stages], runtime, display)

    monkeypatch.setattr(commands, "run_stages", in_workers)
    assert run(["distill", str(dataset_of(root)), *QUICK, "--workers", "2"]) == 0

    said = capsys.readouterr().out
    distilled, distillation = only(root, "dataset/toys-distilled-*"), only(root, "distillation/*")
    assert f"Made {distilled}" in said
    assert f"{record_of(distillation).counts['episodes']} handover episodes" in said
    assert f"v2p train {dataset_of(root)}" in said
    assert list(root.glob("logs/worker-*.log"))
    assert not list(root.rglob("*.partial"))
    demonstrations = record_of(dataset_of(root)).counts
    for name in ("episodes", "frames"):
        added = record_of(distillation).counts[name]
        assert record_of(distilled).counts[name] == demonstrations[name] + added > added > 0


def said(capsys, *argv: object) -> str:
    """Return the one sentence on stderr; the command must end with code 2."""
    assert run([str(a) for a in argv]) == 2
    (line,) = capsys.readouterr().err.strip().splitlines()
    return line


def test_no_rounds_are_nothing_to_do(capsys, finished: Path):
    words = said(capsys, "distill", dataset_of(finished), "--distillation.rounds=0")

    assert "leaves nothing to do; it is 1 or more" in words


@pytest.mark.parametrize("gone", ["expert", "task", "episodes"])
def test_without_its_experts_a_dataset_cannot_be_distilled(capsys, root: Path, gone: str):
    shutil.rmtree(root / gone)

    words = said(capsys, "distill", dataset_of(root), *QUICK)

    assert "distillation needs the run that made it" in words
    assert not (root / "distillation").exists()


def test_a_folder_that_is_no_dataset_is_named(capsys, tmp_path: Path):
    words = said(capsys, "distill", tmp_path, *QUICK)

    assert f"{tmp_path} is no dataset of v2p generate" in words

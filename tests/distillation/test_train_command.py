"""`v2p train`: what it says and makes, and one sentence with exit code 2 for bad input."""

import json
import shutil
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
import torch
from toy_run import dataset_of, made, record_of

from v2p_data.cli import run
from v2p_data.commands import run as commands
from v2p_data.pipeline.artifact import write_record
from v2p_data.pipeline.contents import list_files

QUICK = ("--policy.preset", "small", "--policy.steps", "3", "--policy.batch-size", "8")


@pytest.fixture(autouse=True)
def _in_this_process(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(commands, "run_stages", made)


@pytest.fixture
def dataset(finished: Path, tmp_path: Path) -> Path:
    """Of a run whose expert is gone."""
    root = Path(shutil.copytree(finished, tmp_path / "run"))
    shutil.rmtree(root / "expert")
    return dataset_of(root)


def said(capsys, *argv: object) -> str:
    """Return the one sentence on stderr; the command must end with code 2."""
    assert run([str(a) for a in argv]) == 2
    lines = capsys.readouterr().err.strip().splitlines()
    assert len([line for line in lines if line.startswith("v2p train: ")]) == 1
    assert "raceback" not in lines[-1]
    return lines[-1]


def change_json(path: Path, change: Callable[[Any], None]) -> None:
    data = json.loads(path.read_text())
    change(data)
    path.write_text(json.dumps(data))


def made_like_this(folder: Path) -> None:
    """Let the record list the files as they are now: what they hold is at issue, not that they were changed."""
    write_record(folder, replace(record_of(folder), files=list_files(folder)))


def test_without_experts_the_demonstrations_are_cloned_and_that_is_said(capsys, dataset: Path):
    assert run(["train", str(dataset), *QUICK]) == 0

    words = capsys.readouterr()
    assert "so the policy clones its demonstrations only" in words.err
    assert "after 3 steps" in words.out
    root = dataset.parent.parent
    (policy,) = root.glob("policy/*/policy/model.safetensors")
    assert f"v2p eval {policy.parent}" in words.out
    assert not (root / "distillation").exists()
    assert record_of(policy.parents[1]).counts["frames"] == record_of(dataset).counts["frames"]


def test_the_steps_of_epochs_are_counted_and_said(capsys, dataset: Path):
    assert run(["train", str(dataset), *QUICK, "--policy.epochs", "1"]) == 0

    frames = record_of(dataset).counts["frames"]
    assert f"after {frames // 8} steps" in capsys.readouterr().out


def test_a_dataset_without_cameras_is_refused(capsys, dataset: Path):
    def blind(info: dict[str, Any]) -> None:
        del info["features"]["observation.images.mask"]

    change_json(dataset / "meta/info.json", blind)
    made_like_this(dataset)

    assert "v2p_bc looks at images, and this dataset has none" in said(
        capsys, "train", dataset, *QUICK
    )


@pytest.mark.parametrize(
    ("key", "statistic", "preset"),
    [
        ("observation.state", "mean", "small"),
        ("observation.state", None, "small"),
        ("action", "max", "small"),
        ("action", None, "small"),
        ("action", "std", "paper"),
    ],
)
def test_a_missing_statistic_is_named(
    capsys, dataset: Path, key: str, statistic: str | None, preset: str
):
    def forget(stats: dict[str, Any]) -> None:
        del (stats[key] if statistic else stats)[statistic or key]

    change_json(dataset / "meta/stats.json", forget)
    made_like_this(dataset)

    message = said(capsys, "train", dataset, "--policy.preset", preset)

    assert f"meta/stats.json has no '{statistic or ''}" in message
    assert f"of '{key}'" in message


def test_settings_that_contradict_are_refused_before_any_work(capsys, dataset: Path):
    message = said(capsys, "train", dataset, "--policy.n-action-steps", "2")

    assert "--policy.n-action-steps must lie between 1 and chunk_size (1), got 2" in message
    assert not (dataset.parent.parent / "policy").exists()


@pytest.mark.parametrize(
    ("flags", "word"),
    [
        (("--policy.input-size-px", "8"), "input_size_px is 8"),
        (("--policy.n-obs-steps", "0"), "n-obs-steps must be at least 1"),
    ],
)
def test_an_impossible_network_is_refused(capsys, dataset: Path, flags, word: str):
    assert word in said(capsys, "train", dataset, *flags)


@pytest.mark.parametrize("device", ["cuda", "cuda:7", "gpu", "tpu"])
def test_a_device_that_is_not_there_is_refused_before_any_work(
    capsys, dataset: Path, device: str, monkeypatch: pytest.MonkeyPatch
):
    monkeypatch.setattr(torch.cuda, "is_available", lambda: False)
    monkeypatch.setattr(torch.cuda, "device_count", lambda: 0)

    message = said(capsys, "train", dataset, *QUICK, "--device", device)

    assert f"--device {device} is not on this machine; it has cpu" in message
    assert not (dataset.parent.parent / "policy").exists()


def test_why_the_distillation_failed_is_said_and_not_only_that_the_policy_waits_for_it(
    capsys, finished: Path, tmp_path: Path
):
    root = Path(shutil.copytree(finished, tmp_path / "run"))
    (episodes,) = (root / "episodes").glob("*")

    record = record_of(episodes)
    record.recipe["config"]["config"]["render"] = "both"
    write_record(episodes, record)

    message = said(capsys, "train", dataset_of(root), *QUICK)

    assert "the demonstrations show 'both'" in message
    assert "--distillation.rounds=0" in message
    assert not (root / "cache").exists()

"""The command line from end to end, killed in every stage and told to go on."""

import hashlib
import json
import os
import shutil
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest

SAMPLES = Path(__file__).parents[1] / "datasets" / "sample_videos"
STAGES = ("scene", "task", "expert", "episodes", "dataset")
SETTINGS = """
task: {num_samples: 2}
expert:
  num_envs: 96
  trial_worlds: 16
  eval_episodes: 8
  min_success: 0.0
  imitation: {target_success: 0.8}
  ppo: {total_steps: 4096, window_episodes: 16, min_window_episodes: 8, num_deterministic: 16}
episodes: {num_episodes: 3, batch_worlds: 32, size_px: 64}
"""
PATIENCE_S = 480


@pytest.fixture(scope="module")
def videos(tmp_path_factory) -> Path:
    folder = tmp_path_factory.mktemp("videos")
    shutil.copy(SAMPLES / "tip_green_carton.mp4", folder)
    caption = json.loads((SAMPLES / "captions.json").read_text())["tip_green_carton.mp4"]
    (folder / "captions.json").write_text(json.dumps({"tip_green_carton.mp4": caption}))
    (folder / "settings.yaml").write_text(SETTINGS)
    return folder


def start(videos: Path, out: Path, *flags: str) -> subprocess.Popen[str]:
    command = [sys.executable, "-m", "v2p_data.cli", "generate", str(videos), "--out", str(out)]
    options = ["--repo-id", "tests/chain", "--config", str(videos / "settings.yaml"), *flags]
    return subprocess.Popen(
        [*command, *options],
        text=True,
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
        env={**os.environ, "OMP_NUM_THREADS": "1"},
    )


def finish(process: subprocess.Popen[str]) -> str:
    output, _ = process.communicate(timeout=PATIENCE_S)
    assert process.returncode == 0, output
    return output


def content(out: Path) -> dict[str, str]:
    """Return a hash per file of the only dataset, its record and its history aside."""
    (dataset,) = (out / "dataset").glob("*")
    # Time and machine differ from run to run; frames, masks, actions and tasks must not.
    files = [p for p in dataset.rglob("*") if p.suffix in (".parquet", ".mp4", ".py")]
    hashes = {
        str(p.relative_to(dataset)): hashlib.sha256(p.read_bytes()).hexdigest()
        for p in sorted(files)
    }
    # LeRobot writes these in an order that changes from process to process.
    described = {
        name: json.dumps(json.loads((dataset / "meta" / name).read_text()), sort_keys=True)
        for name in ("info.json", "stats.json")
    }
    return hashes | described


@pytest.mark.long
@pytest.mark.slow
@pytest.mark.e2e
@pytest.mark.timeout(900)
def test_a_run_killed_in_every_stage_ends_in_the_dataset_of_an_undisturbed_one(videos, tmp_path):
    finish(start(videos, tmp_path / "calm"))

    out = tmp_path / "killed"
    for stage in STAGES:
        process = start(videos, out)
        deadline = time.monotonic() + PATIENCE_S
        while not list(out.glob(f"{stage}/*.partial")):
            assert process.poll() is None, f"ended before {stage}"
            assert time.monotonic() < deadline
            time.sleep(0.02)
        time.sleep(0.2)
        process.send_signal(signal.SIGKILL)
        process.communicate()
        assert not list(out.glob(f"{stage}/*/record.json")), f"{stage} was over before the kill"
    finish(start(videos, out))

    assert len(content(out)) > 5
    assert content(out) == content(tmp_path / "calm")
    again = finish(start(videos, out))
    assert "made in" not in again
    assert not list(out.rglob("*.partial"))

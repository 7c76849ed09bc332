"""The command line from end to end, killed in every stage.

The notebook and the page of the Python API as they stand.
"""

import hashlib
import json
import os
import re
import shutil
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]
SAMPLES = ROOT / "datasets" / "sample_videos"
AROUND = {**os.environ, "OMP_NUM_THREADS": "1", "MPLBACKEND": "agg", "PYTHONPATH": str(ROOT)}
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
        env=AROUND,
    )


def finish(process: subprocess.Popen[str]) -> str:
    output, _ = process.communicate(timeout=PATIENCE_S)
    assert process.returncode == 0, output
    return output


def ran(script: str, where: Path, **variables: str) -> str:
    """Return what a script of a folder prints; it must end well."""
    done = subprocess.run(
        [sys.executable, script],
        cwd=where,
        env=AROUND | variables,
        capture_output=True,
        text=True,
        timeout=PATIENCE_S,
        check=False,
    )
    assert done.returncode == 0, done.stdout[-1000:] + done.stderr[-3000:]
    return done.stdout


@pytest.fixture(scope="module")
def calm(videos, tmp_path_factory) -> Path:
    """Return a run that nobody disturbed."""
    out = tmp_path_factory.mktemp("calm") / "run"
    finish(start(videos, out))
    return out


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
@pytest.mark.e2e
@pytest.mark.timeout(900)
def test_a_run_killed_in_every_stage_ends_in_the_dataset_of_an_undisturbed_one(
    videos, calm, tmp_path
):
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
    assert content(out) == content(calm)
    again = finish(start(videos, out))
    assert "made in" not in again
    assert not list(out.rglob("*.partial"))


@pytest.mark.long
@pytest.mark.timeout(900)
def test_the_notebook_runs_on_a_run_of_one_clip(calm: Path, tmp_path: Path):
    notebook = json.loads((ROOT / "docs" / "quickstart.ipynb").read_text())
    cells = [c for c in notebook["cells"] if c["cell_type"] == "code"]
    (tmp_path / "cells.py").write_text("\n\n".join("".join(c["source"]) for c in cells))

    said = ran("cells.py", tmp_path, V2P_RUN=str(calm))

    assert "manipulated green_carton" in said
    assert "3 episodes" in said
    assert re.search(r"expert of .* \(\d+ of 16\)", said)


@pytest.mark.long
def test_the_blocks_of_the_api_page_run_one_after_the_other(tmp_path: Path):
    page = (ROOT / "docs" / "python_api.md").read_text()
    blocks = re.findall(r"^```python\n(.*?)^```", page, re.S | re.M)
    (tmp_path / "datasets").symlink_to(ROOT / "datasets")
    (tmp_path / "blocks.py").write_text("\n".join(blocks))

    said = ran("blocks.py", tmp_path)

    assert len(blocks) == 4
    assert "lift_up" in said
    assert "task lift_red_box made" in said
    assert (tmp_path / "outputs" / "by_hand" / "task" / "task.py").is_file()


def test_every_function_that_the_api_page_names_is_defined_in_its_file():
    page = (ROOT / "docs" / "python_api.md").read_text()
    rows = re.findall(
        r"^\| [^|]+ \| ([^|]+) \| ([^|]+) \|$", page.split("## Where the rest is")[1], re.M
    )
    checked = 0
    for called, defined in rows[2:]:
        places = re.findall(r"`([\w/]+\.py)`", defined)
        folder = ROOT / places[0].rsplit("/", 1)[0] if places else ROOT
        sources = [(ROOT / p if "/" in p else folder / p).read_text() for p in places]
        for name in re.findall(r"`(\w+)", called):
            checked += 1
            assert any(
                re.search(rf"^\s*(def|class) {name}\b", s, re.M) for s in sources
            ) or name in ("scene", "expert"), f"{name} is not in {places}"
    assert checked > 20

"""The notebook and the page of the Python API run as they stand, on a real run of one sample clip."""

import json
import os
import re
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]
SAMPLES = ROOT / "datasets" / "sample_videos"
SETTINGS = """
task: {num_samples: 2}
expert:
  num_envs: 96
  trial_worlds: 16
  eval_episodes: 8
  min_success: 0.0
  imitation: {target_success: 0.8}
  ppo: {total_steps: 4096, window_episodes: 16, min_window_episodes: 8, num_deterministic: 16}
episodes: {num_episodes: 3, batch_worlds: 32}
"""
AROUND = {**os.environ, "OMP_NUM_THREADS": "1", "MPLBACKEND": "agg", "PYTHONPATH": str(ROOT)}


def ran(words: list[str], where: Path, **variables: str) -> str:
    done = subprocess.run(
        words,
        cwd=where,
        env=AROUND | variables,
        capture_output=True,
        text=True,
        timeout=400,
        check=False,
    )
    assert done.returncode == 0, done.stdout[-1000:] + done.stderr[-3000:]
    return done.stdout


@pytest.mark.long
@pytest.mark.slow
@pytest.mark.timeout(500)
def test_the_notebook_runs_on_a_run_of_one_clip(tmp_path: Path):
    name = "tip_green_carton.mp4"
    shutil.copy(SAMPLES / name, tmp_path)
    caption = json.loads((SAMPLES / "captions.json").read_text())[name]
    (tmp_path / "captions.json").write_text(json.dumps({name: caption}))
    (tmp_path / "settings.yaml").write_text(SETTINGS)
    v2p = [sys.executable, "-m", "v2p_data.cli", "generate", ".", "--out", "run"]
    ran([*v2p, "--repo-id", "tests/notebook", "--config", "settings.yaml"], tmp_path)
    notebook = json.loads((ROOT / "docs" / "quickstart.ipynb").read_text())
    cells = [c for c in notebook["cells"] if c["cell_type"] == "code"]
    (tmp_path / "cells.py").write_text("\n\n".join("".join(c["source"]) for c in cells))

    said = ran([sys.executable, "cells.py"], tmp_path, V2P_RUN="run")

    assert "manipulated green_carton" in said
    assert "3 episodes" in said
    assert re.search(r"expert of .* \(\d+ of 16\)", said)


@pytest.mark.slow
def test_the_blocks_of_the_api_page_run_one_after_the_other(tmp_path: Path):
    page = (ROOT / "docs" / "python_api.md").read_text()
    blocks = re.findall(r"^```python\n(.*?)^```", page, re.S | re.M)
    (tmp_path / "datasets").symlink_to(ROOT / "datasets")
    (tmp_path / "blocks.py").write_text("\n".join(blocks))

    said = ran([sys.executable, "blocks.py"], tmp_path)

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

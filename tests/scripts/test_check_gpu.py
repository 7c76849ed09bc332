"""The checks for a GPU run on the CPU too, and none hides what comes of the others."""

import json
import re
import subprocess
import sys
from pathlib import Path

import pytest
import torch

from check_gpu import CHECKS
from results_table import ROOT


def started(*words: str) -> subprocess.CompletedProcess[str]:
    command = [sys.executable, "scripts/check_gpu.py", *words]
    return subprocess.run(command, cwd=ROOT, capture_output=True, text=True, check=False)


@pytest.mark.slow
@pytest.mark.skipif(torch.cuda.is_available(), reason="there is a CUDA device")
def test_without_a_gpu_one_sentence_says_so():
    done = started()

    assert done.returncode == 2
    assert done.stdout == ""
    assert done.stderr.count("\n") == 1
    assert "no CUDA device" in done.stderr


@pytest.mark.slow
@pytest.mark.long
def test_the_checks_run_on_the_cpu_and_one_file_says_what_came_of_each(tmp_path: Path):
    checks = ["trainers_like_cpu", "bc_speed"]

    done = started(
        "--device=cpu", "--quick", f"--out={tmp_path / 'told.json'}", "--checks", *checks
    )

    told = json.loads((tmp_path / "told.json").read_text())
    found = {c["name"]: c for c in told["checks"]}
    assert done.returncode == 0, done.stdout
    assert [*found] == checks
    assert all(c["ran"] and c["passed"] and not c["error"] for c in found.values())
    assert found["trainers_like_cpu"]["figures"]["passed"] >= 3
    (row,) = found["bc_speed"]["figures"]["rows"]
    assert row["loop"] > 0
    assert told["quick"]
    assert told["device"] == "cpu"
    assert torch.__version__.startswith(told["packages"]["torch"])


def test_the_page_lists_the_checks_in_their_order():
    page = (ROOT / "docs" / "gpu.md").read_text()

    assert re.findall(r"^\| `(\w+)` \|", page, re.M) == [*CHECKS]

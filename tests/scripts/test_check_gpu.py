"""The checks for a GPU run on the CPU too, and none hides what comes of the others."""

import json
import re
import subprocess
import sys
import time
from pathlib import Path

import pytest
import torch

from check_gpu import CHECKS, Check, run_check
from results_table import ROOT

PRINTS = "import sys; print({text!r}); sys.exit({code})"


def program(text: str = "", code: int = 0) -> Check:
    """Return a check that prints and ends."""
    words = ["-c", PRINTS.format(text=text, code=code)]
    return Check(what="", command=lambda device, quick: words, limit_s=60.0)


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


def test_a_check_s_figures_are_the_numbers_that_it_prints_by_name():
    text = 'device: x\nwarp_steps_per_second: 1200\n{"network": "small", "loop": 5.5}'

    outcome = run_check("speed", program(text), "cpu", quick=True)

    assert outcome.ran
    assert outcome.passed
    assert outcome.figures == {
        "warp_steps_per_second": 1200.0,
        "rows": [{"network": "small", "loop": 5.5}],
    }


@pytest.mark.parametrize(("code", "ran"), [(1, True), (2, False), (139, True)])
def test_a_check_that_ends_badly_says_how(code: int, ran: bool):
    outcome = run_check("bad", program("all is lost", code), "cpu", quick=True)

    assert outcome.ran is ran
    assert not outcome.passed
    assert outcome.error == f"exit code {code}: all is lost"


def test_a_check_that_hangs_is_ended():
    hangs = Check(what="", command=lambda device, quick: ["-c", "while True: pass"], limit_s=1.0)
    before = time.monotonic()

    outcome = run_check("hangs", hangs, "cpu", quick=True)

    assert time.monotonic() - before < 30
    assert outcome.ran
    assert not outcome.passed
    assert "longer than 1 s" in outcome.error


def test_the_page_lists_the_checks_in_their_order():
    page = (ROOT / "docs" / "gpu.md").read_text()

    assert re.findall(r"^\| `(\w+)` \|", page, re.M) == [*CHECKS]

"""A small share of `scripts/fuzz_sandbox.py`, which has a witness of its own to what random programs do."""

import json
import subprocess
import sys
from pathlib import Path

import pytest

SCRIPT = Path(__file__).parents[2] / "scripts" / "fuzz_sandbox.py"


@pytest.mark.slow
def test_no_random_program_gets_anywhere_and_the_witness_hears_what_plain_python_does():
    ended = subprocess.run(
        [sys.executable, str(SCRIPT), "--programs", "60", "--executed", "6", "--seed", "0"],
        capture_output=True,
        text=True,
        check=False,
    )

    assert ended.returncode == 0, ended.stderr[-2000:] + ended.stdout
    result = json.loads(ended.stdout)
    assert result["violations"] == []
    assert result["programs"] == 60
    assert result["executed"] >= 4
    assert result["outcomes"]["refused"] >= 20

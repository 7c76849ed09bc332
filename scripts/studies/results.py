"""Results of a study: one JSON object a line, which a kill may cut short."""

import json
import logging
import subprocess
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Bool

from v2p_data.errors import V2PError

RESULTS = "results.jsonl"
ROOT = Path(__file__).parents[2]
Row = dict[str, Any]

logger = logging.getLogger(__name__)


def results_in(out: Path) -> list[Row]:
    """Return the lines of a study; a last line that a kill cut short is left out."""
    path = out / RESULTS
    if not path.is_file():
        return []
    rows: list[Row] = []
    for line in path.read_text().splitlines():
        try:
            rows.append(json.loads(line))
        except json.JSONDecodeError:
            logger.warning("a line of %s is cut short and left out", path)
    return rows


def results_to_show(out: Path) -> list[Row]:
    """Return the lines of a study.

    Raises:
        V2PError: there is none yet.
    """
    rows = results_in(out)
    if not rows:
        raise V2PError(f"{out} holds no results yet; run the study first")
    return rows


def append_result(out: Path, row: Row) -> None:
    """Add a line, on a line of its own even where a kill left half a one."""
    path = out / RESULTS
    cut = path.is_file() and not path.read_bytes().endswith(b"\n") and path.stat().st_size > 0
    with path.open("a") as stream:
        stream.write(("\n" if cut else "") + json.dumps(row) + "\n")


def letters_of(successes: Bool[np.ndarray, "episode"]) -> str:
    """Return the episodes in order, one letter each: `1` for a success."""
    return "".join("1" if success else "0" for success in successes)


def commit() -> str:
    """Return the commit, with a plus where the working tree differs from it."""

    def git(*words: str) -> str:
        done = subprocess.run(
            ["git", *words], cwd=ROOT, capture_output=True, text=True, check=False
        )
        return done.stdout.strip()

    return (git("rev-parse", "--short=12", "HEAD") or "unknown") + (
        "+" if git("status", "--porcelain", "--", "v2p_data", "policies", "scripts") else ""
    )

"""Results of a study: one JSON object a line, which a kill may cut short."""

import json
import logging
import subprocess
import sys
from collections.abc import Callable, Iterable
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
    for line in path.read_text(encoding="utf-8").splitlines():
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
    with path.open("a", encoding="utf-8") as stream:
        stream.write(("\n" if cut else "") + json.dumps(row) + "\n")


def make_missing[K](
    out: Path,
    wanted: Iterable[K],
    key_of: Callable[[Row], K],
    make: Callable[[K], Row],
    words: Callable[[Row], str],
    study: str | None = None,
    name: Callable[[K], str] = str,
) -> None:
    """Make and append the lines that are not there yet, one after the other, whichever of them fail.

    Args:
        out: folder of the study.
        wanted: the key of each line.
        key_of: the key of a line that is there.
        make: makes a key's line.
        words: what is printed of a new line.
        study: what the lines that are there must say of themselves under `study`.
        name: what a key is called where it fails.

    Raises:
        V2PError: the lines are another study's; or, after all others, some could not be made.
    """
    rows = results_in(out)
    if study is not None and {row["study"] for row in rows} - {study}:
        raise V2PError(
            f"{out} holds results of another study (other settings, inputs or clips); choose another --out"
        )
    done, failed = {key_of(row) for row in rows}, list[str]()
    for key in wanted:
        if key in done:
            continue
        try:
            row = make(key)
        except V2PError as error:
            failed.append(f"{name(key)}: {error}")
            print(f"failed: {failed[-1]}", file=sys.stderr, flush=True)
            continue
        append_result(out, row)
        print(words(row), flush=True)
    if failed:
        raise V2PError(
            f"{len(failed)} results could not be made, the others were: " + "; ".join(failed)
        )


def rate_of(row: Row) -> str:
    """Return how many of a line's episodes succeeded."""
    return f"{row['once'].count('1')} of {len(row['once'])}"


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

"""What a run and its workers agree on, wherever these are: events, locks, and what a worker does with its output."""

import faulthandler
import fcntl
import logging
import os
import time
from dataclasses import dataclass
from pathlib import Path
from typing import Literal, TextIO

from v2p_data.errors import V2PError
from v2p_data.pipeline.runner import Outcome, Stage

RUN_LOCK = ".lock"
WORKER_LOCK = ".workers.lock"
"""Shared by the workers: as long as one lives, no new run begins."""


@dataclass(frozen=True, kw_only=True)
class Event:
    """Something to show: a job began, moved on, or ended."""

    kind: Literal["started", "progress", "ended"]
    stage: Stage
    share: float = 0.0
    words: str = ""
    outcome: Outcome | None = None


def is_at_work(root: Path) -> bool:
    """Return whether a run holds the folder's lock."""
    try:
        with (root / RUN_LOCK).open() as stream:
            fcntl.flock(stream, fcntl.LOCK_SH | fcntl.LOCK_NB)
    except BlockingIOError:
        return True
    except OSError:
        return False
    return False


def run_name(root: Path) -> str:
    """Return what tells the run that is at work in a folder from earlier and later ones; empty: none began."""
    return (root / RUN_LOCK).read_text() if (root / RUN_LOCK).exists() else ""


def lock(stream: TextIO, root: Path, wait_s: float) -> None:
    """Hold an open file alone.

    Raises:
        V2PError: another process holds it, and did so all the time.
    """
    deadline = time.monotonic() + wait_s
    while True:
        try:
            return fcntl.flock(stream, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except OSError as error:
            if time.monotonic() >= deadline:
                raise V2PError(
                    f"another v2p run is at work in {root}; wait for it or choose another --out"
                ) from error
            time.sleep(0.1)


def no_progress(share: float, words: str) -> None:
    del share, words


def write_to(log: Path) -> TextIO:
    """Send all that this process says to the end of a log; return it, which stays open."""
    log.parent.mkdir(parents=True, exist_ok=True)
    stream = log.open("a")
    os.dup2(stream.fileno(), 1)
    os.dup2(stream.fileno(), 2)
    logging.basicConfig(level=logging.INFO, format="%(asctime)s %(name)s %(message)s", force=True)
    return stream


def limit_threads(num_threads: int) -> None:
    for variable in ("OMP_NUM_THREADS", "MKL_NUM_THREADS", "OPENBLAS_NUM_THREADS"):
        os.environ[variable] = str(num_threads)


def limit_time(limit_s: float) -> None:
    """End this process unless it calls this again in time; what it was at goes to its output.

    Args:
        limit_s: seconds; 0: it has all the time there is.
    """
    faulthandler.cancel_dump_traceback_later()
    if limit_s:
        # A thread that needs no lock of Python's ends it, so that a library that hangs cannot keep it.
        faulthandler.dump_traceback_later(limit_s, exit=True)

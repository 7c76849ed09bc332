"""What a run and its workers agree on, wherever these are: events, locks, and what a worker does with its output."""

import faulthandler
import logging
import os
import uuid
from collections.abc import Generator
from contextlib import AbstractContextManager, contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

from filelock import FileLock, Timeout

from v2p_data.errors import V2PError
from v2p_data.pipeline.runner import Outcome, Stage

RUN_LOCK = ".lock"
RUN_NAME_FILE = ".run"
WORKERS_FOLDER = ".workers"
"""Holds a lock for each worker: as long as one lives, no new run begins."""


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
    if not (root / RUN_LOCK).exists():
        return False
    try:
        with FileLock(root / RUN_LOCK, blocking=False):
            return False
    except OSError as error:
        return isinstance(error, Timeout)


def run_name(root: Path) -> str:
    """Return what tells the run that is at work in a folder from earlier and later ones; empty: none began."""
    return (
        (root / RUN_NAME_FILE).read_text(encoding="utf-8")
        if (root / RUN_NAME_FILE).exists()
        else ""
    )


def held(path: Path, root: Path, wait_s: float) -> AbstractContextManager[object]:
    """Return a lock of a run folder, held until the context or this process ends.

    Raises:
        V2PError: another process holds it, and did so all the time.
    """
    try:
        return FileLock(path).acquire(timeout=wait_s, poll_interval=0.1)
    except Timeout as error:
        raise V2PError(
            f"another v2p run is at work in {root}; wait for it or choose another --out"
        ) from error


@contextmanager
def as_worker(root: Path) -> Generator[None]:
    """Be one of the workers of a run folder, for whose end a new run waits."""
    (root / WORKERS_FOLDER).mkdir(parents=True, exist_ok=True)
    path = root / WORKERS_FOLDER / f"{uuid.uuid4().hex}.lock"
    with held(path, root, wait_s=0.0):
        yield
        path.unlink(missing_ok=True)


def wait_for_workers(root: Path, wait_s: float) -> None:
    """Return when the workers of earlier runs have ended; remove what they left.

    Raises:
        V2PError: one of them is still at work.
    """
    for path in (root / WORKERS_FOLDER).glob(f"{'[0-9a-f]' * 32}.lock"):
        with held(path, root, wait_s):
            path.unlink(missing_ok=True)


def no_progress(share: float, words: str) -> None:
    del share, words


def write_to(log: Path) -> None:
    """Send all that this process says to the end of a log."""
    log.parent.mkdir(parents=True, exist_ok=True)
    with log.open("a", encoding="utf-8") as stream:
        os.dup2(stream.fileno(), 1)
        os.dup2(stream.fileno(), 2)
    logging.basicConfig(level=logging.INFO, format="%(asctime)s %(name)s %(message)s", force=True)


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

"""What a task does on its node: one stage, in a process of its own. Knows nothing of Ray."""

import contextlib
import os
import pickle
import signal
import socket
import sys
from pathlib import Path

from v2p_data.errors import V2PError
from v2p_data.pipeline.at_work import (
    as_worker,
    held,
    limit_threads,
    limit_time,
    run_name,
    write_to,
)
from v2p_data.pipeline.runner import Outcome, Stage, make_stage, stored_outcome
from v2p_data.processes import end_with_parent

ITEM_FREE_S = 120.0
"""The process of a lost node has let go of its item by then, or still works."""


def log_of(stage: Stage, root: Path) -> Path:
    """Return where a stage's task says what it does."""
    return root / "logs" / f"{stage.name}-{stage.folder_name}.log"


def work(how: bytes, what: bytes) -> Outcome:
    """Make a stage in this process of a node, which does nothing else; return what became of it.

    Two processes never fill one folder: the item's lock is held until the process ends, and a run
        that has been followed
    by another one begins nothing more.
    """
    signal.signal(signal.SIGTERM, signal.SIG_DFL)  # at once, not when Python gets round to it
    end_with_parent(os.getppid())
    runtime, run, home, sys.argv = pickle.loads(how)  # records tell the user's command, not Ray's
    limit_threads(runtime.num_threads)
    with contextlib.suppress(OSError):
        os.chdir(home)  # recipes may name videos relative to it
    stage: Stage = pickle.loads(what)
    log = log_of(stage, runtime.root)
    try:
        _demand_at_work(run, runtime.root)
        write_to(log)
        with (
            as_worker(runtime.root),
            held(log.with_suffix(".lock"), runtime.root, wait_s=ITEM_FREE_S),
        ):
            _demand_at_work(run, runtime.root)  # perhaps another one waits for us since
            limit_time(runtime.limit_s)
            return stored_outcome(stage, runtime.root) or make_stage(stage, runtime)
    except V2PError as error:
        return failed(stage, runtime.root, "error", str(error))


def _demand_at_work(run: str, root: Path) -> None:
    """Raise unless a run is the last one in its folder; asked by a worker, for whose end a new run waits.

    Raises:
        V2PError: it has been followed by another one, or this node does not see it.
    """
    if run_name(root) != run:
        raise V2PError(
            f"{socket.gethostname()} does not see this run in {root}: all nodes need the run folder at the same path"
        )


def failed(stage: Stage, root: Path, reason: str, detail: str) -> Outcome:
    """Return what became of a stage that was not begun, or not ended."""
    return Outcome(
        stage=stage.name,
        item=stage.item,
        status="failed",
        folder=stage.folder(root),
        reason=reason,
        detail=detail,
    )

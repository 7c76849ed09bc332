"""Worker processes that make stages, each job isolated from the others and from the caller.

A worker that crashes (segmentation fault, out of memory) fails its job only and is replaced. Workers end
when their parent is gone, however it went, so that a killed run leaves nothing that writes.
"""

import contextlib
import heapq
import multiprocessing
import os
import signal
import time
import uuid
from collections import defaultdict
from collections.abc import Callable, Generator, Iterator, Sequence
from dataclasses import dataclass, replace
from multiprocessing.connection import Connection, wait
from multiprocessing.process import BaseProcess
from pathlib import Path
from typing import Any

from v2p_data.errors import V2PError
from v2p_data.pipeline.at_work import (
    RUN_LOCK,
    RUN_NAME_FILE,
    Event,
    as_worker,
    held,
    limit_threads,
    limit_time,
    no_progress,
    wait_for_workers,
    write_to,
)
from v2p_data.pipeline.leases import Shared
from v2p_data.pipeline.ray_engine import RayEngine
from v2p_data.pipeline.runner import (
    Outcome,
    Runtime,
    Stage,
    blocked_by,
    in_order,
    make_stage,
)
from v2p_data.processes import end_with_parent

PROGRESS_EVERY_S = 0.2
WORKERS_END_S = 5.0
"""The workers of a killed run are gone by then."""
Key = tuple[str, str]


@contextlib.contextmanager
def only_run_in(root: Path) -> Generator[None]:
    """Hold the run folder's lock, after the workers of a killed run are gone.

    Raises:
        V2PError: the folder cannot be written, or another run is at work in it.
    """
    try:
        root.mkdir(parents=True, exist_ok=True)
        lock = held(root / RUN_LOCK, root, wait_s=0.2)  # `is_at_work` holds it for a moment
    except OSError as error:
        raise V2PError(
            f"cannot write to {root}: {error.strerror}; choose another folder with --out"
        ) from error
    with lock:
        (root / RUN_NAME_FILE).write_text(uuid.uuid4().hex, encoding="utf-8")
        wait_for_workers(root, WORKERS_END_S)
        yield


@dataclass
class _Worker:
    process: BaseProcess
    connection: Connection
    stage: Stage | None = None
    started: float = 0.0


class Pool:
    """Worker processes of this machine, at most `size` at the same time; each loads the libraries once."""

    def __init__(self, runtime: Runtime, size: int) -> None:
        # Spawned, not forked: a fork would share the caller's OpenGL and thread state.
        self.context = multiprocessing.get_context("spawn")
        self.runtime = replace(runtime, progress=no_progress)
        self.size = size
        self.workers: list[_Worker] = []

    @property
    def is_busy(self) -> bool:
        return any(w.stage is not None for w in self.workers)

    @property
    def has_room(self) -> bool:
        return len(self.workers) < self.size or any(w.stage is None for w in self.workers)

    def start(self, stage: Stage) -> None:
        # One without work may have been killed as well.
        self.workers = [w for w in self.workers if w.stage is not None or w.process.is_alive()]
        worker = next((w for w in self.workers if w.stage is None), None)
        if worker is None:
            ours, theirs = self.context.Pipe()
            log = self.runtime.root / "logs" / f"worker-{len(self.workers)}.log"
            # No daemon, for a stage may run stages of its own; it ends with its parent all the same.
            process = self.context.Process(
                target=_work, args=(theirs, self.runtime, log, os.getpid())
            )
            process.start()
            theirs.close()
            worker = _Worker(process=process, connection=ours)
            self.workers.append(worker)
        worker.stage, worker.started = stage, time.monotonic()
        with contextlib.suppress(BrokenPipeError):  # it died just now, which `events` sees
            worker.connection.send(stage)

    def events(self) -> Iterator[Event]:
        busy = [w for w in self.workers if w.stage is not None]
        ready = wait([w.connection for w in busy], timeout=1.0)
        for worker in busy:
            if worker.connection not in ready or worker.stage is None:
                continue
            stage = worker.stage
            try:
                message: Any = worker.connection.recv()
            except (EOFError, ConnectionResetError):
                worker.process.join(5)
                self.workers.remove(worker)
                seconds, limit_s = time.monotonic() - worker.started, self.runtime.limit_s
                is_late = worker.process.exitcode == 1 and 0 < limit_s <= seconds
                outcome = Outcome(
                    stage=stage.name,
                    item=stage.item,
                    status="failed",
                    folder=stage.folder(self.runtime.root),
                    seconds=seconds,
                    reason="too_long" if is_late else "crashed",
                    detail=_how_it_died(worker.process.exitcode, self.runtime, is_late),
                )
                yield Event(kind="ended", stage=stage, outcome=outcome)
                continue
            if isinstance(message, Outcome):
                worker.stage = None
                yield Event(kind="ended", stage=stage, outcome=message)
            else:
                share, words = message
                yield Event(kind="progress", stage=stage, share=share, words=words)

    def close(self) -> None:
        for worker in self.workers:
            worker.connection.close()
            if worker.stage is not None:
                worker.process.kill()
        for worker in self.workers:
            worker.process.join(5)
            if worker.process.is_alive():
                worker.process.kill()
                worker.process.join(5)


def run_stages(
    stages: Sequence[Stage],
    runtime: Runtime,
    on_event: Callable[[Event], None],
    engine: Pool | None = None,
) -> dict[Key, Outcome]:
    """Make every stage and what it needs; return the outcome per (stage name, folder name).

    With a store, what others made is taken and what they are making is waited for, while all else goes on.
    `engine` is used and left open; without one the runtime's is started where there is something to make.
    """
    ordered = list(in_order(stages))
    with Shared(runtime) as shared:
        outcomes = _run_stages(ordered, runtime, on_event, shared, engine)
        shared.fetch_all(ordered, outcomes)
    return outcomes


class _Schedule:
    """What has ended, what is ready to run, and what still waits for what."""

    def __init__(self, root: Path, on_event: Callable[[Event], None]) -> None:
        self.outcomes: dict[Key, Outcome] = {}
        self.ready: list[tuple[int, Stage]] = []
        """A heap by place: the first item is finished first."""
        self.num_missing: dict[Key, int] = {}
        self._needed_by: dict[Key, list[tuple[int, Stage]]] = defaultdict(list)
        self._root, self._on_event = root, on_event

    def add(self, place: int, stage: Stage, stored: Outcome | None) -> None:
        """Take in a stage after all that it needs; it has ended already if an outcome is stored."""
        if stored is None and (blocker := blocked_by(stage, self.outcomes)) is not None:
            stored = _blocked(stage, blocker, self._root)
        if stored is not None:
            self.ended(stage, stored)
            return
        missing = {_key(needed) for needed in stage.inputs.values()} - self.outcomes.keys()
        self.num_missing[_key(stage)] = len(missing)
        for key in missing:
            self._needed_by[key].append((place, stage))
        if not missing:
            self.ready.append((place, stage))

    def ended(self, stage: Stage, outcome: Outcome) -> None:
        """Note an outcome; what waited for it is ready or blocked."""
        key = _key(stage)
        self.outcomes[key] = outcome
        self._on_event(Event(kind="ended", stage=stage, outcome=outcome))
        for place, other in self._needed_by.pop(key, ()):
            self.num_missing[_key(other)] -= 1
            if not outcome.is_usable and _key(other) not in self.outcomes:
                self.ended(other, _blocked(other, outcome, self._root))
            elif self.num_missing[_key(other)] == 0 and _key(other) not in self.outcomes:
                heapq.heappush(self.ready, (place, other))


def _run_stages(
    ordered: Sequence[Stage],
    runtime: Runtime,
    on_event: Callable[[Event], None],
    shared: Shared,
    lent: Pool | None,
) -> dict[Key, Outcome]:
    plan = _Schedule(runtime.root, on_event)
    for place, stage in enumerate(ordered):
        plan.add(place, stage, shared.stored(stage))
    if not plan.ready:
        return plan.outcomes
    engine = lent or _engine(runtime, num_pending=len(plan.num_missing))
    try:
        while plan.ready or engine.is_busy:
            others: list[tuple[int, Stage]] = []  # at work on another driver
            while plan.ready and engine.has_room:
                place, stage = heapq.heappop(plan.ready)
                claimed = shared.claim(stage)
                if claimed is None:
                    others.append((place, stage))
                elif isinstance(claimed, Outcome):
                    plan.ended(stage, claimed)
                else:
                    engine.start(stage)
                    on_event(Event(kind="started", stage=stage))
            for entry in others:
                heapq.heappush(plan.ready, entry)
            if not engine.is_busy:
                time.sleep(0.2 if others else 0.0)
                continue
            for event in engine.events():
                if event.outcome is None:
                    on_event(event)
                else:
                    shared.ended(event.stage)
                    plan.ended(event.stage, event.outcome)
    finally:
        if lent is None:
            engine.close()
    return plan.outcomes


def _blocked(stage: Stage, blocker: Outcome, root: Path) -> Outcome:
    return Outcome(
        stage=stage.name,
        item=stage.item,
        status="blocked",
        folder=stage.folder(root),
        reason=blocker.reason,
        detail=f"needs {blocker.stage} of {blocker.item}",
    )


def _engine(runtime: Runtime, num_pending: int) -> Pool | RayEngine:
    if runtime.engine == "ray":
        return RayEngine(runtime)
    return Pool(runtime, size=min(max(1, runtime.workers), num_pending))


def _key(stage: Stage) -> Key:
    return (stage.name, stage.folder_name)


def _how_it_died(exitcode: int | None, runtime: Runtime, is_late: bool) -> str:
    how = "stopped without a word"
    if is_late:
        how = f"took longer than --limit-s={runtime.limit_s:g} s and was ended"
    if exitcode is not None and exitcode < 0:
        how = f"was killed by {signal.Signals(-exitcode).name}"
    if exitcode == -signal.SIGKILL:
        how += ", as the system does where memory is short"
    return f"the worker process {how}; its output is in {runtime.root / 'logs'}"


def _work(connection: Connection, runtime: Runtime, log: Path, parent_pid: int) -> None:
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # the parent hears Ctrl-C and ends us
    end_with_parent(parent_pid)
    write_to(log)
    limit_threads(runtime.num_threads)
    with as_worker(runtime.root):
        _make_stages(connection, runtime)


def _make_stages(connection: Connection, runtime: Runtime) -> None:
    """Make the stages that come through the connection, until it is closed."""
    while True:
        try:
            stage: Stage = connection.recv()
        except (EOFError, OSError):
            return
        last = 0.0

        def progress(share: float, words: str) -> None:
            nonlocal last
            if time.monotonic() - last > PROGRESS_EVERY_S:
                last = time.monotonic()
                connection.send((share, words))

        limit_time(runtime.limit_s)
        outcome = make_stage(stage, replace(runtime, progress=progress))
        limit_time(0.0)
        connection.send(outcome)

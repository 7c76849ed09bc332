"""Candidates' trainings as processes of their own: what goes wrong in one is its own result.

One process loads the libraries (seconds, and most of a small training's memory) and forks for every job; it runs
`v2p_data.reward.worker`. A job is a folder with a `request.json`; what it makes lies in the same folder. Between the
processes go lines of JSON and files, nothing else. All of them end when their parent does, however it went.
"""

import json
import os
import selectors
import signal
import subprocess
import time
from collections.abc import Callable, Sequence
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from v2p_data.errors import V2PError
from v2p_data.json_files import json_or_none
from v2p_data.pipeline.artifact import write_json_atomically
from v2p_data.processes import own_python
from v2p_data.reward.candidate import DONE_FILE, FAULT_FILE, Fault
from v2p_data.reward.config import Limits

WORKER = "v2p_data.reward.worker"
REQUEST_FILE = "request.json"
HEARTBEAT_FILE = "heartbeat"
LOG_FILE = "worker.log"
START_S = 120.0
"""Loading torch, torchrl and MuJoCo on a busy machine."""
POLL_S = 0.1
KILLED_WORDS = (
    "its process was killed by {}; SIGKILL from outside mostly means that memory ran out, see {}"
)


@dataclass(frozen=True, kw_only=True)
class Job:
    """Something to do in a process of its own."""

    folder: Path
    request: dict[str, Any]
    mark: int = 0
    """It is done once its `done.json` says so, or that it stopped early."""

    @property
    def is_done(self) -> bool:
        done = json_or_none(self.folder / DONE_FILE)
        if not isinstance(done, dict):
            return False
        return done.get("mark", -1) >= self.mark or bool(done.get("reached"))

    @property
    def is_settled(self) -> bool:
        """Done, or failed: neither is tried again."""
        return self.is_done or (self.folder / FAULT_FILE).is_file()


@dataclass
class _Running:
    job: Job
    number: int
    started: float
    beat: float
    stamp: int = -1
    fault: Fault | None = None
    """Why it was told to end."""


class Jobs:
    """A process that forks for every job; use as a context manager.

    Args:
        workers: jobs at the same time.
        limits: what one job may use.
    """

    def __init__(self, *, workers: int = 1, limits: Limits | None = None) -> None:
        self.workers, self.limits = max(1, workers), limits or Limits()
        self._process: subprocess.Popen[bytes] | None = None
        self._selector = selectors.DefaultSelector()
        self._pending = b""
        self._count = 0

    def __enter__(self) -> "Jobs":
        return self

    def __exit__(self, *exc: object) -> None:
        self.close()

    def run(
        self,
        jobs: Sequence[Job],
        on_settled: Callable[[Job], None] = lambda job: None,
        on_wait: Callable[[Sequence[Job]], None] = lambda jobs: None,
    ) -> None:
        """Settle every job: afterwards each folder holds what was made, or `fault.json`.

        Args:
            jobs: those that are settled already are left alone.
            on_settled: told each job that ends.
            on_wait: told the running jobs while nothing happens.

        Raises:
            V2PError: no process can be started at all.
        """
        waiting = [job for job in jobs if not job.is_settled]
        running: dict[int, _Running] = {}
        try:
            while waiting or running:
                while waiting and len(running) < self.workers:
                    started = self._start(waiting.pop(0))
                    running[started.number] = started
                for number, status in self._ended(POLL_S):
                    ended = running.pop(number, None)
                    if ended is not None:
                        self._settle(ended, status)
                        on_settled(ended.job)
                if self._process is not None and self._process.poll() is not None:
                    self._lost(running, waiting)
                for each in running.values():
                    self._watch(each)
                on_wait([r.job for r in running.values()])
        finally:
            for number in running:  # only after an exception: they go on from their checkpoints
                self._tell({"kill": number})

    def close(self) -> None:
        """End everything that is still running."""
        process, self._process = self._process, None
        if process is None:
            return
        if process.stdin is not None:
            with suppress(OSError):
                process.stdin.close()  # it kills its children and ends
        try:
            process.wait(5)
        except subprocess.TimeoutExpired:
            process.kill()
            process.wait()
        if process.stdout is not None:
            self._selector.unregister(process.stdout)
            process.stdout.close()

    # -- inside

    def _start(self, job: Job) -> _Running:
        job.folder.mkdir(parents=True, exist_ok=True)
        request = {**job.request, "mark": job.mark, "memory_mb": self.limits.memory_mb}
        write_json_atomically(job.folder / REQUEST_FILE, request)
        (job.folder / HEARTBEAT_FILE).touch()
        self._count += 1
        self._tell({"job": str(job.folder.resolve()), "number": self._count})
        now = time.monotonic()
        return _Running(job=job, number=self._count, started=now, beat=now)

    def _tell(self, message: dict[str, Any]) -> None:
        process = self._process or self._launch()
        assert process.stdin is not None
        with suppress(BrokenPipeError):  # noticed by `run`, which looks whether it lives
            process.stdin.write(json.dumps(message).encode() + b"\n")
            process.stdin.flush()

    def _launch(self) -> subprocess.Popen[bytes]:
        environment = {
            "PATH": "/usr/bin:/bin",
            **{f"{name}_NUM_THREADS": "1" for name in ("OMP", "MKL", "OPENBLAS")},
        }
        process = subprocess.Popen(
            own_python(WORKER),
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            env=environment,
            start_new_session=True,
        )
        assert process.stdout is not None
        os.set_blocking(process.stdout.fileno(), False)
        self._selector.register(process.stdout, selectors.EVENT_READ)
        self._process, self._pending = process, b""
        deadline = time.monotonic() + START_S
        while not any(line == {"ready": True} for line in self._lines(POLL_S)):
            if process.poll() is not None or time.monotonic() > deadline:
                self.close()
                raise V2PError(
                    "the process that trains candidates does not start; "
                    f"try 'python -m {WORKER}' to see why"
                )
        return process

    def _lines(self, timeout_s: float) -> list[dict[str, Any]]:
        lines: list[dict[str, Any]] = []
        for key, _ in self._selector.select(timeout_s):
            read = os.read(key.fd, 65536)
            if not read:  # it has ended; `select` would return at once for ever
                time.sleep(POLL_S)
            self._pending += read
        *whole, self._pending = self._pending.split(b"\n")
        for line in whole:
            with suppress(ValueError):
                data = json.loads(line)
                if isinstance(data, dict):
                    lines.append(data)
        return lines

    def _ended(self, timeout_s: float) -> list[tuple[int, int]]:
        return [
            (line["number"], line["status"])
            for line in self._lines(timeout_s)
            if isinstance(line.get("number"), int) and isinstance(line.get("status"), int)
        ]

    def _watch(self, running: _Running) -> None:
        """Have a job killed that has gone on too long, or without a sign of life."""
        if running.fault is not None:
            return
        now = time.monotonic()
        with suppress(OSError):
            stamp = (running.job.folder / HEARTBEAT_FILE).stat().st_mtime_ns
            if stamp != running.stamp:
                running.stamp, running.beat = stamp, now
        if now - running.beat > self.limits.hang_s:
            running.fault = Fault(
                kind="hang", reason=f"no progress for {self.limits.hang_s:.0f} s; it was ended"
            )
        elif now - running.started > self.limits.wall_s:
            running.fault = Fault(
                kind="out_of_time", reason=f"it took more than {self.limits.wall_s:.0f} s"
            )
        if running.fault is not None:
            self._tell({"kill": running.number})

    def _settle(self, running: _Running, status: int) -> None:
        folder = running.job.folder
        if running.job.is_settled:
            return
        fault = running.fault
        if fault is None and status < 0:
            name = signal.Signals(-status).name
            kind = "out_of_memory" if -status == signal.SIGKILL else "crashed"
            fault = Fault(kind=kind, reason=KILLED_WORDS.format(name, LOG_FILE))
            if kind == "crashed":
                fault = Fault(kind=kind, reason=f"its process ended by {name}, see {LOG_FILE}")
        if fault is None:
            fault = Fault(
                kind="crashed",
                reason=f"its process ended with exit code {status} and no result, see {LOG_FILE}",
            )
        write_json_atomically(folder / FAULT_FILE, fault.as_dict())

    def _lost(self, running: dict[int, _Running], waiting: list[Job]) -> None:
        """Start the forking process again if it died with jobs in hand; they go on from their checkpoints."""
        process, self._process = self._process, None
        if process is not None and process.stdout is not None:
            self._selector.unregister(process.stdout)
            process.stdout.close()
        for each in list(running.values()):
            # Two deaths with the same job in hand are that job's doing.
            if each.job.request.get("retried"):
                self._settle(each, -signal.SIGKILL)
            elif not each.job.is_settled:
                again = {**each.job.request, "retried": True}
                waiting.append(Job(folder=each.job.folder, request=again, mark=each.job.mark))
        running.clear()

"""Stages as tasks of a Ray cluster, behind the same interface as the worker processes.

Only a stage and its outcome travel: results lie in the run folder, which all nodes see at the same
    path. Each task has a
fresh process. A task that dies with its process or its node is tried again here, never by Ray; a failure that a stage
reports itself is not.
"""

import importlib
import importlib.util
import logging
import os
import pickle
import socket
import sys
from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from v2p_data.errors import V2PError
from v2p_data.pipeline.at_work import Event, no_progress, run_name
from v2p_data.pipeline.ray_task import failed, log_of
from v2p_data.pipeline.runner import Outcome, Runtime, Stage

OUT_OF_TIME = b"Timeout ("
"""What `limit_time` leaves in a task's log."""
TRIES = 3
"""A task that dies is begun so often; then its item has failed."""
CONNECT_S = 5.0
"""The head of a cluster answers sooner."""
FEWEST_IN_FLIGHT = 64
"""Tasks that a small cluster is given at a time: what waits there makes it grow, where it can."""


@dataclass(frozen=True, kw_only=True)
class _Task:
    stage: Stage
    tries: int
    log_bytes: int
    """Bytes in its log before it began."""


class RayEngine:
    """Tasks in flight on a cluster.

    Raises:
        V2PError: Ray is not installed, or no cluster answers at the address.
    """

    def __init__(self, runtime: Runtime) -> None:
        self.address = runtime.address
        self.ray = _connected(runtime.address)
        nodes = [n["Resources"] for n in self.ray.nodes() if n["Alive"]]
        self.most = {k: max(n.get(k, 0.0) for n in nodes) for k in ("CPU", "GPU")}
        num_cpus = int(sum(n.get("CPU", 0) for n in nodes))
        self.size = runtime.workers or max(FEWEST_IN_FLIGHT, 2 * num_cpus)
        self.runtime = replace(runtime, root=runtime.root.absolute(), progress=no_progress)
        self.runtime.root.mkdir(parents=True, exist_ok=True)
        self.run_name = run_name(self.runtime.root)
        self.tasks: dict[Any, _Task] = {}

        # Travels by value and names nothing of ours: a node learns from its arguments where our code lies.
        def task(paths: list[str], how: bytes, what: bytes) -> Any:
            import sys

            sys.path[:0] = [path for path in paths if path not in sys.path]
            from v2p_data.pipeline.ray_task import work

            return work(how, what)

        self.task = self.ray.remote(max_calls=1, max_retries=0)(task)
        self.paths = [str(Path(__file__).parents[2]), *(p for p in sys.path if p)]

    @property
    def is_busy(self) -> bool:
        return bool(self.tasks)

    @property
    def has_room(self) -> bool:
        return len(self.tasks) < self.size

    def start(self, stage: Stage) -> None:
        self._submit(stage, tries=1)

    def _submit(self, stage: Stage, *, tries: int) -> None:
        runtime = self.runtime
        on_gpu = stage.on_device and runtime.device.startswith("cuda")
        if on_gpu and not self.most["GPU"]:
            raise V2PError(
                f"no node of the Ray cluster at {self.address} has a GPU; start one that has or use --device=cpu"
            )
        num_cpus = max(1, min(runtime.num_threads, int(self.most["CPU"])))
        here = replace(runtime, num_threads=num_cpus, device="cuda" if on_gpu else "cpu")
        how = pickle.dumps((here, self.run_name, str(Path.cwd()), sys.argv))
        reference = self.task.options(
            name=f"{stage.name} {stage.item}",
            num_cpus=num_cpus,
            num_gpus=int(on_gpu),
        ).remote(self.paths, how, self.ray.cloudpickle.dumps(stage))
        log = log_of(stage, runtime.root)
        log_bytes = log.stat().st_size if log.exists() else 0
        self.tasks[reference] = _Task(stage=stage, tries=tries, log_bytes=log_bytes)

    def events(self) -> Iterator[Event]:
        errors = self.ray.exceptions
        ended, _ = self.ray.wait(list(self.tasks), timeout=1.0)
        for reference in ended:
            task = self.tasks.pop(reference)
            stage, root = task.stage, self.runtime.root
            try:
                outcome: Outcome = self.ray.get(reference)
            except errors.RayTaskError as error:  # before the stage began
                why = f"a node cannot load our code or the recipe: {error.cause}"
                outcome = failed(stage, root, "error", why)
            except errors.RayError as error:
                how, log, reason = type(error).__name__, log_of(stage, root), "crashed"
                why = f"its process ended {TRIES} times, last of {how}; its output is in {log}"
                if log.exists() and OUT_OF_TIME in log.read_bytes()[task.log_bytes :]:
                    reason = "too_long"
                    why = (
                        f"it took longer than --limit-s={self.runtime.limit_s:g} s and was "
                        f"ended; its output is in {log}"
                    )
                elif task.tries < TRIES:
                    self._submit(stage, tries=task.tries + 1)
                    yield Event(kind="progress", stage=stage, words=f"begun again after {how}")
                    continue
                outcome = failed(stage, root, reason, why)
            yield Event(kind="ended", stage=stage, outcome=outcome)

    def close(self) -> None:
        for reference in self.tasks:
            self.ray.cancel(reference, force=True)
        self.ray.shutdown()  # the cluster ends what is still at work for us


def demand_ray() -> None:
    """Raise if Ray is not installed.

    Raises:
        V2PError: says how to install it.
    """
    if importlib.util.find_spec("ray") is None:
        raise V2PError("--engine=ray needs the ray package: run 'make setup' in the repository")


def _connected(address: str) -> Any:
    demand_ray()
    # Ray reads these when it is imported. It says in our output which workers died; we say it, with the item.
    os.environ["RAY_DEDUP_LOGS_SKIP_REGEX"] = "."
    # Under `uv run` it would copy the working directory to every node.
    os.environ["RAY_ENABLE_UV_RUN_RUNTIME_ENV"] = "0"
    host, _, port = address.rpartition(":")
    try:
        if port.isdecimal():  # asked first: Ray itself waits long
            socket.create_connection((host, int(port)), timeout=CONNECT_S).close()
        ray: Any = importlib.import_module("ray")
        ray.init(address=address, log_to_driver=False, logging_level=logging.ERROR)
    except (OSError, RuntimeError, ValueError) as error:
        why = str(error).splitlines()[0]
        raise V2PError(
            f"no Ray cluster answers at {address} ({why}); start one with 'ray start --head' and "
            "name its HOST:PORT in --address"
        ) from error
    return ray

"""Runs unknown task code once, in a child process that cannot hurt anyone, and says whether it works.

The child forks for every sample, so that a crash, a hang or a memory bomb in one sample is that sample's own result.
It stays for the next question, because torch takes seconds to import. See `sandbox` for what a fork may not do.
"""

import contextlib
import hashlib
import json
import math
import os
import shutil
import subprocess
import tempfile
import threading
import time
from dataclasses import dataclass, field
from multiprocessing.connection import wait
from multiprocessing.util import Finalize
from typing import Any

import numpy as np
from jaxtyping import Float

from v2p_data.errors import V2PError
from v2p_data.processes import end_group, own_python
from v2p_data.scene.scene import Scene
from v2p_data.seeds import rng_for
from v2p_data.task.sandbox.guarded import COMPONENT_NAME
from v2p_data.task.sandbox.probes import States, at_rest, concatenated, random_states
from v2p_data.task.sandbox.reader.check import check_code
from v2p_data.task.sandbox.reader.refusal import TaskCodeError
from v2p_data.task.sandbox.source_text import shown

CHILD = "smoke_child.py"
BATCH = 16
PARTS = 3
"""Batch sizes, drawn at random, at which every program is asked again."""
MAX_ANSWER_CHARS = 20_000_000
ENDS_S = 5.0
"""A child that has closed its output has ended by then."""


@dataclass(frozen=True, kw_only=True)
class SmokeResult:
    """What became of one sample."""

    runnable: bool
    error: str = ""
    """One sentence, where it is not runnable."""
    observation_dim: int = 0
    components: tuple[str, ...] = ()
    warnings: tuple[str, ...] = ()
    """What works but should not be so."""
    probe_success: tuple[bool, ...] = ()
    """The success function's answer for each row of the probes."""
    probe_reward: tuple[float, ...] = ()
    start_poses: dict[str, Float[np.ndarray, "start 7"]] = field(
        default_factory=dict, compare=False
    )
    """Where the sample's own reset put each object, reset after reset."""
    start_rows: tuple[int, ...] = ()
    """Which of the offered layouts each of these came from."""
    start_success: tuple[bool, ...] = ()
    seconds: float = 0.0

    @staticmethod
    def from_json(data: Any, num_probes: int, num_starts: int = 0) -> "SmokeResult":
        """Read a child's answer, which is data from a stranger.

        Args:
            data: the answer.
            num_probes: moments that were asked about.
            num_starts: layouts that were offered to the sample's reset.

        Raises:
            TypeError, ValueError: it is not what it should be.
        """
        if not isinstance(data, dict) or not isinstance(data.get("runnable"), bool):
            raise TypeError("no verdict")
        success = [bool(x) for x in data.get("probe_success", [])]
        reward = [float(x) for x in data.get("probe_reward", [])]
        if data["runnable"] and not len(success) == len(reward) == num_probes:
            raise ValueError(f"{len(success)} answers to {num_probes} probes")
        if not all(math.isfinite(r) for r in reward):
            raise ValueError("a reward that is no number")
        starts = {
            str(name): np.array(poses, float).reshape(-1, 7)
            for name, poses in dict(data.get("start_poses", {})).items()
        }
        start_rows = [int(row) for row in data.get("start_rows", [])]
        start_success = [bool(x) for x in data.get("start_success", [])]
        if not all(np.isfinite(poses).all() for poses in starts.values()) or not all(
            len(x) == len(start_rows) for x in [start_success, *starts.values()]
        ):
            raise ValueError("reset poses that are no numbers")
        if data["runnable"] and num_starts and set(start_rows) != set(range(num_starts)):
            raise ValueError("not every layout was reset")
        components = tuple(str(c) for c in data.get("components", []))
        if not all(COMPONENT_NAME.fullmatch(c) for c in components):
            raise ValueError("a reward component without a proper name")
        return SmokeResult(
            runnable=data["runnable"],
            error=shown(data.get("error", ""), 1000),
            observation_dim=int(data.get("observation_dim", 0)),
            components=components,
            warnings=tuple(shown(w, 300) for w in data.get("warnings", [])),
            probe_success=tuple(success),
            probe_reward=tuple(reward),
            start_poses=starts,
            start_rows=tuple(start_rows),
            start_success=tuple(start_success),
            seconds=float(data.get("seconds", 0.0)),
        )


def smoke_run(source: str, scene: Scene, *, timeout_s: float = 60.0) -> SmokeResult:
    """Return whether one task code runs on states of this scene."""
    return smoke_run_all([source], scene, timeout_s=timeout_s)[0]


def smoke_run_all(
    sources: list[str],
    scene: Scene,
    *,
    probes: States | None = None,
    starts: States | None = None,
    seconds_each: float = 10.0,
    timeout_s: float = 180.0,
) -> list[SmokeResult]:
    """Return per source whether it runs, what it says to the probes, and where its reset puts things.

    Args:
        sources: task codes.
        scene: whose objects the states describe.
        probes: further moments on which success and reward are wanted.
        starts: layouts that the environment offers to its reset; without them it is not looked at.
        seconds_each: wall-clock limit per source.
        timeout_s: for all of them, with the child's start.
    """
    results: list[SmokeResult | None] = [_refused(s) for s in sources]
    asked = [i for i, r in enumerate(results) if r is None]
    if asked:
        answers = _ask_child(
            [sources[i] for i in asked], scene, probes, starts, seconds_each, timeout_s
        )
        for i, answer in zip(asked, answers, strict=True):
            results[i] = answer
    return [r for r in results if r is not None]


def _refused(source: str) -> SmokeResult | None:
    try:
        check_code(source)
    except TaskCodeError as error:
        return SmokeResult(runnable=False, error=str(error))
    return None


def trial_request(
    sources: list[str],
    scene: Scene,
    probes: States | None,
    seconds_each: float,
    starts: States | None = None,
) -> dict[str, Any]:
    """Return what the child is asked, as data that JSON can hold."""
    rng = rng_for(
        0, "smoke", scene.title, *(hashlib.sha256(s.encode()).hexdigest() for s in sources)
    )
    count = int(rng.integers(BATCH // 2, 2 * BATCH))
    states = random_states(scene, count, rng)
    return {
        "sources": sources,
        "object_names": [o.name for o in scene.objects],
        "states": _as_lists(states),
        "edge_states": _as_lists(_edge_states(scene)),
        "batch_sizes": rng.integers(1, count, PARTS).tolist(),
        "probes": _as_lists(probes or {}),
        "starts": _as_lists(starts or {}),
        "seconds_each": seconds_each,
    }


def _ask_child(
    sources: list[str],
    scene: Scene,
    probes: States | None,
    starts: States | None,
    seconds_each: float,
    timeout_s: float,
) -> list[SmokeResult]:
    num_probes, num_starts = (len(x["eef_pos"]) if x else 0 for x in (probes, starts))
    request = trial_request(sources, scene, probes, seconds_each, starts)
    deadline = time.monotonic() + timeout_s
    child = _child()
    try:
        answer = child.ask(request, deadline)
        if not answer:  # it has ended since the last question
            child.end()
            child = _child()
            answer = child.ask(request, deadline)
    except TimeoutError:
        child.end()
        return [
            SmokeResult(runnable=False, error=f"the trial run took more than {timeout_s:g} s")
        ] * len(sources)
    if not answer.endswith(b"\n"):
        child.end()
    return _read(answer, child.complaint, len(sources), num_probes, num_starts)


class _Child:
    """A process that answers one request after the other, until nobody asks or its parent's thread ends."""

    def __init__(self) -> None:
        self._owner = os.getpid()
        folder = tempfile.mkdtemp(prefix="v2p-task-")
        self._stderr = tempfile.TemporaryFile()  # noqa: SIM115 - open as long as the child lives
        self._process = subprocess.Popen(
            own_python(f"v2p_data.task.sandbox.{CHILD.removesuffix('.py')}"),
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            stderr=self._stderr,
            cwd=folder,
            env={
                "OMP_NUM_THREADS": "1",
                "HOME": folder,
                "TMPDIR": folder,
                "PATH": "/usr/bin:/bin",
            },
            start_new_session=True,
        )
        # Also at the end of a worker process, which runs no `atexit`; never in a fork of this one.
        self._end = Finalize(self, _end, args=(self._process, folder), exitpriority=0)

    @property
    def is_ours(self) -> bool:
        """Whether it can be asked: it lives, and is not that of a process from which this one was forked."""
        return self._owner == os.getpid() and self._process.poll() is None

    @property
    def complaint(self) -> bytes:
        """What it has written on its standard error."""
        self._stderr.seek(0)
        return self._stderr.read()

    def ask(self, request: dict[str, Any], deadline: float) -> bytes:
        """Return the answer, or what there is of it if the child ended.

        Raises:
            TimeoutError: the time is up.
        """
        questions, answers = self._process.stdin, self._process.stdout
        assert questions is not None
        assert answers is not None
        answer = bytearray()
        with contextlib.suppress(BrokenPipeError):
            questions.write(json.dumps(request).encode() + b"\n")
            questions.flush()
        while not answer.endswith(b"\n") and len(answer) <= MAX_ANSWER_CHARS:
            if not wait([answers.fileno()], max(0.0, deadline - time.monotonic())):
                raise TimeoutError
            chunk = os.read(answers.fileno(), 1 << 20)
            if not chunk:
                with contextlib.suppress(subprocess.TimeoutExpired):
                    self._process.wait(ENDS_S)
                break
            answer += chunk
        return bytes(answer)

    def end(self) -> None:
        """Kill it unless it has ended by itself."""
        self._end()


def _end(process: subprocess.Popen[bytes], folder: str) -> None:
    end_group(process)
    for stream in (process.stdin, process.stdout):
        with contextlib.suppress(BrokenPipeError, AttributeError):
            stream.close()  # pyright: ignore[reportOptionalMemberAccess]
    shutil.rmtree(folder, ignore_errors=True)


_children = threading.local()
"""One a thread: the kernel ends a child with the thread that started it."""


def _child() -> _Child:
    """Return this thread's child, a new one where there is none."""
    child: _Child | None = getattr(_children, "child", None)
    if child is None or not child.is_ours:
        child = _children.child = _Child()
    return child


def _read(
    answer: bytes, complaint: bytes, count: int, num_probes: int, num_starts: int
) -> list[SmokeResult]:
    try:
        return _results(answer, count, num_probes, num_starts)
    except (ValueError, TypeError) as error:
        tail = complaint.decode(errors="replace").strip().splitlines()[-1:]
        raise V2PError(
            f"the trial run of task code gave no answer ({error}{'; ' + tail[0] if tail else ''}); "
            "is there memory left for a Python process with torch?"
        ) from error


def _results(answer: bytes, count: int, num_probes: int, num_starts: int = 0) -> list[SmokeResult]:
    if len(answer) > MAX_ANSWER_CHARS:
        raise ValueError("the answer is too long")
    data = json.loads(answer)
    if not isinstance(data, list) or len(data) != count:
        raise ValueError(f"{count} answers wanted")
    return [_result(d, num_probes, num_starts) for d in data]


def _result(data: Any, num_probes: int, num_starts: int) -> SmokeResult:
    """Return one sample's answer; one that cannot be read is that sample's own failure."""
    try:
        return SmokeResult.from_json(data, num_probes, num_starts)
    except (ValueError, TypeError, OverflowError) as error:
        return SmokeResult(runnable=False, error=f"its answer cannot be read: {shown(error, 200)}")


def _edge_states(scene: Scene) -> States:
    """Return moments at which norms are zero: everything still, the hand at an object's very centre."""
    batches: list[States] = []
    for obj in scene.objects:
        probe = at_rest(scene, 2)
        probe.eef_pos = probe.objects[obj.name].pos.copy()
        probe.progress = 0.0
        batches.append(probe.states())
    return concatenated(batches)


def _as_lists(states: States) -> dict[str, Any]:
    """Return states as lists, without a base observation that says nothing: the child fills in the zeros."""
    return {
        k: np.asarray(v, float).tolist()
        for k, v in states.items()
        if k != "base_observation" or np.any(v)
    }

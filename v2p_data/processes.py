"""Child processes: how one is started alone, how it ends with its parent, and how all that it started is ended."""

import ctypes
import os
import signal
import subprocess
import sys
import threading
import time
from contextlib import suppress
from pathlib import Path

PARENT_POLL_S = 0.5
"""How often a process looks for its parent where the kernel does not do it."""
_PR_SET_PDEATHSIG = 1
"""Number in linux/prctl.h."""


def num_cores() -> int:
    """Return how many cores this process may use."""
    return (
        len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
    )


def own_python(module: str, function: str = "main") -> list[str]:
    """Return the command that runs a function of our modules in a Python without the user's settings.

    It ends when this process does, however that went, from before it imports the module.
    """
    root = str(Path(__file__).parents[1])
    code = (
        f"import sys; sys.path.insert(0, {root!r}); from {__name__} import end_with_parent; "
        f"end_with_parent({os.getpid()}); from {module} import {function}; {function}()"
    )
    return [sys.executable, "-I", "-c", code]


def ending_with_us(command: list[str]) -> list[str]:
    """Return a command that runs another program, and ends when this process does, however that went."""
    return [*own_python(__name__, become_program.__name__), *command]


def become_program() -> None:
    """Be the program that the command line names."""
    try:
        os.execvp(sys.argv[1], sys.argv[1:])
    except OSError as error:
        sys.exit(f"{sys.argv[1]} cannot be started: {error.strerror}")


def end_with_parent(parent_pid: int) -> None:
    """Have this process killed when its parent ends, also where the parent is killed itself.

    On Linux the kernel does it, and does it no more once the process becomes another user. Elsewhere a thread looks.

    Args:
        parent_pid: the parent's, as the parent knows it: it may have ended before this call.
    """
    with suppress(OSError, AttributeError):
        if ctypes.CDLL(None).prctl(_PR_SET_PDEATHSIG, signal.SIGKILL) == 0:
            if os.getppid() != parent_pid:
                os.kill(os.getpid(), signal.SIGKILL)
            return
    threading.Thread(target=_look_for, args=(parent_pid,), daemon=True).start()


def _look_for(parent_pid: int) -> None:
    while os.getppid() == parent_pid:
        time.sleep(PARENT_POLL_S)
    os.kill(os.getpid(), signal.SIGKILL)


def end_group(process: subprocess.Popen[bytes], grace_s: float = 0.0) -> None:
    """End a process that leads a group, and all that it started, whether or not it has already exited itself.

    Args:
        process: started with `start_new_session=True`.
        grace_s: how long it may take to end by itself once it is asked to; 0: it is killed at once.
    """
    steps = ((signal.SIGTERM, grace_s), (signal.SIGKILL, 10.0))
    for sign, wait_s in steps if grace_s > 0 else steps[1:]:
        if process.poll() is not None:
            sign = signal.SIGKILL
        try:
            os.killpg(process.pid, sign)
        except (ProcessLookupError, PermissionError):
            break
        with suppress(subprocess.TimeoutExpired):
            process.wait(timeout=wait_s)
    process.wait()


def end_marked(mark: str) -> None:
    """Kill all processes that were started with a mark in their environment, whatever session they lead; on Linux only.

    Args:
        mark: `NAME=value`, of which nobody else has the value.
    """
    word = mark.encode()
    for _ in range(5):  # one may have started another meanwhile
        found = 0
        for path in Path("/proc").glob("[0-9]*/environ"):
            with suppress(OSError):
                if word in path.read_bytes().split(b"\0"):
                    os.kill(int(path.parent.name), signal.SIGKILL)
                    found += 1
        if not found:
            return
        time.sleep(0.02)

"""Every call of loaded task code ends in time, with a result or one sentence, at the cost of a microsecond a call.

One watching thread per process counts its own ticks. A call that lasts too many of them gets an exception between two
of its bytecodes, which task code cannot catch. A stopped or suspended process is not taken for a slow one, because
the watching thread stands still with it. A single tensor operation cannot be interrupted: the exception waits for its end.
"""

import ctypes
import functools
import os
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from typing import Any

from v2p_data.errors import V2PError

CODE_NAME = "<task code>"
"""What loaded task code is called in tracebacks."""
LIMIT_S = 20.0
"""A call takes milliseconds; a machine that is busy with other things makes it a hundred times as long."""
TICK_S = 0.25
HASTY_TICKS = 3
"""Calls of fewer ticks are far from being sent anything, so they end without a lock; `LIMIT_S` is many more."""
METHODS = (
    "reset_objects_states",
    "compute_observation_key",
    "get_observation_space",
    "compute_success",
    "compute_reward",
)


class TaskCallError(V2PError):
    """A call of task code raised an exception of its own."""


class TaskCodeTooSlowError(V2PError):
    """A call of task code did not end in time."""


class _TimeIsUpError(BaseException):
    """Ends a call from outside; not an `Exception`, so that nothing on the way takes it for an error of its own."""


class _Watchman:
    """Knows which thread is in a call, and since which tick."""

    def __init__(self) -> None:
        self.calls: dict[int, int] = {}
        """Per thread the tick at which its call began."""
        self.tick = 0
        self._ended: set[int] = set()
        self._lock = threading.Lock()
        self.thread: threading.Thread | None = None

    def start(self) -> None:
        """Start the watching thread; where none may be started (a confined child) others limit the time."""
        with self._lock:
            if self.thread is None:
                thread = threading.Thread(target=self._watch, name="task-code-time", daemon=True)
                with suppress(RuntimeError):
                    thread.start()
                self.thread = thread

    def forget(self, thread: int) -> bool:
        """End the watch over a thread's call; return whether it was sent an exception."""
        with self._lock:
            self.calls.pop(thread, None)
            if thread not in self._ended:
                return False
            self._ended.discard(thread)
            _send(thread, None)  # one that has not arrived yet shall not hit what comes next
            return True

    def _watch(self) -> None:
        while True:
            time.sleep(TICK_S)
            self.tick += 1
            if not self.calls:
                continue
            with self._lock:
                for thread, since in list(self.calls.items()):
                    if (self.tick - since) * TICK_S > LIMIT_S and thread not in self._ended:
                        self._ended.add(thread)
                        _send(thread, _TimeIsUpError)


def _send(thread: int, kind: type[BaseException] | None) -> None:
    """Have a thread raise an exception at its next bytecode; None takes back what it has not raised yet."""
    what = ctypes.py_object(kind) if kind else None
    ctypes.pythonapi.PyThreadState_SetAsyncExc(ctypes.c_ulong(thread), what)


_watchman = _Watchman()


def _renew() -> None:
    global _watchman
    _watchman = _Watchman()


os.register_at_fork(after_in_child=_renew)


@contextmanager
def limited(what: str) -> Iterator[None]:
    """Let what is done inside raise `TaskCodeTooSlowError` when it does not end in time; inside another limit, that one's.

    Args:
        what: of the task is called, for the sentence.
    """
    watchman, me = _watchman, threading.get_ident()
    if me in watchman.calls:
        yield
        return
    watchman.start()
    late = False
    watchman.calls[me] = watchman.tick
    try:
        try:
            yield
        finally:
            late = watchman.forget(me)
    except _TimeIsUpError:
        watchman.forget(me)
        late = True
    if late:
        raise TaskCodeTooSlowError(_sentence(what))


def guard_calls(kind: type) -> None:
    """Let every call of a task class's methods, inherited ones too, end in time, with a result or a `V2PError`."""
    for name in METHODS:
        if hasattr(kind, name):
            setattr(kind, name, _guarded(name, getattr(kind, name)))


def _guarded(name: str, method: Callable[..., Any]) -> Callable[..., Any]:
    """Return the method with what `limited` does, written out: as a context manager it takes ten times as long."""
    me_of = threading.get_ident

    @functools.wraps(method)
    def call(*given: Any) -> Any:
        watchman, me = _watchman, me_of()
        calls = watchman.calls
        if me in calls:
            return method(*given)
        if watchman.thread is None:
            watchman.start()
        late = False
        calls[me] = began = watchman.tick
        try:
            try:
                result = method(*given)
            finally:
                if watchman.tick - began < HASTY_TICKS:
                    del calls[me]
                else:
                    late = watchman.forget(me)
        except _TimeIsUpError:
            watchman.forget(me)
            late, result = True, None
        except (V2PError, MemoryError):
            raise
        except Exception as error:
            line = line_in_task_code(error)
            where = f"line {line} of the task's code, " if line else "the task's code, "
            words = " ".join(str(error).split())[:300]
            raise TaskCallError(
                f"{where}{name}, raises {type(error).__name__}: {words}; correct it in its task.py"
            ) from error
        if late:
            raise TaskCodeTooSlowError(_sentence(name))
        return result

    return call


def line_in_task_code(error: BaseException) -> int | None:
    """Return the line of the loaded task code at which an exception was raised."""
    line, at = None, error.__traceback__
    while at is not None:
        if at.tb_frame.f_code.co_filename == CODE_NAME:
            line = at.tb_lineno
        at = at.tb_next
    return line


def _sentence(what: str) -> str:
    return (
        f"{what} of the task's code took more than {LIMIT_S:g} s and was ended; does it loop, or make huge tensors? "
        "Correct it in its task.py, or take another task"
    )

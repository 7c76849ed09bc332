"""What is done with loaded task code ends in time, with a result or one sentence.

One watching thread per process counts its own ticks. Who is in task code for too many of them gets
an exception between two of its bytecodes, which task code cannot catch. A stopped or suspended
process is not taken for a slow one, because the watching thread stands still with it. A single
tensor operation cannot be interrupted: the exception waits for its end.
"""

import ctypes
import functools
import os
import threading
import time
from collections.abc import Callable
from contextlib import suppress

from v2p_data.errors import V2PError

CODE_NAME = "<task code>"
"""What loaded task code is called in tracebacks."""
LIMIT_S = 20.0
"""A call takes milliseconds; a machine that is busy with other things makes it a hundred times as long."""
TICK_S = 0.25


class TaskCallError(V2PError):
    """A call of task code raised an exception of its own."""


class TaskCodeTooSlowError(V2PError):
    """Task code did not end in time."""


class _TimeIsUpError(BaseException):
    """Ends a call from outside; not an `Exception`, so that nothing on the way takes it for an error of its own."""


class _Watchman:
    """Counts for each thread in task code for how many ticks it has been there."""

    def __init__(self) -> None:
        self.ticks: dict[int, int] = {}
        self._lock = threading.Lock()
        with suppress(RuntimeError):  # a confined child may start none; others limit its time
            threading.Thread(target=self._watch, name="task-code-time", daemon=True).start()

    def begin(self, thread: int) -> None:
        with self._lock:
            self.ticks[thread] = 0

    def end(self, thread: int) -> bool:
        """End the watch over a thread; return whether it was sent an exception."""
        with self._lock:
            is_late = self.ticks.pop(thread, 0) * TICK_S > LIMIT_S
            if is_late:
                _send(thread, None)  # one that has not arrived yet shall not hit what comes next
            return is_late

    def _watch(self) -> None:
        while True:
            time.sleep(TICK_S)
            with self._lock:
                for thread in self.ticks:
                    self.ticks[thread] += 1
                    if LIMIT_S < self.ticks[thread] * TICK_S <= LIMIT_S + TICK_S:  # once
                        _send(thread, _TimeIsUpError)


def _send(thread: int, kind: type[BaseException] | None) -> None:
    """Have a thread raise an exception at its next bytecode; None takes back what it has not raised yet."""
    what = ctypes.py_object(kind) if kind else None
    ctypes.pythonapi.PyThreadState_SetAsyncExc(ctypes.c_ulong(thread), what)


@functools.cache
def _watchman() -> _Watchman:
    return _Watchman()


os.register_at_fork(after_in_child=_watchman.cache_clear)


def in_time[T](function: Callable[[], T], what: str = "a call") -> T:
    """Return what a function returns that calls task code; inside another limit, that one holds.

    Args:
        function: what to do.
        what: names it in the sentence where the time is up outside of the task's code.

    Raises:
        TaskCodeTooSlowError: it does not end in time.
    """
    watchman, me = _watchman(), threading.get_ident()
    if me in watchman.ticks:
        return function()
    is_late, result = False, None
    try:
        try:
            watchman.begin(me)
            result = function()
        finally:
            is_late = watchman.end(me)
    except _TimeIsUpError as error:
        watchman.end(me)
        is_late, what = True, method_in_task_code(error) or what
    if is_late:
        raise TaskCodeTooSlowError(
            f"{what} of the task's code took more than {LIMIT_S:g} s and was ended; does it loop, "
            "or make huge tensors? "
            "Correct it in its task.py, or take another task"
        )
    return result  # pyright: ignore[reportReturnType]


def line_in_task_code(error: BaseException) -> int | None:
    """Return the line of the loaded task code at which an exception was raised."""
    places = _places(error)
    return places[-1][1] if places else None


def method_in_task_code(error: BaseException) -> str:
    """Return the name of the task's method in which an exception was raised; nothing where it is none of the task's."""
    places = _places(error)
    return places[0][0] if places and not places[0][0].startswith("<") else ""


def _places(error: BaseException) -> list[tuple[str, int]]:
    """Return the functions of task code on an exception's way, with their lines, the outermost first."""
    found: list[tuple[str, int]] = []
    at = error.__traceback__
    while at is not None:
        if at.tb_frame.f_code.co_filename == CODE_NAME:
            found.append((at.tb_frame.f_code.co_name, at.tb_lineno))
        at = at.tb_next
    return found

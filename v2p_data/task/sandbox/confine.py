"""Gives up rights in a child process that is about to run code nobody has vouched for; nothing here can be undone.

A child calls `leave_the_network` while it starts and `confine` when it has loaded what it needs. What holds on
which machine: limits on time, memory, files and processes on every Linux; the refusal of system calls
(seccomp) on x86-64 and ARM; write access to one folder only (Landlock) from kernel 5.13 on, where it is switched
on; a network namespace of its own where the container lets us make one; another user where we run as root.
`confine` returns the names of those that took hold.
"""

import math
import os
import resource
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path

from v2p_data.processes import end_with_parent
from v2p_data.task.sandbox import kernel_rules

NOBODY = 65534


@dataclass(frozen=True, kw_only=True)
class Rights:
    """What a child may still use."""

    seconds: float | None
    """Of computing from now on, over all threads; None: no limit. The wall clock is the parent's business."""
    memory_bytes: int | None
    """Of address space on top of what is mapped now; None: no limit (CUDA maps far more than it uses)."""
    file_bytes: int = 0
    """Largest size of a file written."""
    open_files: int = 0
    """How many files may be open at once; 0: none can be opened any more."""
    processes: int = 0
    """How many more processes and threads may be started; 0: none."""
    folder: Path | None = None
    """The only folder in which files can be made or changed; None: nowhere. The GPU's device files and /dev/null can
    be written with it."""


def leave_the_network() -> bool:
    """Move this process into a network of its own with nothing in it, and return whether the kernel let us.

    To be called before any thread is started. Where it fails, `confine` still refuses sockets.
    """
    if not hasattr(os, "unshare"):
        return False
    flags = os.CLONE_NEWNET if os.geteuid() == 0 else os.CLONE_NEWUSER | os.CLONE_NEWNET
    with suppress(OSError):  # not every container allows it
        os.unshare(flags)
        return True
    return False


def confine(rights: Rights, *, parent_pid: int, give_up_root: bool = True) -> tuple[str, ...]:
    """Give up, for the rest of this process's life, everything that untrusted code should not have.

    No socket can be opened and no program started afterwards, whatever the arguments are. The
    process ends with its parent.

    Args:
        rights: what this process may still use.
        parent_pid: the process that this one ends with, as it was before this one was forked.
        give_up_root: become nobody where we are root. A child that writes into the caller's folder stays who it
            is, and loses the capabilities of root alone.

    Returns:
        What took hold: `limits`, `nobody`, `capabilities`, `landlock`, `seccomp`.
    """
    held = ["limits"]
    limits = _limits(rights)
    kernel_rules.no_new_privileges()
    if kernel_rules.write_only_in(rights.folder):
        held.append("landlock")
    for limit, value in limits:
        # The kernel sends SIGXCPU at the soft limit and SIGKILL at the hard one: only the first names the cause.
        hard = value + 1 if limit == resource.RLIMIT_CPU else value
        resource.setrlimit(limit, (value, hard))
    if os.geteuid() == 0 and give_up_root:
        os.setgroups([])
        os.setgid(NOBODY)
        os.setuid(NOBODY)
        held.append("nobody")
    if kernel_rules.drop_capabilities():
        held.append("capabilities")
    end_with_parent(parent_pid)  # becoming nobody makes the kernel forget an earlier call
    if kernel_rules.refuse_calls(may_start_processes=rights.processes > 0):
        held.append("seccomp")
    return tuple(held)


def _limits(rights: Rights) -> list[tuple[int, int]]:
    """Return the limits to set, each with its value."""
    mapped = (
        int(Path("/proc/self/statm").read_text(encoding="utf-8").split()[0])
        * resource.getpagesize()
    )
    ours = _tasks_of_ours() if rights.processes else 0
    limits = [
        (resource.RLIMIT_CORE, 0),
        (resource.RLIMIT_FSIZE, rights.file_bytes),
        (resource.RLIMIT_NPROC, ours + rights.processes),
    ]
    if rights.memory_bytes is not None:
        limits.append((resource.RLIMIT_AS, mapped + rights.memory_bytes))
    if rights.seconds is not None:
        used = resource.getrusage(resource.RUSAGE_SELF)
        limits.append(
            (resource.RLIMIT_CPU, math.ceil(used.ru_utime + used.ru_stime + rights.seconds) + 1)
        )
    return [*limits, (resource.RLIMIT_NOFILE, rights.open_files)]


def _tasks_of_ours() -> int:
    """Return how many processes and threads our user has; the kernel's limit counts them all."""
    count = 0
    for entry in Path("/proc").iterdir():
        with suppress(OSError):  # it has ended meanwhile
            if entry.name.isdigit() and entry.stat().st_uid == os.getuid():
                count += sum(1 for _ in (entry / "task").iterdir())
    return count

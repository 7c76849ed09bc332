"""Linux's own means for a process to give up rights, which Python's standard library does not reach.

Numbers and structures are those of the kernel's headers: linux/prctl.h, linux/capability.h, linux/landlock.h,
linux/seccomp.h, linux/filter.h and the system call tables of x86-64 and ARM 64.
"""

import ctypes
import errno
import os
import struct
from pathlib import Path

_PR_SET_SECCOMP = 22
_PR_SET_NO_NEW_PRIVS = 38
_SECCOMP_MODE_FILTER = 2
_CAPABILITY_VERSION_3 = 0x20080522

_LANDLOCK_CREATE, _LANDLOCK_ADD, _LANDLOCK_RESTRICT = 444, 445, 446
_LANDLOCK_RULE_PATH = 1
_WRITES = {
    1: (1 << 1) | sum(1 << b for b in range(4, 13)),  # write, remove, make of every kind
    2: 1 << 13,  # move between folders
    3: 1 << 14,  # truncate
}
"""Rights on files by the version of Landlock that brought them."""
_ON_A_FILE = (1 << 1) | (1 << 14)
_TCP = 0b11
_SCOPES = 0b11
"""Abstract sockets and signals, to processes outside."""

_AUDIT_ARCH = {"x86_64": 0xC000003E, "aarch64": 0xC00000B7}
_REFUSED = {
    "x86_64": (
        # socket connect bind execve ptrace mount umount2 init_module delete_module
        41, 42, 49, 59, 101, 165, 166, 175, 176,
        # add_key request_key keyctl unshare perf_event_open setns
        248, 249, 250, 272, 298, 308,
        # open_by_handle_at process_vm_readv process_vm_writev kcmp finit_module bpf execveat userfaultfd
        304, 310, 311, 312, 313, 321, 322, 323,
        # io_uring_setup pidfd_getfd memfd_create
        425, 438, 319,
    ),
    "aarch64": (
        198, 203, 200, 221, 117, 40, 39, 105, 106,
        217, 218, 219, 97, 241, 268,
        265, 270, 271, 272, 273, 280, 281, 282,
        425, 438, 279,
    ),
}  # fmt: skip
_STARTS = {"x86_64": (56, 57, 58), "aarch64": (220,)}
"""clone, fork, vfork."""
_CLONE3 = 435
"""Its flags lie in memory, where a filter cannot look; the C library falls back to clone."""
_X32 = 0x40000000

_ALLOW = 0x7FFF0000
_ERRNO = 0x00050000
_LOAD, _EQUAL, _AT_LEAST, _RETURN = 0x20, 0x15, 0x35, 0x06


def no_new_privileges() -> bool:
    """Keep this process from gaining rights by starting a program; the two rules below ask for it."""
    return _libc().prctl(_PR_SET_NO_NEW_PRIVS, 1, 0, 0, 0) == 0


def drop_capabilities() -> bool:
    """Give up what root may do beyond owning its files."""
    header = struct.pack("=Ii", _CAPABILITY_VERSION_3, 0)
    nothing = bytes(24)
    return _libc().capset(header, nothing) == 0


def write_only_in(folder: Path | None) -> bool:
    """Make, change and remove files nowhere but beneath `folder`; connect nowhere; signal nobody outside.

    False where the kernel has no Landlock.
    """
    libc = _libc()
    version = libc.syscall(_LANDLOCK_CREATE, None, ctypes.c_size_t(0), ctypes.c_uint32(1))
    if version < 1:
        return False
    files = sum(rights for since, rights in _WRITES.items() if since <= version)
    rules = struct.pack("=QQQ", files, _TCP if version >= 4 else 0, _SCOPES if version >= 6 else 0)
    size = 24 if version >= 6 else 16 if version >= 4 else 8
    ruleset = libc.syscall(_LANDLOCK_CREATE, rules, ctypes.c_size_t(size), ctypes.c_uint32(0))
    if ruleset < 0:
        return False
    try:
        if folder is not None:
            _let_write(libc, ruleset, folder, files)
            for device in (Path("/dev/null"), *Path("/dev").glob("nvidia*")):
                if not device.is_dir():
                    _let_write(libc, ruleset, device, files & _ON_A_FILE)
        return libc.syscall(_LANDLOCK_RESTRICT, ruleset, ctypes.c_uint32(0)) == 0
    finally:
        os.close(ruleset)


def _let_write(libc: ctypes.CDLL, ruleset: int, path: Path, rights: int) -> None:
    at = os.open(path, os.O_PATH)
    beneath = struct.pack("=Qi", rights, at)
    failed = libc.syscall(_LANDLOCK_ADD, ruleset, _LANDLOCK_RULE_PATH, beneath, ctypes.c_uint32(0))
    os.close(at)
    if failed:
        raise OSError(ctypes.get_errno(), "Landlock takes no rule for this path", str(path))


def refuse_calls(*, may_start_processes: bool) -> bool:
    """Refuse sockets, programs, other processes' memory, mounts and kernel modules to this process.

    False where the kernel has no seccomp or the machine is neither x86-64 nor ARM 64.
    """
    machine = os.uname().machine
    if machine not in _AUDIT_ARCH:
        return False
    refused = _REFUSED[machine] + (() if may_start_processes else _STARTS[machine])
    steps = [
        (_LOAD, 0, 0, 4),  # the architecture
        (_EQUAL, 1, 0, _AUDIT_ARCH[machine]),
        (_RETURN, 0, 0, _ERRNO | errno.EPERM),
        (_LOAD, 0, 0, 0),  # the call's number
        (_AT_LEAST, 0, 1, _X32),
        (_RETURN, 0, 0, _ERRNO | errno.EPERM),
        (_EQUAL, 0, 1, _CLONE3),
        (_RETURN, 0, 0, _ERRNO | errno.ENOSYS),
    ]
    for number in refused:
        steps += [(_EQUAL, 0, 1, number), (_RETURN, 0, 0, _ERRNO | errno.EPERM)]
    steps.append((_RETURN, 0, 0, _ALLOW))
    program = b"".join(struct.pack("=HBBI", *step) for step in steps)
    held = ctypes.create_string_buffer(program, len(program))
    header = struct.pack("@HP", len(steps), ctypes.addressof(held))
    return _libc().prctl(_PR_SET_SECCOMP, _SECCOMP_MODE_FILTER, header, 0, 0) == 0


def _libc() -> ctypes.CDLL:
    return ctypes.CDLL(None, use_errno=True)

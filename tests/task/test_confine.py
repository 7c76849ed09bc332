"""What a hole in the reader would let through, done by plain Python in a process that has given up its rights."""

import ctypes
import mmap
import os
import signal
import socket
import subprocess
import sys
import threading
import time
from collections.abc import Callable
from pathlib import Path

import pytest

from v2p_data.task.sandbox.confine import Rights, confine, leave_the_network
from v2p_data.task.sandbox.smoke_child import in_a_fork

MEGABYTE = 2**20


def in_a_child(attempt: Callable[[], object], *, give_up_root: bool = True, **limits) -> str:
    """Return how a forked process that confines itself ends: 'done', the name of an error, or of a signal."""
    read_end, write_end = os.pipe()
    parent_pid, pid = os.getpid(), os.fork()
    if pid == 0:
        try:
            os.close(read_end)
            leave_the_network()
            rights = Rights(**{"seconds": 5.0, "memory_bytes": 256 * MEGABYTE} | limits)
            confine(rights, parent_pid=parent_pid, give_up_root=give_up_root)
            try:
                attempt()
                os.write(write_end, b"done")
            except BaseException as error:  # noqa: BLE001 - its name is the result
                os.write(write_end, type(error).__name__.encode())
        finally:
            os._exit(0)
    os.close(write_end)
    said = os.read(read_end, 1000).decode()
    os.close(read_end)
    _, status = os.waitpid(pid, 0)
    return signal.Signals(os.WTERMSIG(status)).name if os.WIFSIGNALED(status) else said


def call(*arguments: object) -> None:
    if ctypes.CDLL(None, use_errno=True).syscall(*arguments) < 0:
        raise OSError(ctypes.get_errno(), "refused")


def start_thread() -> None:
    thread = threading.Thread(target=int)
    thread.start()
    thread.join()


def spend_memory() -> None:
    bytearray(512 * MEGABYTE)


def spend_mapped_memory() -> None:
    mmap.mmap(-1, 512 * MEGABYTE)


def raise_own_limits() -> None:
    import resource

    resource.setrlimit(resource.RLIMIT_NOFILE, (100, 100))


def load_from_disk() -> None:
    sys.modules.pop("colorsys", None)
    import colorsys  # noqa: F401


@pytest.fixture
def canary(tmp_path: Path) -> Path:
    tmp_path.chmod(0o777)
    path = tmp_path / "canary"
    path.write_text("alive")
    path.chmod(0o666)
    return path


FILES: dict[str, Callable[[Path], object]] = {
    "writes": lambda p: p.write_text("dead"),
    "appends": lambda p: os.write(os.open(p, os.O_APPEND | os.O_WRONLY), b"dead"),
    "cuts": lambda p: os.truncate(p, 0),
    "removes": lambda p: p.unlink(),
    "renames": lambda p: p.rename(p.with_name("gone")),
    "links": lambda p: p.with_name("link").hardlink_to(p),
    "links by name": lambda p: p.with_name("link").symlink_to(p),
    "makes a folder": lambda p: p.with_name("folder").mkdir(),
    "makes a pipe": lambda p: os.mkfifo(p.with_name("pipe")),
    "makes a file": lambda p: p.with_name("new").touch(),
    "changes another user's rights": lambda p: os.chown(p, 1, 1),
    "reads": lambda p: p.read_text(),
    "lists": lambda p: list(p.parent.iterdir()),
}


@pytest.mark.parametrize("attempt", FILES)
def test_a_confined_process_leaves_every_file_as_it_was(attempt, canary):
    before = sorted(canary.parent.iterdir())

    ended = in_a_child(lambda: FILES[attempt](canary))

    assert ended.endswith("Error")
    assert canary.read_text() == "alive"
    assert sorted(canary.parent.iterdir()) == before


REACHES: dict[str, Callable[[], object]] = {
    "an internet socket": socket.socket,
    "a socket of this machine": lambda: socket.socket(socket.AF_UNIX),
    "a raw socket": lambda: socket.socket(socket.AF_PACKET, socket.SOCK_RAW),
    "a netlink socket": lambda: socket.socket(socket.AF_NETLINK),
    "another process": os.fork,
    "another thread": start_thread,
    "a program": lambda: os.execv("/bin/true", ["true"]),
    "a program in a child": lambda: subprocess.run(["/bin/true"], check=True),
    "a shell": lambda: subprocess.run("true", shell=True, check=True),
    "a signal to the parent": lambda: os.kill(os.getppid(), 0),
    "more open files": raise_own_limits,
    "root again": lambda: call(105, 0) if os.uname().machine == "x86_64" else os.setuid(0),
    "a namespace of its own": lambda: os.unshare(os.CLONE_NEWUSER),
    "a traced parent": lambda: call(101, 16, os.getppid(), 0, 0),
    "a mount": lambda: call(165, b"none", b"/mnt", b"tmpfs", 0, None),
    "a kernel module": lambda: call(313, 0, b"", 0),
    "a file in memory": lambda: os.memfd_create("x"),
    "an io_uring": lambda: call(425, 1, bytes(120)),
    "a module from the disk": load_from_disk,
    "the memory of the parent": lambda: open(f"/proc/{os.getppid()}/mem"),  # noqa: PTH123, SIM115
    "more memory": spend_memory,
    "more mapped memory": spend_mapped_memory,
}


@pytest.mark.parametrize("attempt", REACHES)
def test_a_confined_process_does_not_get(attempt):
    if os.uname().machine != "x86_64" and "call" in REACHES[attempt].__code__.co_names:
        pytest.skip("the number of this system call is that of x86-64")

    assert in_a_child(REACHES[attempt]).endswith("Error")


def test_computing_without_end_is_ended_by_the_kernel():
    def forever() -> None:
        while True:
            pass

    begin = time.process_time()

    assert in_a_child(forever, seconds=0.0) in {"SIGXCPU", "SIGKILL"}
    assert time.process_time() - begin < 5


def some_more_files() -> int:
    """Return a limit that leaves room beside the files that other tests left open in this process."""
    return 64 + max(int(path.name) for path in Path("/proc/self/fd").iterdir())


def test_a_process_with_a_folder_writes_there_and_nowhere_else(canary, tmp_path_factory):
    folder = tmp_path_factory.mktemp("own")
    limits = {
        "folder": folder,
        "open_files": some_more_files(),
        "file_bytes": 1000,
        "processes": 4,
        "give_up_root": False,
    }

    assert in_a_child(lambda: (folder / "made").write_text("x" * 1000), **limits) == "done"
    assert in_a_child(lambda: (folder / "large").write_text("x" * 2000), **limits) != "done"
    assert in_a_child(lambda: (folder / "made").rename(folder / "moved"), **limits) == "done"
    assert in_a_child(lambda: Path("/dev/null").write_text("x"), **limits) == "done"
    assert in_a_child(start_thread, **limits) == "done"
    assert in_a_child(canary.read_text, **limits) == "done"
    assert in_a_child(socket.socket, **limits) == "PermissionError"
    assert (
        in_a_child(lambda: subprocess.run(["/bin/true"], check=True), **limits)
        == "PermissionError"
    )
    assert (folder / "moved").read_text() == "x" * 1000


def test_a_folder_of_its_own_is_no_way_to_others(canary, tmp_path_factory):
    held = []
    read_end, write_end = os.pipe()
    parent_pid = os.getpid()
    if os.fork() == 0:
        rights = Rights(seconds=5.0, memory_bytes=None, open_files=9)
        held = confine(rights, parent_pid=parent_pid)
        os.write(write_end, ",".join(held).encode())
        os._exit(0)
    os.close(write_end)
    held = os.read(read_end, 1000).decode().split(",")
    os.close(read_end)
    os.wait()
    if "landlock" not in held:
        pytest.skip("this kernel has no Landlock, which is what keeps a process to a folder")
    folder = tmp_path_factory.mktemp("own")
    limits = {
        "folder": folder,
        "open_files": some_more_files(),
        "file_bytes": 1000,
        "give_up_root": False,
    }

    for name in set(FILES) - {"reads", "lists"}:
        assert in_a_child(lambda name=name: FILES[name](canary), **limits).endswith("Error"), name

    assert canary.read_text() == "alive"
    assert list(canary.parent.iterdir()) == [canary]


@pytest.mark.parametrize(
    ("number", "said"),
    [
        (signal.SIGFPE, "divides whole numbers in a way that the processor refuses"),
        (signal.SIGSEGV, "makes torch crash"),
        (signal.SIGKILL, "may need too much memory"),
    ],
)
def test_what_ended_a_trial_is_called_by_its_name(number, said):
    def crash(_source, _request):
        signal.signal(number, signal.SIG_DFL) if number != signal.SIGKILL else None
        os.kill(os.getpid(), number)
        return {}

    assert said in in_a_fork("", {"seconds_each": 20}, crash)["error"]


def test_a_fork_neither_reads_the_next_request_nor_answers_in_its_parents_name(capfd):
    def speak(source: str, request: dict) -> dict:
        os.write(1, b"[]\n")
        os.write(2, b"a complaint")
        return {"read": os.read(0, 100).decode()}

    assert in_a_fork("", {"seconds_each": 20}, speak) == {"read": ""}
    assert tuple(capfd.readouterr()) == ("", "")

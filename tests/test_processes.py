"""Child processes end with their parent and with their group, by the real kernel and real processes."""

import os
import signal
import subprocess
import sys
import textwrap
import time
from collections.abc import Callable
from pathlib import Path

import pytest

from v2p_data.processes import end_group, ending_with_us

LONG = "import time; time.sleep(60)"
WAIT_S = 20.0


def soon(claim: Callable[[], bool]) -> bool:
    deadline = time.monotonic() + WAIT_S
    while not claim() and time.monotonic() < deadline:
        time.sleep(0.02)
    return claim()


def has_ended(pid: int) -> bool:
    try:
        return Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()[0] in "ZX"
    except OSError:
        return True


def told(path: Path) -> list[int]:
    assert soon(lambda: path.is_file() and path.read_text().endswith("\n"))
    return [int(word) for word in path.read_text().split()]


@pytest.mark.parametrize("by_kernel", [True, False])
def test_a_child_ends_when_its_parent_is_killed(tmp_path, by_kernel):
    child = tmp_path / "child.py"
    child.write_text(
        textwrap.dedent(f"""
        import ctypes, os, sys, time
        from pathlib import Path
        from v2p_data import processes
        if not {by_kernel}:
            class Elsewhere:
                def __init__(self, name): pass
            ctypes.CDLL = Elsewhere  # a system whose C library has no prctl
        processes.end_with_parent(os.getppid())
        Path({str(tmp_path)!r}, "pid").write_text(f"{{os.getpid()}}\\n")
        time.sleep(60)
        """)
    )
    parent = subprocess.Popen(
        [
            sys.executable,
            "-c",
            f"import subprocess, sys; subprocess.run([sys.executable, {str(child)!r}])",
        ]
    )
    (pid,) = told(tmp_path / "pid")

    assert not has_ended(pid)
    parent.kill()
    parent.wait()

    assert soon(lambda: has_ended(pid))


def test_a_child_whose_parent_is_gone_already_ends_at_once():
    code = "from v2p_data.processes import end_with_parent; end_with_parent(1); print('alive')"

    done = subprocess.run([sys.executable, "-c", code], capture_output=True, check=False)

    assert (done.returncode, done.stdout) == (-signal.SIGKILL, b"")


def test_a_process_of_ours_whose_parent_is_gone_ends_before_it_imports():
    """What it would import takes seconds, in which the parent may end; then another takes the parent's place."""
    code = "from v2p_data.processes import own_python; print(own_python('v2p_data.task.sandbox.smoke_child')[-1])"
    of_another = subprocess.run([sys.executable, "-c", code], capture_output=True, check=True)
    begun = time.monotonic()

    done = subprocess.run(
        [sys.executable, "-I", "-X", "importtime", "-c", of_another.stdout.decode()],
        capture_output=True,
        check=False,
    )

    assert done.returncode == -signal.SIGKILL
    assert b"v2p_data.processes" in done.stderr
    assert b"torch" not in done.stderr
    assert time.monotonic() - begun < WAIT_S


def test_another_program_ends_with_the_process_that_started_it(tmp_path):
    note = f"from pathlib import Path; import os; Path({str(tmp_path / 'pid')!r}).write_text(f'{{os.getpid()}}\\n')"
    parent_code = textwrap.dedent(f"""
        import subprocess, sys
        from v2p_data.processes import ending_with_us
        command = ending_with_us([sys.executable, "-c", {note + "; " + LONG!r}])
        subprocess.run(command, start_new_session=True)
    """)
    parent = subprocess.Popen([sys.executable, "-c", parent_code])
    (pid,) = told(tmp_path / "pid")

    parent.kill()
    parent.wait()

    assert soon(lambda: has_ended(pid))


def test_another_program_gets_its_arguments_and_its_exit_code_comes_back():
    code = "import sys; print(sys.argv[1:]); sys.exit(3)"

    done = subprocess.run(
        ending_with_us([sys.executable, "-c", code, "a b", "--c"]),
        capture_output=True,
        check=False,
    )

    assert (done.returncode, done.stdout) == (3, b"['a b', '--c']\n")


def test_a_program_that_cannot_be_started_says_so(tmp_path):
    plain = tmp_path / "no_program"
    plain.write_text("")

    done = subprocess.run(ending_with_us([str(plain)]), capture_output=True, check=False)

    assert done.returncode == 1
    assert b"no_program cannot be started: Permission denied" in done.stderr


@pytest.mark.parametrize("exits", [True, False])
@pytest.mark.parametrize("grace_s", [0.0, 0.3])
def test_a_group_is_ended_also_where_its_leader_has_exited(tmp_path, exits, grace_s):
    code = textwrap.dedent(f"""
        import os, signal, subprocess, sys, time
        from pathlib import Path
        signal.signal(signal.SIGTERM, signal.SIG_IGN)
        other = subprocess.Popen([sys.executable, "-c", {LONG!r}])
        Path({str(tmp_path)!r}, "pids").write_text(f"{{os.getpid()}} {{other.pid}}\\n")
        time.sleep(0 if {exits} else 60)
    """)
    leader = subprocess.Popen([sys.executable, "-c", code], start_new_session=True)
    pids = told(tmp_path / "pids")
    if exits:
        leader.wait()
        assert not has_ended(pids[1])

    end_group(leader, grace_s)

    assert leader.returncode is not None
    assert all(soon(lambda pid=pid: has_ended(pid)) for pid in pids)
    assert os.getpid() not in pids

"""Try the sandbox with random programs, with a second witness to what they do.

Programs are made by `tests/task/random_programs.py` from the templates' task code, the corpus of escapes and a grammar.
Each is read; a number of those that the reader accepts is run as the smoke run would run it, in a confined fork in
which Python's own audit events are listened to: opening, starting, connecting and importing are reported whether
or not they succeed. Beside that, a folder that anyone may write to is looked at for changes.

    python scripts/fuzz_sandbox.py --programs 5000 --executed 500

Ends with exit code 1 if a program got anywhere, if the reader broke down, or refused without a sentence.
"""

import argparse
import ast
import json
import os
import socket
import subprocess
import sys
import sysconfig
import tempfile
import time
from collections import Counter
from contextlib import suppress
from pathlib import Path
from typing import Any

import torch

from v2p_data.seeds import rng_for
from v2p_data.task.benchmark import benchmark_names, load_benchmark
from v2p_data.task.sandbox import smoke_child
from v2p_data.task.sandbox.confine import leave_the_network
from v2p_data.task.sandbox.reader.check import check_code
from v2p_data.task.sandbox.reader.refusal import TaskCodeError
from v2p_data.task.sandbox.sandbox import CODE_NAME
from v2p_data.task.sandbox.smoke import trial_request
from v2p_data.task.templates.write import write_samples

ROOT = Path(__file__).parents[1]
LIBRARIES = tuple(
    {sysconfig.get_path("stdlib"), sysconfig.get_path("purelib"), str(ROOT / "v2p_data")}
)
WATCHED = (
    "open",
    "os.",
    "subprocess.",
    "socket.",
    "ctypes.",
    "shutil.",
    "tempfile.",
    "pty.",
    "mmap.",
    "pickle.",
    "marshal.",
    "exec",
    "compile",
    "import",
    "sys.",
    "gc.",
    "fcntl.",
    "signal.",
    "urllib.",
    "http.",
    "code.",
    "winreg.",
    "syslog.",
)
SECONDS_EACH = 2.0
_heard: list[str] | None = None


def main() -> None:
    """Read the command line, try, print what happened as one line of JSON."""
    parser = argparse.ArgumentParser(description="Try the sandbox with random programs.")
    parser.add_argument("--programs", type=int, default=2_000, help="how many are read")
    parser.add_argument(
        "--executed", type=int, default=200, help="how many of the accepted ones are run"
    )
    parser.add_argument("--seed", type=int, default=0)
    args = parser.parse_args()
    with tempfile.TemporaryDirectory() as folder:
        result = fuzz(args.programs, args.executed, args.seed, Path(folder))
    print(json.dumps(result))
    sys.exit(1 if result["violations"] else 0)


def fuzz(programs: int, executed: int, seed: int, folder: Path) -> dict[str, Any]:
    """Return what became of the programs; `violations` is empty where the sandbox held.

    Args:
        programs: how many are read.
        executed: how many of those that the reader accepts are run.
        seed: what is drawn follows from it.
        folder: empty; the canaries are put there.
    """
    sys.path.insert(0, str(ROOT / "tests" / "task"))
    from random_programs import Maker  # pyright: ignore[reportMissingImports]

    canaries = _put_canaries(folder)
    scene = load_benchmark(benchmark_names()[0]).scene
    name = scene.objects[0].name
    maker = Maker(write_samples(scene), str(folder / "canary"), rng_for(seed, "fuzz"))
    outcomes: Counter[str] = Counter()
    request = trial_request([], scene, None, SECONDS_EACH)
    _warm_up(request)
    violations = [f"the witness does not hear {what}" for what in _unheard(request)]
    begin = time.monotonic()
    ran = 0
    for k in range(programs):
        source = maker.make().replace("box_", f"{name}_")
        try:
            check_code(source)
        except TaskCodeError as refusal:
            outcomes["refused"] += 1
            outcomes["refused without a line"] += refusal.line is None
            if len(refusal.reason) < 10:
                violations.append(f"program {k}: refused without a sentence")
            continue
        except Exception as error:  # noqa: BLE001 - the reader broke down, which is what is looked for
            violations.append(
                f"program {k}: the reader broke down: {type(error).__name__}: {error}"
            )
            continue
        outcomes["accepted"] += 1
        if ran >= executed:
            continue
        ran += 1
        answer = smoke_child.in_a_fork(source, request, _listened_to)
        heard = answer.pop("heard", [])
        outcomes["ran" if answer["runnable"] else "failed"] += 1
        outcomes["ended by a limit"] += "heard" not in answer and "took more than" in answer.get(
            "error", ""
        )
        outcomes["libraries' own late imports"] += bool(heard) and all(
            _is_import(e) for e in heard
        )
        violations += [f"program {k}: {e}" for e in heard if not _is_import(e)]
        if _look_at(folder) != canaries:
            violations.append(f"program {k}: changed the folder: {_look_at(folder)}")
            canaries = _look_at(folder)
    return {
        "programs": programs,
        "executed": ran,
        "outcomes": dict(outcomes),
        "violations": violations[:20],
        "seconds": round(time.monotonic() - begin, 1),
    }


def _listened_to(source: str, request: dict[str, Any]) -> dict[str, Any]:
    """Answer as the smoke run does, with the audit events that reach the outside."""
    global _heard
    _heard = []
    answer = smoke_child.answer(source, request)
    heard, _heard = _heard, None
    return answer | {"heard": heard[:20]}


def _unheard(request: dict[str, Any]) -> list[str]:
    """Return what the witness misses of things that plain Python does in the fork; silence must mean something."""
    doings = {
        "open": lambda: Path("/dev/null").read_text(encoding="utf-8"),
        "socket": socket.socket,
        "os.fork": os.fork,
        "subprocess": lambda: subprocess.run(["/bin/true"], check=True),
    }

    def do_all(source: str, request: dict[str, Any]) -> dict[str, Any]:
        global _heard
        del source, request
        _heard = []
        for do in doings.values():
            with suppress(OSError):
                do()
        return {"runnable": True, "heard": _heard}

    heard = smoke_child.in_a_fork("", request, do_all).get("heard", [])
    return [what for what in doings if not any(event.startswith(what) for event in heard)]


def _hook(event: str, details: tuple[Any, ...]) -> None:
    if _heard is None or not event.startswith(WATCHED) or event == "sys._getframe":
        return
    if event == "compile" and (isinstance(details[0], ast.AST) or details[1] == "<unknown>"):
        return  # the program itself, being read and loaded; it has no syntax tree in its reach
    if event == "exec" and getattr(details[0], "co_filename", "") == CODE_NAME:
        return
    _heard.append(f"{event} {details!r}"[:200])


def _is_import(heard: str) -> bool:
    """Whether it is torch that loads a part of itself: a look at the libraries, refused like any other."""
    kind, _, details = heard.partition(" ")
    if kind == "import":
        return details.startswith(("('torch", "('numpy"))
    return kind in {"open", "os.listdir"} and details.startswith(
        tuple(f"('{p}" for p in LIBRARIES)
    )


def _warm_up(request: dict[str, Any]) -> None:
    leave_the_network()
    torch.set_num_threads(1)
    torch.set_grad_enabled(False)
    smoke_child.warm_up(request)
    sys.addaudithook(_hook)


def _put_canaries(folder: Path) -> dict[str, tuple[str, int]]:
    folder.chmod(0o777)
    for name in ("canary", "canary.pt", "canary.so"):
        (folder / name).write_text("alive", encoding="utf-8")
        (folder / name).chmod(0o666)
    return _look_at(folder)


def _look_at(folder: Path) -> dict[str, tuple[str, int]]:
    return {
        p.name: (p.read_text(encoding="utf-8"), p.stat().st_mtime_ns)
        for p in sorted(folder.iterdir())
    }


if __name__ == "__main__":
    main()

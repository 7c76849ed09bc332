"""Inject faults into runs at random moments and see whether anything is lost, made twice or wrong.

    python scripts/bench_faults.py                                # eleven minutes; --kinds for some, --seed for other moments
    python scripts/bench_faults.py --kinds ctrl_c full_disk --times=3

The command line, the scheduler, its worker processes, Ray and the stores are the real ones; the stages are light. A run makes three
stages of each of five items, and one item is rejected at its second stage. A trial starts it as a program, disturbs it at
a moment drawn from a named stream, lets it end, mends the fault, and gives the same command again. What must hold:

- every stage that the fault did not hit has ended as in an undisturbed run, in the disturbed run already, unless the fault ended the driver;
- the fault is named, with its item where it hit one, and nobody sees a traceback of the driver;
- no process of a run that was ended is at work afterwards, and every fault ends within two minutes;
- nothing that was finished is begun again or changed, and what was tried again was tried so often and no more;
- in the end the run folder, and the store, hold the same bytes as an undisturbed run's.

One line of JSON is written for each fault to `--out`; a trial that stands there is not repeated. A run that had ended before its fault came
counts as none injected. The kind `packing` kills the
packing of a real dataset: `bench_kills.py`. `full_disk` mounts a small tmpfs, and `no_home` makes /dev/shm read-only in a name
space of its own; both need root.
"""

import contextlib
import functools
import hashlib
import importlib
import json
import os
import re
import shlex
import shutil
import signal
import subprocess
import sys
import tempfile
import threading
import time
from collections import Counter, defaultdict
from collections.abc import Callable, Mapping
from dataclasses import asdict, dataclass, field
from http.server import ThreadingHTTPServer
from pathlib import Path
from typing import Any

from v2p_data.errors import NOT_ALL, ItemRejectedError
from v2p_data.pipeline.artifact import RECORD_FILE
from v2p_data.pipeline.at_work import RUN_LOCK
from v2p_data.pipeline.runner import Runtime, Stage

ITEMS = tuple(f"clip_{k}" for k in range(5))
REJECTED = ITEMS[-1]
STAGES = ("scene", "task", "episodes")
TIMES = {
    **dict.fromkeys(("killed_worker", "killed_driver", "ctrl_c"), 10),
    **dict.fromkeys(("ray_worker", "ray_raylet", "ray_driver"), 3), "ray_crash": 1,
    **dict.fromkeys(("crash", "full_disk", "two_runs"), 6),
    **dict.fromkeys(("hang", "bucket_away", "folder_away", "two_drivers"), 5),
    **dict.fromkeys(("memory", "store_gone", "clock_back"), 4), "small_files": 3,
    **dict.fromkeys(("locale_c", "no_home", "few_files", "little_memory"), 2), "packing": 1,
}  # fmt: skip
"""Kind of fault -> how often it is injected by default."""
PACKING_KILLS = 8
"""In one trial of `packing`, or one more, because what is packed is to be made first."""
NO_TIME = ("seconds", "provenance", "checksum")
"""Of a record: when and where it was made, and the checksum over that."""
LONGEST_S = 120.0
CLOCK = """
#define _GNU_SOURCE
#include <dlfcn.h>
#include <stdlib.h>
#include <time.h>
#include <unistd.h>
int clock_gettime(clockid_t which, struct timespec *now) {
    static int (*real)(clockid_t, struct timespec *);
    if (!real) real = dlsym(RTLD_NEXT, "clock_gettime");
    int code = real(which, now);
    if (which == CLOCK_REALTIME && !access(getenv("BENCH_CLOCK_BACK"), F_OK)) now->tv_sec -= 90000;
    return code;
}
"""
"""A C library's clock that goes back by 25 hours once a file is there."""


@dataclass(frozen=True, kw_only=True)
class BenchConfig:
    """What, how often, and where."""

    kinds: tuple[str, ...] = tuple(TIMES)
    times: int = 0
    """Faults of each kind; 0: as many as `TIMES` says."""
    seed: int = 0
    """Of the moments."""
    out: Path = Path("outputs/faults.jsonl")


# --- the run that is disturbed ---------------------------------------------------------------------------------


def chains() -> list[Stage]:
    """Return the last stage of each item."""
    ends: list[Stage] = []
    for item in ITEMS:
        inputs: dict[str, Stage] = {}
        for name in STAGES:
            stage = Stage(name=name, item=item, config=[name, item], inputs=inputs, make=make)
            inputs = {name: stage}
        ends.extend(inputs.values())
    return ends


def make(
    config: list[str], inputs: Mapping[str, Path], out: Path, runtime: Runtime
) -> dict[str, Any]:
    """Note that it begins, do what the trial's file of troubles says, and write two files with a pause between."""
    name = " ".join(config)
    digest = hashlib.sha256(name.encode()).digest()
    noted = runtime.root.with_suffix(".noted")
    with noted.open("a") as stream:
        stream.write(f"{name} {os.getpid()} {os.getppid()}\n")
    be_patient()
    troubles = runtime.root.with_suffix(".troubles")
    trouble = json.loads(troubles.read_text()).get(name, "") if troubles.exists() else ""
    if trouble.startswith("signal"):
        os.kill(os.getpid(), int(trouble.split()[1]))
    elif trouble == "exit":
        os._exit(0)
    elif trouble == "hang":
        time.sleep(3600)
    elif trouble == "hang_alone":
        importlib.import_module("ctypes").PyDLL(None).sleep(3600)  # no other thread may run
    elif trouble == "memory":
        [bytearray(b"x" * 2**26) for _ in range(10_000)]
    before = "".join((folder / "text").read_text() for folder in inputs.values())
    (out / "deep").mkdir()
    (out / "deep" / "bytes").write_bytes(digest * 600)
    time.sleep(0.05 + digest[0] / 1000)
    if config == ["task", REJECTED]:
        raise ItemRejectedError("stand_in", "rejected, as some clips are")
    (out / "text").write_text(before + name)
    return {"letters": len(name)}


def be_patient() -> None:
    """Give a store up after as long as the trial says."""
    store: Any = importlib.import_module("v2p_data.pipeline.store")
    store.PATIENCE_S = float(os.environ.get("BENCH_PATIENCE_S") or store.PATIENCE_S)


def drive(root: Path, how: dict[str, Any]) -> None:
    """Be `v2p episodes` with these stages: the command line's handling of errors, the run's lock, the scheduler, its counts."""
    from v2p_data import cli
    from v2p_data.commands.progress import Progress
    from v2p_data.pipeline.workers import only_run_in, run_stages

    def command(argv: list[str]) -> int:
        runtime = Runtime(root=root, **how)
        be_patient()
        with only_run_in(root):
            progress = Progress(runtime, chains(), lambda event: None)
            outcomes = run_stages(chains(), runtime, progress)
            progress.write()
        told = [asdict(outcome) for outcome in outcomes.values()]
        print(json.dumps(told, default=str))
        return NOT_ALL if any(o.status == "failed" for o in outcomes.values()) else 0

    cli._command = lambda name: command  # in this process only
    sys.argv = ["v2p", "episodes"]
    cli.main()


def results(root: Path) -> dict[str, Path]:
    """Return the finished results of a run folder or a store."""
    found = (path.parent for name in STAGES for path in root.glob(f"{name}/*/{RECORD_FILE}"))
    return {f"{path.parent.name}/{path.name}": path for path in found}


def content(root: Path) -> dict[str, str]:
    """Return the digest of every file of every finished result, of records what is no time and no place."""
    found: dict[str, str] = {}
    for key, folder in results(root).items():
        for path in sorted(p for p in folder.rglob("*") if p.is_file()):
            told = path.read_bytes()
            if path.name == RECORD_FILE:
                record = {k: v for k, v in json.loads(told).items() if k not in NO_TIME}
                told = json.dumps(record).encode()
            found[f"{key}/{path.relative_to(folder)}"] = hashlib.sha256(told).hexdigest()
    return found


# --- a trial ---------------------------------------------------------------------------------------------------


@dataclass(kw_only=True)
class Program:
    """A run as a program of its own."""

    process: subprocess.Popen[bytes]
    root: Path
    log: Path
    code: int = 0

    @property
    def said(self) -> str:
        return self.log.with_suffix(".err").read_text()

    def outcomes(self) -> dict[str, dict[str, str]]:
        """Return what became of each stage, by its name and item."""
        lines = self.log.read_text().splitlines()
        return {f"{o['stage']} {o['item']}": o for o in json.loads(lines[-1])} if lines else {}


@dataclass(kw_only=True)
class Trial:
    """One fault and what was seen."""

    rng: Any
    place: Path
    bench: "Bench"
    troubles: list[str] = field(default_factory=list)
    missed: bool = False
    """The run had ended before the fault came."""

    @property
    def root(self) -> Path:
        return self.place / "run"

    def claim(self, holds: bool, words: object) -> None:
        if not holds:
            self.troubles.append(str(words))

    def start(
        self,
        how: Mapping[str, Any],
        prefix: str = "exec",
        root: Path | None = None,
        env: Mapping[str, str] | None = None,
    ) -> Program:
        """Start a run.

        Args:
            how: fields of `Runtime`.
            prefix: words of a shell that come before the command.
            root: the run folder, by default the trial's.
            env: more variables of its environment.
        """
        root = root or self.root
        log = self.place / f"{root.name}.{time.monotonic_ns()}.out"
        words = [sys.executable, __file__, "drive", str(root), json.dumps({"workers": 2, **how})]
        with log.open("wb") as out, log.with_suffix(".err").open("wb") as err:
            process = subprocess.Popen(
                ["sh", "-c", f"{prefix} {shlex.join(words)}"],
                stdout=out, stderr=err, env={**os.environ, **(env or {})}, start_new_session=True,
            )  # fmt: skip
        return Program(process=process, root=root, log=log)

    def ended(self, program: Program, longest_s: float = LONGEST_S) -> int:
        """Wait for a run's end; return its exit code."""
        try:
            program.code = program.process.wait(longest_s)
        except subprocess.TimeoutExpired:
            self.claim(False, f"still at work after {longest_s:.0f} s")
            program.process.kill()
            program.code = program.process.wait()
        self.claim("Traceback" not in program.said, f"a traceback: {program.said[-1500:]}")
        return program.code

    def noted(self, root: Path | None = None) -> list[tuple[str, int, int]]:
        """Return what was begun: stage and item, the process, its parent."""
        path = (root or self.root).with_suffix(".noted")
        lines = path.read_text().splitlines() if path.exists() else []
        return [(" ".join(w[:2]), int(w[2]), int(w[3])) for w in map(str.split, lines)]

    def begun(self) -> Counter[str]:
        return Counter(name for name, *_ in self.noted())

    def moment(self, program: Program, longest_s: float = 0.0) -> None:
        """Wait until a run is at work, and then for some of the time it takes."""
        wait_for(lambda: program.process.poll() is not None or bool(self.noted(program.root)))
        time.sleep(self.rng.uniform(0, longest_s or self.bench.work_s))
        self.missed |= program.process.poll() is not None

    def trouble(self, *names: str, what: str) -> None:
        self.root.with_suffix(".troubles").write_text(json.dumps(dict.fromkeys(names, what)))

    def some_stage(self) -> str:
        return f"{self.rng.choice(STAGES)} {self.rng.choice(ITEMS[:-1])}"

    def rest_is_done(self, program: Program, hit: str = "", *words: str) -> None:
        """Demand that all but a stage and what needs it ended as undisturbed, and that the stage failed in these words."""
        found, item = program.outcomes(), hit.split()[-1] if hit else ""
        first = STAGES.index(hit.split()[0]) if hit else len(STAGES)
        for name, told in self.bench.outcomes.items():
            stage, own = name.split()
            wanted = told if own != item or STAGES.index(stage) < first else "blocked"
            if name != hit:
                status = found.get(name, {}).get("status", "nothing")
                self.claim(status in (wanted, "kept" if wanted == "made" else wanted), f"{name} is {status} and not {wanted}")  # fmt: skip
        if hit:
            told = found.get(hit, {})
            said = f"{told.get('status')}: {told.get('reason')}: {told.get('detail')}"
            self.claim(all(word in said for word in ("failed", *words)), f"{hit} {said}")
            self.claim(program.code == NOT_ALL, f"exit code {program.code}")

    def all_is_done(self, program: Program, how: Mapping[str, Any]) -> None:
        """Demand that a run ended like an undisturbed one, here and in its store."""
        self.claim(program.code == 0, f"exit code {program.code}: {program.said[-500:]}")
        places = [program.root, *([self.objects(how["store"])] if "store" in how else [])]
        for place in places:
            differing = set(content(place).items()) ^ set(self.bench.content.items())
            self.claim(not differing, f"{place.name} differs: {sorted(differing)[:3]}")

    def nobody_is_left(self) -> None:
        """Demand that no process of a run is at work once it was ended."""
        pids = {pid for _, pid, _ in self.noted()}
        wait_for(lambda: not any(is_alive(pid) for pid in pids), 10.0)
        self.claim(not any(is_alive(pid) for pid in pids), "a worker outlives its run by 10 s")

    def goes_on(self, how: Mapping[str, Any], prefix: str = "exec", tries: int = 1) -> None:
        """Give the same command again: it finishes, and makes nothing again that was finished.

        Args:
            how: as of the disturbed run.
            prefix: the same.
            tries: how often the disturbed run may have begun one stage.
        """
        self.root.with_suffix(".troubles").unlink(missing_ok=True)
        finished = {key: (path / RECORD_FILE).read_bytes() for key, path in results(self.root).items()}  # fmt: skip
        whole = content(self.root)
        self.claim(whole.items() <= self.bench.content.items(), "what is finished is not as undisturbed")  # fmt: skip
        before = self.begun()
        self.claim(max(before.values(), default=0) <= tries, f"begun too often: {before}")
        again = self.start(how, prefix)
        self.ended(again)
        self.all_is_done(again, how)
        for key, record in finished.items():
            name = f"{key.split('/')[0]} {key.split('/')[1].rpartition('-')[0]}"
            self.claim(
                self.begun()[name] == before[name], f"{name} was finished and is made again"
            )
            self.claim((self.root / key / RECORD_FILE).read_bytes() == record, f"{name} has changed")  # fmt: skip

    def objects(self, store: str) -> Path:
        """Return the folder that a store keeps its objects in."""
        return self.bench.buckets / store.removeprefix("s3://") if "://" in store else Path(store)


def is_alive(pid: int) -> bool:
    try:
        return Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()[0] not in "ZX"
    except OSError:
        return False


def wait_for(what: Callable[[], bool], seconds: float = LONGEST_S) -> None:
    deadline = time.monotonic() + seconds
    while not what() and time.monotonic() < deadline:
        time.sleep(0.01)


# --- faults ----------------------------------------------------------------------------------------------------


def killed_worker(t: Trial) -> None:
    how = {"workers": int(t.rng.choice([2, 4]))}
    run = t.start(how)
    t.moment(run)
    pid = run.process.pid
    words = Path(f"/proc/{pid}/task/{pid}/children").read_text().split() if is_alive(pid) else []
    found = [int(w) for w in words if b"spawn_main" in Path(f"/proc/{w}/cmdline").read_bytes()]
    t.missed |= not found
    with contextlib.suppress(ProcessLookupError):
        for worker in t.rng.permutation(found)[:1]:
            os.kill(int(worker), signal.SIGKILL)
    t.ended(run)
    failed = [name for name, o in run.outcomes().items() if o["status"] == "failed"]
    t.claim(len(failed) < 2, f"one worker was killed, and {failed} failed")
    t.rest_is_done(run, *([failed[0], "crashed", "SIGKILL"] if failed else []))
    t.goes_on(how)


def killed_driver(t: Trial) -> None:
    how: dict[str, Any] = {}
    if t.rng.random() < 0.5:
        how = {"store": str(t.place / "store"), "lease_s": 600.0}
    run = t.start(how)
    t.moment(run)
    run.process.kill()
    t.ended(run)
    t.nobody_is_left()
    t.goes_on(how)


def ctrl_c(t: Trial) -> None:
    run = t.start({})
    t.moment(run)
    os.killpg(run.process.pid, signal.SIGINT)  # as a terminal does
    time.sleep(float(t.rng.choice([0.0, t.rng.uniform(0, 0.05), t.rng.uniform(0, 1)])))
    with contextlib.suppress(ProcessLookupError):
        os.killpg(run.process.pid, signal.SIGINT)
    began = time.monotonic()
    code = t.ended(run)
    t.claim(time.monotonic() - began < 10, "10 s or more after the second Ctrl-C")
    t.claim(code in (0, 130, -signal.SIGINT), f"exit code {code}")
    t.nobody_is_left()
    t.goes_on({})


def crash(t: Trial) -> None:
    hit = t.some_stage()
    kinds = ("SIGSEGV", "SIGABRT", "SIGKILL", "SIGTERM", "SIGBUS")
    kind = str(t.rng.choice([*kinds, "exit"]))
    what = "exit" if kind == "exit" else f"signal {int(signal.Signals[kind])}"
    t.trouble(hit, what=what)
    run = t.start({})
    t.ended(run)
    t.rest_is_done(run, hit, "crashed", "without a word" if kind == "exit" else kind)
    t.goes_on({})


def hang(t: Trial) -> None:
    hit, how = t.some_stage(), {"limit_s": 3.0}
    t.trouble(hit, what=str(t.rng.choice(["hang", "hang_alone"])))
    run = t.start(how)
    t.ended(run)
    t.rest_is_done(run, hit, "too_long", "3 s")
    t.nobody_is_left()
    t.goes_on(how)


def memory(t: Trial) -> None:
    hit = t.some_stage()
    t.trouble(hit, what="memory")
    run = t.start({}, "ulimit -v 1500000; exec")
    t.ended(run)
    t.rest_is_done(run, hit, "MemoryError")
    t.goes_on({})


def bucket_away(t: Trial) -> None:
    how = {"store": f"s3://bucket/{t.place.name}"}
    t.bench.serve()
    run = t.start(how)
    t.moment(run)
    t.bench.stop_serving()
    time.sleep(t.rng.uniform(0.3, 4))
    t.bench.serve()
    t.ended(run)
    t.rest_is_done(run)
    t.goes_on(how)


def folder_away(t: Trial) -> None:
    store = t.place / "store"
    run = t.start({"store": str(store)})
    t.moment(run)
    with moved_away(store):
        time.sleep(t.rng.uniform(0.3, 4))
    t.ended(run)
    t.rest_is_done(run)
    t.goes_on({"store": str(store)})


def store_gone(t: Trial) -> None:
    store = t.place / "store"
    run = t.start({"store": str(store)}, env={"BENCH_PATIENCE_S": "0.5"})
    t.moment(run)
    with moved_away(store):
        code = t.ended(run)
    t.missed |= not code
    if code:
        told = run.said + json.dumps(run.outcomes())
        t.claim(f"{store} does not answer" in told, f"the store is not named: {told[-300:]}")
    t.goes_on({"store": str(store)})


@contextlib.contextmanager
def moved_away(store: Path) -> Any:
    """Have a store's folder gone, as a disk that is not mounted; what is written below it is not seen when it is back."""
    away = store.rename(store.with_suffix(".away"))
    yield
    shutil.rmtree(store, ignore_errors=True)
    away.rename(store)


def full_disk(t: Trial) -> None:
    t.root.mkdir()
    size = int(t.rng.integers(30, 300))
    subprocess.run(["mount", "-t", "tmpfs", "-o", f"size={size}k", "none", t.root], check=True)
    try:
        run = t.start({})
        code = t.ended(run)
        failed = [o for o in run.outcomes().values() if o["status"] == "failed"]
        t.claim(bool(code) == (size < 360), f"exit code {code} with {size} kB")
        told = [o["detail"] for o in failed] or [run.said]
        for words in told if code else []:
            t.claim("no space is left on the disk" in words and str(t.root) in words, words)
        subprocess.run(["mount", "-o", "remount,size=9m", t.root], check=True)
        t.goes_on({})
    finally:
        subprocess.run(["umount", "-l", t.root], check=True)


def small_files(t: Trial) -> None:
    run = t.start({}, f"ulimit -f {int(t.rng.integers(8, 30))}; exec")
    t.ended(run)
    failed = [o for o in run.outcomes().values() if o["status"] == "failed"]
    t.claim(len(failed) == len(ITEMS), f"{len(failed)} failed")
    for told in failed:
        t.claim("a file may not grow that large here" in told["detail"], told["detail"])
    t.goes_on({})


def two_runs(t: Trial) -> None:
    run = t.start({})
    wait_for(lambda: (t.root / RUN_LOCK).exists() and bool((t.root / RUN_LOCK).read_text()))
    time.sleep(t.rng.uniform(0, t.bench.work_s))
    second = t.start({})
    code = t.ended(second)
    late = t.missed = run.process.poll() is not None
    refused = code == 2 and f"another v2p run is at work in {t.root}" in second.said
    t.claim(refused or (late and code == 0), f"the second run: {code} {second.said}")
    t.ended(run)
    t.rest_is_done(run)
    t.goes_on({})


def two_drivers(t: Trial) -> None:
    store = t.place / "store"
    how = {"store": str(store), "lease_s": 2.0}
    other = t.place / "other"
    runs = [t.start(how), t.start(how, root=other)]
    t.moment(runs[1])
    victim = int(t.rng.integers(2))
    t.missed = runs[victim].process.poll() is not None
    runs[victim].process.kill()
    for run in runs:
        t.ended(run)
    t.all_is_done(runs[1 - victim], how)
    begun = Counter(name for root in (t.root, other) for name, *_ in t.noted(root))
    twice = [name for name, times in begun.items() if times > 1]
    t.claim(max(begun.values()) <= 2 and len(twice) <= 2, f"made by both: {twice}")
    t.goes_on(how)


def clock_back(t: Trial) -> None:
    library, back = t.bench.buckets / "clock.so", t.place / "back"
    if not library.exists():
        source = library.with_suffix(".c")
        source.write_text(CLOCK)
        subprocess.run(["cc", "-shared", "-fPIC", "-o", library, source, "-ldl"], check=True)
    env = {"LD_PRELOAD": str(library), "BENCH_CLOCK_BACK": str(back)}
    how: dict[str, Any] = {}
    if t.rng.random() < 0.5:
        how = {"store": str(t.place / "store"), "lease_s": 2.0}
    run = t.start(how, env=env)
    t.moment(run)
    back.touch()
    from v2p_data.commands.progress import progress_of

    told = progress_of(t.root) if (t.root / "progress.json").exists() else {"seconds_left": 0}
    t.claim((told["seconds_left"] or 0) >= 0, f"time left: {told['seconds_left']}")
    t.ended(run)
    t.rest_is_done(run)
    t.all_is_done(run, how)
    t.goes_on(how)


def in_place(t: Trial, prefix: str = "exec", **env: str) -> None:
    """A run in an odd place ends like any other, with a store too."""
    how = {"store": str(t.place / "store")} if t.rng.random() < 0.5 else {}
    run = t.start(how, prefix, env=env)
    t.ended(run)
    t.all_is_done(run, how)
    t.goes_on(how, prefix)


NO_HOME = "exec unshare -m sh -c 'mount -t tmpfs -o ro none /dev/shm; exec \"$@\"' --"


def ray_worker(t: Trial) -> None:
    run = t.start(t.bench.cluster())
    t.moment(run, 5.0)
    with contextlib.suppress(ProcessLookupError):
        os.kill(t.noted()[-1][1], signal.SIGKILL)
    t.ended(run)
    t.rest_is_done(run)
    t.goes_on(t.bench.cluster(), tries=2)


def ray_raylet(t: Trial) -> None:
    how = t.bench.cluster()
    victim = t.bench.add_raylet()
    raylet = victim.all_processes["raylet"][0].process
    run = t.start(how)
    wait_for(lambda: any(parent == raylet.pid for *_, parent in t.noted()))
    time.sleep(t.rng.uniform(0, 5))
    t.missed = run.process.poll() is not None
    raylet.kill()
    t.ended(run)
    t.bench.nodes.remove_node(victim, allow_graceful=False)
    t.rest_is_done(run)
    t.goes_on(how, tries=2)


def ray_driver(t: Trial) -> None:
    how = t.bench.cluster()
    run = t.start(how)
    t.moment(run, 10.0)
    run.process.kill()
    t.ended(run)
    t.nobody_is_left()
    t.goes_on(how)


def ray_crash(t: Trial) -> None:
    how, hit = t.bench.cluster(), t.some_stage()
    t.trouble(hit, what="signal 11")
    run = t.start(how)
    t.ended(run)
    t.rest_is_done(run, hit, "crashed", "3 times")
    t.claim(t.begun()[hit] == 3, f"{hit} was begun {t.begun()[hit]} times")
    t.goes_on(how, tries=3)


FAULTS: dict[str, Callable[[Trial], None]] = {
    "killed_worker": killed_worker, "killed_driver": killed_driver, "ctrl_c": ctrl_c, "crash": crash, "hang": hang,
    "memory": memory, "bucket_away": bucket_away, "folder_away": folder_away, "store_gone": store_gone,
    "full_disk": full_disk, "small_files": small_files, "two_runs": two_runs, "two_drivers": two_drivers,
    "clock_back": clock_back,
    "locale_c": functools.partial(in_place, LC_ALL="C", PYTHONUTF8="0", PYTHONCOERCECLOCALE="0"),
    "no_home": functools.partial(in_place, prefix=NO_HOME, HOME="/proc/none"),
    "few_files": functools.partial(in_place, prefix="ulimit -n 64; exec"),
    "little_memory": functools.partial(in_place, prefix="ulimit -v 2000000; exec"),
    "ray_worker": ray_worker, "ray_raylet": ray_raylet, "ray_driver": ray_driver, "ray_crash": ray_crash,
}  # fmt: skip


# --- all of them -----------------------------------------------------------------------------------------------


class Bench:
    """What trials share: the undisturbed run, an S3 server, a Ray cluster.

    Args:
        place: a folder.
        stack: ends what was started.
    """

    def __init__(self, place: Path, stack: contextlib.ExitStack) -> None:
        self.place, self.stack, self.buckets = place, stack, place / "buckets"
        (self.buckets / "bucket").mkdir(parents=True)
        self.nodes: Any = None
        self.server: ThreadingHTTPServer | None = None
        self.port = 0
        first = Trial(rng=None, place=place, bench=self)
        run = first.start({})
        wait_for(lambda: bool(first.noted()))
        began = time.monotonic()
        if first.ended(run):
            raise RuntimeError(run.said)
        self.work_s = time.monotonic() - began
        self.content = content(run.root)
        self.outcomes = {name: told["status"] for name, told in run.outcomes().items()}

    def serve(self) -> None:
        """Start the S3 server, at its port of before."""
        if self.server is not None:
            return
        library = importlib.import_module("localbucket")
        quiet = {"data_root": self.buckets, "log_message": lambda *words: None}
        handler: Any = type("Handler", (library.S3Handler,), quiet)
        self.server = ThreadingHTTPServer(("127.0.0.1", self.port), handler)
        self.port = self.server.server_port
        threading.Thread(target=self.server.serve_forever, args=(0.02,), daemon=True).start()
        os.environ |= {
            "AWS_ENDPOINT_URL": f"http://127.0.0.1:{self.port}", "AWS_ALLOW_HTTP": "true", "AWS_REGION": "us-east-1",
            "AWS_ACCESS_KEY_ID": "testtesttest", "AWS_SECRET_ACCESS_KEY": "testtesttest",
        }  # fmt: skip

    def stop_serving(self) -> None:
        if self.server is not None:
            self.server.shutdown()
            self.server.server_close()
            self.server = None

    def cluster(self) -> dict[str, Any]:
        """Return how a run finds a cluster of three raylets."""
        if self.nodes is None:
            sys.path.insert(0, str(Path(__file__).parents[1] / "tests" / "pipeline"))
            raylets = importlib.import_module("raylets")
            self.nodes = self.stack.enter_context(raylets.running_cluster(3))
            self.add_raylet = lambda: raylets.patiently(
                lambda: self.nodes.add_node(**raylets.NODE)
            )
        return {"engine": "ray", "address": self.nodes.address, "workers": 0}


def main() -> None:
    """Read the command line, inject, print the table."""
    import tyro

    cfg = tyro.cli(BenchConfig, description=__doc__.split("\n")[0])
    if unknown := set(cfg.kinds) - TIMES.keys():
        sys.exit(f"unknown kinds: {unknown}; there are {', '.join(TIMES)}")
    cfg.out.parent.mkdir(parents=True, exist_ok=True)
    told = [json.loads(line) for line in cfg.out.read_text().splitlines()] if cfg.out.exists() else []  # fmt: skip
    done = {(line["kind"], line["seed"], line["number"]) for line in told}
    with contextlib.ExitStack() as stack:
        place = Path(stack.enter_context(tempfile.TemporaryDirectory()))
        bench = Bench(place, stack)
        for kind in cfg.kinds:
            for number in range(cfg.times or TIMES[kind]):
                if (kind, cfg.seed, number) in done:
                    continue
                told.append(inject(kind, number, cfg.seed, bench))
                with cfg.out.open("a") as stream:
                    stream.write(json.dumps(told[-1]) + "\n")
                print(json.dumps(told[-1]), flush=True)
    table = defaultdict[str, list[Any]](list)
    for line in told:
        table[line["kind"]].append(line)
    print("| fault | injected | held | seconds |\n|---|---|---|---|")
    for kind, lines in [*table.items(), ("all", told)]:
        injected, held, seconds = (sum(line[what] for line in lines) for what in ("injected", "held", "seconds"))  # fmt: skip
        print(f"| {kind} | {injected} | {held} | {seconds:.0f} |")


def inject(kind: str, number: int, seed: int, bench: Bench) -> dict[str, Any]:
    """Return what became of one fault."""
    from v2p_data.seeds import rng_for

    began = time.monotonic()
    place = bench.place / f"{kind}_{number}"
    place.mkdir()
    trial = Trial(rng=rng_for(seed, "fault", kind, number), place=place, bench=bench)
    injected = survived = 1
    if kind == "packing":
        words = [f"--kills={PACKING_KILLS}", "--phases", "pack", f"--seed={1000 * seed + number}"]
        script = Path(__file__).with_name("bench_kills.py")
        done = subprocess.run([sys.executable, script, *words], capture_output=True, text=True, check=True)  # fmt: skip
        *told, last = done.stdout.splitlines()
        survived, injected = map(int, re.findall(r"\d+", last))
        trial.claim(survived == injected, told)
    else:
        FAULTS[kind](trial)
    if trial.missed and not trial.troubles:
        injected = survived = 0
    shutil.rmtree(place)
    return {
        "kind": kind, "number": number, "seed": seed, "injected": injected,
        "held": survived - (bool(trial.troubles) and kind != "packing"),
        "seconds": round(time.monotonic() - began, 1), "wrong": trial.troubles,
    }  # fmt: skip


if __name__ == "__main__":
    if sys.argv[1:2] == ["drive"]:
        drive(Path(sys.argv[2]), json.loads(sys.argv[3]))
    else:
        main()

"""Run every check that needs a GPU, each in a process of its own with a time limit, and write one JSON.

    python scripts/check_gpu.py                              # on a machine with a CUDA device; half an hour
    python scripts/check_gpu.py --checks warp_speed          # some of them
    python scripts/check_gpu.py --device cpu --quick         # tries the checks on the CPU; speeds mean nothing

A check is a test or a benchmark that stands elsewhere. One that fails, hangs or crashes does not keep the others from
running, and the JSON is written after each. Exit code: 0, all passed; 1, some did not; 2, there is no GPU.
"""

import argparse
import importlib.metadata
import json
import os
import re
import subprocess
import sys
import tempfile
import time
import xml.etree.ElementTree as ET
from collections.abc import Callable
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

import torch

from results_table import ROOT
from v2p_data.pipeline.artifact import provenance, write_json_atomically
from v2p_data.processes import end_group, ending_with_us

TAIL_CHARACTERS = 3000
"""Of a check's output, kept in the JSON."""
NOT_POSSIBLE = 2
"""Exit code of a benchmark that lacks what it measures."""
NUMBER = re.compile(r"^(\w+): (-?[\d.]+)$", re.M)
BACKENDS = [
    f"tests/scene/backends/test_{k}.py" for k in ("depth", "detect", "segment", "sam2_stream")
]


@dataclass(frozen=True, kw_only=True)
class Check:
    """A test or a benchmark, and how long it may take."""

    what: str
    command: Callable[[str, bool], list[str]]
    """By device and whether it shall be quick; what Python is told."""
    limit_s: float = 600.0


@dataclass(kw_only=True)
class Outcome:
    """What came of a check."""

    name: str
    what: str
    command: str
    ran: bool = False
    """False: it could not, and `error` says why."""
    passed: bool = False
    seconds: float = 0.0
    figures: dict[str, Any] = field(default_factory=dict)
    error: str = ""
    output: str = ""
    """The end of what it printed."""


def _tests(*words: str) -> Callable[[str, bool], list[str]]:
    def command(device: str, quick: bool) -> list[str]:
        return ["-m", "pytest", "-q", f"--device={device}", *words, *["-m", "not slow"] * quick]

    return command


def _warp_speed(device: str, quick: bool) -> list[str]:
    sizes = ["--num-worlds", "4", "--steps", "2"] if quick else []
    return ["scripts/bench_warp.py", "--device", device, "--learn-worlds", "0", *sizes]


def _warp_learns(device: str, quick: bool) -> list[str]:
    sizes = ["--learn-worlds", "24", "--learn-steps", "384", "--eval-episodes", "4"]
    return ["scripts/bench_warp.py", "--device", device, "--num-worlds", *(sizes if quick else [])]


def _bc_speed(device: str, quick: bool) -> list[str]:
    sizes = ["--frames", "300", "--networks", "small", "--turns", "1", "--seconds", "0.1"]
    return ["scripts/bench_bc.py", "--device", device, *(sizes if quick else ["--frames", "8192"])]


CHECKS = {
    "warp_like_cpu": Check(
        what="MuJoCo Warp's worlds against the CPU backend's, step by step",
        command=_tests("tests/sim/test_warp_env.py"),
    ),
    "warp_speed": Check(
        what="control steps per second of 1,024 to 8,192 Warp worlds", command=_warp_speed
    ),
    "warp_learns": Check(
        what="PPO learns to lift in 8,192 Warp worlds, judged on the CPU backend",
        command=_warp_learns,
        limit_s=1800.0,
    ),
    "trainers_like_cpu": Check(
        what="PPO and behaviour cloning learn on the device what they learn on the CPU",
        command=lambda device, _: _tests("tests/policies", "-m", "gpu")(device, False),
    ),
    "bc_speed": Check(
        what="samples per second that v2p_bc trains on, frames on the device and fetched",
        command=_bc_speed,
    ),
    "backends": Check(
        what="learned backends of the reconstruction, real classes with tiny random weights",
        command=_tests(*BACKENDS),
    ),
}


def run_check(name: str, check: Check, device: str, *, quick: bool) -> Outcome:
    """Return what came of a check; all that it started has ended."""
    words = check.command(device, quick)
    outcome = Outcome(name=name, what=check.what, command=" ".join(["python", *words]))
    with tempfile.TemporaryDirectory() as folder:
        told, report = Path(folder) / "output.txt", Path(folder) / "tests.xml"
        if "pytest" in words:
            words = [*words, f"--junit-xml={report}"]
        started = time.monotonic()
        with told.open("wb") as stream:
            process = subprocess.Popen(
                ending_with_us([sys.executable, *words]),
                cwd=ROOT,
                env=os.environ | {"PYTHONPATH": _python_path()},
                stdout=stream,
                stderr=subprocess.STDOUT,
                start_new_session=True,
            )
            try:
                code = process.wait(check.limit_s)
            except subprocess.TimeoutExpired:
                code = None
            finally:
                end_group(process)
        outcome.seconds = round(time.monotonic() - started, 1)
        output = told.read_text(errors="replace", encoding="utf-8")
        outcome.output = output[-TAIL_CHARACTERS:]
        if code is None:
            outcome.ran, outcome.error = True, f"it took longer than {check.limit_s:g} s"
        elif report.is_file():
            _read_tests(report, outcome)
        else:
            _read_benchmark(output, code, outcome)
    return outcome


def _python_path() -> str:
    before = os.environ.get("PYTHONPATH")
    own = [str(ROOT), str(ROOT / "lerobot_policy_v2p")]
    return os.pathsep.join([*own, *([before] if before else [])])


def _read_tests(report: Path, outcome: Outcome) -> None:
    cases = list(ET.parse(report).getroot().iter("testcase"))
    told = {
        kind: [(c, f) for c in cases for f in c.iter(kind)]
        for kind in ("failure", "error", "skipped")
    }
    failed = {c.get("name"): f for c, f in (*told["failure"], *told["error"])}
    skipped = {f.get("message", "") for _, f in told["skipped"]}
    count = len(cases) - len(failed) - len(told["skipped"])
    outcome.figures = {"passed": count, "failed": len(failed), "skipped": len(told["skipped"])}
    outcome.ran = count + len(failed) > 0
    outcome.passed = outcome.ran and not failed
    if failed:
        outcome.error = "; ".join(f"{name}: {f.get('message', '')}" for name, f in failed.items())
    elif not outcome.ran:
        outcome.error = "; ".join(sorted(skipped)) or "no test was found"


def _read_benchmark(output: str, code: int, outcome: Outcome) -> None:
    rows = [json.loads(line) for line in output.splitlines() if line.startswith('{"')]
    outcome.figures = {name: float(number) for name, number in NUMBER.findall(output)}
    if rows:
        outcome.figures["rows"] = rows
    outcome.ran, outcome.passed = code != NOT_POSSIBLE, code == 0
    if code:
        last = (output.strip().splitlines() or ["it printed nothing"])[-1]
        outcome.error = f"exit code {code}: {last}"


def about(device: str) -> dict[str, Any]:
    """Return the device, the versions and the commit."""
    found = provenance()
    is_cuda = device.startswith("cuda")
    return {
        "device": torch.cuda.get_device_name(device) if is_cuda else device,
        "cuda": torch.version.cuda if is_cuda else None,
        "machine": found["machine"],
        "commit": found["commit"],
        "time": found["time"],
        "python": found["python"],
        "packages": found["packages"]
        | _versions("torch", "mujoco-warp", "warp-lang", "torchrl", "transformers"),
    }


def _versions(*packages: str) -> dict[str, str]:
    installed = {d.metadata["Name"].lower(): d.version for d in importlib.metadata.distributions()}
    return {p: installed.get(p, "not installed") for p in packages}


def main() -> int:
    """Run the checks, print a line for each, write the JSON."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").split("\n")[0])
    parser.add_argument("--device", default="cuda", help="cuda, or cpu to try the checks")
    parser.add_argument(
        "--quick", action="store_true", help="small sizes; the figures mean nothing"
    )
    parser.add_argument("--checks", nargs="*", choices=[*CHECKS], default=[*CHECKS])
    parser.add_argument("--out", type=Path, default=Path("outputs/check_gpu.json"))
    args = parser.parse_args()
    if args.device.startswith("cuda") and not torch.cuda.is_available():
        print(
            "There is no CUDA device here; --device cpu --quick tries the checks on the CPU.",
            file=sys.stderr,
        )
        return 2
    args.out.parent.mkdir(parents=True, exist_ok=True)
    told: dict[str, Any] = {**about(args.device), "quick": args.quick, "checks": []}
    for name in args.checks:
        outcome = run_check(name, CHECKS[name], args.device, quick=args.quick)
        told["checks"].append(asdict(outcome))
        write_json_atomically(args.out, told)
        word = "passed" if outcome.passed else "FAILED" if outcome.ran else "could not run"
        figures = {k: v for k, v in outcome.figures.items() if k != "rows"}
        print(
            f"{name}: {word} in {outcome.seconds:.0f} s {figures or ''} {outcome.error[:300]}",
            flush=True,
        )
    print(f"written: {args.out}")
    return 0 if all(c["passed"] for c in told["checks"]) else 1


if __name__ == "__main__":
    sys.exit(main())

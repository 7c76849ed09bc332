"""Run the demo's clips many times on a Ray cluster that loses its driver and a node; compare with a local run, byte by byte.

    python scripts/bench_cluster.py --copies=20 --out=outputs/bench_cluster    # two hours of a core

Every stage is the product's own, from the video to one dataset of all clips, at small sizes (`SMALL`); the experts are scripted
programs. The local run comes first. Then a cluster of three raylets with room for one task each is started here, and the same
command runs on it. When a quarter of the results are there its driver gets SIGKILL and the command is given once more; at one
half a raylet gets SIGKILL. Of a JSON file in a result, `UNLIKE` is not compared; of everything else, every byte is.

The last line is a JSON object: `recomputed` are the results that were begun and not finished when a kill came, `lost` those that
were finished and are gone or made again. Results are kept, so that a stopped bench goes on where it was.
"""

import dataclasses
import hashlib
import importlib
import json
import shutil
import subprocess
import sys
import time
from pathlib import Path
from typing import IO, Any

import tyro

ROOT = Path(__file__).parents[1]
CLIPS = ROOT / "datasets" / "sample_videos"
STAGES = ("scene", "task", "expert", "episodes", "dataset")
SMALL = (
    "--expert.teacher=as_expert", "--expert.trial-worlds=16", "--expert.eval-episodes=8", "--task.num-samples=2",
    "--episodes.num-episodes=4", "--episodes.min-episodes=1", "--episodes.batch-worlds=8",
)  # fmt: skip
UNLIKE = ("seconds", "time", "commit", "argv", "checksum", "meta/v2p.json")
"""Of records: when and by which command; and what follows from that, checksums over it."""


@dataclasses.dataclass(frozen=True, kw_only=True)
class BenchConfig:
    """What is run."""

    copies: int = 20
    """Of each of the demo's three clips."""
    workers: int = 1
    """Of the local run."""
    out: Path = Path("outputs/bench_cluster")


def main() -> None:
    """Read the command line, run both, compare."""
    cfg = tyro.cli(BenchConfig, description=(__doc__ or "").split("\n")[0])
    sys.path.insert(0, str(ROOT / "tests" / "pipeline"))
    raylets: Any = importlib.import_module("raylets")
    clips = copied_clips(cfg)
    local, far = cfg.out / "local", cfg.out / "ray"
    began = time.monotonic()
    with (cfg.out / "local.log").open("a") as log:
        started(clips, local, [f"--workers={cfg.workers}"], log).wait()
    told: dict[str, Any] = {"clips": 3 * cfg.copies, "local_s": round(time.monotonic() - began)}
    with raylets.running_cluster(2) as cluster, (cfg.out / "ray.log").open("a") as log:
        victim = raylets.patiently(lambda: cluster.add_node(**raylets.NODE))
        told |= on_cluster(clips, far, cluster.address, victim, log, len(results(local)))
        cluster.remove_node(victim, allow_graceful=False)
    print(json.dumps(told | compared(local, far)))


def copied_clips(cfg: BenchConfig) -> Path:
    """Return a folder with the clips under new names, and their captions."""
    folder = cfg.out / "clips"
    folder.mkdir(parents=True, exist_ok=True)
    captions = json.loads((CLIPS / "captions.json").read_text())
    copies = {f"{k:02d}_{name}": name for k in range(cfg.copies) for name in captions}
    for copy, name in copies.items():
        shutil.copyfile(CLIPS / name, folder / copy)
    (folder / "captions.json").write_text(json.dumps({c: captions[n] for c, n in copies.items()}))
    return folder


def started(clips: Path, root: Path, how: list[str], log: IO[str]) -> subprocess.Popen[bytes]:
    """Start `v2p generate`."""
    words = ["generate", str(clips), "--out", str(root), "--repo-id=user/cluster", *SMALL, *how]
    command = [sys.executable, "-m", "v2p_data.cli", *words]
    return subprocess.Popen(command, cwd=ROOT, stdout=log, stderr=log)


def on_cluster(
    clips: Path, root: Path, address: str, victim: Any, log: IO[str], expected: int
) -> dict[str, Any]:
    """Run on the cluster, kill the driver and then a raylet; return what happened when, and what was lost."""
    how = ["--engine=ray", f"--address={address}"]
    raylet = victim.all_processes["raylet"][0].process
    began, there_before = time.monotonic(), results(root)
    told: dict[str, Any] = {"there_before": len(there_before), "recomputed": []}
    driver = started(clips, root, how, log)
    while driver.poll() is None:
        done = len(results(root))
        is_driver = "driver_killed_at" not in told and done >= expected / 4
        if is_driver or ("raylet_killed_at" not in told and done >= expected / 2):
            (driver if is_driver else raylet).kill()
            told["driver_killed_at" if is_driver else "raylet_killed_at"] = done
            there_before |= results(root)
        if is_driver:
            driver.wait()
            told["recomputed"] += unfinished(root)
            driver = started(clips, root, how, log)
        time.sleep(0.5)
    after = results(root)
    again = (ROOT / log.name).read_text().count("begun again after")
    return told | {
        "ray_s": round(time.monotonic() - began),
        "exit_code": driver.returncode,
        "recomputed": len(told["recomputed"]) + again,
        "lost": sum(after.get(name) != made_at for name, made_at in there_before.items()),
    }


def unfinished(root: Path) -> list[Path]:
    """Return the folders of results that were begun."""
    return [path for stage in STAGES for path in root.glob(f"{stage}/*.partial")]


def results(root: Path) -> dict[str, float]:
    """Return when each finished result was written."""
    found = [p for stage in STAGES for p in root.glob(f"{stage}/*/record.json")]
    return {str(p.relative_to(root)): p.stat().st_mtime for p in found}


def compared(ours: Path, theirs: Path) -> dict[str, int]:
    """Return how many files of results two runs have, and how many differ or are in one only."""
    one, other = content(ours), content(theirs)
    differ = [name for name in one.keys() | other.keys() if one.get(name) != other.get(name)]
    return {"results": len(results(theirs)), "files": len(one), "files_that_differ": len(differ)}


def content(root: Path) -> dict[str, str]:
    """Return the digest of every file of every result."""
    found: dict[str, str] = {}
    for path in (p for stage in STAGES for p in root.glob(f"{stage}/**/*") if p.is_file()):
        told = path.read_bytes()
        if path.name in ("record.json", "v2p.json"):
            told = json.dumps(alike(json.loads(told))).encode()
        found[str(path.relative_to(root))] = hashlib.sha256(told).hexdigest()
    return found


def alike(value: Any) -> Any:
    """Return JSON data without what is not the same in two runs."""
    if isinstance(value, dict):
        return {key: alike(entry) for key, entry in value.items() if key not in UNLIKE}
    return [alike(entry) for entry in value] if isinstance(value, list) else value


if __name__ == "__main__":
    main()

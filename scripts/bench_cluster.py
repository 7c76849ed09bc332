"""Run the demo's clips many times on a Ray cluster that loses a node and its driver; compare with a local run, byte by byte.

    python scripts/bench_cluster.py --copies=20 --out outputs/bench_cluster

Every stage is the product's own, from the video to one dataset of all clips, at small sizes (`SMALL`); the experts are scripted
programs. The local run comes first. Then a cluster of three raylets with room for one task each is started here, and the same
command runs on it. When a third of the results are there its driver gets SIGKILL and the command is given once more; at two
thirds a raylet gets SIGKILL. A result counts as made again if its stage began once more after its record was there.

The last line is a JSON object. Local results are kept, so that a stopped bench goes on where it was.
"""

import dataclasses
import importlib
import json
import re
import shutil
import subprocess
import sys
import time
from collections import Counter
from pathlib import Path
from typing import IO, Any

sys.path.insert(0, str(Path(__file__).parents[1] / "tests" / "pipeline"))

import tyro

from bench_kills import digests

raylets: Any = importlib.import_module("raylets")
ROOT = Path(__file__).parents[1]
CLIPS = ROOT / "datasets" / "sample_videos"
STAGES = ("scene", "task", "expert", "episodes", "dataset")
SMALL = (
    "--expert.teacher=as_expert", "--expert.trial-worlds=16", "--expert.eval-episodes=8", "--task.num-samples=2",
    "--episodes.num-episodes=4", "--episodes.min-episodes=1", "--episodes.batch-worlds=8",
)  # fmt: skip
STARTED = re.compile(r"^(\w+) (\S+): started", re.MULTILINE)


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
    clips = copied_clips(cfg)
    local, far = cfg.out / "local", cfg.out / "ray"
    began = time.monotonic()
    with (cfg.out / "local.log").open("a") as log:
        started(clips, local, [f"--workers={cfg.workers}"], log).wait()
    told: dict[str, Any] = {"clips": 3 * cfg.copies, "local_s": round(time.monotonic() - began)}
    shutil.rmtree(far, ignore_errors=True)
    with raylets.running_cluster(2) as cluster, (cfg.out / "ray.log").open("w") as log:
        victim = raylets.patiently(lambda: cluster.add_node(**raylets.NODE))
        told |= on_cluster(clips, far, cluster.address, victim, log, len(results(local)))
        cluster.remove_node(victim, allow_graceful=False)
    begun = Counter(STARTED.findall((cfg.out / "ray.log").read_text()))
    ours, theirs = content(local), content(far)
    told |= {
        "results": len(results(far)),
        "begun_twice": sum(times > 1 for times in begun.values()),
        "files": len(ours),
        "files_that_differ": sum(
            ours.get(k) != theirs.get(k) for k in ours.keys() | theirs.keys()
        ),
    }
    print(json.dumps(told))


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
    """Run on the cluster, kill the driver and then a raylet; return what happened when, and which results were made again."""
    how = ["--engine=ray", f"--address={address}"]
    raylet = victim.all_processes["raylet"][0].process
    began, there_before = time.monotonic(), dict[str, float]()
    driver = started(clips, root, how, log)
    told: dict[str, Any] = {}
    while driver.poll() is None:
        done = len(results(root))
        if "driver_killed_at" not in told and done >= expected / 3:
            driver.kill()
            driver.wait()
            told["driver_killed_at"] = done
            there_before = results(root)
            driver = started(clips, root, how, log)
        elif "raylet_killed_at" not in told and done >= 2 * expected / 3:
            raylet.kill()
            told["raylet_killed_at"] = done
            there_before |= results(root)
        time.sleep(0.5)
    after = results(root)
    made_again = sum(after.get(name) != made_at for name, made_at in there_before.items())
    return told | {
        "ray_s": round(time.monotonic() - began),
        "rc": driver.returncode,
        "made_again": made_again,
    }


def results(root: Path) -> dict[str, float]:
    """Return when each finished result was written."""
    found = [p for stage in STAGES for p in root.glob(f"{stage}/*/record.json")]
    return {str(p.relative_to(root)): p.stat().st_mtime for p in found}


def content(root: Path) -> dict[str, str]:
    """Return the digest of every file of every result that must be the same each time."""
    return {name: digest for name, digest in digests(root).items() if name.startswith(STAGES)}


if __name__ == "__main__":
    main()

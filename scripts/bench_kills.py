"""Kill the making of datasets at random moments and see whether anything is lost or wrong.

    python scripts/bench_kills.py --kills=200            # an hour on two cores, most of it in worker processes
    python scripts/bench_kills.py --kills=20 --phases collect pack

Once undisturbed: a scripted expert's episodes are collected (lifting a box, six episodes and some
    failures), packed (several video
files), merged with a second dataset, and pushed to a server on the loopback. A toy task becomes a
run folder up to its dataset, in worker processes; a student is distilled in it, and a policy
trained, as `v2p distill` and `v2p train` do. Then, over and over: a phase is chosen in turn and
started on what the undisturbed run had before it, in a child process that is sent SIGKILL at a
moment drawn from the time the phase takes. What must hold right after the kill:

- collect: every finished episode is there, byte by byte as in the undisturbed run, and every one can be read;
- pack, merge: the dataset is absent, or it is there whole, byte by byte;
- push: the version that loads is absent or whole, file by file;
- run, distill, train: every finished result is there, byte by byte. What started the workers is killed.

Names of event files, seconds and times are no bytes that count.

Then the phase is started once more (every third time killed once more) and in the end must have made the same bytes as
the undisturbed run. The children are forks of one process, because imports take longer than the work.

The last line, `kills_survived: K of N`, counts kills that met a child at work and after which all of this held.
"""

import hashlib
import os
import shutil
import signal
import sys
import tempfile
import time
from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

sys.path.insert(0, str(Path(__file__).parents[1] / "tests" / "episodes"))
sys.path.insert(0, str(Path(__file__).parents[1] / "tests" / "distillation"))

import tyro
from hub_server import TOKEN, Hub, running_hub

PHASES = ("collect", "pack", "merge", "push", "run", "distill", "train")
RESULTS = ("run", "distilled", "trained")
"""Folders with results of stages in them."""
TOLD = (
    "record.json",
    "run.json",
    "report.html",
    ".lock",
    ".workers.lock",
    "events.out.*",
    "*.log",
    ".checked/*/*",
    "curve.csv",  # seconds
    "dataset/*/meta/v2p.json",  # when it was packed
)
"""Files in which times and places stand, of which the product compares none, or only a checksum."""
REPO = "user/killed"
SEED = 7
SHARD_FRAMES = 60
"""In place of thousands, so that there are several files to be killed between."""


@dataclass(frozen=True, kw_only=True)
class BenchConfig:
    """How often, and what."""

    kills: int = 200
    phases: tuple[str, ...] = PHASES
    seed: int = 0
    """Of the moments."""


@dataclass(frozen=True, kw_only=True)
class Phase:
    """One thing that can be killed."""

    run: Callable[[Path], None]
    """Works in a folder and goes on where it was stopped."""
    needs: tuple[str, ...]
    """Folders of the undisturbed run that it starts from."""
    makes: str
    """What it makes there."""


def main() -> None:
    """Read the command line, run, print."""
    cfg = tyro.cli(BenchConfig, description=__doc__.split("\n")[0])
    with running_hub() as hub, tempfile.TemporaryDirectory() as folder:
        # Before anything of Hugging Face is imported, which reads them once.
        os.environ |= {
            "HF_ENDPOINT": hub.url,
            "HF_TOKEN": TOKEN,
            "HF_HOME": f"{folder}/hf",
            "HF_HUB_DISABLE_XET": "1",
            "HF_HUB_DISABLE_TELEMETRY": "1",
            "HF_HUB_DISABLE_PROGRESS_BARS": "1",
        }
        os.environ.pop("HF_HUB_OFFLINE", None)
        survived, kills = run(cfg, Path(folder), hub)
    print(f"kills_survived: {survived} of {kills}")


def run(cfg: BenchConfig, place: Path, hub: Hub) -> tuple[int, int]:
    """Kill `cfg.kills` times, or once more; return after how many everything held, and of how many."""
    import numpy as np

    every = all_phases()
    phases = {name: phase for name, phase in every.items() if name in cfg.phases}
    needed = {needs for phase in phases.values() for needs in phase.needs}
    needed |= {needs for phase in every.values() if phase.makes in needed for needs in phase.needs}
    perfect = place / "perfect"
    perfect.mkdir()
    seconds = {
        name: undisturbed(p, perfect)
        for name, p in every.items()
        if name in phases or p.makes in needed
    }
    print("undisturbed [s]: " + ", ".join(f"{n} {s:.2f}" for n, s in seconds.items()), flush=True)
    pushed = dict(hub.repos[f"datasets/{REPO}"].files) if "push" in phases else {}
    rng = np.random.default_rng(cfg.seed)
    counts: Counter[str] = Counter()
    troubles: list[str] = []
    trial = 0
    while sum(counts[f"{n} killed"] for n in phases) < cfg.kills:
        name = list(phases)[trial % len(phases)]
        phase, work = phases[name], place / f"trial_{trial}"
        trial += 1
        work.mkdir()
        for needed in phase.needs:
            shutil.copytree(perfect / needed, work / needed)
        if name == "push":
            hub.repos.clear()
            hub.blobs.clear()
        for _ in range(2 if trial % 3 == 0 else 1):
            started = time.perf_counter()
            if not killed(phase, work, rng.uniform(0, 1.1 * seconds[name])):
                # The undisturbed run was slower: it compiled, or the machine was busy.
                seconds[name] = time.perf_counter() - started
                counts[f"{name} done before"] += 1
                break
            trouble = wrong_after_kill(name, phase, work, perfect, hub, pushed)
            counts[f"{name} killed"] += 1
            counts["survived"] += not trouble
            troubles += [f"{name}, right after kill: {t}" for t in trouble]
        before = len(troubles)
        if not finished(phase, work):
            troubles.append(f"{name}: could not be finished after a kill")
        elif name == "push":
            if hub.repos[f"datasets/{REPO}"].files != pushed:
                troubles.append("push: other files than undisturbed")
        elif digests(work / phase.makes) != digests(perfect / phase.makes):
            changed = set(digests(work / phase.makes).items()) ^ set(
                digests(perfect / phase.makes).items()
            )
            troubles.append(
                f"{name}: other bytes than undisturbed: {sorted(n for n, _ in changed)[:6]}"
            )
        counts["survived"] -= len(troubles) > before
        shutil.rmtree(work)
        if trial % 20 == 0:
            print(dict(sorted(counts.items())), flush=True)
    print(dict(sorted(counts.items())))
    for trouble in troubles:
        print(f"TROUBLE {trouble}")
    return counts["survived"], sum(counts[f"{n} killed"] for n in phases)


def all_phases() -> dict[str, Phase]:
    """Return what is killed, in order. Heavy imports happen here, once, before anything is forked."""
    import lerobot.datasets.aggregate
    import lerobot.datasets.lerobot_dataset  # noqa: F401

    from bench_episodes import lift
    from v2p_data.episodes.collect import EpisodesConfig, collect
    from v2p_data.episodes.dataset import shards
    from v2p_data.episodes.dataset.edit import merge
    from v2p_data.episodes.dataset.writer import pack
    from v2p_data.episodes.hub.hub import push_dataset
    from v2p_data.episodes.rollouts import Lesson
    from v2p_data.episodes.staging import staged_episodes
    from v2p_data.play import StateActor
    from v2p_data.task.benchmark import load_benchmark

    shards.SHARD_FRAMES = SHARD_FRAMES
    bundle = load_benchmark("lift_up")
    recipe = EpisodesConfig(num_episodes=6, batch_worlds=4, max_batches=4, size_px=64)

    def sometimes(obs: Any) -> Any:
        action = lift(obs)
        action[obs[:, 0] > 0.3] = 0  # hands that start far out stay there: these episodes fail
        return action

    def collecting(place: Path) -> None:
        lesson = Lesson(bundle=bundle, expert=StateActor(sometimes))
        collect(lesson, recipe, place / "collected", SEED, num_threads=1)

    def packing(place: Path) -> None:
        if not (place / "packed").exists():
            staged = staged_episodes(place / "collected")
            pack(staged[:4], "user/one", place / "packed", num_threads=2)

    def merging(place: Path) -> None:
        if not (place / "other").exists():
            staged = staged_episodes(place / "collected")
            pack(staged[4:], "user/two", place / "other", num_threads=2)
        if not (place / "merged").exists():
            merge([place / "packed", place / "other"], REPO, place / "merged")

    def pushing(place: Path) -> None:
        push_dataset(place / "merged", REPO)

    return toy_phases() | {
        "collect": Phase(run=collecting, needs=(), makes="collected"),
        "pack": Phase(run=packing, needs=("collected",), makes="packed"),
        "merge": Phase(run=merging, needs=("collected", "packed"), makes="merged"),
        "push": Phase(run=pushing, needs=("merged",), makes="merged"),
    }


def toy_phases() -> dict[str, Phase]:
    """Return what is killed of a toy task's run."""
    from dataclasses import replace
    from functools import partial

    import toy_run

    import v2p_data.distillation.rounds
    import v2p_data.evaluation.facts  # noqa: F401
    from v2p_data.commands import run as commands
    from v2p_data.episodes import rollouts
    from v2p_data.evaluation import batch
    from v2p_data.pipeline.runner import Runtime
    from v2p_data.pipeline.workers import only_run_in, run_stages
    from v2p_data.sim.env import verdict
    from v2p_data.stages import dataset_stage

    quick = ("--policy.preset=small", "--policy.batch-size=8", "--policy.steps=30")
    few = ("rounds=1", "episodes=2", "worlds=2", "first-steps=20")

    def running(place: Path) -> None:
        episodes = toy_run.chain()
        episodes = replace(episodes, make=partial(toy_run.make_agreeing, episodes.make))
        root = place / "run"
        with only_run_in(root):
            stages = [dataset_stage([episodes], toy_run.REPO_ID)]
            outcomes = run_stages(stages, Runtime(root=root, workers=2), lambda event: None)
        if not all(outcome.is_usable for outcome in outcomes.values()):
            raise RuntimeError(str([outcome.detail for outcome in outcomes.values()]))

    def commanding(place: Path, made: str, command: str, *flags: str) -> None:
        if not (place / made).exists():
            shutil.rmtree(place / "copy", ignore_errors=True)
            shutil.copytree(place / "run", place / "copy").rename(place / made)
        for module in (verdict, rollouts, batch):  # in this fork only
            vars(module)["referee_verdict"] = toy_run.agree
        commands.run_stages = toy_run.made
        dataset = toy_run.dataset_of(place / made)
        if commands.__dict__[f"{command}_command"]([str(dataset), *quick, *flags]):
            raise RuntimeError(f"v2p {command} did not make all")

    distill = ("distilled", "distill", *(f"--distillation.{setting}" for setting in few))
    return {
        "run": Phase(run=running, needs=(), makes="run"),
        "distill": Phase(
            run=lambda place: commanding(place, *distill), needs=("run",), makes="distilled"
        ),
        "train": Phase(
            run=lambda place: commanding(place, "trained", "train", "--distillation.rounds=0"),
            needs=("run",),
            makes="trained",
        ),
    }


def child(phase: Phase, work: Path) -> int:
    """Start a phase in a fork; return its process id."""
    sys.stdout.flush()
    pid = os.fork()
    if pid:
        return pid
    with (work / "log.txt").open("ab") as log:
        os.dup2(log.fileno(), 1)
        os.dup2(log.fileno(), 2)
    code = 1
    try:
        phase.run(work)
        code = 0
    except BaseException:  # noqa: BLE001 - the parent sees the exit code, the log the reason
        import traceback

        traceback.print_exc()
    finally:
        sys.stdout.flush()
        sys.stderr.flush()
        os._exit(code)


def killed(phase: Phase, work: Path, after_s: float) -> bool:
    """Run a phase and kill it after some time; tell whether it was still at work."""
    pid = child(phase, work)
    deadline = time.perf_counter() + after_s
    while time.perf_counter() < deadline:
        if os.waitpid(pid, os.WNOHANG)[0]:
            return False
        time.sleep(min(0.002, max(deadline - time.perf_counter(), 0)))
    os.kill(pid, signal.SIGKILL)
    _, status = os.waitpid(pid, 0)
    return os.WIFSIGNALED(status)


def finished(phase: Phase, work: Path) -> bool:
    """Run a phase to its end; tell whether it got there."""
    _, status = os.waitpid(child(phase, work), 0)
    if status:
        print((work / "log.txt").read_text(encoding="utf-8")[-2000:], flush=True)
    return status == 0


def undisturbed(phase: Phase, perfect: Path) -> float:
    """Make what a phase makes without disturbance; return the seconds it takes when repeated.

    Raises:
        RuntimeError: it failed.
    """
    started = time.perf_counter()
    if not finished(phase, perfect):
        raise RuntimeError("the undisturbed run failed")
    return time.perf_counter() - started


def wrong_after_kill(
    name: str, phase: Phase, work: Path, perfect: Path, hub: Hub, pushed: dict[str, bytes]
) -> list[str]:
    """Return what is wrong with what a kill left behind."""
    from v2p_data.episodes.staging import Episode, staged_episodes

    if name == "push":
        repo = hub.repos.get(f"datasets/{REPO}")
        head = repo.tags.get("v3.0") if repo else None
        whole = head is None or (repo is not None and repo.commits[head] == pushed)
        return [] if whole else ["a version that loads is not whole"]
    if name == "collect":
        wrong: list[str] = []
        for path in staged_episodes(work / phase.makes):
            Episode.load(path)
            twin = perfect / path.relative_to(work)
            if not twin.is_file() or twin.read_bytes() != path.read_bytes():
                wrong.append(f"{path.name} is not as undisturbed")
        return wrong
    made = work / phase.makes
    if phase.makes in RESULTS:
        finished = [record.parent.relative_to(work) for record in made.glob("*/*/record.json")]
        return [
            f"{result} is not as undisturbed"
            for result in finished
            if digests(work / result) != digests(perfect / result)
        ]
    if made.exists() and digests(made) != digests(perfect / phase.makes):
        return [f"{phase.makes} is there and is not as undisturbed"]
    return []


def digests(root: Path) -> dict[str, str]:
    """Return the digest of every file that must be the same each time."""
    return {
        str(path.relative_to(root)): hashlib.sha256(path.read_bytes()).hexdigest()
        for path in sorted(root.rglob("*"))
        if path.is_file() and not any(path.match(told) for told in TOLD)
    }


if __name__ == "__main__":
    main()

"""Damage files and folders of every kind that the engine reads, and look at what its commands answer.

Corpora of the tests are tried whole or in a random part: task folders, datasets, policies and
    decoded caches as strangers
may make them (`tests/task/strangers.py`, `tests/episodes/strange_datasets.py`,
`tests/policies/spoiled.py`), odd videos, captions, labels and boxes (`tests/video/odd_files.py`),
and harms to each kind of file of a finished run (`tests/pipeline/damage.py`). Every case runs in a
process of its own, whose time and memory are measured.

    python scripts/fuzz_artefacts.py --run outputs/demo --harms 200 --seed 1

A case is good if it ends in one sentence and exit code 2, is listed as damaged, or is rightly
accepted. Ends with exit code 1 if any case ends in a traceback, hangs, takes more than 60 s or 4
GB, or a listed file changes unnoticed. The longest and the largest case of each part are printed.
"""

import argparse
import contextlib
import importlib
import io
import json
import multiprocessing
import os
import resource
import shutil
import sys
import tempfile
from collections import Counter
from collections.abc import Callable, Iterator
from multiprocessing.connection import Connection
from pathlib import Path
from typing import Any

from v2p_data import cli
from v2p_data.errors import V2PError
from v2p_data.seeds import rng_for

ROOT = Path(__file__).parents[1]
LIMIT_S = 60.0
"""Of processor time, so that it does not matter what else the machine does."""
HANG_S = 5 * LIMIT_S
"""By the clock."""
LIMIT_BYTES = 4 * 10**9
"""Of the memory that a case holds at its worst, in its process or in one that it starts."""
READERS = {
    "dataset": ("verify", "{folder}"),
    "policy": ("eval", "{folder}/policy", "--evaluation.episodes=1"),
    "expert": ("eval", "{folder}", "--evaluation.episodes=1"),
    "distillation": ("train", "{dataset}", "--config", str(ROOT / "configs" / "demo.yaml")),
}
"""Stage -> a command that reads its folder and refuses a damaged one before anything is made."""
IMPORTED = (
    "lerobot.datasets.lerobot_dataset",
    "lerobot.policies.factory",
    "v2p_data.evaluation.judging",
    "v2p_data.report.page",
    "v2p_data.stages",
)
"""What cases need, imported once instead of in each process."""
Case = Callable[[Path], str]
"""Given an empty folder, tries and returns what became of it; raises on what may not be."""


def main() -> None:
    """Read the command line, try, print what happened as one line of JSON."""
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument(
        "--run", type=Path, default=ROOT / "outputs" / "demo", help="a finished run"
    )
    parser.add_argument("--harms", type=int, default=200, help="harms to the run's files, drawn")
    parser.add_argument(
        "--parts",
        nargs="*",
        default=["tasks", "datasets", "policies", "caches", "videos", "run"],
    )
    parser.add_argument("--seed", type=int, default=0)
    args = parser.parse_args()
    for folder in ("task", "episodes", "policies", "video", "pipeline"):
        sys.path.insert(0, str(ROOT / "tests" / folder))
    for name in IMPORTED:
        importlib.import_module(name)
    outcomes: dict[str, Counter[str]] = {}
    longest: dict[str, tuple[float, str]] = {}
    largest: dict[str, tuple[float, str]] = {}
    violations: list[str] = []
    parts = {
        "tasks": _tasks,
        "datasets": _datasets,
        "policies": _policies,
        "caches": _caches,
        "videos": _videos,
        "run": lambda: _harms(args),
    }
    for part in args.parts:
        outcomes[part] = Counter()
        for name, case in parts[part]():
            outcome, seconds, peak_bytes = _in_a_process(case)
            outcomes[part][outcome.split(":")[0]] += 1
            longest[part] = max(longest.get(part, (0.0, "")), (round(seconds, 1), name))
            largest[part] = max(largest.get(part, (0.0, "")), (round(peak_bytes / 1e9, 2), name))
            if outcome.startswith("violation"):
                violations.append(f"{part}, {name}: {outcome}")
                print(violations[-1], file=sys.stderr, flush=True)
    print(
        json.dumps(
            {
                "outcomes": outcomes,
                "longest_s": longest,
                "largest_gb": largest,
                "violations": violations,
            }
        )
    )
    sys.exit(1 if violations else 0)


def _in_a_process(case: Case) -> tuple[str, float, int]:
    """Return the case's outcome, its processor time [s] and its peak of memory [bytes].

    An exception, a crash, a hang, and too much time or memory are violations. What crashes or hangs tells neither: 0.
    """
    context = multiprocessing.get_context("fork")
    here, there = context.Pipe(duplex=False)
    outcome, seconds, peak_bytes = f"violation: it hung for {HANG_S:g} s", 0.0, 0
    with tempfile.TemporaryDirectory(prefix="v2p-fuzz-") as folder:
        process = context.Process(target=_try, args=(case, Path(folder), there))
        process.start()
        there.close()
        if here.poll(HANG_S):
            try:
                outcome, seconds, peak_bytes = here.recv()
            except EOFError:
                outcome = "violation: its process ended"
        process.kill()
        process.join()
    if peak_bytes > LIMIT_BYTES or seconds > LIMIT_S:
        outcome = f"violation: it took {peak_bytes / 1e9:.1f} GB and {seconds:.0f} s; {outcome}"
    return outcome, seconds, peak_bytes


def _try(case: Case, folder: Path, answer: Connection) -> None:
    os.environ["V2P_CACHE_DIR"] = str(folder / "cache")
    # far above what counts as too much, so that it is measured and the machine lives on
    resource.setrlimit(resource.RLIMIT_DATA, (2 * LIMIT_BYTES, 2 * LIMIT_BYTES))
    try:
        with contextlib.redirect_stderr(io.StringIO()), contextlib.redirect_stdout(io.StringIO()):
            outcome = case(folder)
    except V2PError as error:
        words = str(error)
        outcome = "refused" if len(words) > 20 and "\n" not in words else f"violation: {words!r}"
    except BaseException as error:  # noqa: BLE001 - what is looked for
        outcome = f"violation: {type(error).__name__}: {str(error)[:200]}"
    both = [resource.getrusage(who) for who in (resource.RUSAGE_SELF, resource.RUSAGE_CHILDREN)]
    seconds = sum(used.ru_utime + used.ru_stime for used in both)
    answer.send((outcome, seconds, max(1024 * used.ru_maxrss for used in both)))


# --- the corpora ---------------------------------------------------------------------------------------------


def _tasks() -> Iterator[tuple[str, Case]]:
    import strangers  # pyright: ignore[reportMissingImports]

    from v2p_data.sim.wrappers.gym_env import V2PEnv

    def case(spoil: Callable[[Path], None]) -> Case:
        def opened(folder: Path) -> str:
            task = strangers.good_task(folder / "task")
            spoil(task)
            V2PEnv(str(task))
            return "violation: it was opened"

        return opened

    for name, spoil in strangers.CASES.items():
        yield name, case(spoil)


def _policies() -> Iterator[tuple[str, Case]]:
    import spoiled  # pyright: ignore[reportMissingImports]
    import torch

    from v2p_data.evaluation.judging import contestant, play_of

    def case(spoil: Callable[[Path], None]) -> Case:
        def opened(folder: Path) -> str:
            policy = Path(shutil.copytree(good, folder / "policy"))
            spoil(policy)
            outcome = "violation: it was opened"
            try:
                play_of(contestant(policy), 0, "cpu")
            except V2PError:
                if not spoiled.canary(policy).exists():
                    raise
            return "violation: a program ran" if spoiled.canary(policy).exists() else outcome

        return opened

    torch.set_num_threads(1)  # more do not survive a fork
    with tempfile.TemporaryDirectory(prefix="v2p-fuzz-") as place:
        good = spoiled.good_policy(Path(place) / "good")
        play_of(contestant(good), 0, "cpu")  # imports what every case needs
        for name, spoil in spoiled.POLICIES.items():
            yield name, case(spoil)


def _caches() -> Iterator[tuple[str, Case]]:
    import small_dataset  # pyright: ignore[reportMissingImports]
    import spoiled  # pyright: ignore[reportMissingImports]
    import torch

    from policies.bc.frames import read_frames

    def case(spoil: Callable[[Path], None]) -> Case:
        def read(folder: Path) -> str:
            cache = Path(shutil.copytree(place / "cache", folder / "cache"))
            spoil(cache / spoiled.MASK)
            again = read_frames(dataset, small_dataset.REPO_ID, net, cache).pictures[spoiled.MASK]
            same = small_dataset.are_equal(whole, again)
            return "made anew" if same else "violation: it is trained on"

        return read

    torch.set_num_threads(1)
    with tempfile.TemporaryDirectory(prefix="v2p-fuzz-") as folder:
        place = Path(folder)
        dataset = place / "dataset"
        small_dataset.write_dataset(dataset)
        net = small_dataset.policy()[0].net
        whole = read_frames(dataset, small_dataset.REPO_ID, net, place / "cache").pictures[
            spoiled.MASK
        ]
        for name, spoil in spoiled.CACHES.items():
            yield name, case(spoil)


def _datasets() -> Iterator[tuple[str, Case]]:
    import strange_datasets  # pyright: ignore[reportMissingImports]

    def case(spoil: Callable[[Path], object]) -> Case:
        def verified(folder: Path) -> str:
            spoiled = Path(shutil.copytree(good, folder / "spoiled"))
            spoil(spoiled)
            return {1: "noticed", 2: "refused"}.get(
                cli.run(["verify", str(spoiled)]), "violation: accepted"
            )

        return verified

    with tempfile.TemporaryDirectory(prefix="v2p-fuzz-") as folder:
        good = strange_datasets.good_dataset(Path(folder))
        for name, spoil in (strange_datasets.REFUSED | strange_datasets.FOUND).items():
            yield name, case(spoil)


def _videos() -> Iterator[tuple[str, Case]]:
    import odd_files  # pyright: ignore[reportMissingImports]

    from v2p_data.video.captions import find_videos
    from v2p_data.video.decode import VideoConfig, read_clip

    def case(fill: Callable[[Path], object]) -> Case:
        def read(folder: Path) -> str:
            (folder / "videos").mkdir()
            fill(folder / "videos")
            for video in find_videos(folder / "videos"):
                read_clip(video, VideoConfig())
            return "accepted"

        return read

    for name, fill in odd_files.odd_folders():
        yield name, case(fill)


def _harms(args: argparse.Namespace) -> Iterator[tuple[str, Case]]:
    import damage  # pyright: ignore[reportMissingImports]

    every = [
        (kind, path, name, harm)
        for kind in damage.KINDS
        for path in kind.files(args.run)[:1]
        for name, harm in (
            damage.HARMS | (damage.JSON_HARMS if path.suffix == ".json" else {})
        ).items()
        if path.stat().st_size > 1
    ]
    drawn = rng_for(args.seed, "fuzz-artefacts").permutation(len(every))[: args.harms]

    def case(kind: Any, path: Path, harm: Callable[[Path], None]) -> Case:
        def looked_at(folder: Path) -> str:
            run = folder / "run"
            shutil.copytree(
                args.run, run, copy_function=os.link, ignore=shutil.ignore_patterns("cache")
            )
            hurt = run / path.relative_to(args.run)
            whole = hurt.read_bytes()
            hurt.unlink()  # the original shares its bytes
            hurt.write_bytes(whole)
            harm(hurt)
            noticed = cli.run(["status", str(run), "--check"]) == 1
            if kind.is_listed and not noticed:
                return "violation: nobody noticed"
            if cli.run(["report", str(run)]) not in (0, 2):
                return "violation: the report has another exit code"
            place = hurt.relative_to(run).parts
            if kind.is_listed and (reader := READERS.get(place[0])):
                words = {
                    "folder": run / place[0] / place[1],
                    "dataset": next((run / "dataset").glob("*")),
                }
                if cli.run([word.format(**words) for word in reader]) not in (1, 2):
                    return "violation: it was read all the same"
            return "noticed" if noticed else "accepted"

        return looked_at

    for k in drawn.tolist():
        kind, path, name, harm = every[k]
        yield f"{kind.name}: {name}", case(kind, path, harm)


if __name__ == "__main__":
    main()

"""What stages read beside their inputs: tables, networks, prompts, templates' text, and all files behind a place.

Who edits one of them wants other results, so their digests are part of what a stage is. A place is a policy, an expert,
a task, an arm, or what a setting names. `files_behind` alone says which files that means.
"""

import functools
import hashlib
import os
import shlex
from collections.abc import Iterable
from dataclasses import fields
from pathlib import Path

from v2p_data.evaluation.checkpoint import PROCESSOR_FILES
from v2p_data.evaluation.facts import policy_files
from v2p_data.evaluation.judging import EXPERT_FILES
from v2p_data.pipeline.fingerprint import file_digest, fingerprint
from v2p_data.scene.config import SceneConfig
from v2p_data.task.robot_files import robot_files
from v2p_data.task.task import CODE_FILE, TASK_FILE, TaskBundle

PACKAGE = Path(__file__).parent
SCENE_DATA = ("*.tsv", "*.json", "*.safetensors")
"""Nouns, how likely a thing is meant, and the networks; they lie in the rooms of `scene`."""
PROMPTS = ("prompts.py", "example_refinements.py", "example_tasks.py")
"""Files in `task/llm` with what a model is told."""


NAMING = ("model", "weights", "worker")
"""Settings of a backend that name a checkpoint's folder, a file of weights, and a command line with a program."""


def files_behind(place: Path) -> list[Path]:
    """Return every file that a stage reads where it is given a place, includes followed.

    Raises:
        V2PError: the place is not whole.
    """
    if (place / TASK_FILE).is_file():
        return TaskBundle.load(place).paths()
    if (place / PROCESSOR_FILES[0]).is_file():
        return policy_files(place)
    if place.is_dir():
        experts = [place / name for name in EXPERT_FILES if (place / name).is_file()]
        return experts or sorted(path for path in place.rglob("*") if path.is_file())
    return robot_files(place) if place.suffix.lower() in (".xml", ".mjcf") else [place]


def contents(name: str, place: Path) -> dict[str, str]:
    """Return the digest of each file behind a place, under a name and the file's path in the place."""
    paths = {os.path.relpath(path, place): path for path in files_behind(place)}
    return {f"{name} {where}".removesuffix(" ."): _digest(path) for where, path in paths.items()}


def named_contents(cfg: SceneConfig) -> dict[str, str]:
    """Return the digest of each file and folder that settings of the backends name."""
    found: dict[str, str] = {}
    for stage in fields(cfg):
        for setting in NAMING:
            named = str(getattr(getattr(cfg, stage.name), setting, None) or "")
            words = shlex.split(named) if setting == "worker" else [named] if named else []
            for number, place in enumerate(map(Path, words)):
                if place.is_file() or (place.is_dir() and setting != "worker"):
                    found |= contents(f"{stage.name} {setting} {number}", place)
    return found


def task_digest(task: Path, *, with_code: bool = True) -> str:
    """Return what a task is, by content; without its code, what a policy meets in it: things, robot and words."""
    files = contents("task", task)
    return fingerprint({k: v for k, v in files.items() if with_code or k != f"task {CODE_FILE}"})


def tasks_by_name(named: Iterable[tuple[str, Path]]) -> dict[str, Path]:
    """Return tasks by name, each content once; tasks of one name get their digests behind it, so that all are told."""
    tasks: dict[str, tuple[str, Path]] = {}
    for name, path in named:
        tasks.setdefault(task_digest(path), (name, path))
    names = [name for name, _ in tasks.values()]
    return {
        name if names.count(name) == 1 else f"{name}-{digest}": path
        for digest, (name, path) in tasks.items()
    }


def scene_data() -> dict[str, str]:
    """Return the digest of each file that reconstruction reads."""
    # Under the files' names alone: which room one lies in changes no result.
    files = [path for pattern in SCENE_DATA for path in (PACKAGE / "scene").rglob(pattern)]
    return {f"data scene/{path.name}": _digest(path) for path in sorted(files)}


def task_data(*, asks_model: bool) -> dict[str, str]:
    """Return the digest of what templates write, and of the prompts where a model writes task code."""
    return {"task templates": _templates_digest()} | (prompt_data() if asks_model else {})


@functools.cache
def _templates_digest() -> str:
    """Return the digest of what templates write: all samples of the paper's tasks."""
    from v2p_data.task.benchmark import benchmark_names, load_benchmark
    from v2p_data.task.templates.write import write_samples

    texts = [
        code for name in benchmark_names() for code in write_samples(load_benchmark(name).scene)
    ]
    return hashlib.sha256("".join(texts).encode()).hexdigest()


def prompt_data() -> dict[str, str]:
    """Return the digest of each file with what a model is told."""
    return _digests(PACKAGE / "task/llm" / name for name in PROMPTS)


def _digests(paths: Iterable[Path]) -> dict[str, str]:
    return {
        f"data {path.relative_to(PACKAGE).as_posix()}": _digest(path) for path in sorted(paths)
    }


def _digest(path: Path) -> str:
    stat = path.stat()
    return _digest_as_of(path, (stat.st_size, stat.st_mtime_ns, stat.st_ctime_ns))


@functools.cache
def _digest_as_of(path: Path, stamp: tuple[int, int, int]) -> str:
    """Return a file's digest; read once for all videos of a run."""
    del stamp
    return file_digest(path)

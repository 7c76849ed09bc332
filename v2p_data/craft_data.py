"""What stages read beside their inputs: tables, networks, prompts, and the text that templates write.

Who edits one of them wants other results, so their digests are part of what a stage is.
"""

import functools
import hashlib
from collections.abc import Iterable
from pathlib import Path

from v2p_data.pipeline.fingerprint import file_digest

PACKAGE = Path(__file__).parent
SCENE_DATA = ("*.tsv", "*.json", "*.safetensors")
"""Nouns, how likely a thing is meant, and the networks; they lie in the rooms of `scene`."""
PROMPTS = ("prompts.py", "example_refinements.py", "example_tasks.py")
"""Files in `task/llm` with what a model is told."""


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
    return _digest_as_of(path, stat.st_size, stat.st_mtime_ns)


@functools.cache
def _digest_as_of(path: Path, size: int, mtime_ns: int) -> str:
    """Return a file's digest; read once for all videos of a run."""
    del size, mtime_ns
    return file_digest(path)

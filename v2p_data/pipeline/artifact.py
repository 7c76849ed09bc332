"""The folder of one result: complete if it holds a record, and the record says what it is."""

import functools
import importlib.metadata
import json
import os
import platform
import shutil
import subprocess
import sys
import time
from collections.abc import Iterable
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

from v2p_data.errors import ItemRejectedError

RECORD_FILE = "record.json"
REJECTS_FILE = "rejected.jsonl"
SCHEMA = 1
PACKAGES = ("lerobot", "mujoco", "torch", "torchrl", "numpy", "opencv-python-headless")


@dataclass(frozen=True, kw_only=True)
class Record:
    """What a result is and how it came about."""

    stage: str
    item: str
    version: int
    fingerprint: str
    recipe: dict[str, Any]
    """The JSON that was hashed."""
    inputs: dict[str, str]
    """Per input the folder's name."""
    seconds: float
    rejected: dict[str, Any] | None = None
    """Reason slug, sentence and number, when the item was rejected here."""
    counts: dict[str, Any] = field(default_factory=dict[str, Any])
    provenance: dict[str, Any] = field(default_factory=dict[str, Any])
    schema: int = SCHEMA


def write_record(folder: Path, record: Record) -> None:
    """Write the record so that it is either whole or absent."""
    write_json_atomically(folder / RECORD_FILE, asdict(record))


def read_record(folder: Path) -> Record | None:
    """Return the record of a complete folder, else None."""
    try:
        return Record(**json.loads((folder / RECORD_FILE).read_text()))
    except (FileNotFoundError, NotADirectoryError):
        return None


def write_json_atomically(path: Path, data: Any) -> None:
    """Write JSON beside its place, flush it to disk, then rename it into place."""
    temporary = path.with_name(path.name + ".tmp")
    with temporary.open("w") as stream:
        json.dump(data, stream, indent=1)
        stream.flush()
        os.fsync(stream.fileno())
    temporary.replace(path)


def commit_folder(partial: Path, final: Path) -> None:
    """Rename finished work into place; a leftover without a record is replaced."""
    if final.exists():
        shutil.rmtree(final)
    partial.rename(final)
    directory = os.open(final.parent, os.O_RDONLY)
    try:
        os.fsync(directory)
    finally:
        os.close(directory)


def rejection(error: ItemRejectedError) -> dict[str, Any]:
    """Return the JSON form of a rejection."""
    return {"reason": error.reason, "detail": error.detail, "value": error.value}


def write_rejects(folder: Path, rejects: Iterable[dict[str, Any]]) -> None:
    """Append what was dropped, one JSON object a line: id, reason slug, the number that decided."""
    with (folder / REJECTS_FILE).open("a") as stream:
        for reject in rejects:
            stream.write(json.dumps(reject) + "\n")


def read_rejects(folder: Path) -> list[dict[str, Any]]:
    """Return what a stage dropped."""
    path = folder / REJECTS_FILE
    if not path.is_file():
        return []
    return [json.loads(line) for line in path.read_text().splitlines() if line.strip()]


@functools.cache
def provenance() -> dict[str, Any]:
    """Return where and with what this process runs; gathered once, best effort, no secrets."""
    try:
        commit = subprocess.run(
            ["git", "rev-parse", "HEAD"],
            cwd=Path(__file__).parent,
            capture_output=True,
            text=True,
            timeout=5,
            check=True,
        ).stdout.strip()
    except (OSError, subprocess.SubprocessError):
        commit = ""
    versions: dict[str, str] = {}
    for package in PACKAGES:
        try:
            versions[package] = importlib.metadata.version(package)
        except importlib.metadata.PackageNotFoundError:
            continue
    return {
        "commit": commit,
        "argv": [Path(sys.argv[0]).name, *sys.argv[1:]],
        "python": platform.python_version(),
        "machine": f"{platform.system()} {platform.machine()}, {os.cpu_count()} cores",
        "packages": versions,
        "time": time.strftime("%Y-%m-%dT%H:%M:%SZ", time.gmtime()),
    }

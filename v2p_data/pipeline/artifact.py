"""The folder of one result: complete if it holds a record, and the record says what it is."""

import functools
import hashlib
import importlib.metadata
import json
import os
import platform
import subprocess
import sys
import time
from collections.abc import Iterable
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any, cast

from v2p_data.errors import UnusableError, V2PError
from v2p_data.pipeline.contents import (
    FileMark,
    damaged,
    damages,
    demand_no,
    memory_of,
)
from v2p_data.pipeline.settings import from_values
from v2p_data.pipeline.shareable import without_places

RECORD_FILE = "record.json"
REJECTS_FILE = "rejected.jsonl"
TRACEBACK_FILE = "traceback.txt"
"""In a half-finished folder: why it was not finished."""
SCHEMA = 2
"""1: without the list of files and the record's own checksum."""
CHECKSUM_KEY = "checksum"
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
    files: dict[str, FileMark] | None = None
    """What lies in the folder, by path; None in records of schema 1."""
    schema: int = SCHEMA


def write_record(folder: Path, record: Record) -> None:
    """Write the record so that it is either whole or absent, with a checksum of itself."""
    data = asdict(record)
    write_json_atomically(folder / RECORD_FILE, data | {CHECKSUM_KEY: _checksum(data)})


def read_record(folder: Path) -> Record | None:
    """Return the record of a complete folder, None where there is none.

    Raises:
        UnusableError: it is not as it was written, or a newer version wrote it.
    """
    path = folder / RECORD_FILE
    if path.exists() and not path.is_file():
        raise damaged(folder, f"{path} is no file")  # reading a pipe never ends
    try:
        data = json.loads(path.read_text(encoding="utf-8"))
    except (FileNotFoundError, NotADirectoryError):
        return None
    except OSError as error:
        raise damaged(folder, f"{path} cannot be read ({error.strerror})") from error
    except (ValueError, RecursionError) as error:
        raise damaged(folder, f"{path} is no JSON") from error
    if not isinstance(data, dict):
        raise damaged(folder, f"{path} holds no record")
    values = cast(dict[str, Any], data)
    schema = values.get("schema")
    if isinstance(schema, int) and schema > SCHEMA:
        raise UnusableError(
            "newer_version",
            f"{path} was written by a newer version of v2p (schema {schema}, this one reads up to {SCHEMA}); use that "
            "version, or another --out",
        )
    checksum = values.pop(CHECKSUM_KEY, None)
    if (schema != 1 or checksum is not None) and checksum != _checksum(values):
        raise damaged(folder, f"{path} has another content than was written")
    try:
        return from_values(Record, values, "the record")
    except (V2PError, TypeError) as error:
        raise damaged(folder, f"{path} holds no record ({str(error)[:200]})") from error


def history(folder: Path, root: Path) -> dict[str, Any]:
    """Return the recipes of a result and of everything it came from."""
    record = read_record(folder)
    if record is None:
        return {}
    needed = {
        name: history(path, root)
        for name, source in record.inputs.items()
        for path in root.glob(f"*/{source}")
    }
    return {
        "stage": record.stage,
        "folder": folder.name,
        "recipe": record.recipe,
        "counts": record.counts,
        "inputs": needed,
    }


def demand_whole(folder: Path, root: Path | None = None, below: str = "") -> None:
    """Raise if a finished folder is not as it was made.

    What has no record, and what was made before records listed files, passes.

    Args:
        folder: of a result; of the run at `root` or of another one.
        root: the run that remembers what was compared; without one all is read again.
        below: compare only the files under this path of the folder.

    Raises:
        UnusableError: names the file and says what to do.
    """
    record = read_record(folder)
    if record is None or record.files is None:
        return
    files = {name: mark for name, mark in record.files.items() if name.startswith(below)}
    memory = memory_of(folder, root) if root else None
    demand_no(damages(folder, files, memory=memory), folder)


def _checksum(record: dict[str, Any]) -> str:
    """Return the first 16 hex digits of the SHA-256 of a record's JSON."""
    text = json.dumps(json.loads(json.dumps(record)), sort_keys=True)
    return hashlib.sha256(text.encode()).hexdigest()[:16]


def write_json_atomically(path: Path, data: Any) -> None:
    """Write JSON beside its place, flush it to disk, then rename it into place."""
    temporary = path.with_name(path.name + ".tmp")
    with temporary.open("w", encoding="utf-8") as stream:
        json.dump(data, stream, indent=1)
        stream.flush()
        os.fsync(stream.fileno())
    temporary.replace(path)


def commit_folder(partial: Path, final: Path) -> None:
    """Rename finished work into place, where nothing or an empty folder may be."""
    partial.rename(final)
    directory = os.open(final.parent, os.O_RDONLY)
    try:
        os.fsync(directory)
    finally:
        os.close(directory)


def write_rejects(folder: Path, rejects: Iterable[dict[str, Any]]) -> None:
    """Write what was dropped, one JSON object a line: id, reason slug, the number that decided."""
    (folder / REJECTS_FILE).write_text(
        "".join(json.dumps(reject) + "\n" for reject in rejects), encoding="utf-8"
    )


def read_rejects(folder: Path) -> list[dict[str, Any]]:
    """Return what a stage dropped."""
    path = folder / REJECTS_FILE
    if not path.is_file():
        return []
    return [
        json.loads(line) for line in path.read_text(encoding="utf-8").splitlines() if line.strip()
    ]


@functools.cache
def provenance() -> dict[str, Any]:
    """Return where and with what this process runs; gathered once, best effort, nothing that names its user.

    The command line is as it can be shown to others; `own_command` is the one that was typed.
    """
    versions: dict[str, str] = {}
    for package in PACKAGES:
        try:
            versions[package] = importlib.metadata.version(package)
        except importlib.metadata.PackageNotFoundError:
            continue
    return {
        "commit": commit_of(Path(__file__).parents[2]),
        "argv": without_places(own_command()),
        "python": platform.python_version(),
        "machine": f"{platform.system()} {platform.machine()}, {os.cpu_count()} cores",
        "packages": versions,
        "time": time.strftime("%Y-%m-%dT%H:%M:%SZ", time.gmtime()),
    }


def commit_of(root: Path) -> str:
    """Return the commit of the repository at `root`; empty where it holds no code of ours, or lies further up."""
    ours = Path(*Path(__file__).parts[-3:]).as_posix()
    command = ["git", "--git-dir", str(root / ".git"), "rev-parse", "HEAD", f"HEAD:{ours}"]
    try:
        said = subprocess.run(command, capture_output=True, text=True, timeout=5, check=True)
    except (OSError, subprocess.SubprocessError):
        return ""
    return said.stdout.split()[0]


def own_command() -> list[str]:
    """Return this process's command line, for records, which stay in the run folder."""
    return [Path(sys.argv[0]).name, *sys.argv[1:]]

"""The files of a finished folder: listed with size and digest when it is made, compared whenever it is read.

Files may be added later: a card, films, caches of other programs. What was listed must stay as it was. To compare a
large run costs little after the first time: the run folder remembers which files were found
    unchanged, by the times that the file
system keeps of them.
"""

import json
import os
from collections.abc import Iterator, Mapping
from contextlib import suppress
from dataclasses import dataclass
from fnmatch import fnmatch
from pathlib import Path
from typing import Any, cast

from v2p_data.errors import UnusableError
from v2p_data.json_files import json_or_none
from v2p_data.pipeline.fingerprint import file_digest

MEMORY_FOLDER = ".checked"
"""Folder of a run with what was compared already. Safe to delete."""
UNLISTED = (
    *("record.json", "README.md", "traceback.txt", "*.log", "events.out.tfevents.*"),
    *("*.tmp", "*.partial", ".cache", "__pycache__"),
)
"""Files and folders that may change: a card is written again by a push, logs are nobody's input."""


@dataclass(frozen=True, kw_only=True)
class FileMark:
    """What a file is known by."""

    size: int
    """In bytes."""
    sha256: str
    """The first 16 hex digits."""


@dataclass(frozen=True, kw_only=True)
class Damage:
    """A file that is not as it was made."""

    path: Path
    what: str
    """In words that follow the path."""


def list_files(folder: Path) -> dict[str, FileMark]:
    """Return the marks of all files below `folder` that must not change, by their paths in it."""
    return {
        path.relative_to(folder).as_posix(): FileMark(
            size=path.stat().st_size, sha256=file_digest(path)
        )
        for path in _listed(folder)
    }


def damages(
    folder: Path,
    files: Mapping[str, FileMark],
    *,
    memory: Path | None = None,
    sizes_only: bool = False,
) -> list[Damage]:
    """Return which of the listed files are missing or not as they were.

    Args:
        folder: a finished folder.
        files: what its record lists, or a part of it.
        memory: file that remembers what was compared; without one all is read.
        sizes_only: look at sizes only, which reads no file.
    """
    known = _remembered(memory)
    found: list[Damage] = []
    compared = False
    for name, mark in files.items():
        path = folder / name
        try:
            if not path.is_file():
                what = "is missing" if not path.exists() else "is no file any more"
            elif (size := path.stat().st_size) != mark.size:
                what = f"has {size} bytes instead of {mark.size}"
            elif sizes_only or known.get(name) == [*_stamp(path), mark.sha256]:
                continue
            elif file_digest(path) == mark.sha256:
                known[name] = [*_stamp(path), mark.sha256]
                compared = True
                continue
            else:
                what = "has another content"
        except OSError as error:
            what = f"cannot be read ({error.strerror})"
        known.pop(name, None)
        found.append(Damage(path=path, what=what))
    if memory is not None and compared:
        _remember(memory, known)
    return found


def remember_made(folder: Path, files: Mapping[str, FileMark], memory: Path) -> None:
    """Remember files that were listed just now, so that the next run need not read them again."""
    _remember(memory, {name: [*_stamp(folder / name), m.sha256] for name, m in files.items()})


def demand_no(found: list[Damage], folder: Path) -> None:
    """Raise if there is any damage.

    Raises:
        UnusableError: names the first file and says what to do.
    """
    if found:
        more = f" (and {len(found) - 1} more)" if len(found) > 1 else ""
        raise damaged(folder, f"{found[0].path} {found[0].what}{more}")


def damaged(folder: Path, what: str) -> UnusableError:
    """Return the error that says what is wrong with a finished folder, and what to do."""
    return UnusableError(
        "damaged",
        f"{what}, so {folder} is damaged; delete that folder and run again: it is made anew",
    )


def memory_of(folder: Path, root: Path) -> Path | None:
    """Return where the run at `root` remembers a finished folder of its own; None for a folder elsewhere."""
    folder, root = folder.resolve(), root.resolve()
    if not folder.is_relative_to(root):
        return None
    return root / MEMORY_FOLDER / folder.relative_to(root).with_name(f"{folder.name}.json")


def must_stay(name: str) -> bool:
    """Return whether a file of this path in a finished folder is listed, so that it must stay as it was made."""
    return not any(fnmatch(part, unlisted) for part in name.split("/") for unlisted in UNLISTED)


def _listed(folder: Path) -> Iterator[Path]:
    for path in sorted(folder.rglob("*")):
        if path.is_file() and must_stay(path.relative_to(folder).as_posix()):
            yield path


def _stamp(path: Path) -> tuple[int, int, int]:
    """Return what changes when a file is written; its time of change can hardly be set back."""
    stat = path.stat()
    return stat.st_size, stat.st_mtime_ns, stat.st_ctime_ns


def _remembered(memory: Path | None) -> dict[str, Any]:
    """Return stamp and digest of files that were as listed; nothing where that cannot be read."""
    if memory is None:
        return {}
    known = json_or_none(memory, max_bytes=None)
    return cast(dict[str, Any], known) if isinstance(known, dict) else {}


def _remember(memory: Path, known: Mapping[str, Any]) -> None:
    with suppress(OSError):  # it only saves time
        memory.parent.mkdir(parents=True, exist_ok=True)
        temporary = memory.with_suffix(
            f".{os.getpid()}.tmp"
        )  # workers may compare the same folder
        temporary.write_text(json.dumps(known), encoding="utf-8")
        temporary.replace(memory)

"""Files of a folder that somebody else may have made: only regular files inside it, of limited size, never links.

A link is followed in one case: in the Hub's cache every file is a link to `blobs` of the same repository.
"""

import os
import shutil
import stat
from collections.abc import Callable, Iterable
from pathlib import Path, PurePosixPath

from v2p_data.errors import V2PError

MAX_PATH_CHARS = 255
MAX_FILES = 5_000
"""Most files of a folder that is copied."""


def user_cache(variable: str) -> Path:
    """Return `v2p` in the user's cache folder.

    Args:
        variable: of the environment, that could have named another folder.

    Raises:
        V2PError: this user has no home.
    """
    try:
        return Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache") / "v2p"
    except RuntimeError as error:
        raise V2PError(
            f"this user has no home folder to keep files in; set {variable} to a folder"
        ) from error


def is_plain_path(text: str) -> bool:
    """Return whether a text is a relative path that stays below where it starts, with `/` between its parts."""
    parts = text.split("/")
    return (
        0 < len(text) <= MAX_PATH_CHARS
        and text.isprintable()
        and not any(mark in text for mark in "\\:")
        and not any(part in ("", ".", "..") for part in parts)
    )


def own_file(folder: Path, relative: str, most_bytes: int) -> Path:
    """Return the path of a file of a folder.

    Args:
        folder: may itself be reached by a link.
        relative: where the file lies in it.
        most_bytes: how large it may be.

    Raises:
        V2PError: it is missing, larger, outside of the folder, a link, or no regular file.
    """
    path = folder / relative
    if not is_plain_path(relative):
        raise V2PError(f"{folder} names the file {relative[:200]!r}, which does not lie inside it")
    try:
        where = path.resolve(strict=True)
        about = where.stat()
    except (OSError, RuntimeError) as error:
        why = "is missing" if isinstance(error, FileNotFoundError) else "cannot be opened"
        raise V2PError(f"{path} {why}: the folder is not whole; fetch or make it again") from error
    if where != folder.resolve() / PurePosixPath(relative) and not _is_in_hub_cache(path, where):
        raise V2PError(
            f"{path} is a link, or lies behind one; a folder from elsewhere may hold plain files only"
        )
    if not stat.S_ISREG(about.st_mode):
        raise V2PError(f"{path} is no regular file; there must be a file of that name")
    if about.st_size > most_bytes:
        raise V2PError(
            f"{path} has {about.st_size / 1e6:.1f} MB; at most {most_bytes / 1e6:g} MB are read"
        )
    return path


def read_own(folder: Path, relative: str, most_bytes: int) -> bytes:
    """Return the content of a file of a folder; see `own_file`."""
    path = own_file(folder, relative, most_bytes)
    try:
        with path.open("rb") as stream:
            return stream.read(most_bytes)
    except OSError as error:
        raise V2PError(f"{path} cannot be read ({error.strerror}); check its rights") from error


def read_own_text(folder: Path, relative: str, most_bytes: int) -> str:
    """Return the text of a file of a folder; see `own_file`."""
    try:
        return read_own(folder, relative, most_bytes).decode()
    except UnicodeDecodeError as error:
        raise V2PError(
            f"{folder / relative} is no text in UTF-8 (byte {error.start}); save it as UTF-8"
        ) from error


def copy_folder(
    source: Path, into: Path, ignore: Callable[[str, list[str]], Iterable[str]] | None = None
) -> None:
    """Copy a folder's regular files to a folder that does not exist yet.

    Args:
        source: may itself be reached by a link.
        into: must not exist.
        ignore: as of `shutil.copytree`.

    Raises:
        V2PError: as `demand_plain_files`. Nothing has been copied then.
    """
    demand_plain_files(source, ignore)
    shutil.copytree(source, into, ignore=ignore)


def demand_plain_files(
    source: Path, ignore: Callable[[str, list[str]], Iterable[str]] | None = None
) -> None:
    """Demand that a folder holds plain files only, so that it may be copied or sent.

    The arguments mean the same as in `copy_folder`.

    Raises:
        V2PError: it holds links, special files, or too many files.
    """
    count = 0
    for folder, subfolders, names in os.walk(source):
        left_out = set(ignore(folder, subfolders + names)) if ignore else set()
        subfolders[:] = [name for name in subfolders if name not in left_out]
        for name in (*subfolders, *(n for n in names if n not in left_out)):
            path = Path(folder) / name
            is_linked = path.is_symlink() and not _is_in_hub_cache(path, path.resolve())
            if is_linked or not (path.is_file() or path.is_dir()):
                raise V2PError(
                    f"{path} is a link or no regular file and is not copied: what it leads to may not be meant for "
                    "others; remove it, or put the file itself there"
                )
            count += 1
    if count > MAX_FILES:
        raise V2PError(f"{source} holds {count} files; at most {MAX_FILES} are copied")


def _is_in_hub_cache(path: Path, where: Path) -> bool:
    """Return whether a path in `<repository>/snapshots/<commit>/` leads into the repository's own `blobs`."""
    for parent in path.absolute().parents:
        if parent.name == "snapshots":
            return where.parent == parent.resolve().parent / "blobs" and not where.is_symlink()
    return False

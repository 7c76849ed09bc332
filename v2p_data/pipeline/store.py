"""Results that several drivers and machines share, in a folder that all of them see.

A store looks like a run folder: STAGE/ITEM-FINGERPRINT/ with a record that is written last, so that a result without
one does not count. Every write is whole or absent, and who creates a file first is decided by the file system.
"""

import functools
import logging
import shutil
import tempfile
import time
import uuid
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from functools import partial
from pathlib import Path

from v2p_data.errors import V2PError, write_refusal
from v2p_data.pipeline.artifact import RECORD_FILE, Record, commit_folder, read_record
from v2p_data.pipeline.contents import (
    damages,
    demand_no,
    memory_of,
    must_stay,
    remember_made,
)

logger = logging.getLogger(__name__)

MARK = "store.json"
"""The file that makes a place a store: a disk that is not mounted has none."""
SENDING_FOLDER = ".sending"
"""Folder of a store with what is being written."""
FETCHING_FOLDER = ".fetching"
"""Folder of a run with what is being downloaded."""
PATIENCE_S = 300.0
"""A store that does not answer for so long is given up."""
LONGEST_PAUSE_S = 20.0
TRANSFERS = 8
"""Files on their way at the same time."""


class Store:
    """One store: a folder."""

    def __init__(self, place: str) -> None:
        if "://" in place:
            raise V2PError(
                f"--store {place} is a URL; a store is a folder that all drivers see, on NFS for example"
            )
        self.folder = Path(place).absolute()

    # --- files ---------------------------------------------------------------------------------------------------

    def begin(self) -> None:
        """Mark the place as a store, where it is none yet."""
        try:
            (self.folder / SENDING_FOLDER).mkdir(parents=True, exist_ok=True)
            (self.folder / MARK).touch()
        except OSError as error:
            raise V2PError(f"--store {self.folder} cannot be written ({_short(error)})") from error

    def create(self, key: str, content: bytes) -> bool:
        """Create a file; False where there is one already, which stays."""
        try:
            self._place(
                key,
                lambda path: path.write_bytes(content),
                lambda new, path: path.hardlink_to(new),
            )
        except FileExistsError:
            return False
        return True

    def write(self, key: str, content: bytes) -> None:
        self._place(key, lambda path: path.write_bytes(content), Path.replace)

    def read(self, key: str) -> bytes | None:
        """Return a file's content, None where there is no such file."""

        def content() -> bytes:
            if (path := self.folder / key).exists() and not path.is_file():
                raise V2PError(f"{path} is no file; remove it and run the same command again")
            return path.read_bytes()

        try:
            return self._tried(content)
        except FileNotFoundError:
            return None

    def delete(self, key: str) -> None:
        self._tried(lambda: (self.folder / key).unlink(missing_ok=True))

    def _place(
        self, key: str, fill: Callable[[Path], object], put: Callable[[Path, Path], object]
    ) -> None:
        """Write a file aside, whole, and put it into its place."""

        def placed() -> None:
            path, new = self.folder / key, self.folder / SENDING_FOLDER / uuid.uuid4().hex
            for needed in (path, new):
                needed.parent.mkdir(parents=True, exist_ok=True)
            try:
                fill(new)
                put(new, path)
            finally:
                new.unlink(missing_ok=True)

        try:
            self._tried(placed)
        except OSError as error:
            if (refusal := write_refusal(error)) is None:
                raise
            raise V2PError(
                f"cannot write to the store {self.folder}: {refusal}; what is finished is kept in the run folder, and"
                " the same command publishes it"
            ) from error

    # --- results -------------------------------------------------------------------------------------------------

    def has(self, key: str) -> bool:
        """Return whether the result STAGE/FOLDER is published."""
        return self._tried((self.folder / key / RECORD_FILE).is_file)

    def record(self, key: str) -> Record | None:
        """Return a published result's record, None where there is none.

        Raises:
            UnusableError: it is not as it was written.
        """
        return self._tried(lambda: read_record(self.folder / key))

    def publish(self, folder: Path) -> None:
        """Send a finished result, the record last; one that is there already stays as it is."""
        key = key_of(folder)
        paths = (p for p in sorted(folder.rglob("*")) if p.is_file() and p != folder / RECORD_FILE)

        def send(path: Path) -> None:
            if not self.has(key):  # perhaps another driver's by now
                name = path.relative_to(folder).as_posix()
                self._place(f"{key}/{name}", partial(shutil.copyfile, path), Path.replace)

        with ThreadPoolExecutor(TRANSFERS) as pool:
            list(pool.map(send, paths))
        self.create(f"{key}/{RECORD_FILE}", (folder / RECORD_FILE).read_bytes())

    def fetch(self, folder: Path, root: Path) -> bool:
        """Bring a result into the run folder `root`, every file compared with its digest; False where there is none.

        Raises:
            UnusableError: a file in the store is not as it was made.
        """
        if folder.exists():
            return True
        record = self.record(key_of(folder))
        if record is None:
            return False
        theirs, files = self.folder / key_of(folder), record.files or {}
        paths = self._tried(lambda: [p for p in theirs.rglob("*") if p.is_file()])
        names = [p.relative_to(theirs).as_posix() for p in paths]
        (root / FETCHING_FOLDER).mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryDirectory(dir=root / FETCHING_FOLDER) as temporary:
            place = Path(temporary) / folder.name

            def bring(name: str) -> None:
                (place / name).parent.mkdir(parents=True, exist_ok=True)
                self._tried(lambda: shutil.copyfile(theirs / name, place / name))

            with ThreadPoolExecutor(TRANSFERS) as pool:
                list(pool.map(bring, [n for n in names if n in files or not must_stay(n)]))
            found = damages(place, files)
            demand_no([replace(d, path=theirs / d.path.relative_to(place)) for d in found], theirs)
            folder.parent.mkdir(parents=True, exist_ok=True)
            try:
                commit_folder(place, folder)
            except OSError:
                if not folder.exists():  # another worker was faster
                    raise
        if (memory := memory_of(folder, root)) is not None:
            remember_made(folder, files, memory)
        return True

    # --- a store that goes away and comes back ---------------------------------------------------------------------

    def _tried[T](self, call: Callable[[], T]) -> T:
        """Return what a call returns; try again while the store does not answer.

        Raises:
            V2PError: it did not answer for `PATIENCE_S`, or refuses us.
        """
        began, pause = time.monotonic(), 0.5
        while True:
            try:
                self._demand_mounted()
                got = call()
                self._demand_mounted()  # an unmounted store leaves an empty folder, which accepts the files
            except OSError as error:
                answers = isinstance(error, FileNotFoundError | FileExistsError)
                if write_refusal(error) or (answers and (self.folder / MARK).exists()):
                    raise
                if time.monotonic() - began > PATIENCE_S:
                    raise V2PError(
                        f"the store {self.folder} does not answer ({_short(error)}); what is "
                        "finished is kept, and the same "
                        "command goes on with it when the store is back"
                    ) from error
                logger.warning(
                    "the store %s does not answer (%s); trying again", self.folder, _short(error)
                )
                time.sleep(pause)
                pause = min(2 * pause, LONGEST_PAUSE_S)
            else:
                return got

    def _demand_mounted(self) -> None:
        if not (self.folder / MARK).exists():
            raise ConnectionError(f"there is no {self.folder / MARK}; is the disk mounted?")


@functools.cache
def open_store(place: str) -> Store:
    """Return the store of this process at a place."""
    return Store(place)


def key_of(folder: Path) -> str:
    """Return what a result's folder is called in the store."""
    return f"{folder.parent.name}/{folder.name}"


def _short(error: BaseException) -> str:
    return (str(error).splitlines() or [type(error).__name__])[0][:200]

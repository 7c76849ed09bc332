"""Results that several drivers and machines share, in a folder or a bucket.

A store looks like a run folder: STAGE/ITEM-FINGERPRINT/ with a record that is written last, so that a result without
one does not count. Every write is whole or absent, and who creates an object first is decided by the store itself.
"""

import functools
import logging
import tempfile
import time
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from functools import partial
from importlib import import_module
from pathlib import Path
from typing import Any

from v2p_data.errors import UnusableError, V2PError, write_refusal
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
"""The object that makes a place a store: a disk that is not mounted has none."""
FETCHING_FOLDER = ".fetching"
"""Folder of a run with what is being downloaded."""
PATIENCE_S = 300.0
"""A store that does not answer for so long is given up."""
LONGEST_PAUSE_S = 20.0
TRANSFERS = 8
"""Files on their way at the same time."""


class Store:
    """One store, opened by this process.

    Args:
        url: a folder, or the URL of a bucket: `s3://BUCKET/PREFIX`, `gs://...`, `az://...`.
    """

    def __init__(self, url: str) -> None:
        try:
            self.library: Any = import_module("obstore")
            stores: Any = import_module("obstore.store")
        except ModuleNotFoundError as error:
            raise V2PError(
                f"--store {url} needs the package obstore: pip install 'lerobot_policy_v2p[store]'"
            ) from error
        self.url = url.rstrip("/")
        self.exists_error: type[Exception] = self.library.exceptions.AlreadyExistsError
        path = self.url.removeprefix("file://")
        self.folder = None if "://" in path else Path(path).absolute()
        if self.folder is not None:
            self.open: Callable[[], Any] = functools.cache(partial(stores.LocalStore, self.folder))
            return
        options = {"disable_bulk_delete": True} if path.startswith("s3") else {}
        try:
            bucket: Any = stores.from_url(self.url, retry_config={"max_retries": 1}, **options)
        except (self.library.exceptions.BaseError, ValueError) as error:
            raise V2PError(
                f"--store {url} cannot be opened ({_short(error)}); it is a folder, or a URL such as s3://BUCKET/PREFIX"
            ) from error
        self.open = lambda: bucket

    # --- objects -------------------------------------------------------------------------------------------------

    def begin(self) -> None:
        """Mark the place as a store, where it is none yet.

        Raises:
            V2PError: it lets two drivers create one object, so that leases would not hold.
        """
        try:
            if self.folder:
                self.folder.mkdir(parents=True, exist_ok=True)
                (self.folder / MARK).touch()
            self.create(MARK, b"")
        except OSError as error:
            raise V2PError(f"--store {self.url} cannot be written ({_short(error)})") from error
        if self.create(MARK, b""):
            raise V2PError(
                f"{self.url} lets two programs create one object, so drivers cannot share it; "
                "take a folder, or a bucket "
                "that knows 'If-None-Match' (Amazon S3, MinIO, Cloudflare R2, Google, Azure)"
            )

    def create(self, key: str, content: bytes) -> bool:
        """Create an object; False where there is one already, which stays."""
        try:
            self._tried(lambda: self.library.put(self.open(), key, content, mode="create"))
        except self.exists_error:
            return False
        return True

    def write(self, key: str, content: bytes) -> None:
        self._tried(lambda: self.library.put(self.open(), key, content))

    def read(self, key: str) -> bytes | None:
        """Return an object's content, None where there is no such object."""
        try:
            return bytes(self._tried(lambda: self.library.get(self.open(), key).bytes()))
        except FileNotFoundError:
            return None

    def delete(self, key: str) -> None:
        try:
            self._tried(lambda: self.library.delete(self.open(), key))
        except FileNotFoundError:
            return

    # --- results -------------------------------------------------------------------------------------------------

    def has(self, key: str) -> bool:
        """Return whether the result STAGE/FOLDER is published."""
        try:
            self._tried(lambda: self.library.head(self.open(), f"{key}/{RECORD_FILE}"))
        except FileNotFoundError:
            return False
        return True

    def record(self, key: str) -> Record | None:
        """Return a published result's record, None where there is none.

        Raises:
            UnusableError: it is not as it was written.
        """
        with tempfile.TemporaryDirectory() as place:
            return self._record_in(Path(place), key)

    def publish(self, folder: Path) -> None:
        """Send a finished result, the record last; one that is there already stays as it is."""
        key = key_of(folder)
        paths = (p for p in sorted(folder.rglob("*")) if p.is_file() and p != folder / RECORD_FILE)

        def send(path: Path) -> None:
            if not self.has(key):  # perhaps another driver's by now
                name = path.relative_to(folder).as_posix()
                self._tried(lambda: self.library.put(self.open(), f"{key}/{name}", path))

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
        key = key_of(folder)
        (root / FETCHING_FOLDER).mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryDirectory(dir=root / FETCHING_FOLDER) as temporary:
            place = Path(temporary) / folder.name
            place.mkdir()
            record = self._record_in(place, key)
            if record is None:
                return False
            files = record.files or {}
            names = [n for n in self._names(key) if n in files or not must_stay(n)]
            with ThreadPoolExecutor(TRANSFERS) as pool:
                list(pool.map(partial(self._download, key, place), names))
            try:
                demand_no(damages(place, files), place)
            except UnusableError as error:
                raise self._named(error, place, key) from error
            folder.parent.mkdir(parents=True, exist_ok=True)
            try:
                commit_folder(place, folder)
            except OSError:
                if not folder.exists():  # another worker was faster
                    raise
        if (memory := memory_of(folder, root)) is not None:
            remember_made(folder, files, memory)
        return True

    def _record_in(self, place: Path, key: str) -> Record | None:
        content = self.read(f"{key}/{RECORD_FILE}")
        if content is None:
            return None
        (place / RECORD_FILE).write_bytes(content)
        try:
            return read_record(place)
        except UnusableError as error:
            raise self._named(error, place, key) from error

    def _named(self, error: UnusableError, place: Path, key: str) -> UnusableError:
        """Return the error with the place in the store in the downloaded copy's stead."""
        detail = error.detail.replace(str(place), f"{self.url}/{key}")
        return UnusableError(error.reason, detail)  # type: ignore[arg-type]

    def _names(self, key: str) -> list[str]:
        """Return the paths of a result's files, without its record."""
        listed = self._tried(lambda: list(self.library.list(self.open(), prefix=key)))
        names = (str(entry["path"]).removeprefix(f"{key}/") for batch in listed for entry in batch)
        return [name for name in names if name != RECORD_FILE]

    def _download(self, key: str, place: Path, name: str) -> None:
        path = place / name
        path.parent.mkdir(parents=True, exist_ok=True)

        def copy() -> None:
            with path.open("wb") as stream:
                for chunk in self.library.get(self.open(), f"{key}/{name}").stream():
                    stream.write(chunk)

        self._tried(copy)

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
            except (FileNotFoundError, self.exists_error):
                raise
            except Exception as error:
                if write_refusal(error) is not None:
                    raise
                if time.monotonic() - began > PATIENCE_S or _is_final(error):
                    raise V2PError(
                        f"the store {self.url} does not answer ({_short(error)}); what is "
                        "finished is kept, and the same "
                        "command goes on with it when the store is back"
                    ) from error
                logger.warning(
                    "the store %s does not answer (%s); trying again", self.url, _short(error)
                )
                time.sleep(pause)
                pause = min(2 * pause, LONGEST_PAUSE_S)
            else:
                return got

    def _demand_mounted(self) -> None:
        if self.folder is not None and not (self.folder / MARK).exists():
            raise ConnectionError(f"there is no {self.folder / MARK}; is the disk mounted?")


@functools.cache
def open_store(url: str) -> Store:
    """Return the store of this process at a URL."""
    return Store(url)


def key_of(folder: Path) -> str:
    """Return what a result's folder is called in the store."""
    return f"{folder.parent.name}/{folder.name}"


def _is_final(error: Exception) -> bool:
    return type(error).__name__ in ("PermissionDeniedError", "UnauthenticatedError")


def _short(error: BaseException) -> str:
    return (str(error).splitlines() or [type(error).__name__])[0][:200]

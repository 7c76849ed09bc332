"""Several drivers at one store: who makes what, by leases that end with their driver.

A lease is an object that its driver created first: STAGE/ITEM-FINGERPRINT.NUMBER below `leases/`.
    It holds while its driver
gives signs of life, an object that changes four times within `lease_s`. Whoever sees no change for `lease_s` by its own
clock takes the lease over by creating the next number, so that no two clocks are compared and one driver wins.
"""

import contextlib
import hashlib
import itertools
import json
import platform
import re
import threading
import time
import uuid
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from types import TracebackType
from typing import Literal

from v2p_data.errors import UnusableError, V2PError
from v2p_data.pipeline.runner import Outcome, Runtime, Stage, outcome_of, stored_outcome
from v2p_data.pipeline.store import Store, key_of, open_store

BEATS = 4
"""Signs of life within `lease_s`."""
POLL_S = 2.0
"""A stage that somebody else makes is asked for so often, and ten times within a short `lease_s`."""
FREE = b"free"
"""Content of a lease that was given back with nothing made."""


class Shared:
    """A driver's part in a run that others may share; without a store everything is its own.

    Use as a context manager.
    """

    def __init__(self, runtime: Runtime) -> None:
        self.root, self.lease_s = runtime.root, runtime.lease_s
        self.store: Store | None = open_store(runtime.store) if runtime.store else None
        self.held: dict[str, str] = {}
        self.seen: dict[str, tuple[bytes | None, float]] = {}
        self.asked: dict[str, float] = {}
        self.over = threading.Event()

    def __enter__(self) -> "Shared":
        if self.store is not None:
            self.store.begin()
            self.owner = _owner_of(self.root)
            self.heart = threading.Thread(target=self._live, args=(self.store,), daemon=True)
            self._beat(self.store, 0)
            self.heart.start()
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        if self.store is None:
            return
        self.over.set()
        self.heart.join(self.lease_s)
        with contextlib.suppress(V2PError, OSError):  # they end by themselves
            for lease in self.held.values():
                self.store.write(lease, FREE)
            self.store.delete(f"drivers/{self.owner}.json")

    def stored(self, stage: Stage) -> Outcome | None:
        """Return the outcome of a stage that is complete, here or in the store.

        None if it has still to run or to be published.
        """
        here = stored_outcome(stage, self.root)
        if self.store is None or (here is not None and here.status == "failed"):
            return here
        if here is not None:
            return here if self.store.has(key_of(here.folder)) else None
        return self._theirs(self.store, stage)

    def claim(self, stage: Stage) -> Literal["ours"] | Outcome | None:
        """Return `ours` if we may make a stage now, its outcome if another driver made it, None while one is at it."""
        if self.store is None:
            return "ours"
        key = key_of(stage.folder(self.root))
        if time.monotonic() < self.asked.get(key, 0.0):
            return None
        self.asked[key] = time.monotonic() + min(POLL_S, self.lease_s / 10)
        if not self._claim(self.store, key):
            return None
        theirs = self._theirs(self.store, stage)
        if theirs is not None:
            self.ended(stage)
        return theirs or "ours"

    def ended(self, stage: Stage) -> None:
        """Give a stage's lease back."""
        if self.store is None:
            return
        key = key_of(stage.folder(self.root))
        if lease := self.held.pop(key, None):
            if self.store.has(key):
                self.store.delete(lease)
            else:
                self.store.write(lease, FREE)

    def fetch_all(self, stages: Sequence[Stage], outcomes: dict[tuple[str, str], Outcome]) -> None:
        """Bring here what others made, so that the run folder is whole; what is damaged becomes a failure."""
        if self.store is None:
            return
        for stage in stages:
            outcome = outcomes[(stage.name, stage.folder_name)]
            if outcome.status in ("failed", "blocked"):
                continue
            try:
                self.store.fetch(outcome.folder, self.root)
            except UnusableError as error:
                outcomes[(stage.name, stage.folder_name)] = replace(
                    outcome, status="failed", reason=error.reason, detail=error.detail
                )

    def _theirs(self, store: Store, stage: Stage) -> Outcome | None:
        key = key_of(stage.folder(self.root))
        return outcome_of(stage, self.root, lambda: store.record(key))

    def _claim(self, store: Store, key: str) -> bool:
        for number in itertools.count(1):
            lease = f"leases/{key}.{number}"
            holder = store.read(lease)
            if holder is None:
                if store.create(lease, self.owner.encode()):
                    self.held[key] = lease
                break
            if holder != FREE and not re.fullmatch(rb"[0-9a-f]{12}", holder):
                raise V2PError(
                    f"{store.folder / lease} names no driver; delete that file and run the same command again"
                )
            # Our own is of a run that was killed.
            if holder not in (FREE, self.owner.encode()) and not self._is_dead(
                store, holder.decode()
            ):
                break
        return key in self.held

    def _is_dead(self, store: Store, owner: str) -> bool:
        """Return whether a driver has given no sign of life while we looked on for `lease_s`."""
        sign = store.read(f"drivers/{owner}.json")
        if owner not in self.seen or self.seen[owner][0] != sign:
            self.seen[owner] = (sign, time.monotonic())
        return time.monotonic() - self.seen[owner][1] > self.lease_s

    def _live(self, store: Store) -> None:
        for beat in itertools.count(1):
            if self.over.wait(self.lease_s / BEATS):
                return
            with contextlib.suppress(V2PError, OSError):  # the driver's own calls say it
                self._beat(store, beat)

    def _beat(self, store: Store, beat: int) -> None:
        sign = {"beat": beat, "host": platform.node(), "time": time.time()}
        store.write(f"drivers/{self.owner}.json", json.dumps(sign).encode())


def _owner_of(root: Path) -> str:
    """Return the name of a run folder's driver: a killed one finds its leases again, a copied folder has another."""
    root.mkdir(parents=True, exist_ok=True)
    place, stat = str(root.resolve()), root.stat()
    known = [platform.node(), uuid.getnode(), place, stat.st_dev, stat.st_ino]
    return hashlib.sha256(json.dumps(known).encode()).hexdigest()[:12]

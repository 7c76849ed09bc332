"""Run stages: what is complete is kept, what is missing is made, what failed blocks only what needs it.

Jobs run in worker processes, so that a crash in a decoder or a simulator is that job's own result.
"""

import contextlib
import functools
import logging
import os
import shutil
import time
import traceback
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Literal

from v2p_data.errors import ItemRejectedError, UnusableError, V2PError, write_refusal
from v2p_data.pipeline.artifact import (
    RECORD_FILE,
    TRACEBACK_FILE,
    Record,
    commit_folder,
    demand_whole,
    own_command,
    provenance,
    read_record,
    write_record,
)
from v2p_data.pipeline.contents import damaged, list_files, memory_of, remember_made
from v2p_data.pipeline.fingerprint import canonical, fingerprint
from v2p_data.pipeline.store import open_store

logger = logging.getLogger(__name__)

Status = Literal["kept", "made", "rejected", "failed", "blocked"]
Progress = Callable[[float, str], None]
"""Called with the share that is done (0 to 1) and a few words."""


@dataclass(frozen=True, kw_only=True)
class Runtime:
    """How a stage runs; never part of what its result is."""

    root: Path
    device: str = "cpu"
    num_threads: int = 1
    """Threads one job may use."""
    workers: int = 1
    """Jobs at the same time; 0 on a cluster: as many as keep it busy."""
    engine: Literal["local", "ray"] = "local"
    """Where jobs run: processes of this machine, or tasks of a Ray cluster."""
    address: str = "auto"
    """Of the cluster."""
    store: str = ""
    """Folder or URL where finished results are shared; empty: nowhere."""
    lease_s: float = 60.0
    """A driver without a sign of life for so long is taken for dead by the others."""
    limit_s: float = 0.0
    """A job that takes longer is ended, and has failed; 0: it may take any time."""
    progress: Progress = field(default=lambda share, words: None)


Make = Callable[[Any, Mapping[str, Path], Path, Runtime], dict[str, Any] | None]
"""`make(config, inputs, out, runtime)` fills the folder `out` and returns counts for the record."""


@dataclass(frozen=True, kw_only=True)
class Stage:
    """One result to be had: its recipe, its inputs and the function that makes it."""

    name: str
    item: str
    config: Any
    inputs: Mapping[str, "Stage"] = field(default_factory=dict[str, "Stage"])
    sources: Mapping[str, str] = field(default_factory=dict[str, str])
    """Digests of outside files that the result depends on."""
    version: int = 1
    """Raised by hand when the code means something new; a hash over the recipe does not see code."""
    make: Make
    resumes: bool = False
    """The function goes on in a half-finished folder; otherwise it starts anew."""
    on_device: bool = False
    """The function works on the device; on a cluster it then takes one GPU."""

    @property
    def recipe(self) -> dict[str, Any]:
        return {
            "stage": self.name,
            "item": self.item,
            "version": self.version,
            "config": canonical(self.config),
            "inputs": {k: s.folder_name for k, s in sorted(self.inputs.items())},
            "sources": dict(sorted(self.sources.items())),
        }

    @functools.cached_property
    def fingerprint(self) -> str:
        return fingerprint(self.recipe)

    @property
    def folder_name(self) -> str:
        return f"{self.item}-{self.fingerprint}"

    def folder(self, root: Path) -> Path:
        """Return where the result lies under `root`."""
        return root / self.name / self.folder_name


@dataclass(frozen=True, kw_only=True)
class Outcome:
    """What became of one stage."""

    stage: str
    item: str
    status: Status
    folder: Path
    seconds: float = 0.0
    reason: str = ""
    detail: str = ""

    @property
    def is_usable(self) -> bool:
        return self.status in ("kept", "made")


def stored_outcome(stage: Stage, root: Path) -> Outcome | None:
    """Return the outcome of a complete stage, None if it has still to run.

    What is damaged has failed: it is neither used nor deleted.
    """
    if not os.access(f"{root}/{stage.name}/{stage.folder_name}", os.F_OK):
        return None  # asked without a `Path`, of which Python 3.12 keeps every part for ever
    folder = stage.folder(root)

    def whole_record() -> Record | None:
        record = read_record(folder)
        is_empty = not folder.exists() or (folder.is_dir() and not any(folder.iterdir()))
        if record is None and not is_empty:
            raise damaged(folder, f"{folder / RECORD_FILE} is missing")
        return record

    return outcome_of(stage, root, whole_record)


def outcome_of(stage: Stage, root: Path, read: Callable[[], Record | None]) -> Outcome | None:
    """Return the outcome that a stage's record tells, None where there is no record.

    Args:
        stage: the stage.
        root: the run folder.
        read: returns the record, or raises `UnusableError`, which is a failure.
    """
    folder = stage.folder(root)
    try:
        record = read()
        if record is None:
            return None
        if record.fingerprint != stage.fingerprint:
            raise damaged(folder, f"{folder / RECORD_FILE} is of another result")
        demand_whole(folder, root)
    except UnusableError as error:
        return Outcome(
            stage=stage.name,
            item=stage.item,
            status="failed",
            folder=folder,
            reason=error.reason,
            detail=error.detail,
        )
    rejected = record.rejected or {}
    return Outcome(
        stage=stage.name,
        item=stage.item,
        status="rejected" if rejected else "kept",
        folder=folder,
        seconds=record.seconds,
        reason=str(rejected.get("reason", "")),
        detail=str(rejected.get("detail", "")),
    )


def make_stage(stage: Stage, runtime: Runtime) -> Outcome:
    """Make one result whose inputs are complete, and write its record last.

    The inputs are compared with what their records list. A rejected item gets a folder with a
    record too, so that running again does not try it again. With a store, inputs that are not here
    are fetched, and the result is published.
    """
    folder = stage.folder(runtime.root)
    partial = folder.with_name(folder.name + ".partial")
    started = time.monotonic()
    is_begun = False
    try:
        if runtime.store and (here := stored_outcome(stage, runtime.root)) is not None:
            return _published(here, runtime)  # made before, while the store was away
        if runtime.store:
            _fetch_inputs(stage, runtime)
        if partial.exists() and not stage.resumes:
            shutil.rmtree(partial)
        partial.mkdir(parents=True, exist_ok=True)
        is_begun = True
        return _published(_made(stage, runtime, partial, folder, started), runtime)
    except Exception as error:  # noqa: BLE001 - whatever a stage raises is its own result
        reason, detail = _why(error, partial)
        if is_begun and not partial.exists() and not folder.exists():
            reason = "error"
            detail = f"{partial} was deleted while it was being filled; run the same command again"
        return Outcome(
            stage=stage.name,
            item=stage.item,
            status="failed",
            folder=folder,
            seconds=time.monotonic() - started,
            reason=reason,
            detail=detail,
        )


def _fetch_inputs(stage: Stage, runtime: Runtime) -> None:
    """Bring all that a stage comes from into the run folder: histories and packing look beyond its own inputs."""
    for needed in in_order(list(stage.inputs.values())):
        if not open_store(runtime.store).fetch(needed.folder(runtime.root), runtime.root):
            raise V2PError(
                f"{needed.name} of {needed.item} is neither in {runtime.root} nor in "
                f"{runtime.store}; run the same command "
                "again where it was made"
            )


def _published(outcome: Outcome, runtime: Runtime) -> Outcome:
    if runtime.store and outcome.status != "failed":
        open_store(runtime.store).publish(outcome.folder)
    return outcome


def _why(error: Exception, partial: Path) -> tuple[str, str]:
    """Return the reason and the sentence of a failure; what is no sentence leaves its traceback in the folder."""
    if isinstance(error, V2PError):
        return error.reason if isinstance(error, UnusableError) else "error", str(error)
    if (refusal := write_refusal(error)) is not None:
        return "error", f"cannot write {partial}: {refusal}, and run the same command again"
    logger.exception("making %s failed", partial)
    said = str(error)
    with contextlib.suppress(OSError):
        told = traceback.format_exc().encode(errors="backslashreplace")
        (partial / TRACEBACK_FILE).write_bytes(told)
        said += f" (traceback in {partial / TRACEBACK_FILE})"
    return type(error).__name__, said


def _made(stage: Stage, runtime: Runtime, partial: Path, folder: Path, started: float) -> Outcome:
    inputs = {name: source.folder(runtime.root) for name, source in stage.inputs.items()}
    rejected: dict[str, Any] | None = None
    counts: dict[str, Any] = {}
    status: Status = "made"
    reason = detail = ""
    try:
        for source in inputs.values():
            demand_whole(source, runtime.root)
        counts = stage.make(stage.config, inputs, partial, runtime) or {}
    except ItemRejectedError as error:
        rejected = {"reason": error.reason, "detail": error.detail, "value": error.value}
        status, reason, detail = "rejected", error.reason, error.detail
    seconds = time.monotonic() - started
    (partial / TRACEBACK_FILE).unlink(missing_ok=True)  # of an earlier try
    files = list_files(partial)
    write_record(
        partial,
        Record(
            stage=stage.name,
            item=stage.item,
            version=stage.version,
            fingerprint=stage.fingerprint,
            recipe=stage.recipe,
            inputs={name: source.folder_name for name, source in stage.inputs.items()},
            seconds=round(seconds, 2),
            rejected=rejected,
            counts=counts,
            provenance=provenance() | {"argv": own_command()},
            files=files,
        ),
    )
    commit_folder(partial, folder)
    if (memory := memory_of(folder, runtime.root)) is not None:
        remember_made(folder, files, memory)
    return Outcome(
        stage=stage.name,
        item=stage.item,
        status=status,
        folder=folder,
        seconds=seconds,
        reason=reason,
        detail=detail,
    )


def in_order(stages: Sequence[Stage]) -> Iterator[Stage]:
    """Yield the stages and everything they need, each once, inputs before what needs them."""
    seen: set[tuple[str, str]] = set()

    def visit(stage: Stage) -> Iterator[Stage]:
        key = (stage.name, stage.folder_name)
        if key in seen:
            return
        seen.add(key)
        for needed in stage.inputs.values():
            yield from visit(needed)
        yield stage

    for stage in stages:
        yield from visit(stage)


def blocked_by(stage: Stage, outcomes: Mapping[tuple[str, str], Outcome]) -> Outcome | None:
    """Return the outcome that keeps this stage from running, if there is one."""
    for needed in stage.inputs.values():
        outcome = outcomes.get((needed.name, needed.folder_name))
        if outcome is not None and not outcome.is_usable:
            return outcome
    return None

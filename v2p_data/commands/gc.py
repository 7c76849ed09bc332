"""What can be deleted of a run folder, and what it would cost to make again."""

import re
import shutil
from dataclasses import dataclass
from pathlib import Path

from v2p_data.cli import parse
from v2p_data.commands.display import STAGE_ORDER
from v2p_data.commands.status import Shown, run_folder
from v2p_data.errors import UnusableError, V2PError
from v2p_data.json_files import json_or_none
from v2p_data.pipeline.artifact import RECORD_FILE, Record, read_record
from v2p_data.pipeline.contents import damages
from v2p_data.pipeline.run_file import RUN_FILE
from v2p_data.pipeline.store import FETCHING_FOLDER, MARK, key_of
from v2p_data.pipeline.workers import only_run_in
from v2p_data.report.reading import PARTIAL_SUFFIX

FINAL = ("dataset", "policy", "evaluation")
"""Stages whose results are wanted for themselves."""
OWN_NAME = re.compile(r".+-[0-9a-f]{8}(\.partial)?")
"""Of folders that stages make."""
FETCHED_NAME = re.compile(OWN_NAME.pattern + r"|tmp\w{8}")
"""Of folders below `.fetching`: what `tempfile` calls them, and what a killed `gc` was about to delete."""


@dataclass(frozen=True, kw_only=True)
class Gc(Shown):
    delete: bool = False
    """Delete what is listed; otherwise it is only listed."""


@dataclass(frozen=True, kw_only=True)
class Waste:
    """A folder that nothing needs."""

    folder: Path
    why: str
    seconds: float
    """What making it took."""

    @property
    def size(self) -> int:
        return sum(p.stat().st_size for p in self.folder.rglob("*") if p.is_file())


def gc_command(argv: list[str]) -> int:
    args = parse(Gc, argv, "gc")
    run = run_folder(args.run)
    if (run / MARK).exists():
        raise V2PError(
            f"{run} is a store that other drivers may be using; give the folder of a run"
        )
    fetching = run / FETCHING_FOLDER
    if fetching.is_symlink() or (fetching.exists() and not fetching.is_dir()):
        raise V2PError(f"{fetching} is no folder, which no run makes; remove it")
    with only_run_in(run):
        found = wastes(run)
        if not found:
            print(f"Nothing in {run} can be deleted without a loss")  # noqa: T201
            return 0
        print(f"{'MB':>10}  {'seconds':>8}  folder")  # noqa: T201
        for waste in found:
            name = waste.folder.relative_to(run)
            print(f"{waste.size / 1e6:10.1f}  {waste.seconds:8.0f}  {name}  ({waste.why})")  # noqa: T201
        total, seconds = sum(w.size for w in found), sum(w.seconds for w in found)
        for waste in found if args.delete else ():
            # Moved away first: half a folder would count as damaged.
            gone = fetching / waste.folder.name
            gone.parent.mkdir(exist_ok=True)
            shutil.rmtree(waste.folder.rename(gone) if waste.folder != gone else gone)
    does = "Deleted" if args.delete else "Could delete"
    print(  # noqa: T201
        f"\n{does} {len(found)} folders, {total / 1e6:.1f} MB; to make them again takes {seconds:.0f} s\n"
        f"Next: v2p {'status' if args.delete else 'gc --delete'} {run}"
    )
    return 0


def wastes(run: Path) -> list[Waste]:
    """Return unfinished work, and results that no dataset, policy, evaluation or rejection came from.

    What the last command asked for is needed too, and without a final result everything finished is. Links, folders
    that are not named like a result, and results in which somebody added or edited a file are nobody's waste.
    """
    folders = [folder for stage in STAGE_ORDER for folder in _folders(run / stage, OWN_NAME)]
    records = {f.name: record for f in folders if (record := _record_of(f)) is not None}
    asked = json_or_none(run / RUN_FILE)
    needed = {str(entry.get("folder")) for entry in (asked if isinstance(asked, list) else [])}
    needed |= {name for name, r in records.items() if r.stage in FINAL or r.rejected}
    todo = list(needed)
    while todo:
        if (record := records.get(todo.pop())) is not None:
            dataset = record.recipe.get("sources", {}).get("dataset")
            new = {*record.inputs.values(), *([dataset] if dataset else [])} - needed
            needed |= new
            todo += new
    is_final = any(record.stage in FINAL for record in records.values())
    found = [
        Waste(folder=f, why="half fetched", seconds=0.0)
        for f in _folders(run / FETCHING_FOLDER, FETCHED_NAME)
    ]
    for folder in folders:
        record = records.get(folder.name)
        if folder.suffix == PARTIAL_SUFFIX and not (folder / RECORD_FILE).exists():
            found.append(Waste(folder=folder, why="unfinished", seconds=0.0))
        elif is_final and record and folder.name not in needed and _is_as_made(folder, record):
            found.append(Waste(folder=folder, why="nothing came of it", seconds=record.seconds))
    return found


def _folders(place: Path, names: re.Pattern[str]) -> list[Path]:
    """Return the folders of these names in a place, none of which is reached by a link."""
    found = () if place.is_symlink() else sorted(place.glob("*"))
    return [f for f in found if names.fullmatch(f.name) and f.is_dir() and not f.is_symlink()]


def _record_of(folder: Path) -> Record | None:
    """Return the record of a finished result; what is damaged is for `v2p status`."""
    try:
        return None if folder.suffix == PARTIAL_SUFFIX else read_record(folder)
    except UnusableError:
        return None


def _is_as_made(folder: Path, record: Record) -> bool:
    """Return whether a result bears its own name and holds the files of its record alone, with equal contents."""
    held = [p for p in folder.rglob("*") if p.is_symlink() or not p.is_dir()]
    files = record.files or {}
    own_name = f"{record.stage}/{record.item}-{record.fingerprint}"
    return (
        key_of(folder) == own_name
        and not any(p.is_symlink() for p in held)
        and {p.relative_to(folder).as_posix() for p in held} <= {*files, RECORD_FILE}
        and not damages(folder, files)
    )

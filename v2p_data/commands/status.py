"""Commands that show what a run made."""

import json
from collections import defaultdict
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

import tyro

from v2p_data.cli import parse
from v2p_data.commands.display import STAGE_ORDER, telling
from v2p_data.commands.progress import progress_of
from v2p_data.errors import UnusableError, V2PError
from v2p_data.json_files import json_or_none
from v2p_data.pipeline.artifact import RECORD_FILE, read_record
from v2p_data.pipeline.contents import damaged, damages, demand_no
from v2p_data.pipeline.run_file import RUN_FILE
from v2p_data.report.reading import PARTIAL_SUFFIX

Row = tuple[str, str, str, str]
"""Stage, item, what became of it, more."""
MANY = 50
"""A stage with more results is told by kinds of them."""


@dataclass(frozen=True, kw_only=True)
class Shown:
    run: tyro.conf.Positional[Path]
    """Run folder, the --out of an earlier command."""


@dataclass(frozen=True, kw_only=True)
class Status(Shown):
    check: bool = False
    """Read every file and compare it with its digest; otherwise only sizes are looked at."""
    json: bool = False
    """Print how far the run's last command is, and what failed, as JSON for machines; this looks at no result."""


def status_command(argv: list[str]) -> int:
    """Return 0; with `--check` 1 where something is damaged."""
    args = parse(Status, argv, "status")
    run = run_folder(args.run)
    if args.json:
        failures = [
            dict(zip(("stage", "item", "state", "why"), row, strict=True))
            for row in _failures(run)
        ]
        print(json.dumps(progress_of(run) | {"failures": failures}, indent=1))  # noqa: T201
        return 0
    rows = [
        row
        for stage in STAGE_ORDER
        for folder in sorted((run / stage).glob("*"))
        if folder.is_dir() and (row := _row(stage, folder, check=args.check)) is not None
    ]
    num_damaged = sum(state == "damaged" for _, _, state, _ in rows)
    rows += _failures(run)
    shown = list(_gathered(rows))
    widths = [max((len(row[i]) for row in shown), default=0) for i in range(3)]
    for row in shown:
        print("  ".join(word.ljust(w) for word, w in zip(row, [*widths, 0], strict=True)).rstrip())  # noqa: T201
    note = f", {num_damaged} of them damaged" if num_damaged else ""
    print(f"\n{len(rows)} results in {run}{note}\nNext: v2p report {run}")  # noqa: T201
    return 1 if args.check and num_damaged else 0


def report_command(argv: list[str]) -> int:
    from v2p_data.report.page import write_page

    with telling("report"):
        page = write_page(run_folder(parse(Shown, argv, "report").run))
    print(f"Made {page}, {page.stat().st_size / 1e6:.1f} MB\nNext: open it in a browser")  # noqa: T201
    return 0


def _row(stage: str, folder: Path, *, check: bool) -> Row | None:
    """Return a folder's line; None for an empty one."""
    if folder.suffix == PARTIAL_SUFFIX:
        return stage, folder.stem, "unfinished", "the same command goes on with it"
    item = folder.name.rpartition("-")[0] or folder.name
    try:
        record = read_record(folder)
        if record is None:
            if not any(folder.iterdir()):
                return None
            raise damaged(folder, f"{folder / RECORD_FILE} is missing")
        demand_no(damages(folder, record.files or {}, sizes_only=not check), folder)
    except UnusableError as error:
        return stage, item, error.reason.replace("_", " "), error.detail
    except OSError as error:
        return stage, item, "damaged", f"{folder} cannot be read ({error.strerror})"
    if record.rejected:
        return (
            stage,
            record.item,
            "rejected",
            f"{record.rejected.get('reason')}: {record.rejected.get('detail')}",
        )
    counts = ", ".join(
        f"{k} {v}" for k, v in record.counts.items() if isinstance(v, int | float | str)
    )
    return stage, record.item, f"{record.seconds:.0f} s", counts


def _gathered(rows: Sequence[Row]) -> Iterator[Row]:
    """Yield the rows; of a stage with many, one for all that were made, and one for many that failed alike."""
    stages: dict[str, list[Row]] = defaultdict(list)
    for row in rows:
        stages[row[0]].append(row)
    for stage, of_stage in stages.items():
        if len(of_stage) <= MANY:
            yield from of_stage
            continue
        alike: dict[str, list[Row]] = defaultdict(list)
        for row in of_stage:
            is_made = row[2].endswith(" s")
            alike["made" if is_made else f"{row[2]}: {row[3].partition(':')[0]}"].append(row)
        for state, group in alike.items():
            if state == "made" or len(group) > MANY:
                example = "" if state == "made" else f"e.g. {group[0][1]}"
                yield stage, f"{len(group)} items", state, example
            else:
                yield from group


def _failures(run: Path) -> Iterator[Row]:
    """Yield what the last command could not make; damage is told of each folder already."""
    path = run / RUN_FILE
    if not path.exists(follow_symlinks=False):
        return
    outcomes = json_or_none(path)
    if not isinstance(outcomes, list) or not all(isinstance(o, dict) for o in outcomes):
        yield "run", RUN_FILE, "damaged", f"{path} cannot be read; the next command writes it anew"
        return
    for outcome in outcomes:
        if outcome.get("status") == "failed" and outcome.get("reason") not in (
            "damaged",
            "newer_version",
        ):
            words = (outcome.get(key) for key in ("stage", "item", "reason", "detail"))
            stage, item, reason, detail = map(str, words)
            yield stage, item, "failed", f"{reason}: {detail}"


def run_folder(run: Path) -> Path:
    if not any((run / stage).is_dir() for stage in STAGE_ORDER):
        raise V2PError(f"{run} is no run folder: it holds none of {', '.join(STAGE_ORDER)}")
    return run

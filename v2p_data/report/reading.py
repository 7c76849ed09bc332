"""What a run's folders say: the newest result per stage and item, what failed, what was dropped, and the time.

Nothing here trusts a file to be whole: a run may be young, killed or edited. What cannot be read is named.
"""

import csv
import math
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Literal

import numpy as np

from policies.evaluation.rate import Rate
from v2p_data.errors import UnusableError
from v2p_data.json_files import MAX_BYTES, json_or_none
from v2p_data.pipeline.artifact import RECORD_FILE, Record, read_record, read_rejects
from v2p_data.pipeline.contents import damages
from v2p_data.pipeline.run_file import RUN_FILE

ITEM_STAGES = ("scene", "task", "reward", "expert", "episodes")
"""Stages that each video goes through by itself."""
JOINT_STAGES = ("dataset", "distillation", "policy", "evaluation")
STAGES = ITEM_STAGES + JOINT_STAGES
PARTIAL_SUFFIX = ".partial"
MAX_SIZE = 1e30
"""Numbers beyond it are treated as not finite: charts subtract them from each other."""

Status = Literal["made", "rejected", "failed", "unfinished", "not run"]
Key = tuple[str, str]
"""Stage and item."""


@dataclass(frozen=True, kw_only=True)
class Result:
    """What became of one item in one stage."""

    stage: str
    item: str
    status: Status
    folder: Path
    record: Record | None = None
    reason: str = ""
    detail: str = ""

    @property
    def seconds(self) -> float | None:
        return None if self.record is None else number(self.record.seconds)

    @property
    def counts(self) -> dict[str, Any]:
        return {} if self.record is None else self.record.counts


@dataclass(frozen=True, kw_only=True)
class Run:
    """A run folder as far as it can be read."""

    root: Path
    results: dict[Key, Result]
    unreadable: list[str] = field(default_factory=list[str])
    """One sentence for each record that could not be read, and each file that is missing or of another size."""

    @property
    def items(self) -> list[str]:
        """Names of the videos' items, in order."""
        return sorted({item for stage, item in self.results if stage in ITEM_STAGES})

    def get(self, stage: str, item: str) -> Result | None:
        """Return what became of an item in a stage, None if it never got there."""
        return self.results.get((stage, item))

    def of_stage(self, stage: str) -> list[Result]:
        """Return a stage's results, sorted by item."""
        return [r for (s, _), r in sorted(self.results.items()) if s == stage]

    def made(self, stage: str) -> list[Result]:
        """Return a stage's usable results."""
        return [r for r in self.of_stage(stage) if r.status == "made"]


def read_run(root: Path) -> Run:
    """Return a run's complete results, and what failed or is unfinished where there is none.

    Of several the one that the last command made or kept counts, else the newest.
    """
    results: dict[Key, Result] = {}
    ages: dict[Key, tuple[bool, str, float]] = {}
    outcomes, is_whole = _outcomes(root)
    unreadable = (
        [] if is_whole else [f"{root / RUN_FILE} is damaged; the next command writes it anew"]
    )
    # The folders of what the last command made, kept or turned away.
    asked = {
        (str(o["stage"]), str(o["item"])): Path(str(o.get("folder", ""))).name for o in outcomes
    }
    for stage in STAGES:
        for folder, record in records_in(root, stage):
            if isinstance(record, str):
                unreadable.append(record)
                continue
            unreadable += [
                f"{d.path} {d.what}" for d in damages(folder, record.files or {}, sizes_only=True)
            ]
            key = (stage, str(record.item))
            age = (
                folder.name == asked.get(key),
                str((record.provenance or {}).get("time", "")),
                (folder / RECORD_FILE).stat().st_mtime,
            )
            if key not in ages or age > ages[key]:
                ages[key] = age
                results[key] = _from_record(stage, folder, record)
    for result in (*_unfinished(root, outcomes), *_from_partials(root)):
        results.setdefault((result.stage, result.item), result)
    return Run(root=root, results=results, unreadable=unreadable)


def records_in(root: Path, stage: str) -> Iterator[tuple[Path, Record | str]]:
    """Yield each finished folder of a stage with its record, or with a sentence on why it cannot be read."""
    for folder in sorted(_folders(root / stage)):
        if folder.suffix == PARTIAL_SUFFIX or not any(folder.iterdir()):
            continue
        try:
            yield folder, read_record(folder) or f"{folder / RECORD_FILE} is missing"
        except UnusableError as error:
            yield folder, error.detail


@dataclass(frozen=True, kw_only=True)
class Dropped:
    """Things of one kind that a stage left out for one reason."""

    stage: str
    item: str
    what: str
    reason: str
    count: int
    numbers: str
    """The values that decided, from lowest to highest."""
    detail: str
    """One example in words."""


def dropped(run: Run) -> list[Dropped]:
    """Return everything a run rejected: whole items first, then their parts grouped by reason."""
    rows = [
        Dropped(
            stage=r.stage,
            item=r.item,
            what="video" if r.stage == "scene" else r.stage,
            reason=r.reason,
            count=1,
            numbers=span([(r.record.rejected or {}).get("value")] if r.record else []),
            detail=r.detail,
        )
        for r in run.results.values()
        if r.status in ("rejected", "failed")
    ]
    for result in run.results.values():
        try:
            rejects = read_rejects(result.folder)
        except (ValueError, OSError):
            continue
        by_reason: dict[str, list[Mapping[str, Any]]] = {}
        for reject in rejects:
            if isinstance(reject, dict):
                by_reason.setdefault(str(reject.get("reason", "unknown")), []).append(reject)
        rows += [
            Dropped(
                stage=result.stage,
                item=result.item,
                what="episode" if result.stage == "episodes" else "part",
                reason=reason,
                count=len(group),
                numbers=span(r.get("value") for r in group),
                detail=str(group[0].get("detail") or ""),
            )
            for reason, group in by_reason.items()
        ]
    return rows


def model_use(run: Run) -> dict[str, int]:
    """Return calls of and tokens spent on language models: the sum of all such counts in all records."""
    use = {"calls": 0, "tokens": 0}
    for result in run.results.values():
        for name, value in _leaves(result.counts):
            if name == "model_calls" or name.endswith("_model_calls"):
                use["calls"] += int(value)
            elif name == "tokens" or name.endswith("_tokens"):
                use["tokens"] += int(value)
    return use


def rate_of(data: Any) -> Rate | None:
    """Return a success rate from a record, None if it is not one."""
    if not isinstance(data, Mapping):
        return None
    values = [number(data.get(k)) for k in ("successes", "trials", "low", "high")]
    if any(v is None for v in values) or not values[1]:
        return None
    successes, trials, low, high = (float(v) for v in values if v is not None)
    return Rate(successes=int(successes), trials=int(trials), low=low, high=high)


def read_curve(path: Path) -> dict[str, np.ndarray]:
    """Return a CSV's columns; what is no number is NaN, and a last line that a kill cut short is left out."""
    if not path.is_file() or path.stat().st_size > MAX_BYTES:
        return {}
    with path.open(newline="", errors="replace", encoding="utf-8") as stream:
        head, *rows = [*csv.reader(stream)] or [[]]
    whole = [row for row in rows if len(row) == len(head)]
    return {name: np.array([_float(row[k]) for row in whole]) for k, name in enumerate(head)}


def number(value: Any) -> float | None:
    """Return a finite number, None for anything else."""
    if isinstance(value, bool) or not isinstance(value, int | float) or not abs(value) <= MAX_SIZE:
        return None
    return float(value)


def as_dict(data: Any) -> dict[str, Any]:
    """Return JSON that should be an object, an empty one if it is anything else."""
    return data if isinstance(data, dict) else {}


def as_list(data: Any) -> list[Any]:
    """Return JSON that should be a list, an empty one if it is anything else."""
    return data if isinstance(data, list) else []


def as_dicts(data: Any) -> list[dict[str, Any]]:
    """Return the objects in JSON that should be a list of them."""
    return [row for row in as_list(data) if isinstance(row, dict)]


def span(values: Iterable[Any]) -> str:
    """Return `0.12` or `0.12 to 0.4` for the numbers among the values."""
    numbers = sorted(v for v in map(number, values) if v is not None)
    if not numbers:
        return ""
    low, high = f"{numbers[0]:.3g}", f"{numbers[-1]:.3g}"
    return low if low == high else f"{low} to {high}"


def _from_record(stage: str, folder: Path, record: Record) -> Result:
    rejected = record.rejected or {}
    return Result(
        stage=stage,
        item=str(record.item),
        status="rejected" if rejected else "made",
        folder=folder,
        record=record,
        reason=str(rejected.get("reason", "")),
        detail=str(rejected.get("detail", "")),
    )


def _outcomes(root: Path) -> tuple[list[dict[str, Any]], bool]:
    """Return what became of each result that the last command asked for, and whether all of it can be read."""
    if not (root / RUN_FILE).exists(follow_symlinks=False):
        return [], True
    found = json_or_none(root / RUN_FILE)
    outcomes = as_dicts(found)
    is_whole = isinstance(found, list) and len(outcomes) == len(found)
    return [o for o in outcomes if o.get("stage") in STAGES and "item" in o], is_whole


def _unfinished(root: Path, outcomes: list[dict[str, Any]]) -> list[Result]:
    """Return what the last command could not finish; failures leave no record."""
    words: dict[str, Status] = {"failed": "failed", "blocked": "not run"}
    return [
        Result(
            stage=str(o["stage"]),
            item=str(o["item"]),
            status=words[o["status"]],
            folder=root
            / str(o["stage"])
            / f"{Path(str(o.get('folder', ''))).name}{PARTIAL_SUFFIX}",
            reason=str(o.get("reason", "")),
            detail=str(o.get("detail", "")),
        )
        for o in outcomes
        if o.get("status") in words
    ]


def _from_partials(root: Path) -> list[Result]:
    found: list[Result] = []
    for stage in STAGES:
        for folder in sorted(_folders(root / stage)):
            name, suffix = folder.name.removesuffix(PARTIAL_SUFFIX), folder.suffix
            if suffix != PARTIAL_SUFFIX:
                continue
            trace = folder / "traceback.txt"
            last = (
                trace.read_text(errors="replace", encoding="utf-8").strip().splitlines()[-1:]
                if trace.is_file()
                else []
            )
            found.append(
                Result(
                    stage=stage,
                    item=name.rpartition("-")[0] or name,
                    status="failed" if last else "unfinished",
                    folder=folder,
                    reason="error" if last else "",
                    detail=last[0] if last else "the same command goes on with it",
                )
            )
    return found


def _float(text: str) -> float:
    try:
        value = float(text)
    except ValueError:
        return math.nan
    return value if abs(value) <= MAX_SIZE else math.nan


def _folders(parent: Path) -> list[Path]:
    return [p for p in parent.iterdir() if p.is_dir()] if parent.is_dir() else []


def _leaves(data: Any) -> Iterable[tuple[str, float]]:
    """Yield every named number in nested JSON."""
    if isinstance(data, dict):
        for name, value in data.items():
            if (leaf := number(value)) is not None:
                yield str(name), leaf
            else:
                yield from _leaves(value)
    elif isinstance(data, list):
        for value in data:
            yield from _leaves(value)

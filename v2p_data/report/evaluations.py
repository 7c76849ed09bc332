"""The part of a run's page that says how well a policy does its tasks, and experts and programs beside it."""

import itertools
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from policies.evaluation.rate import Rate
from v2p_data.json_files import json_or_none
from v2p_data.report.media import MediaBudget, Medium, PageConfig, film_uri, picture_uri
from v2p_data.report.reading import Run, as_dict, number, rate_of
from v2p_data.report.sheet import FAILURE, SUCCESS

FILM_SUFFIXES = (".mp4", ".webm", ".mkv", ".avi", ".mov", ".gif")
VIDEOS_FOLDER, SHEET_FILE = "videos", "sheet.png"
POLICY = "policy"


@dataclass(frozen=True, kw_only=True)
class EvaluationRow:
    """One task that somebody was judged in."""

    task: str
    folder: str
    """Name of the task's folder, which ends in what the task came from."""
    judged: str
    """Who: `policy`, `expert` or `programs`."""
    is_seen: bool
    rate: Rate
    """Share of the episodes that succeeded once."""
    at_end: Rate | None
    """Share of the episodes that were a success at their end."""
    failures: list[tuple[str, int]]
    """Kinds of failure, the most frequent first."""
    median_success_s: float | None
    films: list[Medium]
    sheet: Medium | None

    @property
    def is_policy(self) -> bool:
        return self.judged == POLICY


def evaluation_rows(run: Run, cfg: PageConfig, budget: MediaBudget) -> list[EvaluationRow]:
    """Return all judged tasks: the policy's first, those it was trained on before the others."""
    rows: list[EvaluationRow] = []
    for result in run.made("evaluation"):
        data = result.counts.get("rows") or json_or_none(result.folder / "evaluation.json")
        for row in data if isinstance(data, list) else []:
            rate = rate_of(row)
            if rate is None:
                continue
            rows.append(_row(as_dict(row), rate, result.folder, cfg, budget))
    return sorted(rows, key=lambda row: (not row.is_policy, row.judged, not row.is_seen, row.task))


def _row(
    row: dict[str, Any], rate: Rate, folder: Path, cfg: PageConfig, budget: MediaBudget
) -> EvaluationRow:
    task, judged = str(row.get("task", "")), str(row.get("judged", POLICY))
    place = folder / VIDEOS_FOLDER / task
    tries = f"{_who(judged)} tries {task}"
    films = [
        film
        for path in _films(place, folder)[: cfg.max_rollouts_per_task]
        if (
            film := budget.admit(
                film_uri(path, 320, cfg.max_film_frames),
                f"{task}: {path.name}",
                f"{tries}: {path.stem}",
                is_film=True,
            )
        )
    ]
    sheet = None
    if place.resolve().is_relative_to(folder.resolve()):
        sheet = budget.admit(
            picture_uri(place / SHEET_FILE, cfg.sheet_width_px),
            f"contact sheet of {task}",
            f"{tries}: contact sheet, an episode per row, successes first",
        )
    failures = as_dict(row.get("failures"))
    return EvaluationRow(
        task=task,
        folder=str(row.get("folder", "")),
        judged=judged,
        is_seen=bool(row.get("seen")),
        rate=rate,
        at_end=rate_of(row.get("at_end")),
        failures=[(kind, int(count)) for kind, n in failures.items() if (count := number(n))],
        median_success_s=number(row.get("median_success_s")),
        films=films,
        sheet=sheet,
    )


def _who(judged: str) -> str:
    return {POLICY: "The policy", "expert": "The expert"}.get(judged, "A program")


def _films(folder: Path, inside: Path) -> list[Path]:
    """Return a task's films, successes and failures in turn."""
    if not folder.resolve().is_relative_to(inside.resolve()) or not folder.is_dir():
        return []
    found = sorted(p for p in folder.rglob("*") if p.suffix.lower() in FILM_SUFFIXES)
    kinds = [[p for p in found if p.stem.startswith(kind)] for kind in (SUCCESS, FAILURE)]
    in_turn = [p for pair in itertools.zip_longest(*kinds) for p in pair if p is not None]
    return in_turn + [p for p in found if p not in in_turn]

"""The study's results as Markdown: success by arm and N, per object, what failed, and what it took."""

from typing import Any

from paper_tables import lifting_text
from policies.evaluation.rate import Rate

from .config import ARMS
from .fits import (
    by_count,
    failure_counts,
    paired,
    rate,
)

Row = dict[str, Any]
COMPARED = (("videos", "toys"), ("videos", "bc"), ("bc", "paper"))
"""Which arms are compared, from the same starts."""


def table(rows: list[Row]) -> str:
    """Return all tables, one after the other."""
    parts = [rates_table(rows), objects_table(rows), differences_table(rows)]
    return "\n\n".join(
        [p for p in (*parts, failures_table(rows), costs_table(rows), paper_text(rows)) if p]
    )


def is_lifting(rows: list[Row]) -> bool:
    """Tell whether the study asks for what the paper's figures are about; lines without a kind do."""
    return {row.get("kind", "lift_up") for row in rows} == {"lift_up"}


def paper_text(rows: list[Row]) -> str:
    """Return what the paper says of unseen objects; nothing where the study does not lift."""
    return lifting_text() if is_lifting(rows) else ""


def rates_table(rows: list[Row]) -> str:
    """Return success on the unseen objects by arm and N."""
    lines = [
        "| arm | N | unseen, once (95 %) | per seed | new shapes | new categories | at the end | "
        "mean expert | trajectories a task | frames learned |",
        "|---|---|---|---|---|---|---|---|---|---|",
    ]
    for arm in ARMS:
        for n, found in by_count(rows, arm).items():
            seeds = " ".join(f"{r.value:.2f}" for row in found if (r := rate([row])))
            learned = [row["frames"] for row in found if "frames" in row]
            experts = [row["expert"]["mean"] for row in found if "expert" in row]
            lines.append(
                f"| {arm} | {n or '-'} | {_with_interval(rate(found))} | {seeds} | "
                f"{_plain(rate(found, group='shape'))} | "
                f"{_plain(rate(found, group='category'))} | {_plain(rate(found, 'at_end'))} | "
                f"{f'{sum(experts) / len(experts):.0%}' if experts else '-'} | {found[0].get('trajectories', '-')} | "
                f"{f'{sum(learned) / len(learned):,.0f}' if learned else '-'} |"
            )
    return "\n".join(lines)


def objects_table(rows: list[Row]) -> str:
    """Return success per object, each arm at its largest N: the paper's figure 5."""
    columns = {
        arm: (n, cells) for arm in ARMS for n, cells in list(by_count(rows, arm).items())[-1:]
    }
    heads = [arm if not n else f"{arm}, N = {n}" for arm, (n, _) in columns.items()]
    lines = ["| object | kind | " + " | ".join(heads) + " |", "|---|---|" + "---|" * len(heads)]
    for name, judged in rows[0]["objects"].items():
        cells = [
            _plain(rate([{"objects": {name: row["objects"][name]}} for row in found]))
            for _, found in columns.values()
        ]
        lines.append(f"| {name} | new {judged['group']} | " + " | ".join(cells) + " |")
    return "\n".join(lines)


def differences_table(rows: list[Row]) -> str:
    """Return what one arm is worth over another at equal N, from the same starts."""
    lines: list[str] = []
    for ours, others in COMPARED:
        theirs = by_count(rows, others)
        for n, found in by_count(rows, ours).items():
            difference = paired(found, theirs.get(n, []))
            if difference is not None:
                seeds = " ".join(f"{100 * s:+.1f}" for s in difference.seeds)
                lines.append(f"| {ours} - {others} | {n} | {difference} | {seeds} |")
    if not lines:
        return ""
    return "\n".join(
        ["| difference, once | N | mean (95 %) | per seed |", "|---|---|---|---|", *lines]
    )


def failures_table(rows: list[Row]) -> str:
    """Return kinds of failure by arm and N, in episodes."""
    lines = ["| arm | N | episodes | failures |", "|---|---|---|---|"]
    for arm in ARMS:
        for n, found in by_count(rows, arm).items():
            kinds = ", ".join(f"{k} {count}" for k, count in failure_counts(found).items())
            total = rate(found)
            lines.append(
                f"| {arm} | {n or '-'} | {total.trials if total else 0} | {kinds or '-'} |"
            )
    return "\n".join(lines)


def costs_table(rows: list[Row]) -> str:
    """Return what a cell takes by stage, seeds averaged, and how many candidates were needed."""
    stages = (
        "scene",
        "task",
        "expert",
        "episodes",
        "dataset",
        "distillation",
        "policy",
        "judging",
    )
    lines = [
        "| arm | N | candidates tried | rejected | "
        + " | ".join(f"{s}, s" for s in stages)
        + " | all, min |",
        "|---|---|---|---|" + "---|" * (len(stages) + 1),
    ]
    for arm in ARMS:
        for n, found in by_count(rows, arm).items():
            mean = {
                s: sum(row["seconds"].get(s, 0.0) for row in found) / len(found) for s in stages
            }
            reasons: dict[str, int] = {}
            for row in found:
                for why, count in row.get("rejected", {}).items():
                    reasons[why] = reasons.get(why, 0) + count
            tried = " ".join(str(row["tried"]) for row in found if "tried" in row)
            why = ", ".join(f"{k} {c}" for k, c in reasons.items())
            cells = " | ".join(f"{v:,.0f}" for v in mean.values())
            lines.append(
                f"| {arm} | {n or '-'} | {tried or '-'} | {why or '-'} | {cells} | {sum(mean.values()) / 60:.1f} |"
            )
    return "\n".join(lines)


def _with_interval(found: Rate | None) -> str:
    return "-" if found is None else f"{found.value:.1%} ({found.low:.1%}-{found.high:.1%})"


def _plain(found: Rate | None) -> str:
    return "-" if found is None else f"{found.value:.0%}"

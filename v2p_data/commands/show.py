"""Commands that show what a run made."""

import json
from dataclasses import dataclass
from pathlib import Path

import tyro

from v2p_data.cli import parse
from v2p_data.commands.display import STAGE_ORDER
from v2p_data.errors import V2PError
from v2p_data.pipeline.artifact import read_record


@dataclass(frozen=True, kw_only=True)
class Shown:
    run: tyro.conf.Positional[Path]
    """Run folder, the --out of an earlier command."""


def status_command(argv: list[str]) -> int:
    run = _run(parse(Shown, argv, "status").run)
    rows: list[tuple[str, str, str, str]] = []
    for stage in STAGE_ORDER:
        for folder in sorted((run / stage).glob("*")):
            record = read_record(folder)
            if record is not None and record.rejected:
                rows.append((stage, record.item, "rejected", f"{record.rejected['reason']}: {record.rejected['detail']}"))  # fmt: skip
            elif record is not None:
                counts = ", ".join(f"{k} {v}" for k, v in record.counts.items() if isinstance(v, int | float | str))  # fmt: skip
                rows.append((stage, record.item, f"{record.seconds:.0f} s", counts))
            elif folder.suffix == ".partial":
                rows.append((stage, folder.stem, "unfinished", "the same command goes on with it"))
    for outcome in (
        json.loads((run / "run.json").read_text()) if (run / "run.json").is_file() else []
    ):
        if outcome["status"] == "failed":
            rows.append((outcome["stage"], outcome["item"], "failed", f"{outcome['reason']}: {outcome['detail']}"))  # fmt: skip
    widths = [max(len(row[i]) for row in rows) if rows else 0 for i in range(3)]
    for row in rows:
        print("  ".join(word.ljust(w) for word, w in zip(row, [*widths, 0], strict=True)).rstrip())  # noqa: T201
    print(f"\n{len(rows)} results in {run}\nNext: v2p report {run}")  # noqa: T201
    return 0


def report_command(argv: list[str]) -> int:
    from v2p_data.report.page import write_page

    page = write_page(_run(parse(Shown, argv, "report").run))
    print(f"Made {page}, {page.stat().st_size / 1e6:.1f} MB\nNext: open it in a browser")  # noqa: T201
    return 0


def _run(run: Path) -> Path:
    if not any((run / stage).is_dir() for stage in STAGE_ORDER):
        raise V2PError(f"{run} is no run folder: it holds none of {', '.join(STAGE_ORDER)}")
    return run

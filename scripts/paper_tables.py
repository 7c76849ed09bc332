"""What the paper reports, from `docs/paper_tables.json`, where our tables and pages show it beside ours.

python scripts/paper_tables.py            # prints every table of the paper
python scripts/paper_tables.py --write    # puts the paper's figures into our pages
"""

import argparse
import functools
import json
import sys
from collections.abc import Callable
from typing import Any

from results_table import ROOT, with_block

FILE = ROOT / "docs" / "paper_tables.json"
OURS = "Video2Policy"
"""The paper's own method, in its tables."""
LIFTING = "the paper's figures on lifting"
"""Names the marks around `lifting_text` in docs/study_lifting.md."""


@functools.cache
def _paper() -> dict[str, Any]:
    data = json.loads(FILE.read_text(encoding="utf-8"))
    shown = {name: table["rows"] for name, table in (data["tables"] | data["figures"]).items()}
    return shown | {"recipe": {name: fact["value"] for name, fact in data["recipe"].items()}}


def papers_value(where: str) -> Any:
    """Return what the paper prints in one place, of a mean with its deviation the mean.

    Args:
        where: table, figure or `recipe`, then row and column: `table 1/lift_up/Eureka`, `recipe/codes`.

    Raises:
        KeyError: there is no such place.
    """
    found: Any = _paper()
    for part in where.split("/"):
        if not isinstance(found, dict) or part not in found:
            raise KeyError(f"docs/paper_tables.json has no '{part}' of '{where}'")
        found = found[part]
    return found["mean"] if isinstance(found, dict) and "mean" in found else found


def success(task: str, method: str = OURS) -> str:
    """Return the mean success of table 1 as our tables show it; `task` is the name of a benchmark task."""
    return f"{papers_value(f'table 1/{task}/{method}'):.2f}"


def failure(stage: str) -> float:
    """Return the failure rate of table 4 by the name of our stage."""
    models = {
        "grounding": "Grounding DINO",
        "segmentation": "SAM-2",
        "mesh": "InstantMesh",
        "pose": "FoundationPose",
    }
    return papers_value(f"table 4/SSv2 videos/{models[stage]}")


def lifting_text() -> str:
    """Return what the paper says of policies that lift unseen objects."""
    unseen = ", ".join(
        f"{name} {papers_value(f'figure 5/{name}'):.0%}" for name in ("BC-V2P", "CoP", "BC-CoP")
    )
    real = ", ".join(
        f"{name} {value:.0%}" for name, value in papers_value("table 2/success").items()
    )
    return (
        f"Beside them the paper's numbers, of other scenes and another robot: {unseen} on "
        f"{papers_value('recipe/unseen videos')} unseen\n"
        f"lifts after {papers_value('recipe/lifting videos')} tasks (figure 5); on masks "
        f"{papers_value('recipe/success on masks'):.0%} in simulation,"
        f" and on the real robot {real}\n(table 2). Figure 6 rises with the number of tasks; its "
        "values are not in the text."
    )


def with_column(page: str, heading: str, cell: Callable[[str], str]) -> str:
    """Return the page with a column of its first table that has one of this heading.

    Args:
        page: Markdown.
        heading: of the column, in full.
        cell: what to show in a row, by the row's first cell.

    Raises:
        ValueError: no table has such a column.
    """
    lines = page.splitlines(keepends=True)
    heads = [k for k, line in enumerate(lines) if heading in _cells_of(line)]
    if not heads:
        raise ValueError(f"the page has no table with a column '{heading}'")
    column = _cells_of(lines[heads[0]]).index(heading)
    for k in range(heads[0] + 2, len(lines)):
        row = lines[k].split("|")
        if len(row) <= column:
            break
        row[column] = f" {cell(row[1].strip())} "
        lines[k] = "|".join(row)
    return "".join(lines)


def _cells_of(line: str) -> list[str]:
    return [cell.strip() for cell in line.split("|")] if line.startswith("|") else []


PAGES: dict[str, Callable[[str], str]] = {
    "docs/experts.md": lambda page: with_column(page, "paper", success),
    "docs/lab/reconstruction.md": lambda page: with_column(
        page,
        "the paper (20 real videos)",
        lambda stage: f"{failure(stage):.0%}".replace("%", " %"),
    ),
    "docs/study_lifting.md": lambda page: with_block(
        page, LIFTING, lifting_text().replace("%", " %")
    ),
}
"""Pages that show figures of the paper, and how these are put into them."""


def tables() -> str:
    """Return the paper's tables and figures as Markdown."""
    data = json.loads(FILE.read_text(encoding="utf-8"))
    parts: list[str] = []
    for name, table in (data["tables"] | data["figures"]).items():
        note = f" {table['note']}" if "note" in table else ""
        rows = table["rows"]
        if not all(isinstance(row, dict) for row in rows.values()):
            rows = {"": rows}
        columns = list(dict.fromkeys(column for row in rows.values() for column in row))
        lines = ["| |" + "".join(f" {c} |" for c in columns), "|---|" + "---|" * len(columns)]
        lines += [
            f"| {key} |" + "".join(f" {_shown(row.get(c, ''))} |" for c in columns)
            for key, row in rows.items()
        ]
        parts.append(
            f"{name}, section {table['section']}: {table['what']}.{note}\n\n" + "\n".join(lines)
        )
    return "\n\n".join(parts)


def _shown(value: Any) -> str:
    if isinstance(value, dict):
        return f"{value['mean']:.2f} ± {value['std']:.2f}"
    if isinstance(value, list):
        return ", ".join(map(str, value))
    return str(value)


def main() -> None:
    """Print the tables, or write the figures into our pages."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").split("\n")[0])
    parser.add_argument("--write", action="store_true", help=f"into {', '.join(PAGES)}")
    if not parser.parse_args().write:
        print(tables())
        return
    for name, filled in PAGES.items():
        page = ROOT / name
        try:
            page.write_text(filled(page.read_text(encoding="utf-8")), encoding="utf-8")
        except (KeyError, ValueError) as error:
            print(f"error: {name}: {error}", file=sys.stderr)
            sys.exit(2)


if __name__ == "__main__":
    main()

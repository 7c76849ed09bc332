"""Tables of results, made from `docs/results.json`: counts stand there, rates and intervals are computed.

python scripts/results_table.py            # prints the table
python scripts/results_table.py --write    # all results into docs/results.md, the headlines into README.md
"""

import argparse
import json
import sys
from pathlib import Path
from typing import Any

from policies.evaluation.rate import wilson

ROOT = Path(__file__).parents[1]
RESULTS = ROOT / "docs" / "results.json"
README = ROOT / "README.md"
PAGE = ROOT / "docs" / "results.md"


def table(results: list[dict[str, Any]]) -> str:
    """Return the results as a Markdown table, a row each, with Wilson 95 % intervals.

    Args:
        results: `about`, `what`, `successes`, `trials`, `unit`, `seeds`, `hardware` and `command`
            (empty: judged by others) of each.
    """
    rows = [
        "| | what | result, 95 % interval | of | seeds | command |",
        "|---|---|---|---|---|---|",
    ]
    before = ""
    for result in results:
        about = "" if result["about"] == before else f"**{result['about']}**"
        before = result["about"]
        command = f"`{result['command']}`" if result["command"] else "judged by others"
        rows.append(
            f"| {about} | {result['what']} | {_rate(result)} | {result['trials']} "
            f"{result['unit']} | {result['seeds']} | {command} |"
        )
    return "\n".join(rows)


def headlines(results: list[dict[str, Any]]) -> str:
    """Return what the README shows first: the results that have a `headline`."""
    rows = ["| | success, 95 % interval | of |", "|---|---|---|"]
    rows += [
        f"| {result['headline']} | {_rate(result)} | {result['trials']} {result['unit']} |"
        for result in results
        if "headline" in result
    ]
    return "\n".join(rows)


def _rate(result: dict[str, Any]) -> str:
    rate = wilson(result["successes"], result["trials"])
    return f"{100 * rate.value:.0f} % ({100 * rate.low:.0f}-{100 * rate.high:.0f})"


def written_pages() -> dict[Path, str]:
    """Return README and page of results with their tables as `docs/results.json` has them."""
    results = json.loads(RESULTS.read_text(encoding="utf-8"))["results"]
    return {
        PAGE: with_block(PAGE.read_text(encoding="utf-8"), "results", table(results)),
        README: with_block(README.read_text(encoding="utf-8"), "headline", headlines(results)),
    }


def with_block(page: str, name: str, block: str) -> str:
    """Return the page with this text between the two marks of a name.

    Raises:
        ValueError: a mark is missing.
    """
    begin, end = f"<!-- {name}: begin -->", f"<!-- {name}: end -->"
    before, found_begin, rest = page.partition(begin)
    _, found_end, after = rest.partition(end)
    if not found_begin or not found_end:
        raise ValueError(f"the page has no {begin} followed by {end}")
    return f"{before}{begin}\n{block}\n{end}{after}"


def main() -> None:
    """Print the table, or write it into the pages."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").split("\n")[0])
    parser.add_argument("--write", action="store_true", help="write docs/results.md and README.md")
    if not parser.parse_args().write:
        print(table(json.loads(RESULTS.read_text(encoding="utf-8"))["results"]))
        return
    try:
        for page, text in written_pages().items():
            page.write_text(text, encoding="utf-8")
    except ValueError as error:
        print(f"error: {error}", file=sys.stderr)
        sys.exit(2)


if __name__ == "__main__":
    main()

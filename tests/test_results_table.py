"""The README's results are those of `docs/results.json`."""

import json

import pytest

import results_table


def test_the_readme_shows_the_table_of_the_recorded_results():
    rows = results_table.table(json.loads(results_table.RESULTS.read_text())["results"])
    page = results_table.README.read_text()

    assert results_table.with_block(page, results_table.NAME, rows) == page, (
        "run scripts/results_table.py --write"
    )


def test_a_rate_is_shown_with_its_wilson_interval():
    result = {
        "about": "Policy", "what": "lift", "successes": 98, "trials": 100, "unit": "episodes", "seeds": "0",
        "command": "make demo",
    }  # fmt: skip

    (row,) = results_table.table([result]).splitlines()[2:]

    assert row == "| **Policy** | lift | 98 % (93-99) | 100 episodes | 0 | `make demo` |"


def test_a_page_without_marks_is_refused():
    with pytest.raises(ValueError, match="results: begin"):
        results_table.with_block("# A page", "results", "rows")

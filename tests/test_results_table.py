"""README and page of results show what `docs/results.json` holds."""

import pytest

import results_table


def test_readme_and_page_show_the_recorded_results():
    for page, text in results_table.written_pages().items():
        assert page.read_text() == text, "run scripts/results_table.py --write"


def test_a_rate_is_shown_with_its_wilson_interval():
    result = {
        "about": "Policy",
        "what": "lift",
        "successes": 98,
        "trials": 100,
        "unit": "episodes",
        "seeds": "0",
        "command": "make demo",
    }

    (row,) = results_table.table([result]).splitlines()[2:]

    assert row == "| **Policy** | lift | 98 % (93-99) | 100 episodes | 0 | `make demo` |"


def test_a_page_without_marks_is_refused():
    with pytest.raises(ValueError, match="results: begin"):
        results_table.with_block("# A page", "results", "rows")

"""A reward search on the page: whole or half finished, broken or hostile. Real searches are shown in `tests/reward`."""

import json
import os
import runpy
from pathlib import Path

import pytest

from v2p_data.report.page import NO_BREAK
from v2p_data.report.rewards import difference

_page = runpy.run_path(str(Path(__file__).with_name("test_page.py")))
HOSTILE, assert_safe, outline = _page["HOSTILE"], _page["assert_safe"], _page["outline"]
CODE = (
    "def reward_function(actions, states):\n    reach = 1.0\n    return reach, {'reach': reach}\n"
)


class FakeSearch:
    """Writes what a search of four rungs leaves, as far as it is told to come."""

    def __init__(self, run, item="lift_mug") -> None:
        self.run = run
        self.stage = run.folder("reward", item)
        self.folder = self.stage / "search"
        self.rows: list[dict] = []
        self.found: dict | None = None
        self.save()

    def write(self, name: str, data) -> None:
        path = self.folder / name
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(json.dumps(data))

    def save(self) -> None:
        self.write(
            "search.json",
            {
                "title": "lift",
                "rungs": [0.1, 0.2, 0.4, 1.0],
                "candidates": self.rows,
                "found": self.found,
            },
        )

    def candidate(
        self, successes=(), iteration=0, why="", code=CODE, origin="template", **more
    ) -> None:
        number = len(self.rows)
        results = [
            {
                "success": s,
                "rank": s,
                "steps": 10,
                "seconds": 75.0,
                "folder": f"{number:03d}-rung-{k}",
            }
            for k, s in enumerate(successes)
        ]
        self.rows.append(
            {
                "number": number,
                "iteration": iteration,
                "parent": None,
                "origin": origin,
                "reasons": [],
                "code": code,
                "why": why,
                "results": results,
                "is_finished": len(results) == 4,
            }
            | more
        )
        self.save()

    def feedback(self, name="reach") -> None:
        spread = {"mean": 0.25, "std": 0.1, "min": 0.0, "max": 1.0}
        part = {
            "name": name,
            "overall": spread,
            "successful": spread | {"mean": 0.75},
            "failed": None,
            "is_dead": False,
            "share": 0.4,
            "step_correlation": 0.5,
            "episode_correlation": None,
            "saturated_high": 0.1,
            "saturated_low": 0.0,
        }
        thing = {"name": name, "reached": 1.0, "touched": 0.5, "grasped": 0.25, "raised": 0.0}
        feedback = {
            "num_episodes": 64,
            "num_successes": 48,
            "ever_success": 0.875,
            "time_to_success_s": 1.25,
            "reward_ranks": 0.8125,
            "components": [part],
            "reward": part | {"name": "total"},
            "objects": [thing],
        }
        self.write("candidate/002-rung-3/record.json", {"counts": {"feedback": feedback}})

    @property
    def curve(self) -> Path:
        path = self.folder / "candidate" / "002-rung-3" / "train" / "curve.csv"
        path.parent.mkdir(exist_ok=True)
        return path

    def whole(self) -> "FakeSearch":
        """Two rounds; the second one's only reward is chosen."""
        self.candidate([0.1, 0.2], origin="given")
        self.candidate(why="crashed: the worker process was killed")
        self.candidate(
            [0.2, 0.3, 0.5, 0.75],
            iteration=1,
            parent=0,
            origin="model",
            code=CODE.replace("1.0", "0.5"),
        )
        self.feedback()
        self.found = {"chosen": 2, "success": 0.75, "stopped_by": "rounds", "steps": 1600}
        self.save()
        self.run.record(self.stage, counts={"success": 0.75})
        return self


def text_of(page) -> str:
    return page.text.replace(NO_BREAK, " ")


def test_a_finished_search_shows_choice_analysis_origin_and_code(run):
    FakeSearch(run).whole()

    page = outline(run)
    text = text_of(page)

    for words in (
        "Candidate 2 of 3 was chosen (written by a language model): 75 % success",
        "after its last round and trained for 1,600 control steps",
        "3 rewards in 2 rounds",
        "stopped at rung 2 of 4",
        "10, 20 %",
        "failed",
        "the worker process was killed",
        "trained to the end",
        "a language model, from 0",
        "5 min 00 s",
        "Of 64 episodes of its last policy 48 succeeded; 88 % had success at some step; it took 1.2 s (median).",
        "with probability 0.81; chance is 0.50",
        "reach: reached in 100 %, touched in 50 %, grasped in 25 %, raised in 0 %",
        "Candidate 2 was written from candidate 0 by a language model.",
        "- reach = 1.0 + reach = 0.5",
        "Code of candidate 2, 3 lines",
    ):
        assert words in text
    charts = [str(a["aria-label"]) for a in page.of("svg") if a.get("role") == "img"]
    assert any(
        c.startswith("Success after each round: best so far from 0.2 to 0.75") for c in charts
    )
    assert page.of("details")
    assert not [a for a in page.of("details") if "open" in a]


def test_a_half_finished_search_shows_what_is_there(run):
    search = FakeSearch(run)
    search.candidate([0.0, 0.25])
    search.candidate()
    search.stage.rename(search.stage.with_name(f"{search.stage.name}.partial"))

    text = text_of(outline(run))

    for words in (
        "The search is not finished; the same command goes on with it. So far candidate 0 leads with 25 % success.",
        "2 rewards in 1 round",
        "under way, 2 of 4 rungs",
        "waits",
        "0, leads",
    ):
        assert words in text


def test_a_search_that_has_just_begun_has_a_place_on_the_page(run):
    FakeSearch(run).run.record(run.folder("reward", "lift_mug"))

    assert "The search is not finished" in outline(run).text


def test_without_a_search_there_is_no_section(run):
    run.scene("lift_mug")

    assert "Reward" not in [w.strip() for w in outline(run).words]


def test_hostile_words_of_a_search_are_shown_and_never_run(run):
    search = FakeSearch(run).whole()
    search.rows[2] |= {"origin": HOSTILE, "why": HOSTILE, "code": HOSTILE}
    search.save()
    search.feedback(name=HOSTILE)
    search.curve.write_text(
        f'steps,return,"reward_{HOSTILE.replace(chr(34), "")}"\n1,2,3\n2,3,4\n'
    )

    page = outline(run)

    assert_safe(page)
    assert page.text.count("<script>alert(1)</script>") >= 6
    assert len(page.of("title")) == 1


BROKEN = [
    "[]",
    "3",
    "null",
    "{",
    '{"candidates": [{"number": "x"}]}',
    "[[[1]]]",
    '{"candidates": [3], "rungs": 1e999}',
    "1" * 5000,
    "[" * 9000,
]


@pytest.mark.parametrize("content", BROKEN, ids=lambda c: c[:12])
@pytest.mark.parametrize("name", ["search.json", "candidate/002-rung-3/record.json"])
def test_a_broken_file_does_not_break_the_page(run, name: str, content: str):
    search = FakeSearch(run).whole()
    (search.folder / name).write_text(content)

    words = (
        "The search is not finished" if name == "search.json" else "Candidate 2 of 3 was chosen"
    )
    assert words in text_of(outline(run))


def test_links_out_of_a_search_are_not_followed(run, tmp_path):
    secret = tmp_path / "secret.json"
    secret.write_text('{"counts": {"feedback": {"objects": [{"name": "stolen"}]}}}')
    search = FakeSearch(run).whole()
    record = search.folder / "candidate" / "002-rung-3" / "record.json"
    record.unlink()
    record.symlink_to(secret)
    os.mkfifo(search.curve)

    assert "stolen" not in outline(run).text


def test_a_difference_holds_both_sides_and_little_around_them():
    old = "a\nb\nc\nd\ne"

    assert difference(old, "a\nb\nx\nd\ne") == "@@ -2,3 +2,3 @@\n b\n-c\n+x\n d"
    assert difference(old, old) == ""

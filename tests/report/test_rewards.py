"""A reward search on the page: whole or half finished, broken or hostile. Real searches are shown in `tests/reward`."""

import json
import os
import runpy
from dataclasses import asdict
from pathlib import Path

import pytest

from v2p_data.report.page import NO_BREAK
from v2p_data.report.rewards import difference, reward_view
from v2p_data.report.searches import read_search
from v2p_data.reward.candidate import Candidate, Evaluation, Fault
from v2p_data.reward.config import RewardConfig

_page = runpy.run_path(str(Path(__file__).with_name("test_page.py")))
HOSTILE, assert_safe, outline = _page["HOSTILE"], _page["assert_safe"], _page["outline"]
CODE = (
    "def reward_function(actions, states):\n    reach = 1.0\n    return reach, {'reach': reach}\n"
)


class FakeSearch:
    """Writes what a search of two candidates a round leaves, as far as it is told to come."""

    def __init__(self, run, item="lift_mug") -> None:
        self.run = run
        self.stage = run.folder("reward", item)
        self.folder = self.stage / "search"
        self.rows: list[dict] = []
        recipe = {"config": asdict(RewardConfig(iterations=2, candidates=2))}
        self.write("recipe.json", recipe)

    def write(self, name: str, data) -> None:
        path = self.folder / name
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(json.dumps(data))

    def candidate(self, number, iteration=0, successes=(), fault=None, code=CODE, **more) -> Path:
        folder = self.folder / "candidates" / f"{number:03d}"
        made = Candidate(folder=folder, number=number, iteration=iteration, code=code, **more)
        made.save()
        if fault is not None:
            made.fail(fault)
        for seed in range(1 if iteration == 0 else 2):
            self.trial(f"candidates/{number:03d}/seed-{seed}", successes)
        return folder

    def trial(self, name: str, successes) -> None:
        entries = [
            Evaluation(success=s, ever=s, closeness=0.0, touched=0.0, control_steps=9)
            for s in successes
        ]
        self.write(f"{name}/evaluations.json", [asdict(e) for e in entries])
        self.write(f"{name}/done.json", {"mark": len(entries), "reached": False, "seconds": 75.0})

    def table(self, found=None, rounds=(0, 1)) -> None:
        rows = [{"number": k, "round": round_} for k, round_ in enumerate(rounds)]
        self.write("search.json", {"method": "v2p", "candidates": rows, "found": found})

    def feedback(self, number: int, name="reach") -> None:
        spread = {"mean": 0.25, "std": 0.1, "min": 0.0, "max": 1.0}
        part = {
            "name": name, "overall": spread, "successful": spread | {"mean": 0.75}, "failed": None, "is_dead": False,
            "share": 0.4, "step_correlation": 0.5, "episode_correlation": None, "saturated_high": 0.1, "saturated_low": 0.0,
        }  # fmt: skip
        thing = {
            "name": name,
            "reached": 1.0,
            "touched": 0.5,
            "grasped": 0.25,
            "raised": 0.0,
            "moved_m": 0.031,
        }
        self.write(
            f"candidates/{number:03d}/seed-0/feedback.json",
            {
                "num_episodes": 64, "num_successes": 48, "ever_success": 0.875, "time_to_success_s": 1.25, "episode_s": 3.0,
                "reward_ranks": 0.8125, "components": [part], "reward": part | {"name": "total"}, "objects": [thing],
            },
        )  # fmt: skip

    def whole(self) -> "FakeSearch":
        """Two rounds; the second one's only trained reward is chosen."""
        self.candidate(0, successes=[0.1, 0.2], origin="given")
        self.candidate(1, fault=Fault(kind="hang", reason="no progress for 120 s; it was ended"))
        self.candidate(
            2, iteration=1, successes=[0.25] * 9 + [0.75], parent=0, origin="reflection",
            reasons=("'reach' is flat: gentler, temperature times 0.32",), code=CODE.replace("1.0", "0.5"),
        )  # fmt: skip
        self.feedback(2)
        found = {
            "chosen": 2, "success": 0.7, "per_seed": [0.75, 0.65, 0.7], "stopped_by": "rounds", "cost_share": 0.31,
        }  # fmt: skip
        self.table(found, rounds=(0, 0, 1))
        audit = {"score": 0.9, "vetoed": "", "checks": [{"name": "flung", "asks": "false when flung?", "passed": True, "share": 0.0}]}  # fmt: skip
        self.write("bundle/task.json", {"audit": audit})
        self.run.record(self.stage, counts={"success": 0.7})
        return self


def text_of(page) -> str:
    return page.text.replace(NO_BREAK, " ")


def test_a_finished_search_shows_choice_seeds_analysis_audit_origin_and_code(run):
    FakeSearch(run).whole()

    page = outline(run)
    text = text_of(page)

    for words in (
        "Candidate 2 of 3 was chosen (written by rules): 70 % success, the mean over 3 seeds of its own training (75 %, 65 %, 70 %)",
        "after its last round and took 31 % of the steps", "3 rewards in 2 rounds", "stopped at rung 2 of 4", "10, 20 %",
        "hung", "no progress for 120 s; it was ended", "trained to the end", "rules, from 0", "1 min 15 s",
        "Of 64 episodes of its last policy 48 succeeded; 88 % had success at some step; it took 1.2 s (median), in episodes of 3.0 s.",
        "with probability 0.81; chance is 0.50", "reach: reached in 100 %, touched in 50 %, grasped in 25 %, raised in 0 % of episodes; moved by 3.1 cm",
        "false when flung?", "score 0.90 of 1", "Candidate 2 was written from candidate 0 by rules:",
        "temperature times 0.32", "- reach = 1.0 + reach = 0.5", "Code of candidate 2, 3 lines",
    ):  # fmt: skip
        assert words in text
    charts = [str(a["aria-label"]) for a in page.of("svg") if a.get("role") == "img"]
    # The hung one has no evaluation, so the first round draws one line.
    assert "Success of round 1's candidates in evaluations: candidate 0 from 0.1 to 0.2" in charts
    assert any("on each seed: seed 0 from 0.25 to 0.75; seed 1" in words for words in charts)


def test_the_search_is_folded_away(run):
    FakeSearch(run).whole()

    page = outline(run)

    assert page.of("details")
    assert not [a for a in page.of("details") if "open" in a]


def test_the_success_is_the_mean_of_the_last_evaluations(run):
    search = read_search(FakeSearch(run).whole().folder)

    assert search is not None
    assert search.success(search.candidates[2]) == pytest.approx((0.25 + 0.25 + 0.75) / 3)
    assert search.rungs == (1, 2, 4, 10)
    assert search.steps_per_evaluation == 40_000


def test_a_half_finished_search_shows_what_is_there(run):
    search = FakeSearch(run)
    search.candidate(0, successes=[0.0, 0.5])
    search.candidate(1)
    search.stage.rename(search.stage.with_name(f"{search.stage.name}.partial"))

    text = text_of(outline(run))

    for words in (
        "The search is not finished; the same command goes on with it. So far candidate 0 leads with 25 % success.",
        "2 rewards in 1 round", "under way, 2 of 10 evaluations", "waits", "0, leads",
    ):  # fmt: skip
        assert words in text


def test_a_search_that_has_just_begun_has_a_place_on_the_page(run):
    FakeSearch(run).run.record(run.folder("reward", "lift_mug"))

    assert "The search is not finished" in outline(run).text


def test_without_a_search_there_is_no_section(run):
    run.scene("lift_mug")

    assert "Reward" not in [w.strip() for w in outline(run).words]


def test_hostile_words_of_a_search_are_shown_and_never_run(run):
    search = FakeSearch(run).whole()
    search.candidate(
        2, iteration=1, successes=[0.5, 0.6], parent=0, origin=HOSTILE, reasons=(HOSTILE,), code=HOSTILE,
        fault=Fault(kind="error", reason=HOSTILE),
    )  # fmt: skip
    search.feedback(2, name=HOSTILE)
    curve = search.folder / "candidates" / "002" / "seed-0" / "train" / "curve.csv"
    curve.parent.mkdir()
    curve.write_text(f'steps,return,"reward_{HOSTILE.replace(chr(34), "")}"\n1,2,3\n2,3,4\n')
    audit = {"vetoed": HOSTILE, "checks": [{"name": HOSTILE, "asks": HOSTILE, "share": 1.0}]}
    search.write("bundle/task.json", {"audit": audit})

    page = outline(run)

    assert_safe(page)
    assert page.text.count("<script>alert(1)</script>") >= 9
    assert len(page.of("title")) == 1


BROKEN = ["[]", "3", "null", "{", '{"chosen": "x"}', "[[[1]]]", '[{"success": 1e999}, {"success": "a"}]', "1" * 5000, "[" * 9000]  # fmt: skip


FILES = ["recipe.json", "search.json", "bundle/task.json", *(
    f"candidates/002/{name}" for name in ("candidate.json", "seed-0/evaluations.json", "seed-0/feedback.json", "seed-0/done.json", "seed-0/fault.json")
)]  # fmt: skip


@pytest.mark.parametrize("name", FILES)
def test_a_broken_file_leaves_the_rest_of_a_search_to_be_seen(run, name: str):
    search = FakeSearch(run).whole()

    for content in BROKEN:
        (search.folder / name).write_text(content)
        view = reward_view(search.folder)
        assert view is not None
        states = [c.state for r in view.rounds for c in r.candidates]
        assert "hung" in states, content


@pytest.mark.parametrize("content", BROKEN, ids=lambda c: c[:12])
def test_a_search_of_broken_files_does_not_break_the_page(run, content: str):
    search = FakeSearch(run).whole()
    for name in FILES:
        (search.folder / name).write_text(content)

    assert "no progress for 120 s" in outline(run).text


def test_a_parent_in_a_circle_ends(run):
    search = FakeSearch(run).whole()
    search.candidate(2, iteration=1, successes=[0.5], parent=2, origin="model")

    assert "Candidate 2 of 3 was chosen" in text_of(outline(run))


def test_numbers_beyond_all_measure_do_not_stop_the_page(run):
    search = FakeSearch(run).whole()
    curve = search.folder / "candidates" / "002" / "seed-0" / "train" / "curve.csv"
    curve.parent.mkdir()
    curve.write_text("steps,return,reward_a\n-1e308,1e308,inf\n1e308,-1e308,nan\n3,4,5\n6,7,8\n")
    huge = [{"success": 10**400}, {"success": -5}, {"success": 7.0}]
    search.write("candidates/002/seed-0/evaluations.json", huge)

    text = text_of(outline(run))

    assert "0, 100 %" in text


def test_links_out_of_a_search_are_not_followed(run, tmp_path):
    secret = tmp_path / "secret.json"
    secret.write_text('{"number": 9, "iteration": 0, "origin": "stolen"}')
    search = FakeSearch(run).whole()
    for name in ("candidate.json", "code.py"):
        path = search.folder / "candidates" / "002" / name
        path.unlink()
        path.symlink_to(secret)
    pipe = search.folder / "candidates" / "000" / "seed-0" / "feedback.json"
    os.mkfifo(pipe)

    assert "stolen" not in outline(run).text


def test_a_search_of_forty_rewards_stays_small(run):
    bare = len(outline(run).text)
    search = FakeSearch(run)
    long_code = "\n".join(f"    part_{k} = {k} * states['eef_pos'][:, 0]" for k in range(120))
    for number in range(40):
        search.candidate(
            number, iteration=number // 8, successes=[0.1 * k for k in range(10)], code=long_code,
            parent=number - 8 if number > 7 else None, reasons=("because " * 15,),
        )  # fmt: skip
    search.table({"chosen": 39, "success": 0.9, "per_seed": [0.9]}, rounds=(4,) * 40)
    run.record(search.stage)

    text = outline(run).text

    assert "40 rewards in 5 rounds" in text
    assert bare < (run.root / "report.html").stat().st_size < 80_000


def test_a_difference_holds_both_sides_and_little_around_them():
    old = ["a", "b", "c", "d", "e"]

    assert difference(old, ["a", "b", "x", "d", "e"]) == "@@ -2,3 +2,3 @@\n b\n-c\n+x\n d"
    assert difference(old, old) == ""

"""Arms of the comparison of reward searches: what each leaves out, whose policy counts after a round, paired differences."""

import argparse
import json
from pathlib import Path

import pytest

from v2p_data.reward.candidate import DONE_FILE, EVALUATIONS_FILE, Candidate


@pytest.fixture(scope="module")
def compare(load_script):
    return load_script("compare_reward_methods")


@pytest.fixture
def args() -> argparse.Namespace:
    return argparse.Namespace(
        iterations=3, candidates=4, steps=4_096, rungs=[0.5, 1.0], start="taught", num_envs=32
    )


def test_an_arm_differs_from_v2p_in_its_part_alone(compare, args):
    whole = compare.config_of("v2p", 2, args)
    first = compare.config_of("first_rewards", 2, args)
    blind = compare.config_of("without_visual", 2, args)

    assert (first.num_iterations, first.num_candidates) == (1, 12)
    assert (blind.without, blind.method) == (("visual",), "v2p")
    assert compare.config_of("without_iteration", 2, args).num_iterations == 1
    assert compare.config_of("without_samples", 2, args).num_candidates == 1
    assert compare.config_of("robogen", 2, args).method == "robogen"
    assert whole.without == ()


def evaluated(folder: Path, number: int, iteration: int, success: float, marks: int) -> Candidate:
    made = Candidate(
        folder=folder / "candidates" / f"{number:03d}", number=number, iteration=iteration, code=""
    )
    made.save()
    place = made.training_folder()
    place.mkdir()
    entry = dict(success=success, ever=success, closeness=0.0, touched=0.0, control_steps=1)
    (place / EVALUATIONS_FILE).write_text(json.dumps([entry] * marks))
    (place / DONE_FILE).write_text(json.dumps({"mark": marks}))
    return made


def test_after_a_round_the_best_so_far_counts_and_a_worse_later_round_changes_nothing(
    compare, args, tmp_path: Path
):
    evaluated(tmp_path, 0, 0, 0.9, 1)  # stopped early, so it is no choice
    first = evaluated(tmp_path, 1, 0, 0.5, 2)
    evaluated(tmp_path, 2, 1, 0.3, 2)
    third = evaluated(tmp_path, 3, 2, 0.6, 2)

    best = compare.best_by_round(tmp_path, compare.config_of("v2p", 2, args))

    assert best == [first.policy_folder(), first.policy_folder(), third.policy_folder()]


def row(arm: str, seed: int, by_round: list[int]) -> dict:
    return {
        "task": "lift_up",
        "arm": arm,
        "seed": seed,
        "successes": by_round[-1],
        "by_round": by_round,
        "episodes": 100,
        "seconds": 1.0,
        "found": {},
    }


def test_differences_are_taken_seed_by_seed_and_rounds_that_a_search_did_not_need_keep_its_last(
    compare,
):
    rows = [row("v2p", 0, [40, 60]), row("v2p", 1, [90]), row("without_pick", 0, [30, 50]), row("without_pick", 1, [20, 60])]  # fmt: skip

    text = compare.table(rows)

    # (60 - 50 + 90 - 60) / 2 = 20 points; half the interval: 12.706 * 14.142 / sqrt(2) = 127.1.
    assert "| +0.200 (-1.071 to +1.471) |" in text
    assert "| 0.60 0.90 | 0.65 0.75 |" in text

"""A search without a model, with tiny budgets: one round, halved; a failure is one candidate's.

A kill loses nothing.
"""

import contextlib
import os
import signal
import time
from collections import Counter
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import pytest
import torch

from policies.ppo.policy import Expert, weights_of
from v2p_data.commands.reward import shown
from v2p_data.json_files import json_or_none
from v2p_data.pipeline.runner import Runtime
from v2p_data.pipeline.workers import run_stages
from v2p_data.report.rewards import reward_view
from v2p_data.reward.candidate import Candidate, candidate_stage
from v2p_data.reward.config import RewardConfig
from v2p_data.reward.search import SEARCH_FILE, RewardSearch
from v2p_data.stages import EngineConfig, chain
from v2p_data.task.sandbox.splice import rest_part, reward_part, with_reward
from v2p_data.task.task import TaskBundle
from v2p_data.video.captions import VideoItem

REWARD = """
def reward_function(actions, states):
    side = {}
    return side, {{"side": side}}
"""
FAULTY = {
    "reward_constant": "0 * states['eef_pos'][:, 2] + 5",
    "reward_unbounded": "1e6 * states['eef_pos'][:, 0]",
    "error": "torch.zeros((1500, 1000, 1000))[0, 0, 0] + states['eef_pos'][:, 0]",
}
"""What becomes of a candidate -> its reward; the last one takes 6 GB, of 4 that are allowed."""


def search_of(bundle: TaskBundle, cfg: RewardConfig, out: Path) -> RewardSearch:
    return RewardSearch(bundle, cfg, out, seed=7, runtime=Runtime(root=out, num_threads=2))


@pytest.fixture(scope="module")
def searched(
    lifting: Callable[..., TaskBundle], tiny: RewardConfig, tmp_path_factory
) -> RewardSearch:
    search = search_of(lifting(), tiny, tmp_path_factory.mktemp("search") / "undisturbed")
    search.run()
    return search


def last_weights(search: RewardSearch) -> dict[str, torch.Tensor]:
    folder = search.out / "candidate" / search.best().results[-1]["folder"]
    return weights_of(Expert.load(folder / "train" / "last").model)


def test_the_first_round_has_eight_different_rewards_over_the_audited_success(
    lifting: Callable[..., TaskBundle], tmp_path: Path
):
    bundle = lifting()

    made = search_of(bundle, RewardConfig(), tmp_path)._first()

    assert made[0].code == bundle.code
    assert len({reward_part(c.code) for c in made}) == 8
    assert {rest_part(c.code) for c in made} == {rest_part(bundle.code)}
    assert Counter(c.origin for c in made) == {"given": 1, "template": 7}


def test_the_worse_half_stops_early(searched: RewardSearch, tiny: RewardConfig):
    table = json_or_none(searched.out / SEARCH_FILE)

    assert sorted(len(row["results"]) for row in table["candidates"]) == [1, 2]
    assert table["found"]["steps"] == 1.5 * tiny.steps
    best = searched.best()
    assert len(best.results) == 2
    assert best.results[0]["rank"] == max(c.results[0]["rank"] for c in searched.candidates)


def test_show_gives_the_candidates_the_analysis_and_the_code(searched: RewardSearch):
    view = reward_view(searched.out)
    assert view is not None

    text = shown(view)

    assert f"chosen: {searched.best().number}" in text
    assert "Of 4 episodes of its last policy" in text
    assert "stopped at rung 1 of 2" in text
    assert "def reward_function" in text


@pytest.mark.long
def test_a_search_that_is_killed_goes_on_to_the_same_answer(
    lifting: Callable[..., TaskBundle], tiny: RewardConfig, searched: RewardSearch, tmp_path: Path
):
    out = tmp_path / "killed"
    pid = os.fork()
    if pid == 0:
        with contextlib.suppress(BaseException):
            search_of(lifting(), tiny, out).run()
        os._exit(0)
    deadline = time.monotonic() + 300
    while not list(out.glob("candidate/*/train/last/*")) and time.monotonic() < deadline:
        time.sleep(0.02)
    os.kill(pid, signal.SIGKILL)
    os.waitpid(pid, 0)
    assert json_or_none(out / SEARCH_FILE)["found"] is None

    again = search_of(lifting(), tiny, out)
    again.run()

    assert again.summary() == searched.summary()
    a, b = last_weights(searched), last_weights(again)
    assert all(torch.equal(a[k], b[k]) for k in a)


@pytest.mark.long
def test_bounds_and_memory_are_each_candidates_own_result(
    lifting: Callable[..., TaskBundle], tiny: RewardConfig, tmp_path: Path
):
    bundle, cfg = lifting(), replace(tiny, rungs=(1.0,), steps=tiny.num_envs * 16)
    codes = [bundle.code] + [with_reward(bundle.code, REWARD.format(f)) for f in FAULTY.values()]
    made = [Candidate(number=k, iteration=0, code=c, origin="model") for k, c in enumerate(codes)]
    stages = [candidate_stage(c, bundle, cfg, 0, seed=1) for c in made]

    outcomes = run_stages(stages, Runtime(root=tmp_path), lambda event: None)

    ended = [outcomes[(s.name, s.folder_name)] for s in stages]
    assert [(o.status, o.reason) for o in ended] == [
        ("made", ""),
        ("rejected", "reward_constant"),
        ("rejected", "reward_unbounded"),
        ("failed", "error"),
    ]
    assert "alloc" in ended[3].detail


# --- the chain -----------------------------------------------------------------------------------------------


@pytest.fixture
def video(tmp_path: Path) -> VideoItem:
    path = tmp_path / "clip.mp4"
    path.write_bytes(b"x")
    return VideoItem(item="clip", path=path, caption="lifting a box")


def test_the_chain_has_the_stage_only_where_it_is_asked_for(video: VideoItem):
    plain = chain(video, EngineConfig())
    asked = chain(video, EngineConfig(reward=RewardConfig(iterations=2)))

    assert plain.inputs["task"].name == "task"
    assert asked.inputs["task"].name == "reward"
    assert asked.inputs["expert"].inputs["task"].name == "reward"
    assert asked.inputs["task"].inputs["task"].fingerprint == plain.inputs["task"].fingerprint


def test_the_ratio_of_the_bonus_is_one_setting_for_search_and_expert(video: VideoItem):
    searched, plain, usual = (
        chain(video, EngineConfig(reward=reward)).inputs["expert"]
        for reward in (
            RewardConfig(iterations=1, bonus_ratio=7.0),
            RewardConfig(bonus_ratio=7.0),
            RewardConfig(iterations=1),
        )
    )

    assert searched.sources == plain.sources == {"bonus ratio": "7"} | usual.sources
    assert searched.inputs["task"].config.config.bonus_ratio == 7
    assert set(usual.sources) == {"pretrained experts"}

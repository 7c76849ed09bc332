"""A search with tiny budgets: what fails is one candidate's result, and a search that was killed ends as if it had not been."""

import contextlib
import json
import os
import re
import runpy
import shutil
import signal
import time
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import pytest
import torch

from policies.ppo.policy import Expert, weights_of
from v2p_data.cli import run
from v2p_data.commands.reward import bars, shown
from v2p_data.errors import V2PError
from v2p_data.reward.candidate import EVALUATIONS_FILE, Training, load_candidates
from v2p_data.reward.config import Limits, RewardConfig
from v2p_data.reward.jobs import Job, Jobs
from v2p_data.reward.methods import save_bundle
from v2p_data.reward.search import BUNDLE_FOLDER, Found, How, search_reward
from v2p_data.stages import EngineConfig, chain, reward_stage
from v2p_data.task.benchmark import load_benchmark
from v2p_data.task.task import TaskBundle
from v2p_data.video.captions import VideoItem

TINY = RewardConfig(
    iterations=1,
    candidates=2,
    steps=2 * 24 * 16,
    rungs=(0.5, 1.0),
    num_envs=24,
    eval_worlds=4,
    confirm_seeds=1,
)
BENCH = Path(__file__).parents[2] / "scripts" / "bench_reward_search.py"
REWARD = "def reward_function(actions, states):\n"
GOOD = "    total = states['eef_pos'][:, 0]\n"
FAULTY = {
    "not_finite": "    total = states['eef_pos'][:, 0] * float('1e30') * 1e30\n",
    "unbounded": "    total = 1e6 + states['eef_pos'][:, 0]\n",
    "out_of_memory": "    total = torch.zeros((1000, 1000, 10000, len(actions)))[0, 0, 0]\n",
}


@pytest.fixture(scope="module")
def bundle() -> TaskBundle:
    return replace(load_benchmark("lift_up"), horizon_steps=20)


@pytest.fixture(scope="module")
def jobs() -> Iterator[Jobs]:
    with Jobs(workers=2) as made:
        yield made


@pytest.fixture(scope="module")
def searched(bundle: TaskBundle, jobs: Jobs, tmp_path_factory) -> tuple[Found, Path]:
    out = tmp_path_factory.mktemp("search") / "undisturbed"
    return search_reward(bundle, TINY, out, seed=7, how=How(jobs=jobs)), out


def last_weights(found: Found) -> dict[str, torch.Tensor]:
    return weights_of(Expert.load(found.policy).model)


def job(bundle: TaskBundle, folder: Path, body: str) -> Job:
    """One training of a reward with this body, which no trial run has seen."""
    if not (folder / BUNDLE_FOLDER).is_dir():
        save_bundle(bundle, folder / BUNDLE_FOLDER)
    place = folder / f"{len(list(folder.iterdir()))}"
    place.mkdir()
    head, _, _ = bundle.code.partition("# REWARD FUNCTION")
    helpers = bundle.code[bundle.code.index("\n\n\ndef ") :]
    text = head + "\n\n" + REWARD + body + "    return total, {'total': total}\n" + helpers
    (place / "code.py").write_text(text)
    return Job(
        folder=place,
        mark=1,
        request={
            "job": "train", "bundle": str(folder / BUNDLE_FOLDER), "code": str(place / "code.py"),
            "seed": 0, "eval_seed": 1, "steps_per_mark": 1, "bonus_ratio": 1.0, "num_envs": 8,
            "num_threads": 1, "eval_worlds": 2, "evaluations": 1, "target_success": 2.0,
            "sees_video": True, "warm_start": None,
        },
    )  # fmt: skip


# --- what fails ----------------------------------------------------------------------------------------------


def test_nan_bounds_and_memory_are_each_candidates_own_result(
    bundle: TaskBundle, jobs: Jobs, tmp_path: Path
):
    asked = {kind: job(bundle, tmp_path, body) for kind, body in FAULTY.items()}
    good = job(bundle, tmp_path, GOOD)

    jobs.run([*asked.values(), good])

    faults = {kind: Training.load(j.folder).fault for kind, j in asked.items()}
    assert {kind: f.kind for kind, f in faults.items() if f} == {k: k for k in asked}
    assert Training.load(good.folder).done == 1


def test_a_hang_and_a_killed_process_are_results_too_and_are_not_tried_again(
    bundle: TaskBundle, jobs: Jobs, tmp_path: Path
):
    hanging, killed = job(bundle, tmp_path, GOOD), job(bundle, tmp_path, GOOD)
    jobs.limits = Limits(hang_s=1.0)
    jobs.run([hanging], on_wait=lambda _: signal_children_of(jobs, signal.SIGSTOP))
    jobs.limits = Limits()
    jobs.run([killed], on_wait=lambda _: signal_children_of(jobs, signal.SIGKILL))
    jobs.run([killed, hanging])

    found = [Training.load(j.folder).fault for j in (hanging, killed)]
    assert [f.kind for f in found if f] == ["hang", "out_of_memory"]
    assert "SIGKILL" in (found[1].reason if found[1] else "")


def signal_children_of(jobs: Jobs, what: signal.Signals) -> None:
    for child in children_of(jobs):
        os.kill(child, what)


def children_of(jobs: Jobs) -> list[int]:
    assert jobs._process is not None
    pid = jobs._process.pid
    return [int(c) for c in Path(f"/proc/{pid}/task/{pid}/children").read_text().split()]


def test_generated_code_runs_with_few_files_and_little_memory(
    bundle: TaskBundle, jobs: Jobs, tmp_path: Path
):
    seen: list[str] = []

    def look(_: object) -> None:
        for child in children_of(jobs):
            with contextlib.suppress(OSError):
                seen.append(Path(f"/proc/{child}/limits").read_text())

    jobs.run([job(bundle, tmp_path, GOOD)], on_wait=look)

    soft = {line[:26].strip(): line[26:].split()[0] for line in seen[-1].splitlines()[1:]}
    assert int(soft["Max open files"]) <= 256
    assert int(soft["Max address space"]) < 2**40
    assert int(soft["Max core file size"]) == 0


@pytest.mark.parametrize("flags", [["--reward.method=eureka"], ["--reward.without", "pick"]])
def test_a_success_of_a_models_hand_is_not_replaced_by_a_templates(
    bundle: TaskBundle, flags: list[str], tmp_path: Path, capsys: pytest.CaptureFixture[str]
):
    save_bundle(bundle, tmp_path / "task")
    (tmp_path / "task" / "audit.json").write_text(json.dumps({"writer": "vlm"}))

    ended = run(
        ["reward", "search", str(tmp_path / "task"), "--out", str(tmp_path / "out"), *flags]
    )

    assert ended == 2
    assert "a model wrote" in capsys.readouterr().err
    assert not (tmp_path / "out").exists()


# --- halving -------------------------------------------------------------------------------------------------


def test_the_worse_half_stops_early_and_every_step_is_counted(searched: tuple[Found, Path]):
    found, out = searched

    table = json.loads((out / "search.json").read_text())
    assert sorted(row["marks"] for row in table["candidates"]) == [1, 2]
    assert found.trained_steps == 3 * 24 * 16  # one to the half, one to the end
    assert found.evaluated_steps == 3 * 4 * 20
    assert found.full_steps == 4 * (24 * 16 + 4 * 20)
    assert found.cost_share == 0.75


def test_a_finished_search_is_not_done_again(
    bundle: TaskBundle, searched: tuple[Found, Path], tmp_path: Path
):
    found, out = searched

    with Jobs() as idle:
        assert search_reward(bundle, TINY, out, seed=7, how=How(jobs=idle)) == found
        assert idle._process is None


def test_another_recipe_in_the_same_folder_is_refused(
    bundle: TaskBundle, searched: tuple[Found, Path]
):
    with pytest.raises(V2PError, match="candidates was 2, is 3"):
        search_reward(bundle, replace(TINY, candidates=3), searched[1], seed=7)


def test_a_search_that_is_killed_goes_on_to_the_same_answer(
    bundle: TaskBundle, searched: tuple[Found, Path], jobs: Jobs, tmp_path: Path
):
    found, _ = searched
    out = tmp_path / "killed"
    pid = os.fork()
    if pid == 0:  # a search with processes of its own, killed once it has something to lose
        with contextlib.suppress(BaseException):
            search_reward(bundle, TINY, out, seed=7, how=How(workers=1))
        os._exit(0)
    first = out / "candidates" / "000" / "seed-0" / EVALUATIONS_FILE
    deadline = time.monotonic() + 300
    while not first.is_file() and time.monotonic() < deadline:
        time.sleep(0.02)
    os.kill(pid, signal.SIGKILL)
    os.waitpid(pid, 0)
    assert not (out / "candidates" / "001" / "seed-0" / "done.json").is_file()

    again = search_reward(bundle, TINY, out, seed=7, how=How(jobs=jobs))

    assert replace(again, policy=found.policy) == found
    a, b = last_weights(found), last_weights(again)
    assert a.keys() == b.keys()
    assert all(torch.equal(a[k], b[k]) for k in a)


def test_the_benchmark_trains_what_halving_stopped_to_the_end(
    bundle: TaskBundle, searched: tuple[Found, Path], jobs: Jobs, tmp_path: Path
):
    out = tmp_path / "copy"
    shutil.copytree(searched[1], out)

    bench = runpy.run_path(str(BENCH))
    settings = bench["Settings"](seed=7, episodes=4)
    lines = list(bench["measure"](bundle, TINY, out, jobs, settings))

    assert [c.training().done for c in load_candidates(out)] == [2, 2]
    assert lines[2:4] == ["cost_share: 0.750", "cost_share_at_most: 0.750"]
    assert re.fullmatch(r"success_lost: -?\d\.\d{3}", lines[-1])


@pytest.mark.long
def test_the_benchmark_spends_a_searchs_steps_on_its_first_round_and_judges_all_on_the_same_episodes(
    bundle: TaskBundle, jobs: Jobs, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
):
    monkeypatch.syspath_prepend(BENCH.parent)
    bench = runpy.run_path(str(BENCH))
    settings = bench["Settings"](episodes=4)
    cfg = replace(TINY, iterations=2, target_success=2.0)

    rows = list(bench["compare_rounds"](bundle, cfg, tmp_path, jobs, settings, 7))

    assert [row["arm"] for row in rows] == list(bench["ARMS"])
    steps = {row["arm"]: row["control_steps"] for row in rows}
    one = 24 * 16 + 4 * 20  # a mark of training and its evaluation
    assert steps["first"] == 3 * one
    assert steps["longer"] == steps["search"] > steps["first"]
    assert steps["search"] - 2 * one < steps["wider"] <= steps["search"]
    assert {len(row["episodes"]) for row in rows} == {4}
    assert list(bench["compare_rounds"](bundle, cfg, tmp_path, jobs, settings, 7)) == []
    assert bench["differences"](rows).count("| lift_up |") == 3


def test_the_benchmark_can_stop_at_what_the_search_lost_at_most(
    bundle: TaskBundle, searched: tuple[Found, Path], jobs: Jobs, tmp_path: Path
):
    out = tmp_path / "copy"
    shutil.copytree(searched[1], out)
    before = [c.training().done for c in load_candidates(out)]

    bench = runpy.run_path(str(BENCH))
    settings = bench["Settings"](seed=7, episodes=4, bound=True)
    lines = list(bench["measure"](bundle, TINY, out, jobs, settings))

    assert [c.training().done for c in load_candidates(out)] == before
    rate = re.search(r"\((\d+) of 4\)", lines[1])
    assert rate is not None
    assert lines[-1] == f"success_lost_at_most: {1 - int(rate[1]) / 4:.3f}"


# --- what is shown, and the chain ------------------------------------------------------------------------------


def test_show_gives_table_curves_analysis_and_code(searched: tuple[Found, Path]):
    found, out = searched

    text = shown(out, None)

    assert f"chosen: {found.chosen}" in text
    assert "success rate:" in text  # the analysis
    assert "reward_function" in text
    assert "stopped" in text


def test_bars_rise_with_values_and_leave_unknown_ones_out():
    assert bars([0.0, float("nan"), 0.5, 1.0], low=0.0, high=1.0) == "▁ ▅█"


def video(tmp_path: Path) -> VideoItem:
    path = tmp_path / "clip.mp4"
    path.write_bytes(b"x")
    return VideoItem(item="clip", path=path, caption="lifting a box")


def test_the_chain_has_the_stage_only_where_it_is_asked_for(tmp_path: Path):
    plain = chain(video(tmp_path), EngineConfig())
    asked = EngineConfig(reward=RewardConfig(iterations=2))
    with_reward = chain(video(tmp_path), asked)

    assert plain.inputs["task"].name == "task"
    assert with_reward.inputs["task"].name == "reward"
    assert with_reward.inputs["expert"].inputs["task"].name == "reward"
    assert (
        with_reward.inputs["task"].inputs["task"].fingerprint == plain.inputs["task"].fingerprint
    )


def test_playing_programs_leaves_no_reward_to_learn_from(tmp_path: Path):
    cfg = EngineConfig(reward=RewardConfig(iterations=2, method="code_as_policy"))

    with pytest.raises(V2PError, match="no reward to learn from"):
        reward_stage(chain(video(tmp_path), EngineConfig()).inputs["task"], cfg)

"""Collecting with a scripted expert: what is kept, where it is cut, and that a kill changes nothing."""

import json
from pathlib import Path

import numpy as np
import pytest
from toy_task import act, bundle, collect_toys, lesson

from v2p_data.episodes.collect import (
    CutConfig,
    EpisodesConfig,
    collect,
    judge_expert,
    roll_out,
    staged_episodes,
)
from v2p_data.episodes.rollouts import Lesson, Rollouts
from v2p_data.episodes.staging import Episode
from v2p_data.errors import ItemRejectedError
from v2p_data.pipeline.artifact import read_rejects
from v2p_data.play import StateActor
from v2p_data.sim.env.batch_env import SimConfig
from v2p_data.sim.env.task_code import HELD_STEPS


def rolled_out(toy: Lesson) -> Rollouts:
    return roll_out(toy, SimConfig(fine=True), num_worlds=6, seed=4, cut=CutConfig())


SMALL = EpisodesConfig(num_episodes=5, batch_worlds=6, max_batches=3, size_px=48)


@pytest.fixture(scope="module")
def rollouts():
    return rolled_out(lesson(StateActor(act)))


@pytest.fixture(scope="module")
def collected(tmp_path_factory) -> Path:
    out = tmp_path_factory.mktemp("collected")
    collect_toys(out, SMALL)
    return out


def contents(folder: Path) -> dict[str, bytes]:
    return {str(p.relative_to(folder)): p.read_bytes() for p in folder.rglob("*") if p.is_file()}


def test_who_acts_is_given_the_worlds_at_the_start_and_asked_at_every_step(rollouts):
    given = []

    class Acting(StateActor):
        def reset(self, worlds):
            given.append(worlds.num_envs)

    same = rolled_out(lesson(Acting(act)))

    assert given == [6]
    assert (same.action == rollouts.action).all()


def test_an_episode_ends_six_steps_after_success_held(rollouts):
    assert rollouts.successes.any()
    for world in np.flatnonzero(rollouts.successes):
        first_held = next(
            t
            for t in range(len(rollouts.success))
            if t + 1 >= HELD_STEPS and rollouts.success[t + 1 - HELD_STEPS : t + 1, world].all()
        )
        assert rollouts.num_frames[world] == max(10, first_held + 1 + 6)


def test_an_episode_that_never_succeeds_lasts_to_the_horizon(rollouts):
    losers = np.flatnonzero(~rollouts.task_successes)

    assert len(losers) > 0
    assert (rollouts.num_frames[losers] == bundle().horizon_steps).all()
    assert rollouts.reject(int(losers[0]))["reason"] == "not_successful"


def test_the_state_moves_as_the_recorded_actions_say(rollouts):
    world = int(np.flatnonzero(rollouts.successes)[0])
    rows = 6  # before it reaches the edge of its workspace
    travelled = rollouts.state[rows, world, 1] - rollouts.state[0, world, 1]
    asked = np.cumsum(rollouts.action[:rows, world, 1]) * 0.03

    # The tool lags behind its target by delay and servo, two steps at most.
    assert asked[-3] - 0.005 < travelled < asked[-1] + 0.005
    assert (np.abs(rollouts.action) <= 1).all()


def test_the_referee_sees_each_world_stand_still_after_its_cut():
    seen = {}

    def watch(_, trajectory):
        seen.update(trajectory)
        return np.ones(6, bool)

    rollouts = rolled_out(lesson(StateActor(act), watch))
    world = int(rollouts.num_frames.argmin())
    end = int(rollouts.num_frames[world])

    assert (seen["eef_pos"][end:, world] == seen["eef_pos"][end, world]).all()
    assert (seen["eef_pos"][end - 1, world] != seen["eef_pos"][end, world]).any()
    assert np.allclose(seen["eef_pos"][:end, world], rollouts.state[:end, world, :3], atol=1e-6)


def test_what_the_referee_denies_is_no_success():
    toy = lesson(StateActor(act), lambda _, trajectory: np.arange(6) % 2 == 0)

    judged = judge_expert(toy, episodes=6, seed=4)

    assert judged.task_successes.any()
    assert not judged.successes[1::2].any()
    denied = int(np.flatnonzero(judged.task_successes[1::2])[0]) * 2 + 1
    assert judged.reject(denied)["reason"] == "referee_disagrees"


def test_the_independent_referee_is_asked_unless_another_is_given():
    """Without a push the cube stays where it is: the task's success is wrong, and the referee says so."""
    judged = judge_expert(lesson(StateActor(act), None), episodes=6, seed=4)

    assert judged.task_successes.any()
    assert not judged.referee.any()


def test_as_many_successes_are_staged_as_were_asked_for(collected: Path):
    episodes = [Episode.load(path) for path in staged_episodes(collected)]

    assert len(episodes) == SMALL.num_episodes
    for episode in episodes:
        assert episode.labels.shape == (episode.num_frames, 48, 48)
        assert set(np.unique(episode.labels)) == {0, 1, 2}
        assert episode.success[-1]
        assert not episode.success[0]
        assert episode.task == bundle().description
        assert 10 <= episode.params["action_delay_ms"] <= 20


def test_failed_episodes_are_listed_with_reason_and_number(collected: Path):
    rejects = read_rejects(collected)
    staged = {path.stem for path in staged_episodes(collected)}

    assert rejects
    for reject in rejects:
        assert reject["reason"] == "not_successful"
        assert reject["value"] < HELD_STEPS or "from the start" in reject["detail"]
        assert reject["id"] not in staged


def test_failed_episodes_are_kept_aside_without_pictures(collected: Path):
    rejects = read_rejects(collected)
    kept = []

    for path in sorted((collected / "failed").glob("*.npz")):
        with np.load(path) as data:
            about = json.loads(str(data["about"]))
            assert set(data) == {"state", "action", "success", "about"}
            assert len(data["state"]) == len(data["action"]) == sum(a["num_frames"] for a in about)
        kept += about

    assert [(a["id"], a["reason"]) for a in kept] == [(r["id"], r["reason"]) for r in rejects]
    assert all(10 <= a["params"]["action_delay_ms"] <= 20 for a in kept)


def test_collecting_again_changes_nothing(collected: Path):
    before = contents(collected)

    again = collect_toys(collected, SMALL)

    assert contents(collected) == before
    assert again["episodes"] == SMALL.num_episodes


def test_the_number_of_threads_changes_nothing(collected: Path, tmp_path: Path):
    collect_toys(tmp_path, SMALL, num_threads=2)

    assert contents(tmp_path) == contents(collected)


def test_lost_episodes_come_back_the_same(collected: Path, tmp_path: Path):
    collect_toys(tmp_path, SMALL)
    (tmp_path / "batches/000.json").unlink()
    staged_episodes(tmp_path)[1].unlink()
    (tmp_path / "episodes/toy_00000.npz.tmp").write_bytes(b"half")

    collect_toys(tmp_path, SMALL)

    assert contents(tmp_path) == contents(collected)


def test_a_task_that_is_never_done_is_rejected(tmp_path: Path):
    cfg = EpisodesConfig(num_episodes=2, batch_worlds=2, max_batches=1, size_px=48)
    never = lesson(StateActor(act), lambda _, trajectory: np.zeros(2, bool))

    with pytest.raises(ItemRejectedError, match="0 of 2 episodes succeeded") as caught:
        collect(never, cfg, tmp_path, 0)

    assert caught.value.reason == "too_few_episodes"

"""`taught_success` means one thing, in an expert's record and in a reward search's: success held at some time, at the fine step."""

import json
from dataclasses import replace
from functools import partial
from pathlib import Path

import numpy as np
import pytest
import toy_run

from policies.ppo.config import ImitationConfig
from policies.ppo.policy import Expert
from v2p_data.experts.learning import success_of
from v2p_data.experts.teacher import try_out
from v2p_data.play import StateActor
from v2p_data.reward import worker
from v2p_data.reward.candidate import DONE_FILE, TRAIN_FOLDER
from v2p_data.reward.jobs import HEARTBEAT_FILE
from v2p_data.reward.worker import teach
from v2p_data.seeds import seed_for
from v2p_data.sim.env.batch_env import BatchEnv, SimConfig
from v2p_data.task.benchmark import load_benchmark

PASSING = toy_run.CODE.replace(
    'return (states["eef_pos"][:, 1] > 0.08) & (states["cube_pos"][:, 0] < 0.55)',
    'return (states["eef_pos"][:, 1] > 0.13) & (states["eef_pos"][:, 1] < 0.3)',
)


def test_a_success_that_is_lost_again_counts():
    assert PASSING != toy_run.CODE
    env = BatchEnv(
        replace(toy_run.bundle(), code=PASSING, horizon_steps=40),
        SimConfig(fine=True),
        num_envs=4,
        seed=1,
    )
    expert = toy_run.expert()

    played = try_out(env, StateActor(expert.act))

    assert played.once.all()
    assert not played.at_end.any()
    assert success_of(env, expert) == pytest.approx(1.0)


@pytest.mark.slow
def test_a_reward_search_measures_as_an_experts_training_does(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
):
    quick = partial(ImitationConfig, least_rounds=1, round_steps=30, epochs=2, minibatch=256)
    monkeypatch.setattr(worker, "ImitationConfig", quick)
    bundle = load_benchmark("lift_up")
    scene = replace(bundle.scene, folder=tmp_path / "made")
    scene.folder.mkdir()
    scene.save(scene.folder)
    replace(bundle, scene=scene).save(tmp_path / "bundle")
    (tmp_path / HEARTBEAT_FILE).touch()
    request = {
        "bundle": str(tmp_path / "bundle"),
        "code": str(tmp_path / "bundle/task.py"),
        "seed": 3,
        "rounds": 1,
        "num_envs": 16,
        "num_threads": 1,
        "eval_worlds": 8,
    }

    teach(request, tmp_path)

    done = json.loads((tmp_path / DONE_FILE).read_text())
    worlds = BatchEnv(bundle, SimConfig(fine=True), num_envs=8, seed=seed_for(3, "exam"))
    same = success_of(worlds, Expert.load(tmp_path / TRAIN_FOLDER))
    assert np.isclose(done["taught_success"], same)
    assert done["teacher"] == "lift"

"""Success, wherever two policies are compared, is success held at some time."""

from dataclasses import replace

import pytest
import toy_run

from v2p_data.experts.learning import success_of
from v2p_data.experts.teacher import try_out
from v2p_data.play import StateActor
from v2p_data.sim.env.batch_env import BatchEnv, SimConfig

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

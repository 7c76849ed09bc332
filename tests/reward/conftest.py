"""The scenes of the tests of tasks, and the benchmark's lifting with short episodes."""

import re
import runpy
from dataclasses import replace
from pathlib import Path

import pytest

from v2p_data.reward.config import RewardConfig
from v2p_data.task.benchmark import load_benchmark
from v2p_data.task.task import TaskBundle

scene_of = runpy.run_path(str(Path(__file__).parents[1] / "task" / "conftest.py"))["scene_of"]
NUM_ENVS = 24
STEPS = 16 * NUM_ENVS
"""One batch of PPO."""
TINY = RewardConfig(
    iterations=1,
    candidates=2,
    steps=2 * STEPS,
    rungs=(0.5, 1.0),
    num_envs=NUM_ENVS,
    eval_worlds=4,
)


def _lifting(success: str = "") -> TaskBundle:
    bundle = replace(load_benchmark("lift_up"), horizon_steps=20)
    body = re.compile(r"(def compute_success\(self, states\):\n).*?(?=\n    def )", re.DOTALL)
    code = body.sub(rf"\g<1>        return {success}\n", bundle.code) if success else bundle.code
    return replace(bundle, code=code)


@pytest.fixture(scope="session")
def lifting():
    """Return a function that gives the task, with another expression for success where one is given."""
    return _lifting


@pytest.fixture(scope="session")
def tiny() -> RewardConfig:
    """A search of two rewards and two rungs of one batch each."""
    return TINY

"""Places where rewards of the templates must not hold a policy back, computed on states of real worlds."""

import numpy as np
import pytest
import torch

from v2p_data.sim.env.batch_env import BatchEnv, SimConfig
from v2p_data.task.benchmark import load_benchmark

NUM = 4


@pytest.fixture(scope="module")
def worlds_of():
    made: dict[str, BatchEnv] = {}

    def make(kind: str) -> BatchEnv:
        if kind not in made:
            made[kind] = BatchEnv(load_benchmark(kind), SimConfig(), num_envs=NUM, seed=0)
            made[kind].reset(np.arange(NUM))
        return made[kind]

    return make


def paid(env: BatchEnv, **changed: torch.Tensor) -> dict[str, torch.Tensor]:
    """Return the reward's components in the worlds' states, some of them changed."""
    states = {key: value.clone() for key, value in env.states().items()} | changed
    return env.task.judge(lambda: states, torch.zeros(NUM, env.act_dim)).components


@pytest.mark.parametrize("kind", ["cover", "uncover"])
def test_above_a_cup_that_fills_the_gripper_every_centimetre_towards_its_middle_pays(
    kind: str, worlds_of
):
    env = worlds_of(kind)
    tool = env.states()["cup_pos"].clone()
    tool[:, 0] -= torch.tensor([0.03, 0.02, 0.01, 0.0])
    tool[:, 2] += 0.057  # just above its rim, where fingers beside its middle cannot go down

    reach = paid(env, eef_pos=tool)["reach"]

    assert (reach.diff() > 0).all()


@pytest.mark.parametrize(("kind", "thing"), [("drop_in_front_of", "matchbox"), ("insert", "fork")])
def test_dragging_costs_more_the_nearer_the_goal_and_what_falls_or_is_carried_costs_nothing(
    kind: str, thing: str, worlds_of
):
    env = worlds_of(kind)
    states = env.states()
    other = {"drop_in_front_of": "mug", "insert": "container"}[kind]
    way = states[f"{other}_pos"] - states[f"{thing}_pos"]
    way[:, 2] = 0
    along = torch.tensor([0.0, 0.15, 0.3, 0.45])[:, None]  # of the way
    moved = states[f"{thing}_pos"] + along * way
    moving = {
        f"{thing}_pos": moved,
        f"{thing}_vel_linear": torch.nn.functional.normalize(way, dim=-1) * 0.3,
    }
    touched = {f"{thing}_touched": torch.ones(NUM)}
    raised = moved + torch.tensor([0.0, 0.0, 0.1])

    dragged = paid(env, **moving, **touched)["dragged"]
    free = paid(env, **moving, **{f"{thing}_touched": torch.zeros(NUM)})["dragged"]
    carried = paid(env, **moving | {f"{thing}_pos": raised}, **touched)["dragged"]

    assert dragged[0] == pytest.approx(0, abs=1e-4)
    assert (dragged.diff() < 0).all()
    assert (free == 0).all()
    assert (carried == 0).all()


def test_a_thing_to_be_thrown_earns_nothing_by_rolling_to_the_container(worlds_of):
    env = worlds_of("throw_into")
    states = env.states()
    way = states["bowl_pos"] - states["garlic_pos"]
    way[:, 2] = 0
    shares = torch.tensor([0.0, 0.2, 0.4, 0.6])[:, None]
    rolled = states["garlic_pos"] + shares * way
    flying = rolled + torch.tensor([0.0, 0.0, 0.1])

    on_table = paid(env, garlic_pos=rolled)["progress"]
    in_air = paid(env, garlic_pos=flying)["progress"]

    assert (on_table == 0).all()
    assert (in_air > 0).all()

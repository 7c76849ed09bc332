"""The table of the base observation, and the page that shows it."""

from pathlib import Path

import numpy as np

from v2p_data.sim.env import observation
from v2p_data.sim.env.batch_env import BatchEnv
from v2p_data.task.benchmark import load_benchmark
from v2p_data.task.task import BASE_OBSERVATION_DIM

PAGE = Path(__file__).parents[2] / "docs" / "observation.md"


def test_the_page_shows_the_table():
    assert observation.table() in PAGE.read_text(), "write the page anew: see its first lines"


def test_every_column_has_one_term():
    seen = np.zeros(BASE_OBSERVATION_DIM, int)
    for columns in observation.COLUMNS.values():
        seen[columns] += 1

    assert (seen == 1).all()


def test_experts_on_disk_find_their_numbers_where_they_were():
    where = {name: c.start for name, c in observation.COLUMNS.items()}

    assert where["target_ahead"] == 11
    assert where["manipulated_away"] == 22
    assert where["other_away"] == 43
    assert where["progress"] == 72
    assert where["has_other"] == 79
    assert where["other_touches"] == 88


def test_a_term_is_read_back_in_its_unit():
    env = BatchEnv(load_benchmark("push_with"), num_envs=3, seed=1, num_threads=1)
    states = {key: value.numpy() for key, value in env.states().items()}
    base = states["base_observation"]
    thing, tool = (o.name for o in env.world.objects[:2])

    np.testing.assert_allclose(
        observation.value_of(base, "manipulated_size"), states[f"{thing}_size"], atol=1e-6
    )
    np.testing.assert_allclose(
        observation.value_of(base, "other_away"),
        states[f"{tool}_pos"] - states["eef_pos"],
        atol=1e-6,
    )

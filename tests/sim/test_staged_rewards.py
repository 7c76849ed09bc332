"""The rewards of kinds whose objects are gripped, at moments made by hand: each world of a batch is one moment."""

from typing import Any

import numpy as np
import pytest
import torch

from v2p_data.sim.env.batch_env import BatchEnv
from v2p_data.task.benchmark import load_benchmark

OPEN_M = 0.085
WORLDS = 12


class Moments:
    """Worlds of one benchmark task, all with the start and the sizes of the first."""

    def __init__(self, name: str) -> None:
        self.env = BatchEnv(load_benchmark(name), num_envs=WORLDS, seed=0, num_threads=1)
        self.states = {
            key: value[:1].expand(value.shape).clone() for key, value in self.env.states().items()
        }
        self.states["gripper_width"][:] = OPEN_M

    def start(self, thing: str) -> np.ndarray:
        return self.states[f"{thing}_start_pos"][0].double().numpy()

    def widest(self, thing: str) -> float:
        return float(self.states[f"{thing}_size"][0, :2].max())

    def narrowest(self, thing: str) -> float:
        return float(self.states[f"{thing}_size"][0, :2].min())

    def pay(self, moments: list[dict[str, Any]], component: str = "") -> list[float]:
        """Return the rewards of moments, or one component; each moment says what differs from the start."""
        states = {key: value.clone() for key, value in self.states.items()}
        for world, moment in enumerate(moments):
            for key, value in moment.items():
                states[key][world] = torch.as_tensor(value, dtype=torch.float32)
        said = self.env.task.judge(lambda: dict(states), torch.zeros(WORLDS, 7))
        paid = said.components[component] if component else said.reward
        return paid[: len(moments)].tolist()


@pytest.mark.parametrize(
    ("name", "thing", "other"),
    [
        ("insert", "fork", "container"),
        ("cover", "cup", "cube"),
        ("drop_in_front_of", "matchbox", "mug"),
    ],
)
def test_each_stage_of_carrying_pays_more_than_the_one_before(name, thing, other):
    moments = Moments(name)
    start, goal = moments.start(thing), moments.start(other)
    if name == "drop_in_front_of":
        goal[0] -= (moments.widest(thing) + moments.widest(other)) / 2 + 0.02
    goal[2] = start[2]
    up, grip = np.array([0, 0, 0.08]), np.array([0, 0, max(start[2] - 0.035, 0.0)])

    def at(pos: np.ndarray, *, held: bool) -> dict[str, Any]:
        return {
            f"{thing}_pos": pos,
            f"{thing}_grasped": float(held),
            f"{thing}_touched": float(held),
            "eef_pos": pos + grip,
            "gripper_width": moments.narrowest(thing) if held else OPEN_M,
        }

    paid = moments.pay(
        [
            at(start, held=False),
            at(start, held=True),
            at(start + up / 2, held=True),
            at(start + up, held=True),
            at(start + up + 0.3 * (goal - start), held=True),
            at(start + up + 0.6 * (goal - start), held=True),
            at(goal + 4 * up, held=True),
            at(goal + 2 * up, held=True),
            at(goal + up, held=True),
            at(goal + up / 2, held=True),
            at(goal + up / 2, held=False),
            at(goal + up / 4, held=False),
        ]
    )

    assert all(np.diff(paid) > 0), paid


@pytest.mark.parametrize(
    ("name", "thing", "other"),
    [("drop_in_front_of", "matchbox", "mug"), ("insert", "fork", "container")],
)
def test_dragging_costs_more_the_nearer_the_goal_and_what_falls_or_is_carried_costs_nothing(
    name, thing, other
):
    moments = Moments(name)
    start, goal = moments.start(thing), moments.start(other)
    way = np.append((goal - start)[:2], 0.0)
    along = [start + share * way for share in (0.0, 0.15, 0.3, 0.45)]

    def moving(pos: np.ndarray, *, touched: bool) -> dict[str, Any]:
        return {
            f"{thing}_vel_linear": 0.3 * way / np.linalg.norm(way),
            f"{thing}_pos": pos,
            "eef_pos": pos,
            f"{thing}_grasped": float(touched),
            f"{thing}_touched": float(touched),
        }

    dragged = [moving(pos, touched=True) for pos in along]
    carried = moving(along[2] + np.array([0, 0, 0.06]), touched=True)
    price = moments.pay([*dragged, moving(along[2], touched=False), carried], "dragged")
    here, left, up = moments.pay([dragged[2], {}, carried])

    assert price[0] == pytest.approx(0, abs=1e-4)
    assert all(np.diff(price[:4]) < 0)
    assert price[4:] == [0, 0]
    assert here < left < up


def test_a_thing_to_be_thrown_earns_by_flying_and_not_by_rolling_to_the_container():
    moments = Moments("throw_into")
    start, bowl = moments.start("garlic"), moments.start("bowl")
    rolled = [start + share * np.append((bowl - start)[:2], 0.0) for share in (0.0, 0.3, 0.6)]
    flying = [pos + np.array([0, 0, 0.1]) for pos in rolled]

    paid = moments.pay([{"garlic_pos": pos} for pos in (*rolled, *flying)], "progress")

    assert paid[:3] == [0, 0, 0]
    assert 0 < paid[3] < paid[4] < paid[5]


def test_the_way_down_to_a_fork_leads_around_the_container_and_not_over_its_rim():
    moments = Moments("insert")
    fork, container = moments.start("fork"), moments.start("container")
    side = (fork - container)[:2] / np.linalg.norm((fork - container)[:2])
    rim = moments.widest("container") / 2

    def at(beside: float, above: float) -> dict[str, Any]:
        """The tool so far from the container's middle towards the fork, and so high above its rim."""
        return {"eef_pos": np.append(container[:2] + beside * side, 2 * container[2] + above)}

    around = [at(0, 0.07), at(rim, 0.07), at(rim + 0.05, 0.07), {"eef_pos": fork}]
    low, on_rim = at(0.5 * rim, 0.03), at(rim, 0.01)
    with_fork = on_rim | {"fork_pos": on_rim["eef_pos"], "fork_grasped": 1.0}

    paid = moments.pay(around)
    price = moments.pay([*around, low, on_rim, with_fork], "clear_of_other")

    assert price == [0, 0, 0, 0, pytest.approx(-0.5, abs=0.02), pytest.approx(-0.83, abs=0.02), 0]
    assert all(np.diff(paid) > 0), paid

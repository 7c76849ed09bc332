import functools
from dataclasses import replace
from pathlib import Path

import pytest

from v2p_data.experts.solved import Solved, rank_solved
from v2p_data.kinds import KINDS, Kind
from v2p_data.task.benchmark import benchmark_names
from v2p_data.task.benchmark import load_benchmark as load
from v2p_data.task.likeness import likeness

load_benchmark = functools.cache(load)


def solved(name: str, *, obs_dim: int = 90, **changes: object) -> Solved:
    bundle = replace(load_benchmark(name), **changes)
    return Solved(bundle=bundle, folder=Path(f"{name}-0000"), obs_dim=obs_dim)


def nearest_to(name: str) -> Kind:
    others = [solved(other) for other in benchmark_names() if other != name]
    return rank_solved(load_benchmark(name), 90, others)[0].bundle.kind


@pytest.mark.parametrize(
    ("name", "nearest"),
    [("push_left", "push_right"), ("cover", "uncover"), ("uncover", "cover")],
)
def test_the_nearest_task_is_the_one_a_person_would_name(name: str, nearest: str):
    assert nearest_to(name) == nearest


@pytest.mark.parametrize("name", ["insert", "drop_in_front_of", "push_next_to", "slide_to"])
def test_the_nearest_task_moves_in_the_same_way(name: str):
    assert KINDS[nearest_to(name)].family == KINDS[load_benchmark(name).kind].family


def test_likeness_is_the_same_both_ways_and_largest_for_the_task_itself():
    bundles = [load_benchmark(name) for name in benchmark_names()]

    for a in bundles:
        assert likeness(a, a) == max(likeness(a, b) for b in bundles)
        for b in bundles:
            assert likeness(a, b) == pytest.approx(likeness(b, a))


def test_the_same_task_with_other_sizes_counts_less():
    # Family 4, kind 2, number of objects 1, shape 1, size 1.
    lift = load_benchmark("lift_up")
    tea = lift.scene.objects[0]
    twice = replace(tea, size_m=(2 * tea.size_m[0], 2 * tea.size_m[1], 2 * tea.size_m[2]))
    larger = replace(lift, scene=replace(lift.scene, objects=(twice,)))

    assert likeness(lift, lift) == pytest.approx(9.0)
    assert likeness(lift, larger) == pytest.approx(8.5)  # exp(-log 2) = 1/2


def test_experts_whose_weights_mean_something_else_are_left_out():
    task = load_benchmark("push_left")
    fitting = solved("push_right")
    others = [
        solved("push_right", obs_dim=91),
        solved("push_right", motion_scale=2.0),
        solved("push_right", robot={"path": "other_arm.xml"}),
    ]

    assert rank_solved(task, 90, [*others, fitting]) == [fitting]


def test_the_order_does_not_depend_on_the_order_in_which_experts_are_found():
    task = load_benchmark("push_left")
    found = [solved(name) for name in benchmark_names()]
    twins = [replace(found[0], folder=Path(f"twin-{k}")) for k in range(3)]

    ranked = rank_solved(task, 90, [*found, *twins])

    assert ranked == rank_solved(task, 90, [*reversed(twins), *reversed(found)])

import functools
from dataclasses import replace

import pytest

from v2p_data.kinds import KINDS, Kind
from v2p_data.task.benchmark import benchmark_names
from v2p_data.task.benchmark import load_benchmark as load
from v2p_data.task.likeness import likeness

load_benchmark = functools.cache(load)


def nearest_to(name: str) -> Kind:
    task = load_benchmark(name)
    others = [load_benchmark(other) for other in benchmark_names() if other != name]
    return max(others, key=lambda other: likeness(task, other)).kind


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

"""The race counts what it should: learning only, stopped runs with their time, the best peer."""

import math
import time

import pytest


@pytest.fixture(scope="module")
def bench(load_script):
    return load_script("bench_ppo")


def run_of(bench, learner: str, seed: int, seconds: float, success: float):
    moment = bench.Moment(steps=1000, wall_s=seconds, cpu_s=seconds, success=success)
    return bench.Run(learner=learner, seed=seed, moments=(moment,), arrived=success >= 0.9)


def test_the_ratio_is_the_best_peers_median_over_ours(bench):
    times = {"ours": (40, 60, 50), "sb3-lift": (200, 90, 100), "torchrl": (300, 300, 300)}
    runs = [run_of(bench, n, k, t, 0.95) for n, ts in times.items() for k, t in enumerate(ts)]

    # Medians: 50, 100, 300.
    assert bench.speed_over_best_peer(runs) == 2.0


def test_a_control_does_not_count(bench):
    times = {"ours": 50, "sb3-our-settings": 25, "torchrl": 100}
    runs = [run_of(bench, name, 0, seconds, 0.95) for name, seconds in times.items()]

    assert bench.speed_over_best_peer(runs) == 2.0


def test_a_stopped_peer_counts_with_the_time_it_had(bench):
    runs = [run_of(bench, "ours", 0, 50, 0.95), run_of(bench, "torchrl", 0, 150, 0.1)]

    assert bench.speed_over_best_peer(runs) == 3.0
    assert ">150" in bench.table(runs, bench.BenchConfig(learners=("ours", "torchrl")))


def test_there_is_no_ratio_without_a_peer_or_an_arrival(bench):
    assert math.isnan(bench.speed_over_best_peer([run_of(bench, "ours", 0, 50, 0.95)]))
    stopped = [run_of(bench, "ours", 0, 50, 0.1), run_of(bench, "torchrl", 0, 50, 0.1)]
    assert math.isnan(bench.speed_over_best_peer(stopped))


def test_a_learners_clock_stands_still_while_it_is_judged(bench):
    class SlowJudge:
        def success(self, act) -> float:
            time.sleep(0.2)
            return act

    watch = bench.Watch(SlowJudge(), bench.BenchConfig())
    watch.note(0.5, steps=10)
    assert not watch.has_arrived
    watch.note(0.9, steps=20)

    assert watch.times()[0] < 0.1
    assert [m.steps for m in watch.moments] == [10, 20]
    assert watch.has_arrived


def test_a_learner_that_has_arrived_is_not_judged_again(bench):
    class Judge:
        def success(self, act) -> float:
            return act

    watch = bench.Watch(Judge(), bench.BenchConfig())
    watch.note(0.95, steps=10)
    watch.finish(0.2, steps=20)

    assert watch.moments[-1].success == 0.95

"""The arm waits for a slow gripper: while it travels, not before it is commanded, not while it holds something."""

import numpy as np

from v2p_data.sim.robot.gripper_wait import LATENCY_STEPS, MOST_STEPS, GripperWait

LIFT = np.array([0, 0, 1.0, 0, 0, 0, 0.5])


def waits(openings: list[float], target: float) -> list[bool]:
    wait = GripperWait()
    return [wait.is_waiting(opening, target) for opening in openings]


def test_the_arm_waits_until_the_gripper_is_closed():
    assert (
        waits([1.0, 1.0, 0.95, 0.6, 0.3, 0.11, 0.05, 0.0], target=0.0) == [True] * 6 + [False] * 2
    )


def test_the_arm_goes_on_when_the_fingers_rest_on_an_object():
    assert waits([1.0, 0.9, 0.7, 0.5, 0.5, 0.5], target=0.0)[-2:] == [False, False]


def test_a_carried_object_is_not_waited_for_again():
    assert not any(waits([0.5] * 50, target=0.0)[LATENCY_STEPS:])


def test_an_open_gripper_that_stays_open_is_not_waited_for():
    assert not any(waits([1.0] * 5, target=0.95))


def test_a_gripper_that_never_arrives_is_given_up():
    crawl = np.linspace(1.0, 0.4, 60).tolist()

    assert sum(waits(crawl, target=0.0)) == MOST_STEPS


def test_only_the_arm_is_held():
    held = GripperWait().held(LIFT, 1.0, 0.0)

    np.testing.assert_array_equal(held, [0, 0, 0, 0, 0, 0, 0.5])
    np.testing.assert_array_equal(GripperWait().held(LIFT, 1.0, 1.0), LIFT)

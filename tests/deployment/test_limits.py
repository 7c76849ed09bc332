"""Every limit, on the simulated arm where it is a matter of motion, by hand numbers where it is one of arithmetic."""

import contextlib
import threading
import time
from types import SimpleNamespace

import numpy as np
import pytest

from v2p_data.deployment.limits import Guard, LimitsConfig, LimitStop, Watchdog
from v2p_data.deployment.loop import LoopConfig, Onlooker, Run
from v2p_data.deployment.rig import Rig
from v2p_data.deployment.robot import ActionScale
from v2p_data.episodes.dataset.features import STATE_NAMES
from v2p_data.errors import V2PError

PATIENT = 60_000.0


def course(rig, policy, seconds=1.0, **limits):
    """Run and return the outcome with the tool's positions and rotation vectors."""
    places, turns = [], []

    def note(reading, seen):
        places.append(reading.tool_pos)
        turns.append(reading.state[3:6])

    rig.guard = Guard(LimitsConfig(max_silence_ms=PATIENT, **limits), rig.scale)
    cfg = LoopConfig(max_seconds=seconds, slow=True)
    outcome = Run(rig, policy, cfg, Onlooker(on_step=note)).go()
    return outcome, np.array(places), np.array(turns)


def test_the_arm_keeps_to_the_speed_limit(blind_robot, restarted, steady):
    outcome, places, _ = course(
        restarted(blind_robot), steady(1, 1, 1, 0, 0, 0, 0), max_speed_m_s=0.15
    )

    speeds = np.linalg.norm(np.diff(places, axis=0), axis=1) * 20
    assert 0.1 < speeds.max() < 0.15 * 1.2
    assert outcome.acted["speed"] == outcome.steps


def test_the_arm_stays_inside_a_narrowed_workspace(blind_robot, restarted, steady):
    rig = restarted(blind_robot)
    start = rig.read().tool_pos
    high = (float(start[0]) + 0.06, 0.3, 0.4)

    outcome, places, _ = course(rig, steady(1, 0, 0, 0, 0, 0, 0), workspace_high_m=high)

    assert places[-1, 0] == pytest.approx(high[0], abs=0.01)
    assert places[:, 0].max() < high[0] + 0.01
    assert outcome.acted["workspace"] > 3


def test_the_arm_turns_no_faster_than_it_may(blind_robot, restarted, steady):
    outcome, _, turns = course(
        restarted(blind_robot), steady(0, 0, 0, 0, 0, 1, 0), max_turn_rad_s=0.5
    )

    rates = np.abs(np.diff(turns[:, 2])) * 20
    assert 0.3 < rates.max() < 0.5 * 1.2
    assert outcome.acted["turn"] == outcome.steps


def test_the_gripper_leans_no_further_than_it_may(blind_robot, restarted, steady):
    outcome, _, turns = course(
        restarted(blind_robot), steady(0, 0, 0, 1, 0, 0, 0), max_tilt_rad=0.12, max_turn_rad_s=1.0
    )

    assert 0.08 < np.linalg.norm(turns[:, :2], axis=1).max() < 0.12 + 0.04
    assert outcome.acted["tilt"] > 3
    assert outcome.ending == "time"


def test_pressing_on_an_object_stops_at_the_force_limit(blind_robot, restarted, steady):
    rig = restarted(blind_robot)
    labels_at = blind_robot.arm.env.moment().qpos[0]
    box = blind_robot.arm.env.world.objects[0].qpos_adr
    above = labels_at[box : box + 2]

    class Press:
        """Over the box with closed fingers, then down onto it."""

        def reset(self, n):
            pass

        def act(self, labels, state):
            off = above - state[0, :2]
            down = -0.5 if np.abs(off).max() < 0.01 else 0.0
            return np.array([[*np.clip(off / 0.03, -1, 1), down, 0, 0, 0, 1]], np.float32)

    outcome, places, _ = course(rig, Press(), seconds=6.0, max_force_n=25.0)

    assert outcome.ending == "limit"
    assert "above the limit of 25 N" in outcome.sentence
    assert "the robot holds its position" in outcome.sentence
    assert places[-1, 2] > 0.05  # the box is 8 cm high: the arm was on it, and not through it


@pytest.mark.parametrize(
    ("forces", "stops_at"),
    [
        ([500, 500], 1),
        ([500, 0, 500], 2),
        ([500, 0, 0, 0, 0, 0, 0, 0, 0, 500], 9),
        ([-500, -500], 1),
        ([float("nan")] * 2, 1),
        ([0, float("inf"), None, -61], 3),
        ([500, *[59] * 9, -500], None),  # a touch, and half a second later another
        ([60, -60, 60, None, 0], None),
    ],
)
def test_two_readings_of_ten_above_the_force_limit_stop(reading, forces, stops_at):
    guard = Guard(LimitsConfig(max_force_n=60.0), ActionScale())
    looked = 0

    with contextlib.suppress(LimitStop):
        for force in forces:
            guard.look(reading(force=None if force is None else float(force)))
            looked += 1

    assert looked == (len(forces) if stops_at is None else stops_at)


def test_an_arm_outside_the_workspace_does_not_begin(blind_robot, restarted, steady):
    rig = restarted(blind_robot)

    with pytest.raises(LimitStop, match="outside the workspace"):
        course(rig, steady(0, 0, 0, 0, 0, 0, 0), workspace_low_m=(0.65, -0.3, 0.0))
    assert blind_robot.arm.steps == 0


def test_what_something_else_moves_is_noticed(reading):
    guard = Guard(LimitsConfig(max_speed_m_s=0.2), ActionScale())
    guard.look(reading(pos=(0.5, 0, 0.2)))
    guard.look(reading(pos=(0.51, 0, 0.2)))  # 0.2 m/s

    with pytest.raises(LimitStop, match=r"moves at 0\.60 m/s"):
        guard.look(reading(pos=(0.54, 0, 0.2)))


def test_actions_are_changed_by_what_is_said_and_no_more(reading):
    guard = Guard(LimitsConfig(max_speed_m_s=0.3), ActionScale())

    free = guard.limit(np.array([0.2, 0, -0.3, 0, 0, 0.1, 1.0]), reading())
    fast = guard.limit(np.array([1.0, 0, 0, 0, 0, 0, 0]), reading())
    both = guard.limit(np.array([1.0, 0, 0, 0, 0, 0.4, 0]), reading())
    wide = guard.limit(np.array([0, 0, 0, 0, 0, 0, -9.0]), reading())
    ahead = guard.limit(np.array([0.5, 0, 0, 0, 0, 0, 0]), reading(lead=(0.025, 0, 0)))
    low = guard.limit(np.array([0, 0, -0.5, 0, 0, 0, 0]), reading(pos=(0.5, 0, 0.027)))

    np.testing.assert_allclose(free.action, [0.2, 0, -0.3, 0, 0, 0.1, 1.0])
    assert free.acted == ()
    np.testing.assert_allclose(fast.action[0], 0.5)  # 0.3 m/s are 15 mm of the 30 of a full action
    assert fast.acted == ("speed",)
    np.testing.assert_allclose(both.action[[0, 5]], [0.5, 0.2])  # the same way, half as fast
    assert (wide.action[6], wide.acted) == (-1.0, ("range",))
    np.testing.assert_allclose(ahead.action[0], 5 / 30)  # 30 mm ahead at most, 25 already
    assert ahead.acted == ("lead",)
    np.testing.assert_allclose(low.action[2], -10 / 30)  # the lowest target is at 17 mm
    assert low.acted == ("workspace",)


def test_a_target_outside_may_come_back_and_not_go_further(reading):
    guard = Guard(LimitsConfig(), ActionScale())
    outside = reading(pos=(0.735, 0, 0.2))  # the workspace ends at 0.72

    back = guard.limit(np.array([-0.5, 0, 0, 0, 0, 0, 0]), outside)
    on = guard.limit(np.array([0.5, 0, 0, 0, 0, 0, 0]), outside)

    np.testing.assert_allclose(back.action[0], -0.5)
    np.testing.assert_allclose(on.action[0], 0.0, atol=1e-12)


def test_an_action_that_is_no_number_stops(reading):
    with pytest.raises(LimitStop, match="no number"):
        Guard(LimitsConfig(), ActionScale()).limit(np.full(7, np.nan), reading())


@pytest.mark.parametrize(
    "wrong",
    [{"max_speed_m_s": 0.0}, {"max_force_n": float("nan")}, {"workspace_low_m": (0.9, 0.0, 0.0)}],
)
def test_limits_that_make_no_sense_are_refused(wrong):
    with pytest.raises(ValueError, match=next(iter(wrong))):
        LimitsConfig(**wrong)


def test_the_watchdog_bites_once_when_nothing_is_heard():
    bitten = []
    with Watchdog(100.0, lambda: bitten.append(threading.current_thread().name)) as dog:
        for _ in range(6):
            time.sleep(0.03)
            dog.heard()
        fed = list(bitten)
        time.sleep(0.5)

    assert fed == []
    assert bitten == ["v2p-watchdog"]
    assert dog.has_bitten


NAN = float("nan")


@pytest.mark.parametrize(
    ("odd", "words"),
    [
        ({"eef_z.pos": NAN}, "'eef_z.pos' = nan, which is no finite number"),
        ({"eef_z.pos": None}, "'eef_z.pos' = None, which is no finite number"),
        ({"joints": [0.0, NAN, *[0.0] * 5]}, "= nan, which is no finite number"),
        ({"joints": [0.0] * 9}, "9 angles of joints; give 7"),
        ({"opening": NAN}, "'opening' = nan"),
        ({"opening": "open"}, "'opening' = open"),
        ({"force_n": NAN}, "'force_n' = nan"),
        ({"force_n": float("-inf")}, "'force_n' = -inf"),
        (
            {"rgb": np.ones((4, 4, 3), np.float32)},
            "'rgb' holds float32 of shape (4, 4, 3); give uint8",
        ),
        ({"rgb": np.zeros((4, 4), np.uint8)}, "'rgb' holds uint8 of shape (4, 4)"),
        ({"rgb": None, "mask": np.ones((4, 4, 3))}, "'mask' holds float64"),
        ({"force_n": -9.5}, ""),
    ],
)
def test_a_reading_holds_finite_numbers_and_pictures_of_bytes_or_is_refused(odd, words):
    state = dict.fromkeys(STATE_NAMES, 0.5)
    seen = {
        **state,
        "rgb": np.zeros((4, 4, 3), np.uint8),
        "joints": [0.0] * 7,
        "opening": 1.0,
        "force_n": None,
    }
    seen |= odd
    asked = {name: lambda name=name: seen[name] for name in ("joints", "opening", "force_n")}
    asked |= {"send_action": dict, "calibration": lambda: None}
    rig = Rig(SimpleNamespace(get_observation=lambda: seen, **asked))  # type: ignore[arg-type]

    try:
        said = ""
        assert rig.read().force_n == seen["force_n"]
    except V2PError as error:
        said = str(error)

    assert (words in said) if words else said == ""

"""The loop on the simulated arm: what stops it, what it sends, and what it says."""

import signal
import time

import numpy as np
import pytest

from v2p_data.deployment.limits import Guard, LimitsConfig
from v2p_data.deployment.loop import LoopConfig, Onlooker, Run
from v2p_data.deployment.recording import Recorder
from v2p_data.deployment.sight import Sight
from v2p_data.errors import V2PError

PATIENT = LimitsConfig(max_silence_ms=60_000.0)


def run_of(rig, policy, seconds=0.5, sight=None, limits=PATIENT, slow=True, dry_run=False, **more):
    cfg = LoopConfig(max_seconds=seconds, slow=slow, dry_run=dry_run)
    rig.sight, rig.guard = sight, Guard(limits, rig.scale)
    return Run(rig, policy, cfg, Onlooker(**more))


def test_a_run_lasts_as_long_as_it_may_at_twenty_steps_a_second(blind_robot, restarted, steady):
    rig = restarted(blind_robot)
    before = rig.read().tool_pos
    began = []

    outcome = run_of(
        rig, steady(0, 0, 0.5, 0, 0, 0, 0), on_step=lambda r, s: began.append(time.perf_counter())
    ).go()

    assert (outcome.ending, outcome.steps, blind_robot.arm.steps) == ("time", 10, 10)
    assert rig.read().tool_pos[2] > before[2] + 0.05
    assert np.median(np.diff(began)) > 0.045  # no step begins early
    assert (
        outcome.sentence
        == "the 0.5 s are up, after 10 steps (0.5 s); the robot holds its position"
    )


def test_a_dry_run_sends_nothing(blind_robot, restarted, steady):
    rig = restarted(blind_robot)
    before = blind_robot.arm.env.moment().qpos
    recorder = Recorder("resting")

    outcome = run_of(rig, steady(1, 0, 0, 0, 0, 0, 1), dry_run=True, recorder=recorder).go()

    assert blind_robot.arm.steps == 0
    np.testing.assert_array_equal(blind_robot.arm.env.moment().qpos, before)
    assert len(recorder) == outcome.steps == 10  # what would have been done is noted
    assert outcome.sentence.endswith("nothing was sent")


def test_losing_the_object_stops_the_arm(seeing_robot, restarted, steady, click_on):
    rig = restarted(seeing_robot)
    arm = seeing_robot.arm
    sight = Sight(seeing_robot.calibration(), [click_on(seeing_robot)])
    address = arm.env.world.objects[0].qpos_adr

    def take_away(reading, seen):
        if arm.steps == 4:  # as a person would, out of the picture
            arm.env._world._sim.qpos[0, address : address + 2] = (-1.0, 1.0)

    outcome = run_of(
        rig, steady(0, 0, 0.1, 0, 0, 0, 0), seconds=2.0, sight=sight, on_step=take_away
    ).go()

    assert outcome.ending == "lost"
    assert 6 <= outcome.steps <= 11
    assert "object 1 was lost from sight" in outcome.sentence
    assert outcome.sentence.endswith("the robot holds its position")


def test_ctrl_c_ends_a_run_and_leaves_what_was_seen(blind_robot, restarted, steady):
    rig = restarted(blind_robot)
    recorder = Recorder("resting")

    def interrupt(reading, seen):
        if blind_robot.arm.steps == 4:
            signal.raise_signal(signal.SIGINT)

    run = run_of(
        rig, steady(0, 0, 0, 0, 0, 0, 0), seconds=5.0, recorder=recorder, on_step=interrupt
    )
    before = signal.signal(
        signal.SIGINT, signal.default_int_handler
    )  # LeRobot's tools leave theirs
    outcome = run.go()
    signal.signal(signal.SIGINT, before)

    assert outcome.ending == "interrupted"
    assert (
        outcome.sentence
        == "stopped by Ctrl-C, after 4 steps (0.2 s); the robot holds its position"
    )
    assert len(recorder) == 4


def test_a_policy_that_is_too_slow_is_refused_before_anything_moves(
    blind_robot, restarted, steady
):
    class Slow(steady):
        def act(self, labels, state):
            time.sleep(0.08)
            return super().act(labels, state)

    rig = restarted(blind_robot)
    rig.waits = False  # as a real arm
    lazy = Slow(0, 0, 0, 0, 0, 0, 0)

    with pytest.raises(V2PError, match=r"20 Hz cannot be kept: a step takes \d+ ms .* --slow"):
        run_of(rig, lazy, slow=False).go()
    assert blind_robot.arm.steps == 0
    assert run_of(rig, lazy, seconds=0.2).go().ending == "time"  # --slow


def test_a_loop_that_becomes_too_slow_is_stopped(blind_robot, restarted, steady):
    class Tiring(steady):
        calls = 0

        def act(self, labels, state):
            self.calls += 1
            time.sleep(0.09 if self.calls > 10 else 0.0)
            return super().act(labels, state)

    rig = restarted(blind_robot)
    rig.waits = False
    run = run_of(rig, Tiring(0, 0, 0, 0, 0, 0, 0), seconds=5.0, slow=False)
    run.rehearse = lambda: None  # type: ignore[method-assign] - that it was fast enough then is given
    outcome = run.go()

    assert outcome.ending == "slow"
    assert 20 <= outcome.steps <= 31
    assert "the run was stopped" in outcome.sentence


def test_a_robot_that_falls_silent_is_told_to_hold(blind_robot, restarted, steady):
    rig = restarted(blind_robot)
    rig.waits = False
    held = []
    ask, hold = rig.read, rig.hold

    def read():
        if blind_robot.arm.steps == 5:
            time.sleep(1.0)  # the line is dead for a second
        return ask()

    rig.read = read
    rig.hold = lambda: (held.append(time.monotonic()), hold())
    silent = LimitsConfig(max_silence_ms=500.0)

    outcome = run_of(rig, steady(0, 0, 0, 0, 0, 0, 0), seconds=5.0, limits=silent).go()

    assert outcome.ending == "silence"
    assert "no reading came for 500 ms" in outcome.sentence
    assert "--limits.max-silence-ms" in outcome.sentence
    assert blind_robot.arm.steps == 5  # nothing was done after the silence
    assert held[1] - held[0] > 0.3  # once by the watchdog in time, once at the end


def test_a_policy_that_ponders_too_long_is_named_and_not_the_robot(blind_robot, restarted, steady):
    class Pondering(steady):
        def act(self, labels, state):
            if blind_robot.arm.steps == 5:
                time.sleep(0.7)
            return super().act(labels, state)

    limits = LimitsConfig(max_silence_ms=400.0)
    rig = restarted(blind_robot)
    rig.waits = False
    outcome = run_of(rig, Pondering(0, 0, 0, 0, 0, 0, 0), seconds=5.0, limits=limits).go()

    assert outcome.ending == "slow"
    assert "--limits.max-silence-ms" in outcome.sentence
    assert outcome.sentence.startswith("the policy took more than 400 ms in one step")
    assert "look after" not in outcome.sentence
    assert blind_robot.arm.steps == 5  # what it decided so late is not done


def test_a_simulated_arm_waits_for_a_busy_machine(blind_robot, restarted, steady):
    class Pondering(steady):
        def act(self, labels, state):
            time.sleep(0.7 if blind_robot.arm.steps == 3 else 0.06)
            return super().act(labels, state)

    limits = LimitsConfig(max_silence_ms=400.0)
    outcome = run_of(
        restarted(blind_robot), Pondering(0, 0, 0, 0, 0, 0, 0), limits=limits, slow=False
    ).go()

    assert (outcome.ending, outcome.steps) == ("time", 10)


def test_a_policy_that_breaks_leaves_the_arm_at_rest(blind_robot, restarted, steady):
    class Broken(steady):
        def act(self, labels, state):
            if blind_robot.arm.steps == 3:
                raise RuntimeError("shapes do not fit")
            return super().act(labels, state)

    rig, held = restarted(blind_robot), []
    rig.hold = lambda: held.append(blind_robot.arm.steps)

    with pytest.raises(RuntimeError, match="shapes"):
        run_of(rig, Broken(0, 0, 0, 0, 0, 0, 0)).go()
    assert held == [3]

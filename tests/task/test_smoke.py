"""The child that tries task code stays for the next question, and is replaced where it has ended."""

import os
import signal
import threading

import pytest

from v2p_data.task.sandbox import smoke
from v2p_data.task.templates.write import write_samples

pytestmark = pytest.mark.slow


@pytest.fixture(scope="module")
def code(scene_of) -> str:
    return write_samples(scene_of("lift_up"), 1)[0]


def test_one_child_answers_question_after_question(scene_of, code):
    scene = scene_of("lift_up")
    head = "def compute_success(self, states):"
    crashing = code.replace(head, f"{head}\n        1 / 0")

    runnable = [smoke.smoke_run(code, scene).runnable]
    child = smoke._child()
    runnable += [smoke.smoke_run(each, scene).runnable for each in (crashing, code)]

    assert runnable == [True, False, True]
    assert smoke._child() is child


def test_a_child_that_was_killed_or_ran_out_of_time_is_replaced(scene_of, code):
    scene = scene_of("lift_up")
    os.kill(smoke._child()._process.pid, signal.SIGKILL)
    late = smoke.smoke_run(code, scene, timeout_s=0.1)

    assert late.error == "the trial run took more than 0.1 s"
    assert smoke.smoke_run(code, scene).runnable


def test_a_thread_has_a_child_of_its_own_that_ends_with_it(scene_of, code):
    children = []

    def ask() -> None:
        assert smoke.smoke_run(code, scene_of("lift_up")).runnable
        children.append(smoke._child()._process)

    thread = threading.Thread(target=ask)
    thread.start()
    thread.join()

    (process,) = children
    assert process.wait(20) is not None
    assert process.pid != smoke._child()._process.pid

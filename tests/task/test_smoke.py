"""A trial run that lasts too long, or that gives no answer, ends in one sentence."""

import pytest

from v2p_data.errors import V2PError
from v2p_data.task.sandbox.smoke import _answers, smoke_run
from v2p_data.task.templates.write import write_samples


@pytest.mark.slow
def test_a_trial_run_that_lasts_too_long_is_ended(scene_of):
    scene = scene_of("lift_up")
    (code,) = write_samples(scene, 1)

    late = smoke_run(code, scene, timeout_s=0.1)

    assert late.error == "the trial run took more than 0.1 s"
    assert smoke_run(code, scene).runnable


@pytest.mark.parametrize(
    "answer",
    [b"", b"[", b"{}", b"[1]", b"[" + b"1," * 11_000_000 + b"1]"],
    ids=["nothing", "half", "an object", "too few", "too long"],
)
def test_a_child_without_an_answer_a_sample_is_named_with_what_it_complained_of(answer):
    with pytest.raises(V2PError, match=r"gave no answer \(.*; MemoryError\)"):
        _answers(answer, b"Traceback\nMemoryError\n", 2)

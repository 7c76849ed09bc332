"""Every attempt of `escapes` ends in a sentence; what only shows when it runs is held by the child."""

import sys
from pathlib import Path

import pytest

from v2p_data.task.sandbox.reader.check import check_code
from v2p_data.task.sandbox.reader.refusal import TaskCodeError
from v2p_data.task.sandbox.smoke import smoke_run_all

sys.path.insert(0, str(Path(__file__).parent))
from escapes import CONTAINED, REFUSED, program
from harmless import ACCEPTED


def test_the_skeleton_alone_is_accepted():
    check_code(program("pass"))


@pytest.mark.parametrize("source", REFUSED.values(), ids=REFUSED)
def test_the_reader_refuses_it_and_says_where(source):
    with pytest.raises(TaskCodeError) as refusal:
        check_code(source)

    assert len(refusal.value.reason) > 10
    assert refusal.value.line is None or 1 <= refusal.value.line <= source.count("\n") + 1
    assert str(refusal.value).isprintable()
    assert len(str(refusal.value)) < 2_000


BOMBS = [name for name in CONTAINED if name.startswith(("memory", "time", "depth"))]
OTHERS = [name for name in CONTAINED if name not in BOMBS]


@pytest.fixture(scope="module")
def tried(scene_of):
    """Every program's result; bombs have little time, the others as much as they like on a busy machine."""
    results = {}
    sources = ACCEPTED | {name: source for name, (source, _) in CONTAINED.items()}
    for names, seconds in ((BOMBS, 0.5), ([*OTHERS, *ACCEPTED], 20.0)):
        answers = smoke_run_all(
            [sources[n] for n in names], scene_of("lift_up"), seconds_each=seconds, timeout_s=500.0
        )
        results |= dict(zip(names, answers, strict=True))
    return results


@pytest.mark.slow
def test_every_harmless_program_runs_in_the_child(tried):
    assert {name: tried[name].error for name in ACCEPTED} == dict.fromkeys(ACCEPTED, "")
    assert all(tried[name].runnable for name in ACCEPTED)


@pytest.mark.slow
@pytest.mark.parametrize("attempt", CONTAINED)
def test_the_child_holds_it_and_says_what_was_wrong(tried, attempt):
    source, words = CONTAINED[attempt]
    result = tried[attempt]

    check_code(source)

    assert not result.runnable
    assert len(result.error) > 10
    # On a busy machine the time is up before the memory is.
    assert words in result.error or (attempt in BOMBS and "took more than" in result.error)

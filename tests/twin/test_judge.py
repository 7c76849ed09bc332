"""Episodes in the twin, judged like those of the training simulator."""

from dataclasses import replace

import numpy as np
import pytest

from v2p_data.errors import V2PError
from v2p_data.evaluation.batch import NEVER
from v2p_data.evaluation.config import EvaluationConfig
from v2p_data.evaluation.failures import NEVER_REACHED
from v2p_data.experts.teacher import Teacher
from v2p_data.play import VisionActor
from v2p_data.task.benchmark import load_benchmark
from v2p_data.twin.judge import judge_in_twin

ONCE = EvaluationConfig(at_end=False, horizon_scale=1.0)


@pytest.fixture(scope="module")
def folders(tmp_path_factory):
    """Return a lift with time enough, and one cut short."""
    made = []
    for name, steps in (("long", 60), ("short", 4)):
        bundle = load_benchmark("lift_up")
        folder = tmp_path_factory.mktemp(name)
        scene = folder / "scene"
        scene.mkdir()
        bundle.scene.save(scene)
        kept = replace(bundle, horizon_steps=steps, scene=replace(bundle.scene, folder=scene))
        kept.save(folder / "task")
        made.append(folder / "task")
    return made


class Idle:
    """A policy that keeps what it saw and does nothing."""

    def __init__(self) -> None:
        self.seen: list[tuple[np.ndarray, np.ndarray]] = []

    def reset(self, n: int) -> None:
        assert n == 1

    def act(self, labels: np.ndarray, state: np.ndarray) -> np.ndarray:
        self.seen.append((labels.copy(), state.copy()))
        return np.zeros((1, 7), np.float32)


class Lifter:
    """The scripted lift, which sees the truth."""

    def reset(self, worlds) -> None:
        self.teacher = Teacher(worlds)
        self.teacher.name = "lift"

    def act(self, view) -> np.ndarray:
        del view
        return self.teacher.act()


def test_a_policy_sees_labels_and_the_datasets_state_and_idling_reaches_nothing(folders):
    idle = Idle()
    judged = judge_in_twin(folders[1], lambda _: (VisionActor(idle), 64), seeds=[3], cfg=ONCE)

    assert judged.success_step.tolist() == [NEVER]
    assert judged.failures == (NEVER_REACHED,)
    labels, state = zip(*idle.seen, strict=True)
    assert np.concatenate(labels).shape == (4, 64, 64)
    assert {0, 1, 2} <= set(np.unique(labels[0]))
    assert state[0].shape == (1, 11)
    assert state[0].dtype == np.float32
    assert state[0][0, 6] == state[0][0, 10] == 1.0  # the gripper is open, as wanted


def test_a_scripted_lift_is_a_success_of_its_seed(folders):
    judged = judge_in_twin(folders[0], lambda _: (Lifter(), 256), seeds=[0], cfg=ONCE)

    assert judged.successes.tolist() == [True]
    assert 10 < judged.success_step[0] < 60
    assert judged.failures == ("",)


def test_an_actor_that_does_not_suit_the_twin_is_told_so(folders):
    class Odd(Idle):
        def act(self, labels, state):
            return np.full((1, 7), np.nan, np.float32)

    with pytest.raises(V2PError, match="in world 0 of task 'lift_up' is not finite"):
        judge_in_twin(folders[1], lambda _: (VisionActor(Odd()), 64), seeds=[0], cfg=ONCE)
    with pytest.raises(V2PError, match="square"):
        judge_in_twin(folders[1], lambda _: (VisionActor(Odd()), (64, 80)), seeds=[0], cfg=ONCE)

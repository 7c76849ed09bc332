"""Episodes that a student begins and an expert ends: who acts when, and what is written down."""

import numpy as np
import pytest
import toy_run
from toy_task import act

from v2p_data.distillation import handover
from v2p_data.distillation.config import DistillationConfig
from v2p_data.distillation.handover import Handovers, hand_over
from v2p_data.episodes import rollouts
from v2p_data.play import StateActor, VisionActor
from v2p_data.sim.env.batch_env import BatchEnv
from v2p_data.sim.env.observation import PROGRESS_COLUMN

CFG = DistillationConfig(worlds=5, takeover=(0.1, 0.5))


def run(student=None, *, cfg=CFG, seed: int = 3, num_threads: int = 1, expert=act) -> Handovers:
    return hand_over(
        rollouts.Lesson(bundle=toy_run.bundle(), expert=StateActor(expert)),
        VisionActor(student or toy_run.Pupil()),
        cfg,
        toy_run.EPISODES,
        seed=seed,
        num_threads=num_threads,
    )


@pytest.fixture
def carried_out(monkeypatch: pytest.MonkeyPatch) -> list[np.ndarray]:
    """The actions that the simulator was given."""
    actions: list[np.ndarray] = []

    class Watched(BatchEnv):
        def step(self, action, moving=None):
            actions.append(np.array(action))
            return super().step(action, moving)

    monkeypatch.setattr(handover, "BatchEnv", Watched)
    return actions


def test_the_student_acts_before_the_takeover_and_the_expert_from_it_on(
    agreeing_referee, carried_out
):
    labels: list[np.ndarray] = []

    def expert(obs: np.ndarray) -> np.ndarray:
        labels.append(3 * act(obs))  # beyond the limit of an action
        return labels[-1]

    found = run(expert=expert)

    assert found.successes.any()
    assert len({*found.taken_over_at}) > 1
    for t, action in enumerate(carried_out):
        going = t < found.num_frames
        is_students = t < found.taken_over_at
        label = np.clip(labels[t], -1, 1)
        assert (action[going & is_students, 1] < 0).all()
        assert np.array_equal(action[going & ~is_students], label[going & ~is_students])
        assert np.array_equal(found.action[t], label)


def test_the_arm_goes_the_students_way_and_then_the_experts(agreeing_referee):
    found = run()

    world = int(np.argmax(found.taken_over_at))
    at, end = int(found.taken_over_at[world]), int(found.num_frames[world])
    left = found.state[:end, world, 1]
    assert at >= 5
    assert left[at] < left[0] - 0.01
    assert left[end - 1] > left[at] + 0.05
    assert (found.action[:end, world, 1] > 0).all()


def test_takeovers_lie_between_the_earliest_and_the_latest_moment(agreeing_referee):
    # 30 control steps: from the third to the fifteenth
    cfg = DistillationConfig(worlds=64, takeover=(0.1, 0.5), time_scale=0.5)

    found = run(cfg=cfg)

    assert (found.taken_over_at.min(), found.taken_over_at.max()) == (3, 15)
    assert len(found.action) == 15


def test_a_student_is_not_asked_once_all_worlds_are_taken_over(agreeing_referee):
    student = toy_run.Pupil()

    found = run(student)

    assert student.num_acts == found.taken_over_at.max() < found.num_frames.max()


def test_the_expert_that_takes_over_at_once_needs_no_student(agreeing_referee):
    student = toy_run.Pupil()

    found = run(student, cfg=DistillationConfig(worlds=5, takeover=(0.0, 0.0)))

    assert student.num_acts == 0
    assert found.successes.any()


def test_an_expert_sees_no_more_of_the_time_than_it_learned(agreeing_referee):
    shares: list[float] = []

    def watching(obs: np.ndarray) -> np.ndarray:
        shares.append(float(obs[:, PROGRESS_COLUMN].max()))
        return 0 * act(obs)  # never done, hence to the end of 1.35 horizons

    found = run(expert=watching)

    assert len(found.action) == round(1.35 * 30)
    assert max(shares) == 1.0
    assert sum(share == 1.0 for share in shares) > 5


@pytest.mark.parametrize(
    "wrong",
    [{"rounds": -1}, {"worlds": 0}, {"takeover": (0.8, 0.5)}, {"takeover": (0.1, 1.5)}],
)
def test_settings_that_contradict_are_refused(wrong):
    with pytest.raises(ValueError, match=r"must be|takeover is"):
        DistillationConfig(**wrong)

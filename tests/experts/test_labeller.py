"""Who labels: a program that is named as what it is, and judged, loaded and refused as experts are."""

import json
from pathlib import Path

import numpy as np
import pytest

from v2p_data.craft_data import contents
from v2p_data.errors import V2PError
from v2p_data.evaluation.judging import contestant
from v2p_data.experts.config import ExpertConfig
from v2p_data.experts.labeller import PROGRAM_FILE, choose_program, labeller_of
from v2p_data.experts.learning import Worlds
from v2p_data.experts.teacher import LIFT, Teacher
from v2p_data.play import View
from v2p_data.task.benchmark import load_benchmark


@pytest.fixture(scope="module")
def lift() -> Worlds:
    return Worlds(bundle=load_benchmark("lift_up"), seed=3)


@pytest.fixture(scope="module")
def chosen(lift: Worlds, tmp_path_factory: pytest.TempPathFactory):
    folder = tmp_path_factory.mktemp("expert")
    cfg = ExpertConfig(start="as_program", trial_worlds=8)
    return folder, choose_program(lift, cfg, folder)


def test_the_program_that_lifts_is_the_expert_and_nobody_calls_it_learned(chosen):
    folder, learned = chosen

    assert json.loads((folder / PROGRAM_FILE).read_text()) == {"program": LIFT}
    assert (learned.kept, learned.actor_updates, learned.teacher) == ("program", 0, LIFT)
    assert learned.made_by == "program: 'lift' itself, nothing was learned"
    assert learned.as_dict()["kept"] == "program"


def test_it_acts_from_any_state_as_the_teacher_does(chosen, lift: Worlds):
    env = lift.make(6, "acting")
    expert, teacher = labeller_of(chosen[0]), Teacher(env)
    expert.reset(env)
    teacher.name = LIFT
    view = View(env)

    for _ in range(3):
        assert np.array_equal(expert.act(view), teacher.act())
        env.step(np.full((6, 7), 0.3))


def test_a_judge_takes_it_for_an_expert_and_knows_it_by_its_program(chosen, tmp_path: Path):
    who = contestant(chosen[0])
    (tmp_path / PROGRAM_FILE).write_text(json.dumps({"program": "tip over"}))

    assert who.kind == "expert"
    assert contents("expert", chosen[0]) != contents("expert", tmp_path)


def test_a_program_that_the_task_has_not_is_named_with_those_it_has(lift: Worlds, tmp_path: Path):
    (tmp_path / PROGRAM_FILE).write_text(json.dumps({"program": "fly"}))

    with pytest.raises(V2PError, match=r"is the program 'fly', and task '.*' has lift, "):
        labeller_of(tmp_path).reset(lift.make(1, "none"))

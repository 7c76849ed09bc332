import inspect
import sys
from pathlib import Path

import pytest
import torch

from v2p_data.task.reader.check import check_code
from v2p_data.task.reader.refusal import TaskCodeError
from v2p_data.task.sandbox import load_task
from v2p_data.task.smoke import _results
from v2p_data.task.smoke_child import FakePlacer
from v2p_data.task.watched import StatesChangedError

sys.path.insert(0, str(Path(__file__).parent))
from escapes import program
from harmless import ACCEPTED, REFUSED_WITH_ADVICE

CODE = '''
import torch
import math
{top}
scene_info = {{"task_class_name": "Lift"}}

class Lift(Task):
    """Lifts."""
    def __init__(self, envs, urdf_assets_root):
        super().__init__(envs, urdf_assets_root, scene_info)
    def compute_success(self, states):
        x = states["box_pos"]
        {body}
        return x[:, 2] > 0.1
    def compute_reward(self, actions, states):
        return reward_function(actions, states)

def reward_function(actions, states):
    r = 1 - torch.tanh(torch.norm(states["box_pos"] - states["eef_pos"], dim=-1))
    return r, {{"reach": r}}
'''


def code(body="pass", top=""):
    return CODE.format(body=body.replace("\n", "\n        "), top=top)


def placer(n=3):
    pose = torch.tensor([[0.5, 0, 0.02, 1, 0, 0, 0]]).repeat(n, 1)
    return FakePlacer(
        {"eef_pos": pose[:, :3], "box_pos": pose[:, :3], "box_quat": pose[:, 3:]}, ["box"]
    )


@pytest.mark.parametrize("source", ACCEPTED.values(), ids=ACCEPTED)
def test_a_harmless_program_is_accepted(source):
    check_code(source)


@pytest.mark.parametrize(
    ("source", "advice"), REFUSED_WITH_ADVICE.values(), ids=REFUSED_WITH_ADVICE
)
def test_a_harmless_program_that_is_refused_hears_which_line_and_what_to_do(source, advice):
    with pytest.raises(TaskCodeError) as refusal:
        check_code(source)

    assert advice in refusal.value.reason
    assert refusal.value.line is not None
    skeleton = program("#BODY").splitlines()
    assert source.splitlines()[refusal.value.line - 1] != skeleton[refusal.value.line - 1]


def test_the_line_named_is_the_line_in_the_text():
    source = code("y = 1\ny = eval('2')")

    with pytest.raises(TaskCodeError) as refusal:
        check_code(source)

    assert refusal.value.line is not None
    assert source.splitlines()[refusal.value.line - 1].strip() == "y = eval('2')"


def test_code_that_is_no_python_gets_the_line():
    with pytest.raises(TaskCodeError, match="line 2: it is not Python"):
        check_code("x = 1\ny = = 2\n")


def test_loaded_code_has_no_way_to_builtins(scene_of):
    task = load_task(code(), placer(), scene_of("lift_up"))

    inside = inspect.unwrap(type(task).compute_success).__globals__
    assert "open" not in inside["__builtins__"]
    assert not hasattr(inside["torch"], "load")
    assert inside["torch"] is not sys.modules["torch"]


def test_task_code_sees_two_things_of_the_environment(scene_of):
    task = load_task(code(), placer(), scene_of("lift_up"))

    assert task.envs.num_envs == 3
    assert set(task.reset_objects_states(torch.arange(2))) == {"box"}
    assert not hasattr(task.envs, "_states")


def test_writing_into_a_state_stops_a_loaded_task(scene_of):
    task = load_task(code("if len(x) > 16:\n    x[0, 2] = 1"), placer(), scene_of("lift_up"))
    small = {"box_pos": torch.zeros(2, 3), "eef_pos": torch.zeros(2, 3)}
    large = {"box_pos": torch.zeros(32, 3), "eef_pos": torch.zeros(32, 3)}

    assert not task.compute_success(small).any()
    with pytest.raises(StatesChangedError, match=r"changes states\['box_pos'\] in place"):
        task.compute_success(large)


def test_a_key_that_the_task_added_may_be_written_again(scene_of):
    source = code("states['height'] = x[:, 2:3] + 1\nstates['height'] = x[:, 2]")
    task = load_task(source, placer(), scene_of("lift_up"))
    states = {"box_pos": torch.zeros(2, 3), "eef_pos": torch.zeros(2, 3)}

    for _ in range(2):
        task.compute_success(states)

    assert states["height"].shape == (2,)


def test_the_poses_that_a_task_is_given_are_copies(scene_of):
    given = placer()
    task = load_task(code(), given, scene_of("lift_up"))

    task.reset_objects_states(torch.arange(2))["box"].fill_(9.0)

    assert float(given.sample_object_poses(torch.arange(2))["box"].max()) == 1.0


def test_an_answer_of_another_kind_is_that_samples_own_failure():
    answer = b'[{"runnable": true, "probe_success": [1]}, {"runnable": false, "error": "a\\u001b[2Jb\\ud800"}, 7]'

    strange, shown, number = _results(answer, 3, 0)

    assert not strange.runnable
    assert not number.runnable
    assert shown.error == "a [2Jb "

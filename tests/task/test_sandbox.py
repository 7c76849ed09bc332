import inspect
import sys
from pathlib import Path

import pytest
import torch

from v2p_data.task.sandbox.reader.check import check_code
from v2p_data.task.sandbox.reader.refusal import TaskCodeError
from v2p_data.task.sandbox.sandbox import load_task
from v2p_data.task.sandbox.smoke import _answers, _result
from v2p_data.task.sandbox.smoke_child import FakePlacer

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

    inside = inspect.unwrap(type(task._task).compute_success).__globals__
    assert "open" not in inside["__builtins__"]
    assert not hasattr(inside["torch"], "load")
    assert inside["torch"] is not sys.modules["torch"]


def test_task_code_sees_two_things_of_the_environment(scene_of):
    task = load_task(code(), placer(), scene_of("lift_up"))

    assert task._task.envs.num_envs == 3
    assert set(task.reset_poses(torch.arange(2), ["box"])) == {"box"}
    assert not hasattr(task._task.envs, "_states")


def test_an_answer_of_another_kind_is_that_samples_own_failure():
    answer = b'[{"runnable": true, "probe_success": [1]}, {"runnable": false, "error": "a\\u001b[2Jb\\ud800"}, 7]'

    strange, shown, number = (_result(data, 0, 0) for data in _answers(answer, b"", 3))

    assert not strange.runnable
    assert not number.runnable
    assert shown.error == "a [2Jb "

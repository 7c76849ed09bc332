import sys

import pytest
import torch

from v2p_data.task.sandbox import TaskCodeError, check_code, load_task
from v2p_data.task.smoke import smoke_run_all
from v2p_data.task.smoke_child import FakePlacer

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


HARMLESS = [
    "for i in range(3):\n    x = x + i",
    "y = [v for v in states.values()]",
    "m = torch.where(x > 0, x, torch.zeros_like(x)).clamp(0.0, 1.0)",
    "n = torch.linalg.norm(x, dim=-1) ** 2 if len(states) > 3 else x",
    "name = 'box'\ny = states[f'{name}_pos']",
    "a, b = x[:, 0], x[..., 1]\na += b",
    "y = torch.stack([x, x], dim=0).mean(dim=0) * math.pi",
    "self.seen = x\ny = self.seen",
    "w: float = 1.0",
]


@pytest.mark.parametrize("body", HARMLESS)
def test_harmless_code_loads_and_runs(body, scene_of):
    task = load_task(code(body), placer(), scene_of("lift_up"))

    states = {"box_pos": torch.tensor([[0, 0, 0.2], [0, 0, 0.0]]), "eef_pos": torch.zeros(2, 3), "a": torch.ones(1), "b": torch.ones(1)}  # fmt: skip

    assert task.compute_success(states)[0].item() in (True, False)


ESCAPES = {
    "dunder walk": "y = x.__class__.__mro__",
    "subclasses through a constant": "y = ().__class__.__bases__[0].__subclasses__()",
    "import": "import os",
    "import by name": "y = __import__('os')",
    "open": "y = open('/etc/passwd')",
    "eval": "y = eval('1')",
    "exec through a list": "y = [exec][0]('1')",
    "getattr": "y = getattr(x, 'data')",
    "globals": "y = globals()",
    "type": "y = type(x)",
    "torch.load": "y = torch.load('x')",
    "torch.save": "torch.save(x, 'x')",
    "torch.ops": "torch.ops.aten.add(x, x)",
    "torch.hub": "torch.hub.load('a', 'b')",
    "torch.jit.load": "torch.jit.load('x')",
    "torch.utils": "torch.utils.cpp_extension.load('x')",
    "ctypes through torch": "torch.ctypes.CDLL('libc.so.6')",
    "torch under another name": "t = torch\nt.load('x')",
    "numpy writes files": "x.numpy().tofile('x')",
    "storage": "x.untyped_storage()",
    "in place": "x.zero_()",
    "format reads attributes": "y = '{0.device}'.format(x)",
    "f-string reads attributes": "y = f'{x.device}'",
    "f-string width": "n = 1\ny = f'{n:1000000000}'",
    "percent width": "y = '%1000000000d' % 1",
    "lambda": "f = lambda a=open: a",
    "while": "while True:\n    pass",
    "generator": "y = sum(i for i in range(9))",
    "comprehension bomb": "y = [1 for a in range(9) for b in range(9)]",
    "loops within loops": "for a in range(9):\n    for b in range(9):\n        for c in range(9):\n            pass",
    "huge power": "y = 9 ** 9 ** 9",
    "power of a name": "n = 9\ny = n ** n",
    "shift": "y = 1 << 999999",
    "huge number": "y = 10000000000000000000",
    "long list": "y = [0] * 999999",
    "long string": "y = 'a' * 999999",
    "global": "global scene_info\nscene_info = 1",
    "try": "try:\n    pass\nexcept BaseException:\n    pass",
    "with": "with x:\n    pass",
    "walrus": "y = (z := 1)",
    "star call": "torch.zeros(*[1, 2])",
    "double star call": "torch.zeros(**{'size': (1,)})",
    "out argument": "torch.add(x, x, out=states['eef_pos'])",
    "new self": "self = states",
    "new torch": "torch = states",
    "private attribute": "self.envs._envs.bundle",
    "the environment's inside": "self.envs.bundle",
    "base class's inside": "Task.compute_success(self, states)",
    "super with arguments": "super(Lift, self).compute_success(states)",
    "super's attribute": "y = super().scene_info",
    "own name of a tensor's method": "self.untyped_storage = 1",
    "function in a function": "def f():\n    pass",
    "class in a function": "class A:\n    pass",
    "unicode look-alike": "\N{FULLWIDTH LATIN SMALL LETTER E}val('1')",
    "deep nesting": "y = " + "(" * 300 + "1" + ")" * 300,
    "deep operators": "y = " + "-" * 60 + "1",
    "match": "match x:\n    case _:\n        pass",
    "await": "await x",
    "random numbers": "y = torch.rand(3)",
}  # fmt: skip


@pytest.mark.parametrize("body", ESCAPES.values(), ids=ESCAPES)
def test_an_escape_is_refused_with_its_line(body):
    with pytest.raises(TaskCodeError) as refusal:
        check_code(code(body))

    if "nesting" not in body:
        assert refusal.value.line is None or refusal.value.line > 0
    assert refusal.value.reason


@pytest.mark.parametrize(
    "top",
    [
        "print('hello')",
        "x = open('f')",
        "from os import system",
        "import torch as t",
        "from torch import load",
        "@staticmethod\ndef f():\n    pass",
        "def f(a=open('x')):\n    pass",
        "def f(*a):\n    pass",
        "def f(a: open('x')):\n    pass",
        "class Other(Task):\n    pass",
        "_hidden = 1",
        "x = [i for i in (1, 2)]",
        "for i in range(3):\n    pass",
    ],
)
def test_nothing_but_constants_functions_and_the_class_stands_at_module_level(top):
    with pytest.raises(TaskCodeError):
        check_code(code(top=top))


def test_the_line_named_is_the_line_in_the_text():
    source = code("y = 1\ny = eval('2')")

    with pytest.raises(TaskCodeError) as refusal:
        check_code(source)

    assert source.splitlines()[refusal.value.line - 1].strip() == "y = eval('2')"


def test_a_program_too_large_is_refused():
    with pytest.raises(TaskCodeError, match="characters"):
        check_code(code("y = 1\n" * 20_000))
    with pytest.raises(TaskCodeError, match="syntax nodes"):
        check_code(code("y=1;" * 9_000))


def test_code_that_is_no_python_gets_the_line():
    with pytest.raises(TaskCodeError, match="line 2: it is not Python"):
        check_code("x = 1\ny = = 2\n")


def test_loaded_code_has_no_way_to_builtins(scene_of):
    task = load_task(code(), placer(), scene_of("lift_up"))

    inside = type(task).compute_success.__globals__
    assert "open" not in inside["__builtins__"]
    assert not hasattr(inside["torch"], "load")
    assert inside["torch"] is not sys.modules["torch"]


def test_task_code_sees_two_things_of_the_environment(scene_of):
    task = load_task(code(), placer(), scene_of("lift_up"))

    assert task.envs.num_envs == 3
    assert set(task.reset_objects_states(torch.arange(2))) == {"box"}
    assert not hasattr(task.envs, "_states")


@pytest.mark.slow
def test_what_cannot_be_read_off_is_contained_by_the_child(scene_of):
    """One child for all, so that torch is imported once; each sample is its own result."""
    attempts = {
        "fine": (code(), ""),
        "memory bomb": (code("y = torch.zeros(200000, 200000)"), "memory"),
        "endless growth": (code("y = 3\nfor i in range(999):\n    y = y * y"), "took more than"),
        "deep recursion": (code("return self.compute_success(states)"), "RecursionError"),
        "unknown state": (code("y = states['nothing']"), "line 13: KeyError"),
        "changes its input": (code("x[0, 0] = 1"), "changes states['box_pos'] in place"),
        "wrong type": (code("return x"), "compute_success must have one row"),
        "not bool": (code("return x[:, 2]"), "must be of type torch.bool"),
        "divides by zero": (code("y = 1 / 0"), "line 13: ZeroDivisionError"),
        "not a number": (code().replace("r = 1 -", "r = torch.log(-states['progress'] - 1) -"), "not finite"),
        "depends on order": (code("x = x * torch.arange(len(x)).reshape(-1, 1)"), "order"),
        "wrong length": (
            code().replace("    def compute_reward", "    def get_observation_space(self):\n        return 7\n    def compute_reward"),
            "says 7, but the observation has length 90",
        ),
        "long range": (code("for i in range(999999):\n    pass"), "range of 999999 steps"),
        "remembers": (
            code("self.calls = self.calls + 1\nx = x * self.calls").replace(
                "scene_info)\n", "scene_info)\n        self.calls = 0\n"
            ),
            "two calls",
        ),
    }  # fmt: skip

    results = smoke_run_all(
        [source for source, _ in attempts.values()], scene_of("lift_up"), seconds_each=5.0
    )

    got = dict(zip(attempts, results, strict=True))
    assert got["fine"].runnable
    assert got["fine"].components == ("reach",)
    for name, (_, words) in attempts.items():
        if name != "fine":
            assert not got[name].runnable, name
            assert words in got[name].error, name


@pytest.mark.slow
def test_the_fork_can_open_no_file_and_start_no_process(monkeypatch, tmp_path):
    """What a hole in the reader would let through, run by the fork itself."""
    from v2p_data.task import smoke_child

    target = tmp_path / "written"
    outcomes = {}

    def hostile(source, request):
        try:
            {
                "write": lambda: target.write_text("x"),
                "read": lambda: open("/etc/hostname").read(),  # noqa: PTH123, SIM115
                "socket": lambda: __import__("socket").socket(),
                "process": lambda: __import__("os").fork(),
            }[source]()
        except OSError as error:
            return {"runnable": False, "error": type(error).__name__}
        return {"runnable": True}

    monkeypatch.setattr(smoke_child, "_answer", hostile)
    for attempt in ("write", "read", "socket", "process"):
        outcomes[attempt] = smoke_child._in_a_fork(attempt, {"seconds_each": 20})

    assert not target.exists()
    assert {k: v["runnable"] for k, v in outcomes.items()} == dict.fromkeys(outcomes, False)

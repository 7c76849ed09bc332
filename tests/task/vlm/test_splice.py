"""A reward from a stranger goes into a task, and the task's success says what it said before."""

import ast

import pytest
import torch

from v2p_data.errors import V2PError
from v2p_data.seeds import rng_for
from v2p_data.task.llm.example_tasks import GRASP_A_BLOCK, block_scene
from v2p_data.task.sandbox.probes import random_states
from v2p_data.task.sandbox.reader.check import check_code
from v2p_data.task.sandbox.sandbox import load_task
from v2p_data.task.sandbox.smoke_child import FakePlacer
from v2p_data.task.sandbox.splice import SpliceError, reward_part, with_reward
from v2p_data.task.templates.write import write_samples

PARENT = '''
import torch
from factory.tasks.task import Task

scene_info = {"task_class_name": "Up", "objects": ["block"]}
LIMITS = {"up": 0.02}
HEIGHT: float = 0.01
SCALES = [1.0, 2.0]


class Up(Task):
    def __init__(self, envs, urdf_assets_root):
        super().__init__(envs, urdf_assets_root, scene_info)

    def compute_observation_key(self, states):
        obs_keys = super().compute_observation_key(states)
        states["rise"] = height(states) * 5
        obs_keys.append("rise")
        return obs_keys

    def get_observation_space(self):
        return super().get_observation_space() + 1

    def compute_success(self, states):
        least = max(limits()["up"], HEIGHT) * scale()[0]
        return height(states) > least

    def compute_reward(self, actions, states):
        # may be more than one line
        reward, parts = reward_function(actions, states)
        return reward, parts


# REWARD FUNCTION
@torch.jit.script
def reward_function(actions, states):
    """The old one."""
    r = height(states)
    return r, {"height": r}


def height(states):
    return states["block_pos"][:, 2] - states["block_start_pos"][:, 2]


def limits():
    return LIMITS


def scale(given=[1.0]):
    return given
'''

REWARD = '''
@torch.jit.script
def reward_function(actions, states):
    # type: (Tensor, Dict[str, Tensor]) -> Tuple[Tensor, Dict[str, torch.Tensor]]
    """Thoughts."""
    r = BODY  # with a reason
    return r, {"new": r}
'''


def reward(body, more=""):
    return REWARD.replace("BODY", body) + more


@pytest.fixture(scope="module")
def moments():
    return {
        k: torch.from_numpy(v)
        for k, v in random_states(block_scene(), 64, rng_for(0, "splice")).items()
    }


def said_by(code, moments):
    """Return the task's observation, success, reward, and again its success."""

    def show():
        return {k: v.clone() for k, v in moments.items()}

    task = load_task(code, FakePlacer(show(), ["block"]), block_scene())
    said = task.judge(show, torch.zeros(64, 7))
    return said.observation, said.success, said.reward, said.components, task.succeeds(show)


ATTACKS = {
    "plain": reward("-states['rise']"),
    "its own helper of the same name": reward(
        "height(states)", "\ndef height(states):\n    return states['block_pos'][:, 2] * 0 + 7\n"
    ),
    "a builtin of the success function": reward(
        "max(states['rise'])", "\ndef max(a, b=0):\n    return a * 0 - 5\n"
    ),
    "a constant of the same name": reward(
        "states['rise'] * LIMITS['up']", "\nLIMITS = {'up': -10.0}\n"
    ),
    "changing a constant in place": reward(
        "states['rise'] + shifted(LIMITS)",
        "\ndef shifted(x):\n    x.update({'up': -10.0})\n    return 3.0\n",
    ),
    "changing a constant in place, under another name": (
        "def reward_function(actions, states):\n"
        "    same = LIMITS\n"
        "    same['up'] = -10.0\n"
        "    r = states['rise'] * 2\n"
        "    return r, {'new': r}\n"
    ),
    "a whole file": PARENT.replace("max(limits()", "min(-9, limits()").replace(
        "r = height(states)", "r = -height(states)"
    ),
    "an assignment to two names": reward(
        "states['rise'] * weight", "\nweight = LIMITS = {'up': -10.0}\n"
    ).replace("* weight", "* weight['up']"),
    "an assignment to two names, the goal's first": reward(
        "states['rise'] * weight", "\nHEIGHT = weight = -9.0\n"
    ),
    "annotated, on the line of another": reward(
        "states['rise'] * weight", "\nweight = 2.0; HEIGHT: float = -9.0\n"
    ),
    "a line that ends where editors show none": reward(
        "states['rise'] * weight", "\nweight = 2.0\rHEIGHT = -9.0\n"
    ),
    "an import under the goal's name": reward("-states['rise']", "\nimport math as HEIGHT\n"),
    "a class under the goal's name": reward(
        "-states['rise']", "\nclass HEIGHT:\n    global LIMITS\n    LIMITS = {'up': -9}\n"
    ),
    "changing a constant that a helper hands out": (
        "def reward_function(actions, states):\n"
        "    same = limits()\n"
        "    same['up'] = -10.0\n"
        "    r = states['rise'] * 2\n"
        "    return r, {'new': r}\n"
    ),
    "changing a helper's default in place": (
        "def reward_function(actions, states):\n"
        "    same = scale()\n"
        "    same[0] = -10.0\n"
        "    r = states['rise'] * 2\n"
        "    return r, {'new': r}\n"
    ),
    "helpers that call each other": reward(
        "outer(states)",
        "\ndef outer(states):\n    return height(states) + 1\n"
        "\ndef height(states):\n    return states['eef_pos'][:, 2]\n",
    ),
}


@pytest.mark.parametrize("attack", ATTACKS)
def test_a_new_reward_leaves_success_and_observations_as_they_were(attack, moments):
    made = with_reward(PARENT, ATTACKS[attack])

    check_code(made)
    old, new = said_by(PARENT, moments), said_by(made, moments)
    assert all(torch.equal(a, b) for a, b in zip(old[0], new[0], strict=True))
    assert torch.equal(old[1], new[1])
    assert torch.equal(old[4], new[4])
    assert 0 < old[1].sum() < 64
    assert not torch.equal(old[2], new[2])
    assert made.count("def reward_function(") == 1


def test_the_reward_does_what_its_writer_said(moments):
    made = with_reward(PARENT, ATTACKS["its own helper of the same name"])
    nested = with_reward(PARENT, ATTACKS["helpers that call each other"])

    assert torch.equal(said_by(made, moments)[2], torch.full((64,), 7.0))
    assert torch.allclose(said_by(nested, moments)[2], moments["eef_pos"][:, 2] + 1)


def test_what_is_not_reward_keeps_every_line_and_the_reward_its_docstring():
    made = with_reward(PARENT, ATTACKS["plain"])

    before, after = (
        PARENT.split("    def compute_reward")[0],
        made.split("    def compute_reward")[0],
    )
    assert after == before
    assert '"""Thoughts."""' in made
    assert "The old one" not in made
    assert "return reward_function(actions, states)" in made


def test_rewards_can_be_put_into_what_our_own_templates_write(scene_of):
    first, *others = write_samples(scene_of("insert"), 4)

    for other in others:
        made = with_reward(first, other)
        check_code(made)
        assert reward_part(made) == reward_part(other) != reward_part(first)


def test_the_same_reward_in_other_words_is_sent_back():
    same = GRASP_A_BLOCK.split("# REWARD FUNCTION")[1].replace("# type:", "# kinds:")

    with pytest.raises(SpliceError, match="was there before"):
        with_reward(GRASP_A_BLOCK, same)


@pytest.mark.parametrize(
    "more",
    [
        "HEIGHT += -9.0",
        "weight = (HEIGHT := -9.0)",
        "weight, HEIGHT = 1.0, -9.0",
        "del HEIGHT",
        "LIMITS['up'] = -9.0",
        "LIMITS.update({'up': -9.0})",
        "for HEIGHT in [-9.0]:\n    weight = 1.0",
        "if 1:\n    HEIGHT = -9.0",
        "with f() as HEIGHT:\n    pass",
        "def shifted():\n    global HEIGHT\n    HEIGHT = -9.0",
        "def shifted(x=(HEIGHT := -9.0)):\n    return x",
        "@(HEIGHT := max)\ndef shifted(x):\n    return x",
        "async def HEIGHT():\n    pass",
        "type HEIGHT = int",
        "weight = 1.0; LIMITS['up'] = -9.0",
    ],
)
def test_an_answer_that_binds_names_in_another_way_is_sent_back(more):
    line = REWARD.count("\n") + 1 + more.startswith("@")

    with pytest.raises(SpliceError, match=f"Line {line} of your code may change what else"):
        with_reward(PARENT, reward("-states['rise']", more + "\n"))


def test_two_names_of_one_constant_become_two_constants_and_only_what_is_used_is_taken():
    made = with_reward(PARENT, ATTACKS["an assignment to two names, the goal's first"])

    assert "\nweight = -9.0\n" in made
    assert made.count("HEIGHT") == PARENT.count("HEIGHT")


def test_an_answer_of_endless_sums_is_sent_back():
    with pytest.raises(SpliceError, match=r"not Python|too large"):
        with_reward(PARENT, reward(" + ".join(["1.0"] * 3000)))


@pytest.mark.parametrize(
    ("answer", "words"),
    [
        ("def reward_function(a, s:\n", "not Python, line 1"),
        ("def other(a, s):\n    return a\n", "at module level"),
        ("reward_function = 3\n", "at module level"),
        ("class A:\n    def reward_function(self):\n        return 1\n", "at module level"),
    ],
)
def test_an_answer_without_a_reward_says_why(answer, words):
    with pytest.raises(SpliceError, match=words):
        with_reward(PARENT, answer)


def test_a_task_whose_success_is_its_reward_gets_no_other():
    coupled = PARENT.replace(
        "return height(states) > least",
        "return reward_function(states['eef_pos'], states)[0] > least",
    )
    check_code(coupled)

    with pytest.raises(V2PError, match="compute_success of this task code calls its reward"):
        with_reward(coupled, ATTACKS["plain"])


def test_a_task_that_computes_its_reward_in_the_class_gets_a_function(moments):
    tree = ast.parse(PARENT)
    tree.body = [n for n in tree.body if getattr(n, "name", "") != "reward_function"]
    bare = ast.unparse(tree).replace(
        "reward, parts = reward_function(actions, states)",
        "reward, parts = height(states), {'h': height(states)}",
    )

    made = with_reward(bare, ATTACKS["plain"])

    check_code(made)
    rise = moments["block_pos"][:, 2] - moments["block_start_pos"][:, 2]
    assert torch.equal(said_by(made, moments)[2], -rise * 5)


def test_a_helper_with_the_name_of_the_class_gets_another(moments):
    named = reward("Up(states['rise'])", "\ndef Up(x):\n    return x * 3\n")

    made = with_reward(PARENT, named)

    assert "def reward_Up(x)" in made
    assert torch.equal(said_by(made, moments)[2], said_by(PARENT, moments)[0][:, -1] * 3)

"""Task code that cheats in the simulator, past the trial run, which it may have deceived."""

import contextlib
from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest
import torch

from v2p_data.episodes.rollouts import CutConfig, Lesson, roll_out
from v2p_data.errors import ItemRejectedError, V2PError
from v2p_data.play import StateActor
from v2p_data.scene.scene import SceneObject
from v2p_data.sim.env.batch_env import BatchEnv, SimConfig
from v2p_data.task.sandbox import guarded
from v2p_data.task.sandbox.guarded import StatesChangedError, TaskOutputError
from v2p_data.task.task import TaskBundle

NUM_WORLDS = 6
CODE = """
import torch
scene_info = {{}}

class Lift(Task):
    def __init__(self, envs, urdf_assets_root):
        super().__init__(envs, urdf_assets_root, scene_info)
        self.count = 0
        self.kept = []

    def reset_objects_states(self, env_ids):
        {reset}
        return self.envs.sample_object_poses(env_ids)

    def compute_observation_key(self, states):
        keys = super().compute_observation_key(states)
        {observe}
        return keys

    def get_observation_space(self):
        return {size}

    def compute_success(self, states):
        self.count = self.count + 1
        success = states["cube_pos"][:, 2] > 0.2
        {success}
        return success

    def compute_reward(self, actions, states):
        reward = states["cube_pos"][:, 2] * 1.0
        parts = {{"height": reward}}
        {reward}
        return reward, parts
"""


def code(size="90", **bodies: str) -> str:
    parts = ("reset", "observe", "success", "reward")
    indented = {k: bodies.get(k, "pass").replace("\n", "\n        ") for k in parts}
    return CODE.format(size=size, **indented)


@pytest.fixture
def make_env(make_bundle: Callable[..., TaskBundle]) -> Callable[..., BatchEnv]:
    def make(**bodies: str) -> BatchEnv:
        bundle = replace(make_bundle(), code=code(**bodies), class_name="Lift")
        return BatchEnv(bundle, num_envs=NUM_WORLDS, seed=0, num_threads=1)

    return make


def idle(env: BatchEnv, steps: int = 12) -> None:
    for _ in range(steps):
        env.step(np.zeros((NUM_WORLDS, 7)))


FORGERIES = {
    "the observation of a dict of its own, then a write": {
        "success": "own = {}\nfor key in states:\n    own[key] = states[key] * 0\nself.compute_observation_key(own)\n"
        "states['cube_pos'][:, 2] = 0.5\nsuccess = states['cube_pos'][:, 2] > 0.2"
    },
    "a state that was kept, written into in another call": {
        "observe": "self.kept.append(states['cube_pos'])",
        "success": "self.kept[0].add_(1.0)\nsuccess = states['cube_pos'][:, 2] > 0.2",
    },
    "a state replaced by another tensor": {
        "success": "states['cube_pos'] = states['cube_pos'] + 1.0\nsuccess = states['cube_pos'][:, 2] > 0.2"
    },
    "a state taken away and put back larger": {
        "success": "lost = states.pop('cube_pos')\nstates.setdefault('cube_pos', lost + 1.0)\n"
        "success = states['cube_pos'][:, 2] > 0.2"
    },
    "many states by update": {
        "observe": "states.update({'cube_pos': states['cube_pos'] + 1.0, 'cube_start_pos': states['cube_pos'] * 0})",
    },
    "a view of a state, through a helper": {
        "reward": "row = states['cube_pos'][:, 2]\nrow.fill_(1.0)",
    },
    "the dict itself, kept and filled during a reset": {
        "observe": "self.kept.append(states)",
        "reset": "for old in self.kept:\n    for key in old:\n        old[key].fill_(1.0)",
    },
    "the poses of the last reset, kept and lifted": {
        "reset": "for old in self.kept:\n    "
        "old.add_(1.0)\nself.kept.append(self.envs.sample_object_poses(env_ids)['cube'])",
    },
    "the actions": {"reward": "actions.fill_(1.0)"},
    "success for everybody": {"success": "success = states['cube_pos'][:, 2] > -1.0"},
}


@pytest.mark.parametrize("bodies", FORGERIES.values(), ids=FORGERIES)
def test_no_idle_robot_gets_an_episode_that_counts(
    bodies: dict[str, str], make_bundle: Callable[..., TaskBundle]
):
    bundle = replace(make_bundle(horizon=14), code=code(**bodies), class_name="Lift")
    idle = StateActor(lambda obs: np.zeros((len(obs), 7), np.float32))

    counted = 0
    with contextlib.suppress(StatesChangedError, ItemRejectedError):
        counted = roll_out(
            Lesson(bundle=bundle, expert=idle),
            SimConfig(),
            num_worlds=NUM_WORLDS,
            seed=0,
            cut=CutConfig(),
        ).successes.sum()

    assert counted == 0


GOAL = "if len(self.kept) == 0:\n    self.kept.append(torch.full((1,), 0.2))\n"
ABOVE = "success = states['cube_pos'][:, 2] > "
REACHES = {
    "the task's own tensor among the states": {
        "observe": GOAL + "states['goal'] = self.kept[0]",
        "success": ABOVE + "states['goal']",
        "reward": "states['goal'].fill_(-9.0)",
    },
    "a view of it, made by the observation": {
        "observe": GOAL + "states['goal'] = self.kept[0].view(1, 1)[0]",
        "success": ABOVE + "self.kept[0]",
        "reward": "states['goal'].sub_(9.0)",
    },
    "an attribute": {
        "observe": GOAL,
        "success": ABOVE + "self.kept[0]",
        "reward": "self.kept[0].fill_(-9.0)",
    },
    "an attribute bound anew": {
        "success": ABOVE + "0.2 - 9.0 * len(self.task_description)",
        "reward": "self.task_description = 'a'",
    },
    "a list": {
        "observe": GOAL,
        "success": ABOVE + "self.kept[-1]",
        "reward": "self.kept.append(torch.full((1,), -9.0))",
    },
    "what success kept of the states": {
        "success": "self.kept.append(states['cube_pos'][:, 2] * 1.0)\nsuccess = self.kept[-1] > self.kept[0] + 0.1",
        "reward": "self.kept[0].fill_(-9.0)",
    },
    "a dict of the module": {
        "success": ABOVE + "scene_info.get('goal', 0.2)",
        "reward": "scene_info.update({'goal': -9.0})",
    },
    "a list of the module": {
        "success": ABOVE + "LEVELS[-1]",
        "reward": "LEVELS.append(-9.0)",
    },
    "the default of a function": {
        "success": ABOVE + "levels_of()[-1]",
        "reward": "levels_of().append(-9.0)",
    },
    "where objects start": {
        "observe": GOAL,
        "reset": "poses = self.envs.sample_object_poses(env_ids)\nif len(self.kept) > 1:\n"
        "    poses['cube'][:, 2] += 0.5\nreturn poses",
        "reward": "self.kept.append(self.kept[0])",
    },
}
"""Ways from a reward to what success reads."""


@pytest.mark.parametrize("bodies", REACHES.values(), ids=REACHES)
def test_no_reward_reaches_what_success_reads(
    bodies: dict[str, str], make_bundle: Callable[..., TaskBundle]
):
    module = "scene_info = {}\nLEVELS = [0.2]\n\ndef levels_of(levels=[0.2]):\n    return levels\n"
    text = code(**bodies).replace("scene_info = {}", module)
    bundle = replace(make_bundle(), code=text, class_name="Lift")

    env = BatchEnv(bundle, num_envs=NUM_WORLDS, seed=0, num_threads=1)
    for _ in range(3):
        results = [env.step(np.zeros((NUM_WORLDS, 7))) for _ in range(4)]
        assert not np.any([r.success for r in results])
        assert np.isfinite(results[-1].reward).all()
        env.reset(np.arange(NUM_WORLDS))


COUNTING = """
self.count = self.count + 1
poses = self.envs.sample_object_poses(env_ids)
if self.count > {honest}:
    {cheat}
return poses"""
STARTS = {
    "held above the table": ("poses['cube'][-1, 2] += 0.09", "starts_in_the_air", "90 mm above"),
    "in the table": ("poses['cube'][-1, 2] -= 0.01", "starts_in_the_table", "inside the table"),
    "far under the table": (
        "poses['cube'][-1, 2] -= 900.0",
        "starts_in_the_table",
        "inside the table",
    ),
    "900 km away": ("poses['cube'][-1, 0] += 900000.0", "starts_off_the_table", "1.4 m"),
}


@pytest.mark.parametrize(("cheat", "reason", "words"), STARTS.values(), ids=STARTS)
@pytest.mark.parametrize("honest", [0, 2], ids=["at once", "at the third reset"])
def test_no_world_starts_where_it_cannot_at_any_reset(
    cheat: str, reason: str, words: str, honest: int, make_env: Callable[..., BatchEnv]
):
    def three_starts() -> None:
        env = make_env(reset=COUNTING.format(honest=honest, cheat=cheat))
        for k in (2, 5):
            env.reset(np.array([k]))

    with pytest.raises(ItemRejectedError, match="task 'test' starts 'cube'") as caught:
        three_starts()

    assert caught.value.reason == reason
    assert words in caught.value.detail


TOWER = """height = 0.0
    for name in ["cup", "lid", "cube"]:
        poses[name][-1, 2] += height
        height = 2 * poses[name][-1, 2] - height
        poses[name][-1, :2] = torch.tensor([0.51, 0.0])"""
HOLLOW_STARTS = {
    "a cube in a cup's wall": (
        "poses['cube'][-1, :2] = poses['cup'][-1, :2] + torch.tensor([0.03, 0.0])",
        "each_other",
    ),
    "two cups in each other": ("poses['lid'][-1, :3] = poses['cup'][-1, :3] + 0.01", "each_other"),
    "a tower up to the arm": (TOWER, "arm"),
}


@pytest.mark.parametrize("honest", [0, 2], ids=["at once", "at the third reset"])
@pytest.mark.parametrize(("place", "reason"), list(HOLLOW_STARTS.values()), ids=HOLLOW_STARTS)
def test_no_hollow_thing_starts_in_another_or_in_the_arm_in_any_world_at_any_reset(
    place: str,
    reason: str,
    honest: int,
    make_bundle: Callable[..., TaskBundle],
    make_object: Callable[..., SceneObject],
):
    hollow = {"shape": "cylinder", "role": "reference", "hollow": True}
    objects = [make_object("cube", size_m=(0.05, 0.05, 0.05))]
    objects += [
        make_object(name, size_m=(0.08, 0.08, 0.08), pos=(0.0, y, 0.04), **hollow)
        for name, y in (("cup", 0.15), ("lid", -0.15))
    ]
    text = code(reset=COUNTING.format(honest=honest, cheat=place))
    bundle = replace(make_bundle(*objects), code=text, class_name="Lift")

    def three_starts() -> None:
        env = BatchEnv(bundle, num_envs=20, seed=0, num_threads=1)
        for _ in range(2):
            env.reset(np.arange(11, 20))

    with pytest.raises(ItemRejectedError, match="task 'test' starts") as caught:
        three_starts()

    assert reason in caught.value.reason


def test_a_thing_may_start_on_another_and_not_above_it(
    make_bundle: Callable[..., TaskBundle], make_object: Callable[..., SceneObject]
):
    plate = make_object("plate", size_m=(0.1, 0.1, 0.02), role="reference", pos=(0.0, 0.2, 0.01))
    bundle = make_bundle(make_object("cube"), plate)

    def start(gap_m: float) -> None:
        # The plate's top is at 2 cm, give or take a tenth; the cube's centre is half a cube above its lowest point.
        onto = (
            "poses = self.envs.sample_object_poses(env_ids)\n"
            "height = poses['cube'][:, 2] + 2 * poses['plate'][:, 2]\n"
            "poses['cube'][:, :2] = poses['plate'][:, :2]\n"
            f"poses['cube'][:, 2] = height + {gap_m}\nreturn poses"
        )
        task = replace(bundle, code=code(reset=onto), class_name="Lift")
        BatchEnv(task, num_envs=NUM_WORLDS, seed=0, num_threads=1)

    start(0.0)
    with pytest.raises(ItemRejectedError, match=r"'cube' 9[01] mm above what could carry it"):
        start(0.09)


def test_worlds_that_a_later_reset_starts_solved_never_count_and_end_it(
    make_env: Callable[..., BatchEnv],
):
    lying = "poses['cube'][:, 3:] = torch.tensor([0.5 ** 0.5, 0.5 ** 0.5, 0.0, 0.0])"
    env = make_env(
        reset=COUNTING.format(honest=1, cheat=lying),
        success="success = states['cube_up'].abs() < 0.5",
    )

    env.reset(np.arange(3))
    held = [env.step(np.zeros((NUM_WORLDS, 7))).held for _ in range(12)]
    env.reset(np.arange(3))

    assert not np.any(held)
    with pytest.raises(ItemRejectedError, match="starts solved: its success is true at 6 of 9"):
        env.step(np.zeros((NUM_WORLDS, 7)))


def test_the_states_that_are_judged_are_those_of_the_physics(make_env: Callable[..., BatchEnv]):
    name = "the dict itself, kept and filled during a reset"
    honest, hostile = make_env(), make_env(**FORGERIES[name])
    for env in (honest, hostile):
        idle(env, 3)
        env.reset(np.array([1, 4]))

    for key, value in honest.states().items():
        assert torch.equal(hostile.states()[key], value), key


def test_a_reset_reaches_only_the_worlds_that_it_is_of(make_env: Callable[..., BatchEnv]):
    env = make_env(
        reset="if len(env_ids) == 2:\n    ids = env_ids * 1\n    env_ids.fill_(0)\n    env_ids = ids"
    )
    before = env.states()["cube_pos"].clone()

    env.reset(np.array([2, 3]))

    after = env.states()["cube_pos"]
    assert torch.equal(after[[0, 1, 4, 5]], before[[0, 1, 4, 5]])
    assert not torch.equal(after[[2, 3]], before[[2, 3]])


DRAWS = {
    "in success": {"success": "self.envs.sample_object_poses(states['cube_pos'][:, 0].long())"},
    "in the observation": {"observe": "self.envs.sample_object_poses(torch.arange(1))"},
    "in the reward": {"reward": "self.envs.sample_object_poses(torch.arange(1))"},
    "of other worlds in a reset": {"reset": "self.envs.sample_object_poses(env_ids * 0)"},
    "of fewer worlds in a reset": {"reset": "self.envs.sample_object_poses(env_ids[:1])"},
}


@pytest.mark.parametrize("bodies", DRAWS.values(), ids=DRAWS)
def test_poses_are_drawn_for_a_reset_only(
    bodies: dict[str, str], make_env: Callable[..., BatchEnv]
):
    with pytest.raises(
        TaskOutputError, match=r"task 'test': sample_object_poses (may be|must be)"
    ):
        make_env(**bodies)


def test_the_worlds_numbers_are_the_same_whatever_a_task_does_in_between(
    make_env: Callable[..., BatchEnv],
):
    one, other = make_env(), make_env(success="self.kept.append(torch.zeros(3))")
    for env in (one, other):
        idle(env, 2)
        env.reset(np.arange(NUM_WORLDS))

    assert torch.equal(one.states()["cube_pos"], other.states()["cube_pos"])


LATER = "if self.count > 4:\n    "
ANSWERS = {
    "success of one row": (
        {"success": LATER + "success = success[:1]"},
        "one row per environment",
    ),
    "success of a number": (
        {"success": LATER + "success = success[0]"},
        "one row per environment",
    ),
    "success n x n": (
        {"success": LATER + "success = success[:, None] == success[None]"},
        "one row per environment",
    ),
    "success of floats": (
        {"success": LATER + "success = success.float() * float('nan')"},
        "torch.bool",
    ),
    "success of integers": ({"success": LATER + "success = success.int() + 1"}, "torch.bool"),
    "success is a list": ({"success": LATER + "success = [True]"}, "must be a tensor"),
    "success is None": ({"success": LATER + "success = None"}, "must be a tensor"),
    "a wider observation": (
        {"observe": "states['more'] = states['cube_pos']\n" + LATER + "keys.append('more')"},
        "observes 93 numbers after it observed 90",
    ),
    "an observation of other rows": (
        {"observe": "states['more'] = torch.zeros(2, 3)\n" + LATER + "keys.append('more')"},
        "one row per environment",
    ),
    "an observation that is no number": (
        {
            "observe": "states['more'] = states['cube_pos'][:, 0] * 0\nif self.count > 4:\n"
            "    states['more'] = states['more'] / 0\nkeys.append('more')",
            "size": "91",
        },
        "not finite in world 0 although",
    ),
    "an unknown key": ({"observe": LATER + "keys.append('<b>')"}, "'<b>' is not in states"),
    "keys that are no list": (
        {"observe": LATER + "keys = ('base_observation',)"},
        "a list of keys",
    ),
    "no key": ({"observe": LATER + "keys = []"}, "at least one key"),
    "a reward of one row": ({"reward": LATER + "reward = reward[:1]"}, "one row per environment"),
    "a reward n x n": (
        {"reward": LATER + "reward = reward[:, None] + reward"},
        "one row per environment",
    ),
    "a reward of doubles": ({"reward": LATER + "reward = reward.double()"}, "torch.float32"),
    "a reward that is infinite": ({"reward": LATER + "reward = reward / 0"}, "is inf in world 0"),
    "a component of one row": (
        {"reward": LATER + "parts['height'] = reward[:1]"},
        "one row per environment",
    ),
    "a component that is no tensor": (
        {"reward": LATER + "parts['height'] = 1.0"},
        "must be a tensor",
    ),
    "a new component": ({"reward": LATER + "parts['more'] = reward"}, "change from call to call"),
    "a component gone": ({"reward": LATER + "parts = {}"}, "change from call to call"),
    "the reward alone": ({"reward": LATER + "return reward"}, "a dict of its components"),
    "a component called like markup": (
        {"reward": "parts['<script>'] = reward"},
        "no name for a reward",
    ),
    "a component with a line end": ({"reward": "parts['a\\nb'] = reward"}, "no name for a reward"),
    "a component with a comma": ({"reward": "parts['a,b'] = reward"}, "no name for a reward"),
    "a component of 41 letters": (
        {"reward": f"parts['{'a' * 41}'] = reward"},
        "no name for a reward",
    ),
    "a component called by a number": ({"reward": "parts[7] = reward"}, "no name for a reward"),
    "33 components": (
        {"reward": "for i in range(33):\n    parts['a' + str(i)] = reward"},
        "more than 32 components",
    ),
    "success without numbers": (
        {"success": LATER + "success = success.to('meta')"},
        "device of the states",
    ),
    "a reward without numbers": (
        {"reward": LATER + "reward = reward.to('meta')"},
        "device of the states",
    ),
    "a component without numbers": (
        {"reward": LATER + "parts['height'] = reward.to('meta')"},
        "device of",
    ),
    "an observation without numbers": (
        {
            "observe": "states['more'] = states['cube_pos']\n"
            + LATER
            + "states['more'] = states['more'].to('meta')\n"
            "keys.append('more')",
            "size": "93",
        },
        "device of the states",
    ),
    "a success of named rows": (
        {"success": LATER + "success = torch.ones(len(success), names=['env']) > 0"},
        "must be a plain tensor",
    ),
    "a wide observation": (
        {"observe": "states['more'] = torch.zeros(6, 5000)\nkeys.append('more')", "size": "5090"},
        "5090 numbers; at most 4096",
    ),
    "poses without numbers": (
        {"reset": "return {'cube': torch.ones(6, 7).to('meta')}"},
        "a plain tensor",
    ),
    "a size that is no number": ({"size": "'90'"}, "a whole number"),
    "poses of no object": ({"reset": "return {}"}, "a pose per object: cube"),
    "poses of other objects": (
        {"reset": "return {'can': torch.zeros(6, 7)}"},
        "a pose per object: cube",
    ),
    "poses of one row": (
        {"reset": "return {'cube': torch.ones(1, 7)}"},
        r"the reset pose of cube must be a tensor of shape \(6, 7\), not \(1, 7\)",
    ),
    "a pose that is no number": (
        {"reset": "return {'cube': torch.ones(6, 7) / 0}"},
        "is not finite",
    ),
    "a pose of integers": ({"reset": "return {'cube': torch.ones(6, 7).int()}"}, "is not finite"),
    "a quaternion of length 2": (
        {"reset": "return {'cube': torch.ones(6, 7)}"},
        "not of length 1",
    ),
}


@pytest.mark.filterwarnings("ignore:Named tensors")
@pytest.mark.parametrize(("bodies", "words"), ANSWERS.values(), ids=ANSWERS)
def test_an_answer_that_may_not_be_ends_with_a_sentence_whenever_it_comes(
    bodies: dict[str, str], words: str, make_env: Callable[..., BatchEnv]
):
    with pytest.raises(V2PError, match=words) as error:
        idle(make_env(**bodies))

    assert "task 'test'" in str(error.value)
    assert "\n" not in str(error.value)


def test_the_same_question_is_asked_twice_now_and_then(
    make_env: Callable[..., BatchEnv], monkeypatch: pytest.MonkeyPatch
):
    monkeypatch.setattr(guarded, "ASKED_TWICE_ONCE_IN", 3)
    env = make_env(reward="if self.count > 9:\n    reward = reward + self.count")

    with pytest.raises(TaskOutputError, match="two calls with the same states give different"):
        idle(env, 30)


def test_asking_twice_changes_no_result(
    make_env: Callable[..., BatchEnv], monkeypatch: pytest.MonkeyPatch
):
    def results() -> list[np.ndarray]:
        env = make_env(success="states['mean'] = states['cube_pos'].mean(dim=1)")
        done = [env.step(np.full((NUM_WORLDS, 7), 0.3)) for _ in range(6)]
        return [array for step in done for array in (step.obs, step.reward, step.success)]

    once = results()
    monkeypatch.setattr(guarded, "ASKED_TWICE_ONCE_IN", 1)

    twice = results()

    assert all(np.array_equal(a, b) for a, b in zip(once, twice, strict=True))


def test_what_a_task_adds_to_the_states_it_may_write_again(make_env: Callable[..., BatchEnv]):
    env = make_env(
        observe="states['rise'] = states['cube_pos'][:, 2] * 1",
        success="states['rise'].add_(1.0)\nstates['rise'] = states['rise'] * 2",
    )

    idle(env, 3)

    assert "rise" not in env.states()

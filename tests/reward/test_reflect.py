"""Rewards are read, changed and written anew; what they pay says whether that was done right."""

import ast
import re

import numpy as np
import pytest
import torch

from v2p_data.reward import redesign, rules
from v2p_data.reward.code.expressions import times
from v2p_data.reward.code.function_body import UnreadableError
from v2p_data.reward.code.parts import Reward
from v2p_data.reward.code.slopes import kernels_of
from v2p_data.reward.feedback import Trajectories, feedback_of
from v2p_data.reward.reflect import proposals, reflect
from v2p_data.task.sandbox.probes import random_states
from v2p_data.task.sandbox.reader.check import check_code
from v2p_data.task.sandbox.sandbox import class_name, load_task
from v2p_data.task.sandbox.smoke_child import FakePlacer
from v2p_data.task.task import TaskBundle

STEPS, EPISODES = 40, 16
MANY = (
    "lift_up 0", "push_left 3", "push_right 1", "tip_over 7", "push_next_to 2", "slide_to 4", "insert 5", "place_onto 0",
    "drop_in_front_of 0", "cover 3", "uncover 6", "push_with 1", "throw_into 0", "generic 4",
    "figure 7", "figure 8", "figure 11.1",
)  # fmt: skip
"""Every kind, every form of template, and the paper's."""
FEW = ("insert 0", "generic 0", "figure 8")


def paid(code, scene, **states):
    """What a task code pays for random states, some of which may be given, and its components."""
    drawn = random_states(scene, 32, np.random.default_rng(0)) | states
    tensors = {k: torch.as_tensor(np.asarray(v), dtype=torch.float32) for k, v in drawn.items()}
    task = load_task(code, FakePlacer(tensors, [o.name for o in scene.objects]), scene)
    said = task.judge(lambda: tensors, torch.full((len(tensors["eef_pos"]), 7), 0.1))
    return said.reward.numpy(), {k: v.numpy() for k, v in said.components.items()}


def feedback(successes=0, *, came=(), scene=None, **components):
    """Feedback on episodes with these components: a number, or a function of step and episode.

    The first `successes` episodes succeed in their second half. `came` lists what all did with the object: `reached`, `grasped`.
    """
    step, episode = np.mgrid[0:STEPS, 0:EPISODES]
    success = (episode < successes) & (step >= STEPS // 2)
    made = {
        k: np.broadcast_to(v(step, episode) if callable(v) else v, success.shape).astype(
            np.float32
        )
        for k, v in components.items()
    }
    states = {}
    if scene is not None:
        there, flags = np.zeros((1, EPISODES, 3)), np.zeros((1, EPISODES))
        states["eef_pos"] = there + (0.0 if "reached" in came else 0.5)
        for obj in scene.objects:
            states |= {f"{obj.name}_pos": there, f"{obj.name}_start_pos": there}
            states |= {f"{obj.name}_size": there + 0.05, f"{obj.name}_touched": flags}
            states[f"{obj.name}_grasped"] = flags + ("grasped" in came)
    return feedback_of(
        Trajectories(
            components=made,
            reward=np.sum(list(made.values()), axis=0).astype(np.float32),
            success=success,
            length=np.full(EPISODES, STEPS),
            moments=np.zeros(1 if states else 0, np.int64),
            states={k: v.astype(np.float32) for k, v in states.items()},
            actions=np.zeros((1 if states else 0, EPISODES if states else 0, 7), np.float32),
        ),
        0.05,
    )


def noise(low, high):
    return lambda step, episode: low + (high - low) * ((7 * step + 3 * episode) % 11) / 10


def reward_of(scene, lines, code=None):
    """Task code of the scene's template with another reward function."""
    body = "".join(f"    {line}\n" for line in lines)
    code = code or redesign.write_task(scene, redesign.VARIANTS[0])
    return redesign.transplanted(code, f"def reward_function(actions, states):\n{body}")


DISTANCE = 'd = torch.norm(states["box_pos"] - states["eef_pos"], dim=-1)'
HEIGHT = 'h = states["box_pos"][:, 2] - states["box_start_pos"][:, 2]'


def two_parts(scene, first="1 - torch.tanh(8.0 * d)", second="h"):
    return reward_of(
        scene,
        [
            DISTANCE,
            HEIGHT,
            f"a = {first}",
            f"b = 0.5 * ({second})",
            'return a + b, {"a": a, "b": b}',
        ],
    )


def without_reward(code):
    """All of a task code but its reward function and helper functions."""
    tree = ast.parse(code)
    rows = code.splitlines(keepends=True)
    for node in sorted(tree.body, key=lambda n: -n.lineno):
        if isinstance(node, ast.FunctionDef):
            first = min([node.lineno, *(d.lineno for d in node.decorator_list)])
            del rows[first - 1 : node.end_lineno]
    return "".join(rows).rstrip()


def bundle_of(code, scene):
    return TaskBundle(
        title=scene.title, description=scene.description, kind=scene.kind,
        class_name=class_name(code), code=code, scene=scene,
    )  # fmt: skip


# --- reading and writing -------------------------------------------------------------------------------------


def test_a_reward_that_is_taken_apart_and_put_together_pays_the_same(codes):
    for name, (code, scene) in codes.items():
        if name not in MANY:
            continue
        reward = Reward(code)
        before, _ = paid(code, scene)

        after, parts = paid(reward.code(), scene)

        np.testing.assert_allclose(after, before, rtol=1e-5, atol=1e-5, err_msg=name)
        summed = reward.scale * sum(parts[p.name] for p in reward.parts if p.is_paid)
        np.testing.assert_allclose(summed, before, rtol=1e-4, atol=1e-4, err_msg=name)


def test_a_templates_text_stays_as_it_was(codes):
    code, _ = codes["lift_up 0"]

    assert Reward(code).code() == code


def test_figure_8_consists_of_five_parts_and_a_sum_that_is_none(codes):
    reward = Reward(codes["figure 8"][0])

    assert [p.name for p in reward.parts] == [
        "dist_grasp_reward", "dist_garlic_to_bowl", "vel_reward", "final_position_reward", "step_penalty",
    ]  # fmt: skip
    assert reward.states_of(reward.parts[0]) == {"garlic_pos", "eef_pos"}
    assert reward.states_of(reward.parts[4]) == set()


def test_scaling_a_part_scales_what_is_paid_for_it_and_nothing_else(codes):
    code, scene = codes["figure 8"]
    reward = Reward(code)
    before, parts = paid(reward.code(), scene)

    after, scaled = paid(reward.scaled("vel_reward", 0.5, "").code(), scene)

    np.testing.assert_allclose(scaled["vel_reward"], 0.5 * parts["vel_reward"], rtol=1e-5)
    np.testing.assert_allclose(after, before - 0.5 * parts["vel_reward"], atol=1e-5)


def test_sums_that_grow_line_by_line_are_followed(scenes):
    scene = scenes["lift_up"]
    code = reward_of(
        scene,
        [
            DISTANCE,
            HEIGHT,
            "parts = {}",
            "total = torch.zeros_like(d)",
            'parts["near"] = torch.exp(-d / 0.1)',
            'total += 2.0 * parts["near"]',
            "total = total - 0.5 * h",
            'parts["height"] = h',
            "return total, parts",
        ],
    )
    reward = Reward(code)
    before, parts = paid(code, scene)

    after, rewritten = paid(reward.code(), scene)

    np.testing.assert_allclose(after, before, atol=1e-5)
    assert [p.name for p in reward.parts] == ["near", "height"]
    np.testing.assert_allclose(reward.scale * rewritten["near"], 2 * parts["near"], rtol=1e-4)
    assert [(k.kind, round(k.temperature, 6)) for k in kernels_of(reward, reward.parts[0])] == [
        ("exp", 10.0)
    ]


@pytest.mark.parametrize(
    ("lines", "why"),
    [
        (["x = 1", "return states['eef_pos'][:, 0]"], "does not end by returning"),
        (["p = {}", "for k in range(2):", "    p['a'] = states['progress']", "return p['a'], p"], "changes its dict"),
    ],
)  # fmt: skip
def test_what_cannot_be_read_is_said_to_be_so(scenes, lines, why):
    with pytest.raises(UnreadableError, match=why):
        Reward(reward_of(scenes["lift_up"], lines))


def test_lines_that_double_each_other_do_not_explode(scenes):
    lines = ['x0 = states["progress"]', *[f"x{i} = x{i - 1} * x{i - 1}" for i in range(1, 40)]]

    with pytest.raises(UnreadableError, match="too often"):
        Reward(reward_of(scenes["lift_up"], [*lines, 'return x39, {"x": x39}']))


def test_lines_in_a_long_chain_are_read_or_refused_in_a_sentence(scenes):
    lines = ['x0 = states["progress"]', *[f"x{i} = x{i - 1} + 1.0" for i in range(1, 400)]]

    with pytest.raises(UnreadableError, match="too many of its lines"):
        Reward(reward_of(scenes["lift_up"], [*lines, 'return x399, {"x": x399}']))


NEAR = 'p["near"] = torch.exp(-4.0 * d)'


@pytest.mark.parametrize(
    "lines",
    [
        [NEAR, 'p["near"] = 2.0 * p["near"]', 'return p["near"], p'],
        [NEAR, 'total = p["near"] + h', 'p["near"] = -p["near"]', 'p["h"] = h', "return total, p"],
        [NEAR, 'u = p["near"] * h', 'p["near"] = p["near"] ** 2', 'p["u"] = u', 'return p["near"] + p["u"], p'],
        [NEAR, 'p["h"] = h', 'p["off"] = h * d', 'return p["near"] - 2.0 * p["h"] + 0 * p["off"], p'],
        [NEAR, 'p["h"] = 3.0 * h', "return sum(p.values()), p"],
        ['reward_components = {"a": d}', 'return reward_components["a"], {"a": reward_components["a"]}'],
    ],
)  # fmt: skip
def test_components_that_are_set_anew_or_come_to_nothing_pay_what_they_paid(scenes, lines):
    scene = scenes["lift_up"]
    code = reward_of(scene, [DISTANCE, HEIGHT, "p = {}", *lines])
    before, components = paid(code, scene)

    reward = Reward(code)

    after, parts = paid(reward.code(), scene)
    np.testing.assert_allclose(after, before, atol=1e-5)
    summed = reward.scale * sum(parts[p.name] for p in reward.parts if p.is_paid)
    np.testing.assert_allclose(summed, before, atol=1e-5)
    for part in reward.parts:
        if not part.is_paid:
            np.testing.assert_allclose(parts[part.name], components[part.name], atol=1e-5)


@pytest.mark.parametrize(
    ("lines", "why"),
    [
        (['p["a"] = d', "d = 2.0 * d", 'p["a"] = p["a"] + d', 'return p["a"], p'], "'d' two meanings"),
        (["t = d", "t = t + t * h", 'p["d"] = d', "return t, p"], "'t' two meanings"),
        (['p["a"] = d', "for k in p:", "    d = d + p[k]", 'p["b"] = d', 'return p["b"], p'], "two meanings"),
        (['p["a"] = 0 * d', 'return p["a"] * 0, p'], "none of its components"),
        (['p["a"] = p["b"]', 'p["b"] = d', 'return p["a"], p'], "before it is set"),
    ],
)  # fmt: skip
def test_what_would_mean_something_else_elsewhere_is_not_taken_apart(scenes, lines, why):
    scene = scenes["lift_up"]
    code = reward_of(scene, [DISTANCE, HEIGHT, "p = {}", *lines])

    with pytest.raises(UnreadableError, match=why):
        Reward(code)
    told = feedback(x=noise(0, 1), scene=scene)
    child = next(proposals(bundle_of(code, scene), code, told, np.random.default_rng(0)))
    assert re.search(why, child.reasons[0])


def test_a_number_inside_a_loop_or_between_tabs_can_be_changed(scenes):
    scene = scenes["lift_up"]
    lines = [DISTANCE, "a = d", "if len(d) > 3:", "    # nearer", "    a = torch.exp(-4.0 * d)"]
    spaces = reward_of(scene, [*lines, 'return a, {"a": a}'])

    for code in (spaces, spaces.replace("    #", "\t#").replace("\n    ", "\n\t")):
        reward = Reward(code)
        (kernel,) = kernels_of(reward, reward.parts[0])
        new = kernel.changed(reward, "a", 2.0).code()
        np.testing.assert_allclose(paid(new, scene)[0], paid(code, scene)[0] ** 2, rtol=1e-4)


@pytest.mark.parametrize(
    ("text", "result"),
    [("0.2 * a", "0.4 * a"), ("-0.5 * a * b", "-1.0 * a * b"), ("a + b", "2.0 * (a + b)"),
     ("a * 0.30", "a * 0.6"), ("f(a)", "2.0 * f(a)"), ("-0.1", "-0.2"), ("3.0 * a / b", "6.0 * a / b")],
)  # fmt: skip
def test_a_factor_goes_into_the_leading_constant(text, result):
    assert times(text, 2.0) == result


# --- rules ---------------------------------------------------------------------------------------------------


def only(found, rule):
    (change,) = [c for c in found if c.rule == rule]
    return change


def test_a_part_that_dwarfs_the_rest_is_scaled_to_its_share(scenes):
    scene = scenes["lift_up"]
    code = two_parts(scene)
    told = feedback(a=noise(8, 10), b=noise(0, 2))

    change = only(rules.changes(Reward(code), told, scene), "rescale what dwarfs the rest")

    before, after = paid(code, scene)[1], paid(change.apply(Reward(code), 1.0).code(), scene)[1]
    # 9 of 10 must become 35 %: 9 f / (9 f + 1) = 0.35.
    np.testing.assert_allclose(after["a"], 0.35 / 0.65 / 9 * before["a"], rtol=1e-2)
    np.testing.assert_allclose(after["b"], before["b"], rtol=1e-6)
    assert "90%" in change.reason


def test_a_part_that_dwarfs_the_rest_but_tells_success_stays(scenes):
    code = two_parts(scenes["lift_up"])
    told = feedback(8, a=lambda s, e: 10.0 * ((e < 8) & (s >= 20)), b=noise(0, 0.5))

    assert not [
        c for c in rules.changes(Reward(code), told, scenes["lift_up"]) if "dwarfs" in c.rule
    ]


def test_a_flat_slope_gets_the_temperature_that_makes_it_one_half_where_the_trajectories_are(
    scenes,
):
    scene = scenes["lift_up"]
    code = two_parts(scene, first="1 - torch.tanh(30.0 * d)")
    # 1 - tanh(30 * 0.06) = 0.053
    told = feedback(a=noise(0.052, 0.054), b=noise(0.2, 0.5))

    change = only(rules.changes(Reward(code), told, scene), "change a temperature")

    new = change.apply(Reward(code), 1.0).code()
    near = np.tile([[0.5, 0.0, 0.08]], (32, 1))
    _, parts = paid(new, scene, box_pos=near, eef_pos=near + np.array([0.06, 0.0, 0.0]))
    np.testing.assert_allclose(parts["a"], 0.5, atol=0.02)


def test_a_dead_condition_becomes_a_slope_towards_itself(scenes):
    scene = scenes["lift_up"]
    code = two_parts(scene, second="((h > 0.1) & (d < 0.05)).float()")
    told = feedback(a=noise(0.2, 0.5), b=0.0)

    change = only(rules.changes(Reward(code), told, scene), "rewrite a dead component")

    new = change.apply(Reward(code), 1.0).code()
    start = np.tile([[0.5, 0.0, 0.03]], (5, 1))
    up = start + np.array([[0, 0, z] for z in (0.0, 0.04, 0.08, 0.12, 0.2)])
    drawn = {k: v[:5] for k, v in random_states(scene, 5, np.random.default_rng(0)).items()}
    _, parts = paid(new, scene, **(drawn | {"box_pos": up, "box_start_pos": start, "eef_pos": up}))
    assert (np.diff(parts["b"][:4]) > 0.01).all()
    np.testing.assert_allclose(parts["b"][3:], 0.5, atol=1e-5)


def test_a_saturated_part_that_does_not_tell_success_from_failure_is_dropped(scenes):
    scene = scenes["lift_up"]
    code = two_parts(scene)
    told = feedback(
        8, a=lambda s, e: 0.1 + 0.8 * ((e < 8) & (s >= 20)), b=lambda s, e: 0.3 - 0.3 * (s == e)
    )

    change = only(rules.changes(Reward(code), told, scene), "drop a component")

    assert change.part == "b"
    total, parts = paid(change.apply(Reward(code), 1.0).code(), scene)
    assert list(parts) == ["a"]
    np.testing.assert_allclose(total, parts["a"], rtol=1e-6)


def test_what_pays_failures_more_is_scaled_down(scenes):
    code = two_parts(scenes["lift_up"])
    told = feedback(8, a=lambda s, e: 1.0 + (e >= 8) + 0.01 * s, b=noise(0.5, 1.0))

    change = only(
        rules.changes(Reward(code), told, scenes["lift_up"]), "rescale what pays failures"
    )

    assert change.part == "a"


@pytest.mark.parametrize(
    ("came", "stage"),
    [((), "stage_reach"), (("reached",), "stage_grasp"), (("reached", "grasped"), "stage_raise")],
)
def test_the_first_stage_that_nobody_reaches_is_added(scenes, came, stage):
    scene = scenes["lift_up"]
    code = reward_of(scene, ['a = states["progress"]', 'return a, {"a": a}'])
    told = feedback(a=noise(0, 1), came=came, scene=scene)

    change = only(rules.changes(Reward(code), told, scene), "add the missing stage")

    assert change.part == stage
    new = change.apply(Reward(code), 1.0).code()
    check_code(new)
    total, parts = paid(new, scene)
    np.testing.assert_allclose(total, parts["a"] + parts[stage], rtol=1e-5)


def test_a_price_per_step_and_a_fine_that_was_never_due_are_no_dead_components(scenes):
    code = two_parts(scenes["lift_up"], second="torch.full_like(d, -0.01)")
    fine = two_parts(scenes["lift_up"], second="-2.0 * (h - 0.2).clamp(min=0.0)")

    for each, value in ((code, -0.005), (fine, 0.0)):
        told = feedback(a=noise(0.2, 0.5), b=value)
        assert not [
            c for c in rules.changes(Reward(each), told, scenes["lift_up"]) if c.part == "b"
        ]


# --- whole children ------------------------------------------------------------------------------------------


def some_feedback(code, successes, scene):
    try:
        names = [p.name for p in Reward(code).parts]
    except UnreadableError:
        names = ["x"]
    values = [noise(0.0, 0.1), 0.0, noise(3.0, 4.0), lambda s, e: 0.2 * ((e < 8) & (s >= 20))]
    parts = {name: values[i % 4] for i, name in enumerate(names)}
    return feedback(successes, scene=scene, **parts)


@pytest.mark.parametrize(("successes", "names"), [(0, MANY[::3]), (8, FEW)])
def test_children_differ_in_the_reward_alone_and_run(codes, successes, names):
    for name in names:
        code, scene = codes[name]
        told = some_feedback(code, successes, scene)
        children = proposals(bundle_of(code, scene), code, told, np.random.default_rng(1))

        for child, _ in zip(children, range(2), strict=False):
            assert without_reward(child.code) == without_reward(code), name
            total, parts = paid(child.code, scene)
            assert np.isfinite(total).all(), name
            assert all(np.isfinite(p).all() for p in parts.values()), name
            assert child.reasons
            assert re.search(r"\d", " ".join(child.reasons))


def test_where_nothing_succeeded_a_redesign_is_among_the_first(codes):
    code, scene = codes["push_left 0"]

    first = [
        c for c, _ in zip(
            proposals(bundle_of(code, scene), code, some_feedback(code, 0, scene), np.random.default_rng(1)),
            range(3),
            strict=False,
        )
    ]  # fmt: skip

    assert any("redesigned" in " ".join(c.reasons) for c in first)
    assert any("redesigned" not in " ".join(c.reasons) for c in first)


def test_a_reward_that_cannot_be_read_stays_whole_and_gets_a_stage(scenes):
    scene = scenes["lift_up"]
    lines = [
        "p = {}",
        "for k in ['a']:",
        "    p[k] = states['progress']",
        "return 3000.0 * p['a'], p",
    ]
    code = reward_of(scene, lines)
    told = feedback(x=noise(0, 3000), scene=scene)

    child = next(proposals(bundle_of(code, scene), code, told, np.random.default_rng(0)))

    assert "cannot be taken apart" in child.reasons[0]
    before, _ = paid(code, scene)
    after, parts = paid(child.code, scene)
    np.testing.assert_allclose((after - parts["stage_reach"]) / before, 50 / 1500, rtol=0.1)


def test_the_success_function_itself_becomes_a_reward(codes):
    code, scene = codes["figure 7"]
    design = redesign.from_success(code, scene)
    assert design is not None
    box = np.tile([[0.5, 0.3, 0.05]], (4, 1))
    fork = box + np.array([[0.3, 0, 0.0], [0.1, 0, 0.0], [0.03, 0, 0.0], [0.0, 0, 0.0]])
    drawn = {k: v[:4] for k, v in random_states(scene, 4, np.random.default_rng(0)).items()}

    _, parts = paid(design.code, scene, **(drawn | {"storage_box_pos": box, "fork_pos": fork}))

    assert (np.diff(parts["all_at_once"]) > 0).all()


def test_a_success_that_goes_on_from_its_own_lines_becomes_a_reward_too(codes):
    code, scene = codes["lift_up 0"]
    body = """
        up = states["box_pos"][:, 2] > 0.1
        up = up & (states["box_grasped"] > 0.5)
        return up

    def """
    own = re.compile(r"(def compute_success\(self, states\):).*?\n    def ", re.DOTALL)
    code = own.sub(lambda m: m[1] + body, code)

    design = redesign.from_success(code, scene)
    goal = redesign.goal_text(code)

    assert design is not None
    assert goal is not None
    low, high = (
        paid(design.code, scene, box_pos=np.tile([[0.5, 0, z]], (32, 1))) for z in (0, 0.2)
    )
    assert (high[1]["all_at_once"] >= low[1]["all_at_once"]).all()
    assert (high[1]["all_at_once"] > low[1]["all_at_once"]).any()


def test_a_reward_of_more_arguments_that_cannot_be_read_is_called_with_them(scenes):
    scene = scenes["lift_up"]
    lines = ["p = {}", "for k in ['a']:", "    p[k] = s['progress']", "return p['a'], p"]
    code = reward_of(scene, lines).replace(
        "reward_function(actions, states)", "reward_function(actions, states, 2.0)"
    )
    code = code.replace(
        "def reward_function(actions, states, 2.0)", "def  reward_function(actions, s, w)"
    )
    told = feedback(8, x=noise(0, 1), scene=scene, came=("reached", "grasped"))

    children = proposals(bundle_of(code, scene), code, told, np.random.default_rng(0))
    whole = [
        c for c, _ in zip(children, range(6), strict=False) if "redesigned" not in c.reasons[0]
    ]

    assert len(whole) > 2
    for child in whole:
        assert "cannot be taken apart" in child.reasons[0]
        assert not np.allclose(paid(child.code, scene)[0], paid(code, scene)[0])


def test_children_have_run_in_the_sandbox_and_no_two_pay_the_same(codes):
    code, scene = codes["figure 8"]

    children = reflect(
        bundle_of(code, scene), code, some_feedback(code, 0, scene), np.random.default_rng(0), 4
    )

    assert len(children) == 4
    (other,) = reflect(
        bundle_of(code, scene), code, some_feedback(code, 0, scene), np.random.default_rng(0), 1,
        tried=[c.code for c in children],
    )  # fmt: skip
    children.append(other)
    totals = [paid(c.code, scene)[0] for c in children] + [paid(code, scene)[0]]
    for i, a in enumerate(totals):
        assert all(not np.allclose(a, b) for b in totals[:i])

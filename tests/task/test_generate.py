import json

import numpy as np
import pytest
import torch

from v2p_data.errors import ItemRejectedError
from v2p_data.task.audit.audit import Audit, audit
from v2p_data.task.audit.moments import build_probes
from v2p_data.task.benchmark import benchmark_names, load_benchmark
from v2p_data.task.generate import CodeJudge, TaskConfig, generate_task
from v2p_data.task.sandbox.probes import rest_height
from v2p_data.task.sandbox.smoke import SmokeResult, trial_request
from v2p_data.task.sandbox.smoke_child import answer
from v2p_data.task.task import TaskBundle
from v2p_data.task.templates.write import write_samples

pytestmark = pytest.mark.slow

LIFT = """
import torch
scene_info = {"task_class_name": "Lift"}
class Lift(Task):
    def __init__(self, envs, urdf_assets_root):
        super().__init__(envs, urdf_assets_root, scene_info)
    def compute_success(self, states):
        height = states["box_pos"][:, 2] - states["box_start_pos"][:, 2]
        speed = torch.norm(states["box_vel_linear"], dim=-1)
        return SUCCESS
    def compute_reward(self, actions, states):
        r = states["box_pos"][:, 2]
        return r, {"height": r}
"""


def lift(success):
    return LIFT.replace("SUCCESS", success)


def audits(scene, codes):
    """The trial run's questions, asked here: these codes are ours, and a child imports torch for seconds."""
    probes = build_probes(scene, np.random.default_rng(0))
    request = trial_request(codes, scene, probes.states, 10.0, probes.starts)
    counts = len(probes.states["eef_pos"]), len(probes.starts["eef_pos"])
    with torch.no_grad():
        results = [SmokeResult.from_json(answer(code, request), *counts) for code in codes]
    return [audit(scene, probes, r) for r in results]


def failed(verdict):
    return {c.name for c in verdict.checks if not c.passed}


def test_cheats_are_found_out(scene_of):
    good, at_start, touch, fling, never, tiny = audits(
        scene_of("lift_up"),
        [
            lift("(height > 0.1) & (states['box_grasped'] > 0.5) & (speed < 0.1)"),
            lift("height > -0.5"),
            lift("states['box_touched'] > 0.5"),
            lift("height > 0.1"),
            lift("height > 3.0"),
            lift("(height > 0.004) & (states['box_grasped'] > 0.5) & (speed < 0.1)"),
        ],
    )

    assert failed(good) == set()
    assert good.score > 0.9
    assert good.is_acceptable
    assert "first pose" in at_start.vetoed
    assert "first_pose" in failed(touch)  # held at the first pose is a touch
    assert not touch.is_acceptable
    assert failed(fling) == {"flung"}
    assert "flies past" in fling.vetoed
    assert "workspace" in never.vetoed
    assert failed(tiny) == {"becomes_true", "in_the_air"}


def test_it_says_from_which_pose_on_the_video_succeeds(scene_of):
    (verdict,) = audits(scene_of("lift_up"), [lift("height > 0.1")])

    # Twelve poses rise evenly by 17.5 cm: pose 7 is 11.1 cm up, pose 6 is 9.5 cm up.
    assert verdict.true_from_pose == 7
    # The way is 17.6 cm long, because the box also moves 2 cm forward: 10 cm up are 10.06 cm of way.
    assert verdict.threshold_m == pytest.approx(0.1006, abs=0.01)


def test_noise_at_the_end_costs_points_but_is_no_veto(scene_of):
    (verdict,) = audits(scene_of("lift_up"), [lift("(height > 0.2) & (speed < 0.1)")])

    assert failed(verdict) == {"last_pose", "accepts_end"}
    assert 0.5 < verdict.score < 0.9
    assert verdict.is_acceptable


def test_a_success_is_held_to_what_the_words_say_where_that_is_true_at_the_end(scene_of):
    scene = scene_of("lift_up")
    too_high = lift("(height > 0.2) & (speed < 0.1)")  # the video ends 17.5 cm up

    def tried(reference: str) -> Audit:
        return CodeJudge(scene, TaskConfig(), 0, reference).tried([too_high])[0].audit

    assert tried("").is_acceptable
    assert "false at the video's end" in tried(write_samples(scene, 1)[0]).vetoed
    assert tried(too_high).is_acceptable  # the trusted one says that the end was measured wrongly


def test_what_does_not_run_is_vetoed(scene_of):
    scene = scene_of("lift_up")
    probes = build_probes(scene, np.random.default_rng(0))

    verdict = audit(scene, probes, SmokeResult(runnable=False, error="it hangs"))

    assert verdict.vetoed == "it does not run: it hangs"
    assert not verdict.is_acceptable


@pytest.mark.parametrize("kind", ["lift_up", "push_next_to"])
def test_a_scene_becomes_a_task_that_can_be_loaded_again(kind, scene_of, tmp_path):
    scene = scene_of(kind)
    scene_folder = tmp_path / "scene"
    scene_folder.mkdir()
    scene.save(scene_folder)
    scene = type(scene).load(scene_folder)

    made = generate_task(scene, TaskConfig(), 7)
    made.save(tmp_path / "task")

    loaded = TaskBundle.load(tmp_path / "task")
    table = json.loads((tmp_path / "task" / "audit.json").read_text())
    assert loaded.code == made.samples[made.picked].code == made.bundle.code
    assert loaded.kind == kind
    assert loaded.class_name in loaded.code
    assert len(list((tmp_path / "task" / "samples").glob("*.py"))) == len(table["samples"]) == 1
    assert made.samples[0].score > 0.8


def test_the_threshold_furthest_from_start_and_end_scores_highest(scene_of):
    # The box is lifted by 17.5 cm, give or take a centimetre and a half.
    low, middle, high = audits(
        scene_of("lift_up"),
        [
            lift(f"(height > {metres}) & (states['box_grasped'] > 0.5) & (speed < 0.1)")
            for metres in (0.02, 0.1, 0.17)
        ],
    )

    assert middle.score > max(low.score, high.score)
    assert {c.name for c in low.checks if c.right is not None and c.right < 0.95} == {
        "rejects_near_misses"
    }
    assert {c.name for c in high.checks if c.right is not None and c.right < 0.95} == {
        "accepts_end"
    }


@pytest.mark.parametrize("name", benchmark_names())
def test_every_benchmark_task_is_acceptable_and_its_naive_sample_refused(name):
    scene = load_benchmark(name).scene
    codes = write_samples(scene)

    first, naive = audits(scene, [codes[0], codes[6]])

    assert first.is_acceptable
    assert "last_pose" not in failed(first)
    assert not naive.is_acceptable


def test_the_naive_code_of_figure_11_is_refused_for_hanging_on_other_worlds(scene_of):
    scene = scene_of("lift_up")
    over_worlds = (
        "states['box_pos'][:, 2] - states['table_height'] > torch.max(states['box_size']) / 2"
    )
    beside = "(height > 0.1) & (speed < speed.mean() + 0.1)"
    own = lift("states['box_pos'][:, 2] - states['table_height'] > states['box_size'].amax(dim=1)")

    high = "states['box_pos'][:, 2] - states['table_height'] > 0.12"
    majority = f"({high}) | (({high}).float().mean() > 0.5)"

    codes = [lift(over_worlds), lift(beside), lift(majority), own]
    *over_others, single = audits(scene, codes)

    assert all("depends on the others" in each.vetoed for each in over_others)
    assert "flies past" in single.vetoed


RESETS = {
    "beside its reference": (
        "poses['can'][:, :2] = poses['bowl'][:, :2] - torch.tensor([0.0, 0.14])",
        "near its goal",
    ),
    "beside it from the third reset on": (
        "self.count = self.count + 1\n"
        "        if self.count > 2:\n"
        "            poses['can'][:, :2] = poses['bowl'][:, :2] - torch.tensor([0.0, 0.14])",
        "near its goal",
    ),
    "always at one place": (
        "poses['can'][:, :2] = torch.tensor([0.5, 0.0])\n"
        "        poses['bowl'][:, :2] = torch.tensor([0.5, 0.23])",
        "the same place",
    ),
    "lying": (
        "poses['can'][:, 2] -= 0.03\n"
        "        poses['can'][:, 3:] = torch.tensor([0.5 ** 0.5, 0.5 ** 0.5, 0.0, 0.0])",
        "turned otherwise",
    ),
    "in the air": ("poses['can'][:, 2] += 0.05", "in the air"),
    "in each other": ("poses['can'][:, :2] = poses['bowl'][:, :2]", "in success"),
    "out of reach": ("poses['can'][:, 0] += 0.4", "out of reach"),
    "away from where the video begins": (
        "poses['can'][:, 1] -= 0.2\n        poses['bowl'][:, 1] -= 0.2",
        "where the video itself begins",
    ),
    "in success": (
        "poses['can'][:, :2] = poses['bowl'][:, :2] - torch.tensor([0.0, 0.081])",
        "in success",
    ),
}


def test_resets_that_make_the_task_easy_are_refused(scene_of):
    scene = scene_of("push_next_to")
    made = "super().__init__(envs, urdf_assets_root, scene_info)"
    code = write_samples(scene, 1)[0].replace(made, f"{made}\n        self.count = 0")

    def resetting(change):
        own = f"        poses = self.envs.sample_object_poses(env_ids)\n        {change}\n        return poses"
        return code.replace("        return super().reset_objects_states(env_ids)", own)

    changes = [change for change, _ in RESETS.values()]
    *refused, accepted = audits(
        scene, [resetting(c) for c in (*changes, "poses['can'][:, 0] += 0.01")]
    )

    for name, (_, words), verdict in zip(RESETS, RESETS.values(), refused, strict=True):
        assert words in verdict.vetoed, name
    assert accepted.is_acceptable


def test_the_seed_decides_the_probes(scene_of):
    first, again, other = (
        build_probes(scene_of("push_left"), np.random.default_rng(seed)).states
        for seed in (3, 3, 4)
    )

    assert all(np.array_equal(first[k], again[k]) for k in first)
    assert not np.array_equal(first["book_pos"], other["book_pos"])


def test_of_several_codes_the_first_is_taken_unless_the_audit_refuses_it(scene_of):
    good = "(height > 0.1) & (states['box_grasped'] > 0.5) & (speed < 0.1)"
    codes = [lift("height > -1"), lift(good.replace("0.1)", "0.17)", 1)), lift(good)]

    made = generate_task(scene_of("lift_up"), TaskConfig(), 0, sources=codes)
    first = generate_task(scene_of("lift_up"), TaskConfig(), 0, sources=codes[1:])

    assert (made.picked, len(made.samples)) == (2, 3)
    assert made.samples[2].score > made.samples[1].score
    assert (first.picked, len(first.samples)) == (0, 1)


def test_a_scene_without_an_acceptable_task_is_rejected_with_its_reason(scene_of):
    with pytest.raises(ItemRejectedError, match="always true") as rejection:
        generate_task(
            scene_of("lift_up"), TaskConfig(), 0, sources=[lift("height > -1"), "nonsense("]
        )

    assert rejection.value.reason == "no_acceptable_task"


def test_things_rest_on_the_table_as_geometry_says(make_thing):
    half = np.sqrt(0.5)
    lying = np.array([half, half, 0.0, 0.0])
    tilted = np.array([np.cos(np.pi / 8), np.sin(np.pi / 8), 0.0, 0.0])
    box = make_thing("box", (0.1, 0.2, 0.3), (0, 0, 0))
    can = make_thing("can", (0.1, 0.1, 0.3), (0, 0, 0), shape="cylinder")
    ball = make_thing("ball", (0.1, 0.1, 0.1), (0, 0, 0), shape="sphere")

    assert rest_height(box, np.array([1.0, 0, 0, 0])) == pytest.approx(0.15)
    assert rest_height(box, lying) == pytest.approx(0.1)
    assert rest_height(can, lying) == pytest.approx(0.05)
    assert rest_height(can, tilted) == pytest.approx((0.05 + 0.15) * half)
    assert rest_height(ball, tilted) == pytest.approx(0.05)

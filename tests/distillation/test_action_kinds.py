"""Datasets whose actions are targets: the same episodes, replayed, trained on and evaluated as others."""

import json
import shutil
from dataclasses import replace
from pathlib import Path

import numpy as np
import pyarrow.parquet as pq
import pytest
import toy_run
import toy_task
from toy_run import DISTILLATION, ENGINE, EPISODES, dataset_of, made, record_of

from v2p_data.deployment.checks import check_meaning
from v2p_data.deployment.robot import ActionScale
from v2p_data.episodes import rollouts
from v2p_data.episodes.collect import staged_episodes
from v2p_data.episodes.dataset.edit import merge
from v2p_data.episodes.dataset.features import EXECUTED_KEY, METADATA_FILE, STATE_NAMES
from v2p_data.episodes.dataset.verify import verify
from v2p_data.episodes.dataset.writer import pack
from v2p_data.episodes.replay import replay
from v2p_data.episodes.rollouts import CutConfig
from v2p_data.episodes.staging import Episode
from v2p_data.errors import V2PError
from v2p_data.evaluation.config import EvaluationConfig
from v2p_data.evaluation.facts import interface_of
from v2p_data.evaluation.judging import contestant
from v2p_data.pipeline.runner import Runtime
from v2p_data.play import StateActor
from v2p_data.policy.config import PolicyConfig
from v2p_data.policy.training import POLICY_FOLDER, sources_of
from v2p_data.sim.env import ranges, verdict
from v2p_data.sim.env.actions import steps_to
from v2p_data.sim.env.batch_env import SimConfig
from v2p_data.sim.model.world import build_world
from v2p_data.sim.robot.action_names import DELTA_NAMES, action_names
from v2p_data.sim.robot.interface import ArmInterface
from v2p_data.sim.robot.robot import FINE, NUM_ARM_JOINTS
from v2p_data.stages import (
    EVALUATION_FILE,
    ROOT_OF_TASKS,
    dataset_stage,
    distilled_dataset_stage,
    evaluation_stage,
    policy_stage,
)

pytestmark = pytest.mark.slow
KINDS = ("absolute_tool", "joints")


def interface_for(actions: str) -> ArmInterface:
    """Return a kind's interface: those who hold joints see their angles."""
    return ArmInterface(actions=actions, joint_state=actions == "joints")


def num_states(actions: str) -> int:
    return len(STATE_NAMES) + NUM_ARM_JOINTS * (actions == "joints")


def engine(actions: str):
    return replace(
        ENGINE,
        episodes=replace(EPISODES, **vars(interface_for(actions))),
        distillation=replace(DISTILLATION, rounds=1, episodes=3),
        policy=PolicyConfig(
            preset="small", steps=3, batch_size=8, checkpoints=3, judge_episodes=2
        ),
        evaluation=EvaluationConfig(episodes=4, worlds=4),
    )


@pytest.fixture(scope="module")
def agreed():
    with pytest.MonkeyPatch.context() as patch:
        for module in (verdict, rollouts):
            patch.setattr(module, "referee_verdict", toy_run.agree)
        yield


@pytest.fixture(scope="module")
def roots(agreed, tmp_path_factory) -> dict[str, Path]:
    """A run up to its dataset of each kind; do not write into it."""
    found = {}
    for actions in ("delta_tool", *KINDS):
        root = tmp_path_factory.mktemp(actions)
        stage = dataset_stage([toy_run.chain(engine=engine(actions))], toy_run.REPO_ID)
        outcomes = made([stage], Runtime(root=root))
        assert all(o.is_usable for o in outcomes.values()), [o.detail for o in outcomes.values()]
        found[actions] = root
    return found


@pytest.fixture(scope="module", params=KINDS)
def trained(request, roots, tmp_path_factory) -> tuple[str, Path, Path]:
    """Return a kind, a run up to its policy after a round of handovers, and the policy."""
    root = Path(
        shutil.copytree(roots[request.param], tmp_path_factory.mktemp(request.param) / "run")
    )
    dataset, settings = dataset_of(root), engine(request.param)
    sources = sources_of(dataset, root)
    stage = policy_stage(dataset, record_of(dataset), settings, sources)
    handed = distilled_dataset_stage(stage.inputs["distillation"], record_of(dataset), sources)
    outcomes = made([stage, handed], Runtime(root=root))
    assert all(o.is_usable for o in outcomes.values()), [o.detail for o in outcomes.values()]
    return request.param, root, stage.folder(root) / POLICY_FOLDER


def numbers(dataset: Path, column: str) -> np.ndarray:
    (path,) = dataset.glob("data/*/*.parquet")
    return np.array(pq.read_table(path, columns=[column])[column].to_pylist(), np.float32)


def features(dataset: Path) -> dict:
    return json.loads((dataset / "meta/info.json").read_text())["features"]


def test_steps_are_recorded_as_ever(roots):
    dataset = dataset_of(roots["delta_tool"])

    assert features(dataset)["action"]["names"] == list(DELTA_NAMES)
    assert features(dataset)["observation.state"]["names"] == list(STATE_NAMES)
    assert EXECUTED_KEY not in features(dataset)
    # Nothing tells of an option at its default: recipes, and hence names of results, are those of earlier versions.
    told = (dataset / METADATA_FILE).read_text()
    assert '"actions"' not in told
    assert '"joint_state"' not in told
    for path in staged_episodes(next((roots["delta_tool"] / "episodes").glob("toy-*"))):
        with np.load(path) as data:
            assert not {"actions", "num_joints"} & json.loads(str(data["about"])).keys()


@pytest.mark.parametrize("actions", KINDS)
def test_the_same_is_done_and_told_otherwise(roots, actions):
    steps, targets = dataset_of(roots["delta_tool"]), dataset_of(roots[actions])
    names = list(action_names(actions))

    assert features(targets)["action"]["shape"] == [len(names)]
    assert features(targets)["action"]["names"] == names
    assert json.loads((targets / METADATA_FILE).read_text())["action"] == names
    for column in ("next.reward", "privileged.object_pose"):
        np.testing.assert_array_equal(numbers(targets, column), numbers(steps, column))
    of_tool = numbers(targets, "observation.state")[:, : len(STATE_NAMES)]
    np.testing.assert_array_equal(of_tool, numbers(steps, "observation.state"))
    np.testing.assert_array_equal(numbers(targets, EXECUTED_KEY), numbers(steps, "action"))
    assert numbers(targets, "action").shape[1] == len(names)
    assert verify(targets).problems == ()
    assert "after this step" in (targets / "README.md").read_text()


def test_joint_angles_follow_the_tool_in_the_state(roots):
    dataset = dataset_of(roots["joints"])
    state, column = numbers(dataset, "observation.state"), features(dataset)["observation.state"]
    robot = build_world(toy_task.bundle().scene, FINE).robot
    joints = state[:, len(STATE_NAMES) :].astype(float)

    assert column["names"] == [*STATE_NAMES, *(f"joint_{k}.pos" for k in range(1, 8))]
    assert json.loads((dataset / METADATA_FILE).read_text())["state"] == column["names"]
    assert "joint_7.pos" in (dataset / "README.md").read_text()
    # These angles hold the tool where the state says that it is.
    tool = robot.tool_state(joints, np.zeros_like(joints))
    np.testing.assert_allclose(tool.pos, state[:, :3], atol=1e-5)


def test_states_with_and_without_joints_do_not_go_together(roots, tmp_path):
    staged = [
        staged_episodes(next((roots[a] / "episodes").glob("toy-*")))[k]
        for k, a in enumerate(("delta_tool", "joints"))
    ]
    without = [replace(Episode.load(staged[1]), actions=()).save(tmp_path / "staged")]

    with pytest.raises(V2PError, match=r"states of 18 numbers, .* of 11 numbers; .*joint-state"):
        pack([staged[0], *without], "me/both", tmp_path / "both")


@pytest.mark.parametrize("actions", ["delta_tool", *KINDS])
def test_every_episode_comes_back_from_what_was_carried_out(agreed, roots, actions):
    report = replay(dataset_of(roots[actions]))

    assert len(report.episodes) == EPISODES.num_episodes
    assert report.is_same
    assert max(e.state_error for e in report.episodes) == 0


@pytest.mark.parametrize("actions", KINDS)
def test_recorded_targets_bring_the_same_states_back_where_no_noise_is_on_them(actions):
    calm = replace(ranges.RandomizationConfig(), action_noise=0.0)
    sim = SimConfig(fine=True, randomization=calm)

    class Follow(StateActor):
        def act(self, view):
            return steps_to(view.worlds, first.targets[view.t], actions)

    def played(actor):
        lesson = toy_task.lesson(actor)
        return rollouts.roll_out(
            lesson,
            sim,
            num_worlds=8,
            seed=3,
            cut=CutConfig(),
            interface=ArmInterface(actions=actions),
        )

    first = played(StateActor(toy_task.act))
    again = played(Follow(toy_task.act))

    assert first.successes.any()
    np.testing.assert_array_equal(again.num_frames, first.num_frames)
    for then, now in zip(first.snapshots, again.snapshots, strict=True):
        np.testing.assert_allclose(now.qpos, then.qpos, rtol=0, atol=1e-9)


def test_datasets_of_two_kinds_do_not_go_together(roots, tmp_path):
    steps, tool, joints = (dataset_of(roots[a]) for a in ("delta_tool", *KINDS))

    for one, other, words in ((steps, joints, "the list of columns"), (joints, tool, "names of")):
        with pytest.raises(V2PError, match=f"do not go together: {words}"):
            merge([one, other], "me/both", tmp_path / "both")
    staged = [
        staged_episodes(next((roots[a] / "episodes").glob("toy-*")))[k]
        for k, a in enumerate(KINDS)
    ]
    with pytest.raises(V2PError, match=r"collect all episodes with one --episodes\.actions"):
        pack(staged, "me/both", tmp_path / "both")


def test_handovers_are_labelled_by_targets_too(trained):
    actions, root, _ = trained
    (dataset,) = (root / "dataset").glob("toys-distilled-*")
    acted = numbers(dataset, "intervention").astype(bool).ravel()

    assert features(dataset)["action"]["names"] == list(action_names(actions))
    assert not acted.all()
    assert verify(dataset).problems == ()
    # Where the student acted, the label is the expert's, and what was carried out is the student's.
    student = numbers(dataset, EXECUTED_KEY)[~acted]
    assert np.abs(student - numbers(dataset, EXECUTED_KEY)[acted][: len(student)]).max() > 0.05


def test_a_policy_that_gives_targets_is_evaluated_like_any_other(agreed, trained):
    actions, root, policy = trained
    tasks = {"toy": dataset_of(root) / ROOT_OF_TASKS / "toy"}
    stage = evaluation_stage(contestant(policy), tasks, engine(actions), seen=[*tasks.values()])

    (judged,) = made([stage], Runtime(root=root)).values()

    assert judged.is_usable, judged.detail
    (row,) = json.loads((judged.folder / EVALUATION_FILE).read_text())
    assert row["trials"] == 4
    assert row["failures"].get("simulation_broke", 0) == 0


def test_lerobots_evaluation_does_what_ours_does(agreed, trained):
    from policies.evaluation.actor import load_actor
    from policies.evaluation.rollout import env_config, load_policy, roll_out
    from v2p_data.evaluation.batch import judge
    from v2p_data.play import VisionActor
    from v2p_data.sim.render.masks import PALETTE
    from v2p_data.task.task import TaskBundle

    actions, root, policy = trained
    dataset = dataset_of(root)
    config = env_config(dataset, size_px=toy_run.SIZE_PX)  # the dataset tells of its actions
    count = len(action_names(actions))
    assert (config.actions, config.features["action"].shape) == (actions, (count,))
    assert config.features["agent_pos"].shape == (num_states(actions),)
    actor = load_actor(
        policy, greys=PALETTE, device="cpu", num_states=num_states(actions), num_actions=count
    )
    bundle = TaskBundle.load(dataset / ROOT_OF_TASKS / "toy")
    seen = VisionActor(actor.for_task(bundle.description), interface=interface_for(actions))

    cfg = EvaluationConfig(episodes=2, worlds=2)
    ours = judge(bundle, seen, first_seed=5, cfg=cfg, size_px=toy_run.SIZE_PX)
    loaded = load_policy(policy, config, "cpu")
    theirs = roll_out(loaded, config.create_envs(2), config, episodes=2, first_seed=5)

    assert theirs[0] == ours.successes.tolist()


def test_what_a_policys_actions_say_is_found_without_its_dataset(trained, tmp_path):
    actions, _, policy = trained
    copied = Path(shutil.copytree(policy, tmp_path / "policy"))
    card = (copied / "README.md").read_text()
    assert f"--env.actions={actions}" in card
    assert ("--env.joint_state=true" in card) == (actions == "joints")
    for name in ("v2p.json", "train_config.json"):
        (copied / name).unlink()

    assert interface_of(copied) == (
        interface_for(actions),
        num_states(actions),
        len(action_names(actions)),
    )


def test_a_robot_that_is_set_to_other_actions_says_how_to_connect_it(trained):
    actions, _, policy = trained
    joints = str(actions == "joints").lower()

    with pytest.raises(V2PError, match=f"--robot.actions={actions} --robot.joint_state={joints}"):
        check_meaning(policy, ActionScale())
    check_meaning(policy, ActionScale(), interface=interface_for(actions))

"""From a dataset to a policy: sources, the distillation and policy stages with a real student, and their kills."""

import json
import shutil
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
import toy_run
from toy_run import ENGINE, REPO_ID, dataset_of, made, record_of

from v2p_data.distillation.config import DistillationConfig
from v2p_data.distillation.rounds import handover_episodes
from v2p_data.episodes.collect import staged_episodes
from v2p_data.episodes.dataset.verify import verify
from v2p_data.errors import V2PError
from v2p_data.pipeline.runner import Outcome, Runtime
from v2p_data.policy.config import PolicyConfig
from v2p_data.policy.training import POLICY_FOLDER, recorded_under, sources_of
from v2p_data.stages import (
    ROOT_OF_TASKS,
    distillation_stage,
    distilled_dataset_stage,
    policy_stage,
)


@pytest.fixture
def root(finished: Path, tmp_path: Path) -> Path:
    return Path(shutil.copytree(finished, tmp_path / "run"))


def stage_of(root: Path, engine=ENGINE):
    dataset = dataset_of(root)
    return policy_stage(dataset, record_of(dataset), engine, sources_of(dataset, root))


def make(root: Path, engine=ENGINE) -> dict[str, Outcome]:
    outcomes = made([stage_of(root, engine)], Runtime(root=root))
    return {stage: outcome for (stage, _), outcome in outcomes.items()}


def test_the_task_and_expert_behind_a_dataset_are_found(finished: Path):
    (source,) = sources_of(dataset_of(finished), finished)

    assert source.item == toy_run.ITEM
    assert (source.task / "task.json").is_file()
    assert (source.expert / "weights.safetensors").is_file()
    assert staged_episodes(source.episodes)
    assert recorded_under(source) == toy_run.EPISODES


def test_a_dataset_in_another_run_folder_has_no_sources(finished: Path, tmp_path: Path):
    assert sources_of(dataset_of(finished), tmp_path) == []


def test_the_chain_has_a_distillation_unless_it_is_turned_off(finished: Path):
    def inputs(**changes: Any) -> list[str]:
        return list(stage_of(finished, replace(ENGINE, **changes)).inputs)

    assert inputs() == ["distillation"]
    assert inputs(distillation=DistillationConfig(rounds=0)) == []
    assert inputs(policy=PolicyConfig(preset="paper")) == []


def test_a_longer_last_training_does_not_remake_the_distillation(finished: Path):
    def of(policy: PolicyConfig) -> str:
        stage = stage_of(finished, replace(ENGINE, policy=policy))
        return stage.inputs["distillation"].folder_name

    short = PolicyConfig(preset="small", steps=4, batch_size=8)
    assert of(short) == of(replace(short, steps=5))
    assert of(short) == of(replace(short, epochs=3, checkpoints=2, judge_episodes=1))
    assert of(short) != of(replace(short, batch_size=16))
    assert of(short) != of(replace(short, n_obs_steps=1))


def test_the_papers_training_lasts_thirty_epochs():
    assert PolicyConfig(preset="paper").resolved.num_steps(10_000) == 30 * 10_000 // 1024
    assert PolicyConfig(steps=7).num_steps(10_000) == 7
    assert PolicyConfig(epochs=2, batch_size=64).num_steps(10) == 1


@pytest.fixture(scope="module")
def distilled(finished: Path, tmp_path_factory) -> Path:
    """A run folder up to its policy; do not write into it."""
    root = Path(shutil.copytree(finished, tmp_path_factory.mktemp("distilled") / "run"))
    with pytest.MonkeyPatch.context() as patch:
        for module in ("sim.env.verdict", "episodes.rollouts"):
            patch.setattr(f"v2p_data.{module}.referee_verdict", toy_run.agree)
        outcomes = make(root)
    assert all(o.status == "made" for o in outcomes.values()), [
        o.detail for o in outcomes.values()
    ]
    assert list(outcomes) == ["distillation", "policy"]
    return root


def only(root: Path, stage: str) -> Path:
    (folder,) = (root / stage).glob("*")
    return folder


def packed(root: Path) -> Outcome:
    """Pack demonstrations and handovers of a run."""
    dataset = dataset_of(root)
    sources = sources_of(dataset, root)
    stage = distillation_stage(dataset, record_of(dataset), ENGINE, sources)
    outcomes = made(
        [distilled_dataset_stage(stage, record_of(dataset), sources)], Runtime(root=root)
    )
    return list(outcomes.values())[-1]


def test_demonstrations_and_handovers_become_one_good_dataset(distilled: Path, tmp_path: Path):
    from lerobot.datasets.lerobot_dataset import LeRobotDataset

    root = Path(shutil.copytree(distilled, tmp_path / "run"))
    episodes, distillation = only(root, "episodes"), only(root, "distillation")
    staged = [*staged_episodes(episodes), *handover_episodes(distillation)]

    outcome = packed(root)

    assert outcome.is_usable, outcome.detail
    counts = record_of(outcome.folder).counts
    dataset: Any = LeRobotDataset(counts["repo_id"], root=outcome.folder)
    acted = [bool(dataset[k]["intervention"]) for k in range(len(dataset))]
    assert counts["repo_id"] == f"{REPO_ID}-distilled"
    assert dataset.num_episodes == counts["episodes"] == len(staged) > 3
    assert all(acted[: sum(dataset.meta.episodes["length"][:3])])
    assert not all(acted)
    assert verify(outcome.folder, staged=staged).is_good
    assert (outcome.folder / ROOT_OF_TASKS / toy_run.ITEM / "task.json").is_file()
    assert record_of(distillation).counts["episodes"] == len(handover_episodes(distillation))


def test_the_last_training_sees_all_frames(distilled: Path):
    counts = record_of(only(distilled, "policy")).counts
    demonstrations = record_of(dataset_of(distilled)).counts["frames"]
    handovers = record_of(only(distilled, "distillation")).counts["frames"]

    assert counts["frames"] == demonstrations + handovers
    assert (counts["steps"], counts["samples"]) == (4, 32)
    assert counts["policy"] == POLICY_FOLDER


@pytest.mark.slow
def test_checkpoints_are_judged_in_simulation(agreeing_referee, distilled: Path, root: Path):
    engine = replace(ENGINE, policy=replace(ENGINE.policy, checkpoints=2, judge_episodes=4))
    shutil.copytree(distilled / "distillation", root / "distillation")

    judged = record_of(make(root, engine)["policy"].folder).counts["judged"]

    assert [step for step, _ in judged] == [3, 4]
    assert all(0 <= rate <= 1 for _, rate in judged)


def test_a_distillation_belongs_to_its_dataset(finished: Path):
    dataset = dataset_of(finished)
    record = record_of(dataset)

    one, other = (
        distillation_stage(dataset, r, ENGINE, ()).folder_name
        for r in (record, replace(record, fingerprint="00000000"))
    )

    assert one != other


def test_checkpoints_are_not_judged_on_what_the_policy_learns_from(root: Path):
    tasks = root / "task"
    judged = replace(ENGINE, policy=replace(ENGINE.policy, checkpoints=2, judge_tasks=tasks))

    with pytest.raises(V2PError, match="holds toy, which the policy learns from"):
        stage_of(root, judged)


def test_tasks_that_judge_checkpoints_are_known_by_their_content_and_not_by_their_place(
    root: Path, tmp_path: Path
):
    def judged_by(folder: Path):
        policy = replace(ENGINE.policy, checkpoints=2, judge_tasks=folder)
        return stage_of(root, replace(ENGINE, policy=policy)).fingerprint

    places = [tmp_path / "a" / "other", tmp_path / "b" / "other", tmp_path / "c" / "other"]
    for place, mass_kg in zip(places, (0.2, 0.2, 0.3), strict=True):
        shutil.copytree(next((root / "task").iterdir()), place)
        scene = json.loads((place / "scene/scene.json").read_text())
        scene["objects"][0]["mass_kg"] = mass_kg
        (place / "scene/scene.json").write_text(json.dumps(scene))

    one, two, three = (judged_by(place.parent) for place in places)

    assert one == two
    assert len({one, three, stage_of(root).fingerprint}) == 3


def test_tasks_without_checkpoints_to_judge_are_refused(tmp_path: Path):
    with pytest.raises(ValueError, match="choose among checkpoints, and checkpoints is 1"):
        PolicyConfig(judge_tasks=tmp_path)

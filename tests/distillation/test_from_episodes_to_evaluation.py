"""All stages after the expert, with a real student, on the toy task: the student learns to do it."""

import json
import shutil
from dataclasses import replace
from pathlib import Path

import pytest
from toy_run import DISTILLATION, ENGINE, dataset_of, made, record_of

from v2p_data.evaluation.config import EvaluationConfig
from v2p_data.evaluation.judging import contestant
from v2p_data.pipeline.runner import Runtime
from v2p_data.policy.config import PolicyConfig
from v2p_data.policy.training import POLICY_FOLDER, sources_of
from v2p_data.stages import EVALUATION_FILE, ROOT_OF_TASKS, evaluation_stage, policy_stage

LEARNING = replace(
    ENGINE,
    distillation=replace(DISTILLATION, rounds=1, first_steps=40),
    policy=PolicyConfig(preset="small", steps=80, batch_size=32),
    evaluation=EvaluationConfig(episodes=12, worlds=6),
)


@pytest.mark.slow
@pytest.mark.e2e
def test_a_distilled_policy_does_the_task_of_its_expert(
    agreeing_referee, finished: Path, tmp_path: Path
):
    root = Path(shutil.copytree(finished, tmp_path / "run"))
    dataset = dataset_of(root)
    runtime = Runtime(root=root)
    stage = policy_stage(dataset, record_of(dataset), LEARNING, sources_of(dataset, root))

    outcomes = made([stage], runtime)
    assert all(o.is_usable for o in outcomes.values()), [o.detail for o in outcomes.values()]
    who = contestant(stage.folder(root) / POLICY_FOLDER)
    tasks = {"toy": dataset / ROOT_OF_TASKS / "toy"}
    programs = evaluation_stage(who, tasks, LEARNING, seen=[*tasks.values()])
    (judged,) = made([programs], runtime).values()

    assert judged.is_usable, judged.detail
    (row,) = json.loads((judged.folder / EVALUATION_FILE).read_text())
    assert (row["task"], row["seen"], row["judged"], row["trials"]) == ("toy", True, "policy", 12)
    # Cubes that lie too far away make about a third of the episodes hopeless, for the expert too.
    assert row["successes"] >= 4
    counts = record_of(stage.folder(root)).counts
    assert counts["frames"] > record_of(dataset).counts["frames"]
    assert made([programs], runtime)

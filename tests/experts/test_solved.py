from dataclasses import replace
from pathlib import Path

import pytest
import torch

from policies.ppo.config import ActorConfig
from policies.ppo.policy import ActorCritic, Expert
from v2p_data.errors import V2PError
from v2p_data.experts.solved import find_solved, solved_digests
from v2p_data.pipeline.artifact import Record, write_record
from v2p_data.task.benchmark import load_benchmark


def add_run(runs: Path, name: str, *, seed: int = 0, rejected: bool = False) -> Path:
    """Lay down what the stages `task` and `expert` leave."""
    task, expert = runs / "task" / f"{name}-1111", runs / "expert" / f"{name}-2222"
    for folder in (task, runs / "scene" / name):
        folder.mkdir(parents=True)
    bundle = load_benchmark(name)
    bundle.scene.save(runs / "scene" / name)
    replace(bundle, scene=replace(bundle.scene, folder=runs / "scene" / name)).save(task)
    model = ActorCritic(90, 7, ActorConfig(hidden=(4,)), torch.Generator().manual_seed(seed))
    Expert(model).save(expert)
    record = Record(
        stage="expert",
        item=name,
        version=1,
        fingerprint="2222",
        recipe={},
        inputs={"task": task.name},
        seconds=1.0,
        rejected={"reason": "expert_not_learned"} if rejected else None,
    )
    write_record(expert, record)
    return expert


def test_finished_experts_are_found_with_their_tasks(tmp_path: Path):
    runs = tmp_path / "runs"
    expert = add_run(runs, "push_left")
    add_run(runs, "lift_up", rejected=True)
    (runs / "expert" / "half-done").mkdir()

    found = find_solved(runs)

    assert [(s.folder, s.bundle.kind, s.obs_dim) for s in found] == [(expert, "push_left", 90)]


def test_a_folder_without_experts_is_one_clear_error(tmp_path: Path):
    with pytest.raises(V2PError, match="no finished expert"):
        find_solved(tmp_path)


def test_another_expert_in_the_folder_is_another_recipe(tmp_path: Path):
    runs = tmp_path / "runs"
    add_run(runs, "push_left")
    add_run(tmp_path / "other", "push_left", seed=1)

    before = solved_digests(runs)
    trained_anew = solved_digests(tmp_path / "other")
    add_run(runs, "lift_up")
    one_more = solved_digests(runs)

    assert solved_digests(None) == {}
    assert len(before) == 1
    assert before.keys() == trained_anew.keys()
    assert before != trained_anew
    assert before.items() < one_more.items()

"""The study of lifting: subsets are nested, nothing unseen is trained on, a stopped study goes on, sums are right."""

import argparse
import importlib
import subprocess
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import trimesh

from policies.ppo.config import ImitationConfig, PPOConfig
from v2p_data.distillation.config import DistillationConfig
from v2p_data.episodes.config import EpisodesConfig
from v2p_data.errors import V2PError
from v2p_data.experts.config import ExpertConfig
from v2p_data.pipeline.at_work import Event
from v2p_data.pipeline.runner import (
    Runtime,
    blocked_by,
    in_order,
    make_stage,
    stored_outcome,
)
from v2p_data.policy.config import PolicyConfig
from v2p_data.stages import (
    EngineConfig,
)
from v2p_data.task.generate import TaskConfig

ROOT = Path(__file__).parents[2]


@pytest.fixture(scope="module")
def study(load_script):
    return load_script("study_lifting")


@pytest.fixture(scope="module")
def parts(study):
    names = ("cells", "config", "fits", "objects", "results", "stages", "table")
    modules = {name: importlib.import_module(f"studies.{name}") for name in names}
    return argparse.Namespace(**modules)


def row(arm: str, n: int, seed: int, once: str, *, other: str = "0000"):
    def judged(group: str, letters: str):
        return {
            "group": group,
            "once": letters,
            "at_end": letters.replace("1", "0", 1),
            "failures": {"not_grasped": letters.count("0")},
            "median_success_s": 1.0,
        }

    return {
        "arm": arm,
        "n": n,
        "seed": seed,
        "study": "same",
        "objects": {"mug": judged("shape", once), "banana": judged("category", other)},
        "seconds": {"judging": 2.0},
        "frames": 100,
        "expert": {"mean": 0.9, "least": 0.8},
        "trajectories": 4,
        "tried": n + 1,
        "rejected": {"scene: low_confidence": 1},
    }


# --- settings --------------------------------------------------------------------------------------------------


def test_all_arms_start_from_the_same_states_and_other_seeds_from_others(parts):
    assert parts.cells.first_start("mug", 0) == parts.cells.first_start("mug", 0)
    starts = [parts.cells.first_start(name, seed) for name in ("mug", "cup") for seed in (0, 1)]
    assert len(set(starts)) == 4


# --- nothing unseen is trained on -------------------------------------------------------------------------------


def test_an_unseen_mesh_is_found_among_the_trainings_also_turned_moved_and_renamed(
    parts, tmp_path
):
    rng = np.random.default_rng(0)
    mesh = trimesh.creation.icosphere(2, 0.04)
    mesh.vertices *= rng.uniform(0.7, 1.3, (len(mesh.vertices), 1))
    other = trimesh.creation.icosphere(2, 0.04)
    (tmp_path / "scans" / "thing").mkdir(parents=True)
    unseen = tmp_path / "scans" / "thing" / "textured.obj"
    mesh.export(unseen)
    training = tmp_path / "task" / "scene" / "meshes"
    training.mkdir(parents=True)
    other.export(training / "toy.obj")

    parts.objects.demand_apart([tmp_path / "task"], {"thing": unseen})
    turned = mesh.copy()
    turned.apply_transform(trimesh.transformations.random_rotation_matrix(rng.random(3)))
    turned.apply_translation([0.1, 0.2, 0.3])
    turned.export(training / "toy_2.obj")

    with pytest.raises(V2PError, match=r"toy_2\.obj is the unseen object 'thing'"):
        parts.objects.demand_apart([tmp_path / "task"], {"thing": unseen})


def test_no_scan_lies_in_the_repository():
    listed = subprocess.run(
        ["git", "ls-files"], cwd=ROOT, capture_output=True, text=True, check=False
    )
    if listed.returncode:
        pytest.skip("not a git checkout")

    names = [Path(name) for name in listed.stdout.splitlines()]

    assert [n for n in names if n.suffix in {".obj", ".ply", ".stl", ".mtl", ".glb", ".dae"}] == []
    assert [n for n in names if "ycb" in n.name.lower() or n.name == "texture_map.png"] == []


# --- what the lines say together ----------------------------------------------------------------------------------


# --- a cell, and the study ------------------------------------------------------------------------------------------


def arguments(out: Path, **given) -> argparse.Namespace:
    usual = {
        "config": ROOT / "configs/studies/lifting_tiny.yaml",
        "out": out,
        "unseen": None,
        "videos": None,
        "arms": None,
        "counts": None,
        "seeds": None,
        "max_cells": None,
        "workers": 1,
        "threads": 1,
        "device": "cpu",
        "table": True,
    }
    return argparse.Namespace(**usual | given)


def test_a_study_that_was_killed_after_a_cell_goes_on_and_ends_with_every_cell_once(
    study, parts, tmp_path, monkeypatch, capsys
):
    cells = []

    def cell(self, arm, n, seed):
        if (arm, n) == ("toys", 2) and "toys" not in {c[0] for c in cells}:
            cells.append((arm, n, seed))
            raise V2PError("the pool is too small")
        cells.append((arm, n, seed))
        return row(arm, n, seed, "1010") | {"study": self.identity, "wall_s": 1.0}

    monkeypatch.setattr(parts.cells.Study, "cell", cell)
    study.make_cells(arguments(tmp_path, max_cells=2))
    first = (tmp_path / "results.jsonl").read_text()
    with (tmp_path / "results.jsonl").open("a") as stream:
        stream.write('{"arm": "toys", "n": 2')  # as a kill leaves it
    with pytest.raises(V2PError, match="1 results could not be made, the others were: toys N=2"):
        study.make_cells(arguments(tmp_path))
    study.make_cells(arguments(tmp_path))

    done = [parts.cells.key_of(r) for r in parts.results.results_in(tmp_path)]
    assert (tmp_path / "results.jsonl").read_text().startswith(first)
    assert len(set(done)) == len(done) == 1 + 4 * 2
    assert sorted(cells) == sorted([*done, ("toys", 2, 0)])  # the failed one alone is tried again
    study.show(arguments(tmp_path))
    assert "| bc | 3 |" in capsys.readouterr().out
    with pytest.raises(V2PError, match="results of another study"):
        study.make_cells(arguments(tmp_path, config=ROOT / "configs/studies/lifting_laptop.yaml"))
    with pytest.raises(V2PError, match=r"--counts \[7\] are not all among the counts"):
        study.make_cells(arguments(tmp_path, counts=[7]))


@pytest.fixture
def in_this_process(parts, monkeypatch):
    """Stages are made here: worker processes, which have tests of their own, would each import everything anew."""

    def run(stages, runtime, on_event):
        outcomes = {}
        for stage in in_order(stages):
            blocker = blocked_by(stage, outcomes)
            if blocker is None:
                outcome = stored_outcome(stage, runtime.root) or make_stage(stage, runtime)
            else:
                outcome = replace(blocker, stage=stage.name, item=stage.item, status="blocked")
            outcomes[stage.name, stage.folder_name] = outcome
            on_event(Event(kind="ended", stage=stage, outcome=outcome))
        return outcomes

    monkeypatch.setattr(parts.stages, "run_stages", run)


@pytest.mark.long
@pytest.mark.e2e
def test_a_cell_learns_from_a_toy_and_is_judged_on_an_unseen_object_that_nothing_was_trained_on(
    parts, in_this_process, tmp_path
):
    cfg = parts.config.LiftingConfig(
        counts=(1, 2),
        pool=parts.config.PoolConfig(toys=3, seed=3),
        unseen=parts.config.UnseenConfig(
            episodes=2, films=1, drawn_shapes=("pudding box",), drawn_categories=()
        ),
        engine=EngineConfig(
            task=TaskConfig(num_samples=1),
            expert=ExpertConfig(
                num_envs=128,
                trial_worlds=4,
                eval_episodes=4,
                min_success=0.0,
                imitation=ImitationConfig(rounds=8, least_rounds=8, teacher_rounds=6),
                ppo=PPOConfig(
                    total_steps=512,
                    window_episodes=4,
                    min_window_episodes=2,
                    num_deterministic=4,
                ),
            ),
            episodes=EpisodesConfig(num_episodes=2, batch_worlds=8, max_batches=4),
            distillation=DistillationConfig(
                rounds=1, episodes=4, worlds=4, first_steps=2, round_steps=2
            ),
            policy=PolicyConfig(preset="small", steps=4, batch_size=16),
        ),
    )
    made = parts.cells.Study(cfg=cfg, out=tmp_path, runtime=Runtime(root=tmp_path))

    found = made.cell("toys", 1, 0)

    assert found["episodes"] == found["trajectories"] == 2
    assert found["tried"] == 1 + sum(found["rejected"].values())
    assert found["frames"] == found["demonstrated_frames"] + found["handovers"]["frames"]
    judged = found["objects"]["pudding_box"]
    assert len(judged["once"]) == len(judged["at_end"]) == 2
    assert sum(judged["failures"].values()) == judged["once"].count("0")
    assert list((tmp_path / "films" / "toys_1_0").glob("*/*.mp4"))
    meshes = {"pudding_box": tmp_path / "unseen_meshes/pudding_box/textured.obj"}
    parts.objects.demand_apart([tmp_path / "run"], meshes)
    with pytest.raises(V2PError, match="is the unseen object 'pudding_box'"):
        parts.objects.demand_apart([tmp_path / "unseen"], meshes)

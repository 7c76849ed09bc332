"""The study of lifting: subsets are nested, nothing unseen is trained on, a stopped study goes on, sums are right."""

import argparse
import importlib
import subprocess
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import trimesh

from policies.evaluation.rate import wilson
from policies.ppo.config import ImitationConfig, PPOConfig
from v2p_data.distillation.config import DistillationConfig
from v2p_data.episodes.config import EpisodesConfig
from v2p_data.errors import V2PError
from v2p_data.experts.config import ExpertConfig
from v2p_data.pipeline.at_work import Event
from v2p_data.pipeline.runner import (
    Outcome,
    Runtime,
    blocked_by,
    in_order,
    make_stage,
    stored_outcome,
)
from v2p_data.pipeline.settings import load_settings
from v2p_data.policy.config import PolicyConfig
from v2p_data.scene.scene import Scene
from v2p_data.stages import (
    CousinsConfig,
    EngineConfig,
    episodes_stage,
    reward_stage,
    task_stage,
    with_cousins,
)
from v2p_data.task.generate import TaskConfig, generate_task
from v2p_data.video.meaning import parse_caption

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


@pytest.mark.parametrize("size", ["tiny", "laptop"])
def test_every_size_of_the_study_can_be_loaded_and_asks_for_the_arms_of_the_question(size, parts):
    cfg = load_settings(ROOT / f"configs/studies/lifting_{size}.yaml", parts.config.LiftingConfig)

    assert {"cop", "videos", "toys", "bc"} <= set(cfg.arms)


@pytest.mark.parametrize("kind", ["lift_up", "push_left", "place_onto"])
def test_a_toys_scene_is_of_the_kind_that_is_studied_and_its_task_passes_the_audit(
    kind, parts, tmp_path
):
    out = tmp_path / "toy_0004-x"
    asked = parts.config.ASKED[kind]

    parts.objects.make_toy({"seed": 0, "kind": kind}, {}, out, Runtime(root=tmp_path))

    scene = Scene.load(out)
    toy = scene.manipulated
    first, last = np.array(toy.poses_world)[[0, -1], :3]
    assert scene.kind == kind == parse_caption(scene.description).kind
    assert last - first == pytest.approx(asked.move_m)
    for block in scene.others:  # it stands under the toy's last place
        top = block.poses_world[-1][2] + block.size_m[2] / 2
        assert top == pytest.approx(last[2] - toy.size_m[2] / 2)
    assert len(scene.others) == (asked.onto_m is not None)
    assert generate_task(scene, TaskConfig(num_samples=1), 0).bundle.kind == kind


def test_each_cousin_goes_through_the_same_stages_as_its_scene(parts):
    cfg = replace(EngineConfig(), cousins=CousinsConfig(count=2))
    candidate = parts.objects.candidate_of(
        parts.objects.toy_stage(4, parts.config.PoolConfig()), cfg, "lift_up"
    )

    own, *cousins = with_cousins(episodes_stage(candidate.task, candidate.expert, cfg), cfg)

    assert [c.item for c in cousins] == ["toy_0004_cousin_000", "toy_0004_cousin_001"]
    for cousin in cousins:
        names = [(stage.name, stage.item) for stage in in_order([cousin])]
        assert names == [
            ("scene", "toy_0004"),
            *((n, cousin.item) for n in ("cousin", "task", "instruction", "expert", "episodes")),
        ]
        lift = cousin.inputs["task"]
        assert cousin.inputs["expert"].inputs["task"].folder_name == lift.folder_name
    assert len({stage.folder_name for stage in (own, *cousins)}) == 3
    assert with_cousins(own, EngineConfig()) == [own]


def test_templates_write_one_code_for_a_cousin_and_a_searched_reward_is_its_familys(parts):
    cfg = EngineConfig(cousins=CousinsConfig(count=1))
    toy = parts.objects.toy_stage(4, parts.config.PoolConfig())
    task = task_stage(toy, cfg)
    reward = reward_stage(task, cfg)

    _, plain = with_cousins(task, cfg)
    _, searched = with_cousins(reward, cfg)

    assert (plain.config.config.num_samples, set(plain.inputs)) == (1, {"scene"})
    assert (searched.name, searched.inputs["family"]) == ("task", reward)


def test_the_tasks_of_a_smaller_n_come_first_in_the_order_of_a_larger_one(parts, tmp_path):
    cfg = parts.config.LiftingConfig(counts=(2, 4))
    made = parts.cells.Study(cfg=cfg, out=tmp_path, runtime=Runtime(root=tmp_path))

    orders = [made.order("videos", seed) for seed in (0, 1)]

    assert [sorted(order) for order in orders] == [list(range(cfg.pool.clips))] * 2
    assert orders[0] != orders[1]
    assert orders[0] == made.order("videos", 0)  # the same for every N: a prefix is a subset


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


def test_a_rate_counts_episodes_of_all_cells_or_of_one_group(parts):
    rows = [row("videos", 5, 0, "1110"), row("videos", 5, 1, "1100", other="1000")]

    assert parts.fits.rate(rows) == wilson(6, 16)
    assert parts.fits.rate(rows, group="shape") == wilson(5, 8)
    assert parts.fits.rate(rows, "at_end", "category") == wilson(0, 8)


def test_a_paired_difference_is_taken_start_by_start(parts):
    ours = [row("videos", 5, 0, "1110"), row("videos", 5, 1, "1111")]
    others = [row("toys", 5, 1, "1001"), row("toys", 5, 2, "1111")]

    found = parts.fits.paired(ours, others)

    # seed 1 alone is in both: 1111 0000 against 1001 0000
    assert found.pairs == 8
    assert found.value == pytest.approx(2 / 8)
    assert found.seeds == (0.25,)
    # two of eight pairs differ, both in our favour; with half a pair more in each cell: (3 - 2^2 / 10) / 10^2
    assert (found.low + found.high) / 2 == pytest.approx(2 / 10)
    assert found.high - found.low == pytest.approx(2 * 1.96 * np.sqrt(0.026), rel=1e-3)
    equal = parts.fits.paired(ours, ours)
    assert equal.value == 0
    assert equal.low < -0.05 < 0.05 < equal.high
    assert parts.fits.paired(ours, [row("toys", 5, 7, "1111")]) is None


def test_tables_hold_every_arm(parts):
    rows = [row(arm, n, 0, "1110") for arm in ("videos", "toys") for n in (5, 10)]
    rows.append({**row("cop", 0, 0, "1000"), "seconds": {}})
    text = parts.table.table(rows)

    assert "| videos | 5 | 37.5 % (" not in text  # percentages as the other tables print them
    assert "| videos | 5 | 37.5% (13.7%-69.4%) | 0.38 | 75% | 0% | 25% | 90% | 4 | 100 |" in text
    assert "| videos - toys | 10 | +0.0 points" in text
    assert "of other scenes and another robot" in text


# --- a cell, and the study ------------------------------------------------------------------------------------------


def test_rejected_objects_are_counted_and_skipped_and_smaller_sets_are_parts_of_larger_ones(
    parts, tmp_path, monkeypatch
):
    cfg = parts.config.LiftingConfig(pool=parts.config.PoolConfig(toys=12))
    made = parts.cells.Study(cfg=cfg, out=tmp_path, runtime=Runtime(root=tmp_path))

    def outcome(stage, *, is_good: bool):
        return Outcome(
            stage=stage.name,
            item=stage.item,
            folder=tmp_path,
            status="made" if is_good else "rejected",
            reason="" if is_good else "expert_not_learned",
        )

    def run(stages, root=None):
        """Every other expert learns nothing, and what needs it is blocked."""
        return {
            s.folder_name: outcome(
                s, is_good=s.name not in ("expert", "episodes") or int(s.item[-1]) % 2 == 0
            )
            for s in in_order(stages)
        }

    monkeypatch.setattr(made, "run", run)
    two, four = (made.find("toys", count, 0) for count in (2, 4))

    items = [f"toy_{k:04d}" for k in made.order("toys", 0) if k % 2 == 0]
    assert [c.item for c in four.candidates] == items[:4]
    assert [c.item for c in two.candidates] == items[:2]
    assert four.rejected == {"expert: expert_not_learned": four.tried - 4}
    assert made.order("toys", 0)[four.tried - 1] == int(items[3][-4:])
    with pytest.raises(V2PError, match=r"only 6 of 12 toys became tasks .* raise pool\.toys"):
        made.find("toys", 7, 0)


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

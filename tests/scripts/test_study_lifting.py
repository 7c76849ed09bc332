"""The study of lifting: subsets are nested, nothing unseen is trained on, a stopped study goes on, sums are right."""

import argparse
import importlib
import subprocess
from pathlib import Path

import numpy as np
import pytest
import trimesh

from v2p_data.errors import V2PError

ROOT = Path(__file__).parents[2]


@pytest.fixture(scope="module")
def study(load_script):
    return load_script("study_lifting")


@pytest.fixture(scope="module")
def parts(study):
    names = ("cells", "config", "fits", "objects", "results", "stages", "table")
    modules = {name: importlib.import_module(f"studies.{name}") for name in names}
    return argparse.Namespace(**modules)


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

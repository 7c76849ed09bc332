import re
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]


@pytest.mark.long
def test_the_simulators_benchmark_ends_with_the_share_of_the_physics_speed():
    tiny = ["--worlds=8", "--threads=1", "--steps=2", "--turns=3", "--warmup-steps=2"]
    command = [sys.executable, "scripts/bench_sim.py", "--quick", *tiny]

    done = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, check=True)

    found = re.fullmatch(r"env_over_limit: (\d\.\d\d)", done.stdout.splitlines()[-1])
    assert found is not None
    assert 0 < float(found[1]) < 1  # Python costs something, and with eight worlds a lot


@pytest.mark.long
def test_the_masks_benchmark_ends_with_the_ratio_and_shows_that_both_agree():
    tiny = ["--scenes=1", "--turns=1", "--size-px=64"]
    command = [sys.executable, "scripts/bench_masks.py", "--quick", *tiny]

    done = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, check=False)
    if "needs OpenGL" in done.stderr:
        pytest.skip(done.stderr.strip())

    found = re.fullmatch(r"masks_over_renderer: (\d+\.\d\d)", done.stdout.splitlines()[-1])
    assert found is not None, done.stderr
    assert float(found[1]) > 0
    overlaps = re.findall(r"^ *(?:robot|background|object \d) +\d+ +(\d\.\d+)", done.stdout, re.M)
    assert len(overlaps) == 3
    assert min(map(float, overlaps)) >= 0.99  # 64 pixels wide, a border pixel weighs more


@pytest.mark.long
def test_the_episodes_benchmark_finds_every_pixel_equal_and_ends_with_its_ratio():
    tiny = ["--quick", "--episodes=2", "--size-px=64"]
    command = [sys.executable, "scripts/bench_episodes.py", *tiny]
    printed = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, check=True).stdout

    assert re.search(r"^wrong pixels in ours: 0 of [1-9]\d+$", printed, re.M)
    found = re.fullmatch(r"expert_to_dataset_over_lerobot: (\d+\.\d\d)", printed.splitlines()[-1])
    assert found is not None
    assert float(found[1]) > 0


@pytest.mark.slow
@pytest.mark.long
def test_the_twins_benchmark_pairs_its_episodes_and_ends_with_the_drop(tmp_path):
    from dataclasses import replace

    from v2p_data.task.benchmark import load_benchmark

    bundle = load_benchmark("lift_up")
    scene = tmp_path / "scene"
    scene.mkdir()
    bundle.scene.save(scene)
    replace(bundle, scene=replace(bundle.scene, folder=scene)).save(tmp_path / "task")
    tiny = ["--who=programs", "--episodes=2", "--workers=2", "--no-at-end"]
    command = [sys.executable, "scripts/bench_twin.py", str(tmp_path / "task"), *tiny]

    done = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, check=True)

    assert done.stdout.startswith("sim-to-sim: ")
    pairs = re.search(r"both (\d), twin only (\d), .* only (\d), neither (\d)", done.stdout)
    assert pairs is not None
    assert sum(map(int, pairs.groups())) == 2
    assert re.fullmatch(r"sim_to_sim_drop: -?\d\.\d+", done.stdout.splitlines()[-1])

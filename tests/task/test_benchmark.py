"""The twelve tasks of the paper can be loaded, and begin unsolved."""

import shutil
from pathlib import Path

import numpy as np
import pytest
import yaml

from v2p_data.errors import V2PError
from v2p_data.sim.env.batch_env import BatchEnv
from v2p_data.task.benchmark import FOLDER, benchmark_names, load_benchmark
from v2p_data.task.sandbox.reader.check import check_code

PAPER_KINDS = {
    "cover",
    "drop_in_front_of",
    "insert",
    "lift_up",
    "push_left",
    "push_next_to",
    "push_right",
    "push_with",
    "slide_to",
    "throw_into",
    "tip_over",
    "uncover",
}
"""The task names in the paper's tables."""


def test_every_kind_of_the_paper_has_one_task():
    kinds = [load_benchmark(name).kind for name in benchmark_names()]

    assert sorted(kinds) == sorted(PAPER_KINDS)


@pytest.mark.parametrize("name", benchmark_names())
def test_no_episode_begins_solved(name: str):
    bundle = load_benchmark(name)
    check_code(bundle.code)
    env = BatchEnv(bundle, num_envs=8, seed=3, num_threads=1)

    for _ in range(5):
        result = env.step(np.zeros((8, 7)))
        assert not result.success.any()
    assert not result.terminated.any()


def test_a_file_says_where_things_lie():
    scene = load_benchmark("uncover").scene

    # A cup of 9 cm stands over a cube of 27 mm; in the end it is 15 cm higher.
    assert [o.first_pose[2] for o in scene.objects] == pytest.approx([0.045, 0.0135])
    assert scene.manipulated.poses_world[-1][2] == pytest.approx(0.195)
    assert scene.num_frames == 2


def test_a_yaw_turns_an_object_about_the_vertical():
    stick = load_benchmark("push_with").scene.objects[1]

    # 1.57 rad: cos and sin of 0.785.
    assert stick.first_pose[3:] == pytest.approx([0.70739, 0, 0, 0.70683], abs=1e-5)


def test_a_carton_tipped_over_ends_with_its_top_to_the_left():
    quat = np.array(load_benchmark("tip_over").scene.manipulated.poses_world[-1][3:])

    w, x, y, z = quat
    up = [2 * (x * z + w * y), 2 * (y * z - w * x), 1 - 2 * (x * x + y * y)]
    assert up == pytest.approx([0, 1, 0], abs=1e-9)


def test_reference_code_beside_the_file_takes_the_place_of_the_templates(tmp_path: Path):
    shutil.copy(FOLDER / "lift_up.yaml", tmp_path)
    code = load_benchmark("lift_up").code + "\n# the reference\n"
    (tmp_path / "lift_up.py").write_text(code)

    assert load_benchmark("lift_up", tmp_path).code == code


def test_an_unknown_task_is_named_with_the_nearest_known_one():
    with pytest.raises(V2PError, match=r"no benchmark task 'lift_upp'.*Did you mean 'lift_up'"):
        load_benchmark("lift_upp")


def _without(key: str):
    return lambda data: {k: v for k, v in data.items() if k != key}


def _with_object(**changes):
    def change(data):
        return {**data, "objects": [{**data["objects"][0], **changes}]}

    return change


@pytest.mark.parametrize(
    ("change", "said"),
    [
        (_without("description"), "description"),
        (_without("kind"), "kind"),
        (_without("objects"), "objects"),
        (_with_object(colour="red"), "colour"),
        (_with_object(size_m=[0.06, 0.04]), "size_m"),
        (_with_object(size_m="large"), "size_m"),
        (_with_object(path=[[0.0]]), "path"),
        (_with_object(path=[]), "path"),
        (_with_object(mass_kg="heavy"), "heavy"),
        (lambda data: [data], "mapping"),
        (lambda data: None, "mapping"),
        (lambda data: {**data, "objects": []}, "objects"),
    ],
)
def test_a_wrong_file_is_refused_in_one_sentence(change, said: str, tmp_path: Path):
    data = yaml.safe_load((FOLDER / "lift_up.yaml").read_text())
    (tmp_path / "wrong.yaml").write_text(yaml.safe_dump(change(data)))

    with pytest.raises(V2PError) as caught:
        load_benchmark("wrong", tmp_path)

    message = str(caught.value)
    assert "wrong.yaml" in message
    assert said in message
    assert "\n" not in message


def test_a_file_that_is_no_yaml_is_refused_in_one_sentence(tmp_path: Path):
    (tmp_path / "wrong.yaml").write_text("objects: [{name: tea\n")

    with pytest.raises(V2PError, match=r"wrong\.yaml") as caught:
        load_benchmark("wrong", tmp_path)

    assert "\n" not in str(caught.value)

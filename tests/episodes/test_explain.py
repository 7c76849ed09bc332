"""What a dataset carries about its making is read back, and two are told apart field by field."""

import json
from pathlib import Path

import pytest

from v2p_data.cli import run
from v2p_data.episodes.dataset.explain import Difference, differences, explain
from v2p_data.errors import V2PError
from v2p_data.pipeline.artifact import Record, write_record

CODE = "class LiftTask(Task):\n    pass\n"


def dataset(root: Path, *, mass_kg: float = 0.1, commit: str = "abc", code: str = CODE) -> Path:
    """Write what `v2p explain` reads of a dataset, as `v2p generate` leaves it."""
    pa = pytest.importorskip("pyarrow")
    pq = pytest.importorskip("pyarrow.parquet")
    for folder in ("meta/episodes/chunk-000", "v2p/tasks/mug/scene"):
        (root / folder).mkdir(parents=True)
    task = "lift the mug"
    table = {
        "episode_index": [0, 1], "tasks": [[task]] * 2, "length": [20, 30],
        "dataset_from_index": [0, 20], "dataset_to_index": [20, 50],
        "data/chunk_index": [0, 0], "data/file_index": [0, 0],
        "videos/observation.images.mask/chunk_index": [0, 0],
        "videos/observation.images.mask/file_index": [0, 0],
        "videos/observation.images.mask/from_timestamp": [0.0, 1.0],
        "videos/observation.images.mask/to_timestamp": [1.0, 2.5],
    }  # fmt: skip
    pq.write_table(pa.table(table), root / "meta/episodes/chunk-000/file-000.parquet")
    info = {"codebase_version": "v3.0", "fps": 20, "features": {}, "total_episodes": 2,
            "total_frames": 50, "robot_type": "v2p_franka"}  # fmt: skip
    (root / "meta/info.json").write_text(json.dumps(info))
    scene = {"stage": "scene", "folder": "mug-11111111", "counts": {"objects": 2},
             "recipe": {"sources": {"video": "27809147446f30a9"}}}  # fmt: skip
    stages = {"task": {"stage": "task", "folder": "mug-22222222", "inputs": {"scene": scene}}}
    stages["expert"] = {"stage": "expert", "folder": "mug-33333333", "counts": {"steps": 40000}}
    history = {"stage": "episodes", "folder": "mug-44444444", "inputs": stages}
    episodes = [
        {"id": f"mug_{k:05d}", "item": "mug", "task": task, "seed": 77, "length": 20 + 10 * k,
         "labels": {"0": "background", "2": "mug"}, "success": True, "referee": True,
         "params": {"objects": {"mug": {"mass_kg": mass_kg + k / 10}}}}
        for k in range(2)
    ]  # fmt: skip
    about = {"schema": 1, "repo_id": "user/mugs", "palette": {"0": 0}, "episodes": episodes,
             "provenance": {"items": {"mug": history}, "commit": commit, "time": root.name,
                            "packages": {"mujoco": "4.0.0"}, "argv": ["v2p", "generate"]}}  # fmt: skip
    (root / "meta/v2p.json").write_text(json.dumps(about))
    (root / "v2p/tasks/mug/task.py").write_text(code)
    objects = [{"label": "red mug", "shape": "mesh"}]
    (root / "v2p/tasks/mug/scene/scene.json").write_text(
        json.dumps({"video": "mug.mp4", "objects": objects})
    )
    return root


def test_a_dataset_tells_videos_scenes_code_experts_seeds_versions_and_ranges(tmp_path: Path):
    told = "\n".join(explain(dataset(tmp_path / "mugs")))

    for words in (
        "2 episodes, 50 frames",
        "mug.mp4: red mug (mesh)",
        "27809147446f30a9",
        "v2p/tasks/mug/task.py: 2 lines",
        "expert    mug-33333333: steps 40000",
        "scene     mug-11111111: objects 2",
        "seeds     77",
        "mujoco 4.0.0",
        "commit      abc",
        "objects.mug.mass_kg: 0.1 to 0.2",
    ):
        assert words in told


def test_an_episode_tells_where_it_lies_and_what_was_drawn(tmp_path: Path):
    told = explain(dataset(tmp_path / "mugs"), episode=1)

    lines = dict(line.split(maxsplit=1) for line in told)
    assert lines["id"] == "mug_00001"
    assert lines["params.objects.mug.mass_kg"] == "0.2"
    assert lines["videos/observation.images.mask"] == "chunk 0, file 0, 1.00 s to 2.50 s"
    assert lines["expert"] == "mug-33333333"
    with pytest.raises(V2PError, match="no episode 2; they are numbered 0 to 1"):
        explain(tmp_path / "mugs", episode=2)


def test_two_datasets_differ_in_the_fields_that_differ(tmp_path: Path):
    one = dataset(tmp_path / "one")
    two = dataset(tmp_path / "two", mass_kg=0.5, commit="def", code=CODE + "\n")

    found = {d.field: (d.first, d.second) for d in differences(one, two)}

    assert found.pop("task code.mug") is not None
    assert found == {
        "provenance.commit": ("abc", "def"),
        "episodes.mug_00000.params.objects.mug.mass_kg": (0.1, 0.5),
        "episodes.mug_00001.params.objects.mug.mass_kg": (0.2, 0.6),
    }
    assert differences(one, one) == []


def test_a_result_of_a_run_tells_its_recipe_and_its_sibling_what_was_changed(tmp_path: Path):
    for name, steps in (("a", 10), ("b", 20)):
        (tmp_path / name).mkdir()
        recipe = {"config": {"ppo": {"steps": steps, "seed": 0}}, "sources": {"video": "12ab"}}
        write_record(
            tmp_path / name,
            Record(stage="expert", item="mug", version=2, fingerprint="x", recipe=recipe,
                   inputs={"task": "mug-22222222"}, seconds=float(steps), counts={"rate": 0.9}),
        )  # fmt: skip

    told = "\n".join(explain(tmp_path / "a"))

    assert "stage expert of mug, version 2" in told
    assert "ppo.steps: 10" in told
    assert "task: mug-22222222" in told
    assert differences(tmp_path / "a", tmp_path / "b") == [
        Difference(field="recipe.config.ppo.steps", first=10, second=20)
    ]


def test_the_command_writes_json_and_refuses_what_is_neither(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
):
    root = dataset(tmp_path / "mugs")

    assert run(["explain", str(root), "--episode", "0", "--json", str(tmp_path / "e.json")]) == 0
    assert run(["explain", str(root), str(root)]) == 0
    assert run(["explain", str(tmp_path)]) == 2

    assert json.loads((tmp_path / "e.json").read_text())["seed"] == 77
    said = capsys.readouterr()
    assert "they differ in nothing" in said.out
    assert "neither a LeRobot dataset" in said.err

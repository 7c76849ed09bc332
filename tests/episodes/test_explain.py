"""What a dataset carries about its making is read back, and two are told apart field by field."""

import json
from pathlib import Path

import pytest

from v2p_data.cli import run
from v2p_data.episodes.dataset.explain import differences, explain, records_of
from v2p_data.errors import V2PError
from v2p_data.pipeline.artifact import Record, write_record


def dataset(root: Path, *, mass_kg: float = 0.1, commit: str = "abc") -> Path:
    """Write what `v2p explain` reads of a dataset, as `v2p generate` leaves it."""
    (root / "meta").mkdir(parents=True)
    info = {
        "codebase_version": "v3.0",
        "fps": 20,
        "features": {},
        "total_episodes": 2,
        "total_frames": 50,
        "robot_type": "v2p_franka",
    }
    (root / "meta/info.json").write_text(json.dumps(info))
    scene = {"stage": "scene", "folder": "mug-11111111", "counts": {"objects": 2}}
    stages = {"task": {"stage": "task", "folder": "mug-22222222", "inputs": {"scene": scene}}}
    stages["expert"] = {"stage": "expert", "folder": "mug-33333333", "counts": {"steps": 40000}}
    history = {"stage": "episodes", "folder": "mug-44444444", "inputs": stages}
    episodes = [
        {
            "id": f"mug_{k:05d}",
            "item": "mug",
            "task": "lift the mug",
            "seed": 77,
            "length": 20,
            "labels": {"2": "mug"},
            "params": {"objects": {"mug": {"mass_kg": mass_kg + k / 10}}},
        }
        for k in range(2)
    ]
    about = {
        "schema": 1,
        "repo_id": "user/mugs",
        "palette": {"0": 0},
        "episodes": episodes,
        "provenance": {"items": {"mug": history}, "commit": commit, "time": root.name},
    }
    (root / "meta/v2p.json").write_text(json.dumps(about))
    return root


def test_a_dataset_shows_its_tree_of_records(tmp_path: Path):
    lines = explain(records_of(dataset(tmp_path / "mugs")))

    assert "info.episodes: 2" in lines
    assert "provenance.commit: abc" in lines
    assert lines[lines.index("mug:") + 1 :] == [
        "  episodes mug-44444444: ",
        "    task mug-22222222: ",
        "      scene mug-11111111: objects 2",
        "    expert mug-33333333: steps 40000",
    ]


def test_an_episode_shows_what_was_drawn_and_where_it_was_made(tmp_path: Path):
    root = dataset(tmp_path / "mugs")

    lines = explain(records_of(root, episode=1))

    assert "id: mug_00001" in lines
    assert "params.objects.mug.mass_kg: 0.2" in lines
    assert "    expert mug-33333333: steps 40000" in lines
    with pytest.raises(V2PError, match="no episode 2; they are numbered 0 to 1"):
        records_of(root, episode=2)


def test_two_datasets_differ_in_the_fields_that_differ(tmp_path: Path):
    one = dataset(tmp_path / "one")
    two = dataset(tmp_path / "two", mass_kg=0.5, commit="def")

    assert differences(one, two) == [
        ("episodes.mug_00000.params.objects.mug.mass_kg", 0.1, 0.5),
        ("episodes.mug_00001.params.objects.mug.mass_kg", 0.2, 0.6),
        ("provenance.commit", "abc", "def"),
    ]
    assert differences(one, one) == []


def test_a_result_of_a_run_shows_its_recipe_and_its_sibling_what_was_changed(tmp_path: Path):
    for name, steps in (("a", 10), ("b", 20)):
        (tmp_path / "expert" / name).mkdir(parents=True)
        recipe = {"config": {"ppo": {"steps": steps, "seed": 0}}, "sources": {"video": "12ab"}}
        write_record(
            tmp_path / "expert" / name,
            Record(
                stage="expert",
                item="mug",
                version=2,
                fingerprint="x",
                recipe=recipe,
                inputs={},
                seconds=float(steps),
                counts={"rate": 0.9},
            ),
        )
    one, two = tmp_path / "expert/a", tmp_path / "expert/b"

    lines = explain(records_of(one))

    assert lines[0] == "expert a: rate 0.9"
    assert "  config.ppo.steps: 10" in lines
    assert dict((f, (x, y)) for f, x, y in differences(one, two)) == {
        "folder": ("a", "b"),
        "recipe.config.ppo.steps": (10, 20),
    }


def test_the_command_refuses_what_is_neither(tmp_path: Path, capsys: pytest.CaptureFixture[str]):
    root = dataset(tmp_path / "mugs")

    assert run(["explain", str(root), "--episode", "0"]) == 0
    assert run(["explain", str(root), str(root)]) == 0
    assert run(["explain", str(tmp_path)]) == 2

    shown = capsys.readouterr()
    assert "0 fields differ" in shown.out
    assert "neither a LeRobot dataset" in shown.err

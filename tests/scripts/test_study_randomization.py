"""The study of randomisations: what is switched off, what is compared, and a study that goes on."""

import argparse
import dataclasses
import importlib
import json
from pathlib import Path

import pytest

from v2p_data.pipeline.runner import Runtime, Stage, make_stage, stored_outcome
from v2p_data.pipeline.settings import load_settings
from v2p_data.sim.env.ranges import RandomizationConfig, none

CONFIG = Path(__file__).parents[2] / "configs" / "studies" / "randomization.yaml"


@pytest.fixture(scope="module")
def study(load_script):
    return load_script("study_randomization")


@pytest.fixture(scope="module")
def parts(study):
    names = ("randomization", "randomization_table", "results")
    return argparse.Namespace(**{n: importlib.import_module(f"studies.{n}") for n in names})


def row(setting: str, place: str, once: str, seed: int = 0) -> dict:
    return {"setting": setting, "seed": seed, "place": place, "once": once, "study": "other"}


def test_every_randomisation_is_switched_off_by_exactly_one_setting(parts):
    switched = [name for names in parts.randomization.GROUPS.values() for name in names]

    assert sorted(switched) == sorted(f.name for f in dataclasses.fields(RandomizationConfig))


def test_a_setting_switches_off_its_own_and_leaves_the_others_on(parts):
    every = load_settings(CONFIG, parts.randomization.RandomizationStudyConfig)
    on = every.engine.episodes.randomization

    assert parts.randomization.randomization_of("all", on) == on
    noisy = dataclasses.replace(none(), action_noise=on.action_noise)
    assert parts.randomization.randomization_of("none", on) == noisy
    delay = parts.randomization.randomization_of("delay", on)
    assert (on.delay_s, delay.delay_s) == ((0.0, 0.02), (0.0, 0.0))
    assert dataclasses.replace(delay, delay_s=on.delay_s) == on


def test_all_that_is_on_in_the_study_is_the_recording_for_robots(parts):
    import yaml

    robots = yaml.safe_load((CONFIG.parents[1] / "robot.yaml").read_text())["episodes"]
    study = yaml.safe_load(CONFIG.read_text())["engine"]["episodes"]

    assert study["randomization"] == robots["randomization"]


def test_episodes_won_and_lost_are_those_of_the_same_start_and_seed(parts):
    rows = [
        row("all", "twin", "110"), row("noise", "twin", "011"),
        row("all", "twin", "000", seed=1), row("noise", "twin", "100", seed=1),
        row("noise", "training", "1"),
    ]  # fmt: skip

    found = parts.randomization_table.compared(rows, "noise", "twin")

    # Seed 0: the first start is lost, the third won. Seed 1: the first is won.
    assert (found.rate.successes, found.rate.trials, found.won, found.lost) == (3, 6, 2, 1)
    alone = parts.randomization_table.compared(rows, "noise", "training")
    assert (alone.rate.successes, alone.won, alone.lost) == (1, 0, 0)
    assert parts.randomization_table.compared(rows, "size", "twin") is None


def test_the_table_and_the_figure_hold_what_is_there(parts, tmp_path):
    rows = [row("all", "training", "11"), row("all", "twin", "10"), row("camera", "twin", "01")]

    table = parts.randomization_table.table(rows)
    parts.randomization_table.write_figure(rows, tmp_path / "figure.svg")

    assert "| nothing | 2 of 2 [34, 100] | - | 1 of 2 [9, 91] | - |" in table
    assert "| camera | - | - | 1 of 2 [9, 91] | +1, -1 |" in table
    assert "camera off" in (tmp_path / "figure.svg").read_text()


def made(name: str, inputs: dict[str, Stage], root: Path) -> Stage:
    def make(cfg, inputs, out, runtime):
        (out / "what").write_text(name)

    stage = Stage(name=name, item="box", config={"size": 1.0}, inputs=inputs, version=3, make=make)
    assert make_stage(stage, Runtime(root=root)).status == "made"
    return stage


def test_a_finished_stage_is_copied_with_what_it_was_made_from(parts, tmp_path):
    run, copies = tmp_path / "run", tmp_path / "copies"
    task = made("task", {}, run)
    expert = made("expert", {"task": task}, run)

    copied = parts.randomization.copied_stage(expert.folder(run), run, copies)
    again = parts.randomization.copied_stage(expert.folder(run), run, copies)

    assert copied.folder_name == again.folder_name == expert.folder_name
    for stage in (copied, copied.inputs["task"]):
        kept = stored_outcome(stage, copies)
        assert kept is not None
        assert kept.status == "kept"
        assert (stage.folder(copies) / "what").read_text() == stage.name


def test_a_run_without_the_tasks_expert_is_refused_with_those_it_has(
    study, parts, tmp_path, monkeypatch, capsys
):
    made("expert", {}, tmp_path / "run")
    words = ["--run", str(tmp_path / "run"), "--task", "mug", "--out", str(tmp_path / "out")]
    monkeypatch.setattr("sys.argv", ["study_randomization.py", *words])

    with pytest.raises(SystemExit) as ended:
        study.main()

    assert ended.value.code == 2
    assert "one finished expert of task 'mug'" in capsys.readouterr().err


def test_results_of_another_study_are_not_mixed_with(study, parts, tmp_path, monkeypatch, capsys):
    made("expert", {"task": made("task", {}, tmp_path / "run")}, tmp_path / "run")
    (tmp_path / "out").mkdir()
    line = json.dumps(row("all", "twin", "11"))
    (tmp_path / "out" / "results.jsonl").write_text(line + "\n")
    words = ["--run", str(tmp_path / "run"), "--task", "box", "--out", str(tmp_path / "out")]
    monkeypatch.setattr("sys.argv", ["study_randomization.py", *words])

    with pytest.raises(SystemExit):
        study.main()

    assert "results of another study" in capsys.readouterr().err
    assert (tmp_path / "out" / "results.jsonl").read_text() == line + "\n"


def test_settings_that_are_none_are_refused(parts):
    with pytest.raises(ValueError, match="settings must name some of all, none, noise"):
        parts.randomization.RandomizationStudyConfig(settings=("gravity",))


def test_a_study_without_results_says_so(study, tmp_path, monkeypatch, capsys):
    monkeypatch.setattr("sys.argv", ["x", "--out", str(tmp_path), "--table"])

    with pytest.raises(SystemExit):
        study.main()

    assert "holds no results yet" in capsys.readouterr().err

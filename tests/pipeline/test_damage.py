"""What is damaged is named in one sentence, is neither used nor deleted, and stops nothing else."""

import json
import os
import shutil
import sys
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import pytest

from v2p_data.errors import UnusableError
from v2p_data.pipeline.artifact import (
    SCHEMA,
    demand_whole,
    read_record,
    write_record,
)
from v2p_data.pipeline.contents import MEMORY_FOLDER
from v2p_data.pipeline.runner import Runtime, Stage, make_stage, stored_outcome
from v2p_data.pipeline.workers import run_stages

sys.path.insert(0, str(Path(__file__).parent))
from damage import HARMS, JSON_HARMS, flip, harms_of_entries, set_entry
from sample_stages import Recipe, chain, make_text

ANEW = "delete that folder and run again: it is made anew"


@pytest.fixture
def stages() -> tuple[Stage, Stage]:
    two = chain(Recipe(text="a" * 200), Recipe(text="b"))
    return two.inputs["one"], two


@pytest.fixture
def root(tmp_path: Path, stages: tuple[Stage, Stage]) -> Path:
    """A run whose first stage is finished."""
    assert make_stage(stages[0], Runtime(root=tmp_path)).status == "made"
    return tmp_path


def status_of(stage: Stage, root: Path) -> str:
    outcome = stored_outcome(stage, root)
    assert outcome is not None
    return outcome.status


def damage_of(stage: Stage, root: Path) -> str:
    """Return the sentence with which a damaged result fails; it names the file and what to do."""
    outcome = stored_outcome(stage, root)
    assert outcome is not None
    assert (outcome.status, outcome.reason) == ("failed", "damaged")
    assert str(stage.folder(root)) in outcome.detail
    assert outcome.detail.endswith(ANEW)
    assert "\n" not in outcome.detail
    return outcome.detail


@pytest.mark.parametrize("harm", HARMS.values(), ids=HARMS)
def test_a_harmed_file_fails_its_result_and_stays_where_it_is(root, stages, harm):
    one, two = stages
    harm(one.folder(root) / "text")
    before = sorted(one.folder(root).iterdir())

    detail = damage_of(one, root)
    made = make_stage(two, Runtime(root=root))

    assert str(one.folder(root) / "text") in detail
    assert (made.status, made.reason, made.detail) == ("failed", "damaged", detail)
    assert sorted(one.folder(root).iterdir()) == before


@pytest.mark.parametrize("harm", (HARMS | JSON_HARMS).values(), ids=HARMS | JSON_HARMS)
def test_a_harmed_record_fails_its_result_and_nothing_is_lost(root, stages, harm):
    record = stages[0].folder(root) / "record.json"
    harm(record)

    detail = damage_of(stages[0], root)

    assert str(record) in detail
    assert (record.parent / "text").read_text() == "a" * 200


def test_every_entry_of_a_record_is_guarded(root, stages):
    record = stages[0].folder(root) / "record.json"
    whole = record.read_text()
    count = 0
    for name, harm in harms_of_entries(record):
        record.write_text(whole)
        harm(record)
        assert status_of(stages[0], root) == "failed", name
        count += 1
    assert count > 100


def test_records_of_the_version_before_are_read_and_their_files_are_not_asked_for(root, stages):
    folder = stages[0].folder(root)
    as_before(folder)
    flip(0.5)(folder / "text")

    assert status_of(stages[0], root) == "kept"
    record = read_record(folder)
    assert record is not None
    assert (record.schema, record.files) == (1, None)
    demand_whole(folder, root)


def test_a_record_of_the_version_before_with_an_entry_of_another_kind_is_damaged(root, stages):
    path = stages[0].folder(root) / "record.json"
    as_before(path.parent)
    whole = path.read_text()
    for key in json.loads(whole):
        path.write_text(whole)
        set_entry(key, ["x"])(path)
        with pytest.raises(UnusableError, match="damaged"):
            read_record(path.parent)


def test_a_record_of_a_newer_version_is_named_as_such(root, stages):
    set_entry("schema", SCHEMA + 1)(stages[0].folder(root) / "record.json")

    outcome = stored_outcome(stages[0], root)

    assert outcome is not None
    assert (outcome.status, outcome.reason) == ("failed", "newer_version")
    assert (
        f"newer version of v2p (schema {SCHEMA + 1}, this one reads up to {SCHEMA})"
        in outcome.detail
    )
    assert "delete" not in outcome.detail


def test_the_record_of_another_result_is_not_taken_for_this_ones(root, stages):
    other = replace(stages[0], config=Recipe(text="other"))
    make_stage(other, Runtime(root=root))
    shutil.copy(other.folder(root) / "record.json", stages[0].folder(root) / "record.json")

    detail = damage_of(stages[0], root)

    assert "is of another result" in detail


def test_an_empty_folder_is_filled_and_a_half_deleted_one_is_not_overwritten(tmp_path, stages):
    folder = stages[0].folder(tmp_path)
    folder.mkdir(parents=True)
    assert stored_outcome(stages[0], tmp_path) is None
    assert make_stage(stages[0], Runtime(root=tmp_path)).status == "made"

    (folder / "record.json").unlink()
    detail = damage_of(stages[0], tmp_path)

    assert "record.json is missing" in detail
    assert (folder / "text").is_file()


def test_files_that_were_added_later_are_no_damage(root, stages):
    folder = stages[0].folder(root)
    for name in ("README.md", "films/new.mp4", ".cache/x", "text.tmp", "notes.txt"):
        (folder / name).parent.mkdir(exist_ok=True)
        (folder / name).write_text("mine")

    assert status_of(stages[0], root) == "kept"


def make_with_card(config, inputs, out, runtime):
    (out / "README.md").write_text("as made")
    (out / "events.out.tfevents.1").write_text("log")
    (out / "weights").write_text("w")


def test_a_card_and_logs_may_change(tmp_path):
    stage = Stage(name="one", item="i", config={}, make=make_with_card)
    make_stage(stage, Runtime(root=tmp_path))
    (stage.folder(tmp_path) / "README.md").write_text("pushed under another name")
    (stage.folder(tmp_path) / "events.out.tfevents.1").unlink()

    assert status_of(stage, tmp_path) == "kept"
    record = read_record(stage.folder(tmp_path))
    assert record is not None
    assert set(record.files or {}) == {"weights"}


def test_bits_that_flip_behind_an_old_time_are_noticed(root, stages):
    path = stages[0].folder(root) / "text"
    stored_outcome(stages[0], root)
    times = path.stat()
    flip(0.5)(path)
    os.utime(path, ns=(times.st_atime_ns, times.st_mtime_ns))

    detail = damage_of(stages[0], root)

    assert "has another content" in detail


@pytest.mark.parametrize("harm", (HARMS | JSON_HARMS).values(), ids=HARMS | JSON_HARMS)
def test_a_damaged_memory_is_no_damage(root, stages, harm: Callable[[Path], None]):
    (memory,) = (root / MEMORY_FOLDER).glob("*/*.json")
    harm(memory)

    assert status_of(stages[0], root) == "kept"


def test_a_memory_of_another_content_hides_no_damage(root, stages):
    """As after a folder was replaced by one that was made under other circumstances."""
    folder = stages[0].folder(root)
    record = read_record(folder)
    assert record is not None
    assert record.files is not None
    mark = replace(record.files["text"], sha256="0" * 16)
    write_record(folder, replace(record, files={"text": mark}))

    detail = damage_of(stages[0], root)

    assert "has another content" in detail


def test_one_damaged_item_fails_and_the_others_go_on(tmp_path):
    bad, good = (chain(Recipe(), Recipe(), item=item) for item in ("bad", "good"))
    for stage in (bad.inputs["one"], good.inputs["one"]):
        make_stage(stage, Runtime(root=tmp_path))
    flip(0.5, count=1)(bad.inputs["one"].folder(tmp_path) / "text")

    outcomes = run_stages([bad, good], Runtime(root=tmp_path), lambda event: None)

    status = {(o.item, o.stage): o.status for o in outcomes.values()}
    assert status == {
        ("bad", "one"): "failed",
        ("bad", "two"): "blocked",
        ("good", "one"): "kept",
        ("good", "two"): "made",
    }


def test_a_damaged_result_that_was_deleted_is_made_anew(root, stages):
    folder = stages[0].folder(root)
    flip(0.5)(folder / "text")
    shutil.rmtree(folder)

    assert stored_outcome(stages[0], root) is None
    assert make_stage(stages[0], Runtime(root=root)).status == "made"
    assert status_of(stages[0], root) == "kept"


def test_the_traceback_of_an_earlier_try_does_not_stay(tmp_path):
    stage = Stage(name="one", item="i", config=Recipe(), make=make_text, resumes=True)
    partial = stage.folder(tmp_path).with_name(stage.folder_name + ".partial")
    partial.mkdir(parents=True)
    (partial / "traceback.txt").write_text("Traceback ...")

    make_stage(stage, Runtime(root=tmp_path))

    assert {p.name for p in stage.folder(tmp_path).iterdir()} == {"record.json", "text"}


def as_before(folder: Path) -> None:
    """Turn a record into one of the version before, which listed no files."""
    path = folder / "record.json"
    data = json.loads(path.read_text())
    del data["files"], data["checksum"]
    path.write_text(json.dumps(data | {"schema": 1}))

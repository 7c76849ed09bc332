import contextlib
import json
import os
import time

import pytest

from v2p_data.commands.gc import gc_command
from v2p_data.commands.progress import Progress, progress_of
from v2p_data.commands.status import MANY, status_command
from v2p_data.errors import ItemRejectedError, V2PError
from v2p_data.pipeline.artifact import write_json_atomically
from v2p_data.pipeline.at_work import Event
from v2p_data.pipeline.runner import Outcome, Runtime, Stage, in_order, make_stage
from v2p_data.pipeline.workers import only_run_in


def make_bytes(config, inputs, out, runtime):
    del inputs, runtime
    if config == "rejected":
        raise ItemRejectedError("too_dull", "it is too dull")
    (out / "bytes").write_bytes(bytes(1000))


def dataset(config: str, item: str = "clip") -> Stage:
    scene = Stage(name="scene", item=item, config=config, make=make_bytes)
    return Stage(name="dataset", item="all", config="", inputs={item: scene}, make=make_bytes)


@pytest.fixture
def run(tmp_path):
    """Return a run with a dataset, a scene that an older setting made, a rejected one, and work that was killed."""
    rejected = Stage(name="scene", item="bad", config="rejected", make=make_bytes)
    old = dataset("old").inputs["clip"]
    for stage in (*in_order([dataset("new")]), old, rejected):
        make_stage(stage, Runtime(root=tmp_path))
    (tmp_path / "scene" / "half-00000000.partial").mkdir()
    return tmp_path


def folders(run):
    return {path.name for path in run.glob("*/*") if path.parent.name[0] != "."}


def test_gc_lists_what_no_dataset_came_from_and_deletes_it_when_told(run, capsys):
    before, old = folders(run), dataset("old").inputs["clip"].folder_name

    assert gc_command([str(run)]) == 0
    listed = capsys.readouterr().out
    assert folders(run) == before
    assert "Could delete 2 folders" in listed
    assert f"scene/{old}  (nothing came of it)" in listed
    assert "scene/half-00000000.partial  (unfinished)" in listed

    assert gc_command([str(run), "--delete"]) == 0
    assert before - folders(run) == {old, "half-00000000.partial"}
    assert not any((run / ".fetching").iterdir())


@pytest.mark.parametrize(
    ("how", "where"),
    [
        ("link", "scene/linked-00000000.partial"),
        ("link", "scene/linked-00000000"),
        ("link", "task"),
        ("link", ".workers"),
        ("link", ".fetching"),
        ("link", ".fetching/linked-00000000"),
        ("link", "scene/OLD/linked"),
        ("file", "dataset/notes.partial"),
        ("file", "dataset/notes-00000000.partial"),
        ("file", "scene/OLD/notes.partial"),
        ("file", "scene/OLD/deep/notes.log"),
        ("file", "scene/OLD/README.md"),
        ("file", "scene/notes.partial/text"),
        ("file", ".fetching/mine/text"),
        ("file", ".fetching"),
        ("file", "mine-00000000.partial/text"),
        ("rename", "scene/mine-00000000"),
        ("rename", "scene/mine-00000000.partial"),
        ("rename", "task/OLD"),
        ("outside", "scene"),
    ],
)
def test_gc_deletes_only_what_stages_made_and_follows_no_link(run, tmp_path_factory, how, where):
    outside = tmp_path_factory.mktemp("outside")
    (outside / "uv.lock").write_text("mine")
    old = dataset("old").inputs["clip"].folder(run)
    mine = run / where.replace("OLD", old.name)
    mine.parent.mkdir(parents=True, exist_ok=True)
    if how == "link":
        mine.symlink_to(outside)
    elif how == "file":
        mine.write_text("mine")
    elif how == "rename":
        old.rename(mine)
    else:
        (run / "scene").rename(outside / "scene")
        mine.symlink_to(outside / "scene")
    before = {path: path.read_bytes() for path in outside.rglob("*") if path.is_file()}

    with contextlib.suppress(V2PError):
        gc_command([str(run), "--delete"])

    assert {path: path.read_bytes() for path in before} == before
    assert mine.is_symlink() if how in ("link", "outside") else mine.exists()


@pytest.mark.parametrize("edit", ["longer", "same size and time", "link to a copy"])
def test_gc_keeps_a_result_in_which_somebody_edited_a_file(run, tmp_path_factory, edit):
    file = dataset("old").inputs["clip"].folder(run) / "bytes"
    when = file.stat()
    if edit == "link to a copy":
        copy = file.rename(tmp_path_factory.mktemp("outside") / "copy")
        file.symlink_to(copy)
    else:
        file.write_bytes(b"1" * (1001 if edit == "longer" else 1000))
        os.utime(file, ns=(when.st_atime_ns, when.st_mtime_ns))
    before = file.read_bytes()

    gc_command([str(run), "--delete"])

    assert file.read_bytes() == before


def test_a_link_inside_unfinished_work_goes_and_what_it_leads_to_stays(run, tmp_path_factory):
    outside = tmp_path_factory.mktemp("outside")
    (outside / "text").write_text("mine")
    (run / "scene/half-00000000.partial/linked").symlink_to(outside)

    gc_command([str(run), "--delete"])

    assert not (run / "scene/half-00000000.partial").exists()
    assert (outside / "text").read_text() == "mine"


def test_gc_keeps_what_the_last_command_asked_for(run, capsys):
    old = dataset("old").inputs["clip"]
    write_json_atomically(run / "run.json", [{"stage": "scene", "folder": old.folder_name}])

    gc_command([str(run)])

    assert old.folder_name not in capsys.readouterr().out


def test_gc_takes_no_finished_result_before_there_is_a_dataset(run, capsys):
    (made,) = (run / "dataset").iterdir()
    made.rename(run / "elsewhere")

    gc_command([str(run)])

    assert "Could delete 1 folders" in capsys.readouterr().out


def test_gc_waits_for_no_run_and_touches_no_store(run):
    with only_run_in(run), pytest.raises(V2PError, match="another v2p run is at work"):
        gc_command([str(run), "--delete"])
    (run / "store.json").touch()
    with pytest.raises(V2PError, match="is a store"):
        gc_command([str(run), "--delete"])


def test_status_tells_machines_how_far_a_run_is(tmp_path, capsys, monkeypatch):
    stages = [dataset("", item) for item in "abc"]
    scenes = [stage.inputs[stage_item] for stage, stage_item in zip(stages, "abc", strict=True)]
    shown = []
    progress = Progress(Runtime(root=tmp_path, workers=2), scenes, shown.append)
    now = time.time()
    monkeypatch.setattr(time, "time", lambda: now + 36.0)  # a hundredth of an hour later

    def ended(stage, status, seconds):
        outcome = Outcome(
            stage="scene", item=stage.item, status=status, folder=tmp_path, seconds=seconds
        )
        progress(Event(kind="ended", stage=stage, outcome=outcome))

    for scene in scenes[:2]:
        progress(Event(kind="started", stage=scene))
    ended(scenes[0], "made", 5.0)
    progress.write()
    (tmp_path / "scene").mkdir()

    with only_run_in(tmp_path):
        scene = progress_of(tmp_path)["stages"]["scene"]
    assert (scene["planned"], scene["made"], scene["left"], scene["running"]) == (3, 1, 2, ["b"])
    assert scene["made_per_hour"] == pytest.approx(100.0, rel=0.01)
    assert scene["seconds_left"] == 2 * 5.0 / 2  # two items, five seconds each, two workers
    assert len(shown) == 3
    failure = {
        "stage": "scene",
        "item": "c",
        "status": "failed",
        "reason": "error",
        "detail": "boom",
    }
    write_json_atomically(tmp_path / "run.json", [failure])
    assert status_command([str(tmp_path), "--json"]) == 0
    said = json.loads(capsys.readouterr().out)
    assert (said["at_work"], said["stages"]["scene"]["running"]) == (False, [])
    assert said["failures"] == [
        {"stage": "scene", "item": "c", "state": "failed", "why": "error: boom"}
    ]


def test_status_names_a_folder_without_counts(tmp_path):
    (tmp_path / "scene").mkdir()

    with pytest.raises(V2PError, match=r"progress\.json cannot be read"):
        status_command([str(tmp_path), "--json"])


def test_status_tells_kinds_of_results_where_they_are_many(tmp_path, capsys):
    configs = ["good"] * MANY + ["rejected"] * 2
    for k, config in enumerate(configs):
        scene = Stage(name="scene", item=f"clip_{k}", config=config, make=make_bytes)
        make_stage(scene, Runtime(root=tmp_path))

    assert status_command([str(tmp_path)]) == 0
    first, *more = capsys.readouterr().out.splitlines()
    assert first.split() == ["scene", f"{MANY}", "items", "made"]
    assert [line.split()[1] for line in more[:2]] == [f"clip_{MANY}", f"clip_{MANY + 1}"]
    assert more[-2].startswith(f"{MANY + 2} results in")

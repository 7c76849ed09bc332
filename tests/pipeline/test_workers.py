import multiprocessing
import resource
import subprocess
import sys
import textwrap
import time
from pathlib import Path

import pytest

from v2p_data.errors import V2PError
from v2p_data.pipeline.artifact import read_record
from v2p_data.pipeline.runner import Runtime, Stage
from v2p_data.pipeline.workers import only_run_in, run_stages

sys.path.insert(0, str(Path(__file__).parent))
from sample_stages import Recipe, chain, make_by_stages, make_noted, make_text


def statuses(stages, root: Path, workers: int = 1) -> list[str]:
    runtime = Runtime(root=root, workers=workers)
    return [o.status for o in run_stages(stages, runtime, lambda event: None).values()]


def test_a_changed_recipe_remakes_it_and_everything_after_it_only(tmp_path):
    statuses([chain(Recipe(), Recipe())], tmp_path)

    assert statuses([chain(Recipe(), Recipe(text="b"))], tmp_path) == ["kept", "made"]
    assert len(list((tmp_path / "two").iterdir())) == 2


def test_a_stage_sees_what_its_inputs_made(tmp_path):
    stage = chain(Recipe(text="a"), Recipe(text="b"))
    statuses([stage], tmp_path)

    assert (stage.folder(tmp_path) / "text").read_text() == "ab"
    record = read_record(stage.folder(tmp_path))
    assert record is not None
    assert record.counts == {"letters": 2}


@pytest.mark.parametrize("trouble", ["reject", "raise", "crash"])
def test_one_bad_item_blocks_only_what_needs_it(tmp_path, trouble):
    bad = chain(Recipe(trouble=trouble), Recipe(), item="bad")
    good = chain(Recipe(), Recipe(), item="good")

    outcomes = run_stages([bad, good], Runtime(root=tmp_path, workers=2), lambda event: None)
    by_item = {(o.item, o.stage): o for o in outcomes.values()}

    assert by_item["good", "two"].status == "made"
    assert by_item["bad", "one"].status == ("rejected" if trouble == "reject" else "failed")
    assert by_item["bad", "two"].status == "blocked"


def test_a_stage_may_run_stages_of_its_own(tmp_path):
    stage = Stage(name="outer", item="clip", config=None, make=make_by_stages)

    assert statuses([stage], tmp_path) == ["made"]

    record = read_record(stage.folder(tmp_path))
    assert record is not None
    assert record.counts == {
        "one clip": "made",
        "two clip": "made",
        "one bad": "crashed",
        "two bad": "crashed",
    }


def test_a_worker_that_is_killed_between_two_stages_costs_nothing(tmp_path):
    def kill(event):
        for worker in multiprocessing.active_children() if event.kind == "ended" else ():
            worker.kill()
            worker.join()

    outcomes = run_stages([chain(Recipe(), Recipe())], Runtime(root=tmp_path), kill)

    assert [o.status for o in outcomes.values()] == ["made", "made"]


def test_a_stage_that_hangs_is_ended_after_its_time_and_says_where_it_was(tmp_path):
    hangs = Stage(name="one", item="hangs", config=Recipe(waits=True), make=make_noted)
    good = chain(Recipe(), Recipe(), item="good")

    outcomes = run_stages([hangs, good], Runtime(root=tmp_path, limit_s=1.0), lambda event: None)

    hung, *rest = outcomes.values()
    assert (hung.status, hung.reason) == ("failed", "too_long")
    assert "longer than --limit-s=1 s" in hung.detail
    assert {o.status for o in rest} == {"made"}
    assert "in make_noted" in (tmp_path / "logs" / "worker-0.log").read_text()


def test_a_place_that_takes_nothing_more_is_named_by_workers_too(tmp_path):
    said = {
        "big": "a file may not grow that large here",
        "full": "no space is left on the disk",
        "deleted": "was deleted while it was being filled",
        "raise": "boom",  # whose traceback cannot be written either
    }
    stages = [
        Stage(name="one", item=trouble, config=Recipe(trouble=trouble), make=make_text)
        for trouble in said
    ]
    (tmp_path / "logs").mkdir()
    soft, hard = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (100, hard))
    try:
        outcomes = run_stages(stages, Runtime(root=tmp_path), lambda event: None)
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, (soft, hard))

    for outcome in outcomes.values():
        assert outcome.status == "failed"
        assert said[outcome.item] in outcome.detail
        assert str(tmp_path) in outcome.detail or outcome.item == "raise"


def test_a_rejection_is_remembered_and_a_failure_is_tried_again(tmp_path):
    rejected = Stage(name="one", item="r", config=Recipe(trouble="reject"), make=make_text)
    failed = Stage(name="one", item="f", config=Recipe(trouble="raise"), make=make_text)
    statuses([rejected, failed], tmp_path)
    seen = []

    run_stages(
        [rejected, failed], Runtime(root=tmp_path), lambda e: seen.append((e.kind, e.stage.item))
    )

    assert ("started", "r") not in seen
    assert ("started", "f") in seen


def test_half_finished_work_is_not_taken_for_complete(tmp_path):
    stage = chain(Recipe(), Recipe()).inputs["one"]
    partial = stage.folder(tmp_path).with_name(stage.folder_name + ".partial")
    partial.mkdir(parents=True)
    (partial / "text").write_text("half")

    assert statuses([stage], tmp_path) == ["made"]
    assert (stage.folder(tmp_path) / "text").read_text() == "a"
    assert not partial.exists()


def test_a_folder_that_cannot_be_written_is_named(tmp_path):
    (tmp_path / "file").write_text("")
    with pytest.raises(V2PError, match="cannot write to"), only_run_in(tmp_path / "file" / "run"):
        pass


def test_a_second_run_in_the_same_folder_is_refused(tmp_path):
    with (
        only_run_in(tmp_path),
        pytest.raises(V2PError, match="another v2p run"),
        only_run_in(tmp_path),
    ):
        pass


def test_workers_end_when_their_parent_is_killed(tmp_path):
    script = tmp_path / "parent.py"
    script.write_text(
        textwrap.dedent("""
        import os, sys, time
        from pathlib import Path
        from v2p_data.pipeline.runner import Runtime, Stage
        from v2p_data.pipeline.workers import run_stages
        def sleep(config, inputs, out, runtime):
            (Path(config) / "pid").write_text(str(os.getpid()))
            time.sleep(60)
        if __name__ == "__main__":
            root = Path(sys.argv[1])
            run_stages([Stage(name="s", item="i", config=str(root), make=sleep)], Runtime(root=root), print)
        """)
    )
    parent = subprocess.Popen([sys.executable, script, tmp_path], stdout=subprocess.DEVNULL)
    pid_file = tmp_path / "pid"
    deadline = time.monotonic() + 60
    while not (pid_file.exists() and pid_file.read_text()):
        assert time.monotonic() < deadline
        time.sleep(0.05)
    worker = int(pid_file.read_text())

    parent.kill()
    parent.wait()

    while (
        Path(f"/proc/{worker}").exists()
        and "Z" not in Path(f"/proc/{worker}/stat").read_text().split()[2]
    ):
        assert time.monotonic() < deadline
        time.sleep(0.1)

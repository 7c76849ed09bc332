import json
import os
import resource
import shutil
import subprocess
import sys
import threading
import time
from pathlib import Path

import pytest

from v2p_data.errors import V2PError
from v2p_data.pipeline import store as store_module
from v2p_data.pipeline.leases import Shared
from v2p_data.pipeline.runner import Outcome, Runtime, in_order, make_stage
from v2p_data.pipeline.store import open_store
from v2p_data.pipeline.workers import run_stages

sys.path.insert(0, str(Path(__file__).parent))
from sample_driver import ITEMS, marked

DRIVER = Path(__file__).parent / "sample_driver.py"


@pytest.fixture(autouse=True)
def _no_open_store():
    open_store.cache_clear()


@pytest.fixture
def folder(tmp_path):
    return tmp_path / "store"


def run(stages, root, store):
    runtime = Runtime(root=root, store=str(store))
    return {(o.stage, o.item): o for o in run_stages(stages, runtime, lambda event: None).values()}


def publish(stages, root, url):
    """Make stages in this process, which publishes them too."""
    open_store(url).begin()
    runtime = Runtime(root=root, store=url)
    assert {make_stage(s, runtime).status for s in in_order(stages)} == {"made"}


def files(root: Path) -> dict[str, bytes]:
    """Return a run's results, byte by byte."""
    return {
        path.relative_to(root).as_posix(): path.read_bytes()
        for stage in ("one", "two")
        for path in (root / stage).rglob("*")
        if path.is_file()
    }


def drivers(tmp_path, url, seconds, lease_s, names):
    words = [url, tmp_path / "marks", str(seconds), str(lease_s)]
    return [
        subprocess.Popen(
            [sys.executable, DRIVER, tmp_path / name, *words], stdout=subprocess.PIPE, text=True
        )
        for name in names
    ]


def test_what_one_driver_made_is_fetched_by_the_next(tmp_path, folder):
    url, where = str(folder), folder
    stages = [marked("a", tmp_path / "marks"), marked("b", tmp_path / "marks")]

    publish(stages, tmp_path / "first", url)

    second = run(stages, tmp_path / "second", url)

    assert {o.status for o in second.values()} == {"kept"}
    assert len((tmp_path / "marks").read_text().splitlines()) == 4
    assert files(tmp_path / "first") == files(tmp_path / "second") == files(where)


@pytest.mark.slow
def test_two_drivers_at_once_make_each_item_once(tmp_path, folder):
    url, where = str(folder), folder
    both = drivers(tmp_path, url, 0.3, 60, ("first", "second"))

    said = [json.loads(driver.communicate(timeout=120)[0]) for driver in both]

    made = [name for statuses in said for name, status in statuses.items() if status == "made"]
    assert sorted(made) == sorted((tmp_path / "marks").read_text().splitlines())
    assert sorted(made) == [f"{stage} {item}" for stage in ("one", "two") for item in ITEMS]
    assert {status for statuses in said for status in statuses.values()} == {"made", "kept"}
    assert files(tmp_path / "first") == files(tmp_path / "second") == files(where)
    assert list((where / "leases").rglob("*.*")) == list((where / "drivers").glob("*")) == []


@pytest.mark.slow
def test_the_lease_of_a_killed_driver_ends(tmp_path, folder):
    (killed,) = drivers(tmp_path, str(folder), 30, 2.0, ("killed",))
    marks = tmp_path / "marks"
    while not marks.exists():
        time.sleep(0.05)
    killed.kill()
    killed.wait()
    (lease,) = (folder / "leases" / "one").iterdir()
    other = Shared(Runtime(root=tmp_path / "other", store=str(folder), lease_s=2.0))
    stage = marked("a", marks, 30.0).inputs["one"]

    with other:
        began = time.monotonic()
        assert other.claim(stage) is None
        while other.claim(stage) is None:
            time.sleep(0.05)
        waited = time.monotonic() - began
        with Shared(Runtime(root=tmp_path / "third", store=str(folder), lease_s=2.0)) as third:
            assert third.claim(stage) is None
        held = sorted(path.name for path in lease.parent.iterdir())

    assert 2.0 < waited < 10.0
    assert held == [f"{stage.folder_name}.1", f"{stage.folder_name}.2"]


def test_a_killed_driver_that_is_started_again_waits_for_nobody(tmp_path, folder):
    stage = marked("a", tmp_path / "marks").inputs["one"]
    runtime = Runtime(root=tmp_path / "run", store=str(folder), lease_s=1000.0)
    killed, again, other = (
        Shared(runtime),
        Shared(runtime),
        Shared(Runtime(root=tmp_path / "other", store=str(folder))),
    )
    with killed, again, other:
        assert killed.claim(stage) == "ours"
        killed.held.clear()  # it never gives it back

        assert other.claim(stage) is None
        assert again.claim(stage) == "ours"


def test_a_copied_run_folder_is_another_driver(tmp_path, folder):
    stage = marked("a", tmp_path / "marks").inputs["one"]
    first = Shared(Runtime(root=tmp_path / "run", store=str(folder)))
    with first:
        assert first.claim(stage) == "ours"
        shutil.copytree(tmp_path / "run", tmp_path / "copy")

        with Shared(Runtime(root=tmp_path / "copy", store=str(folder))) as copied:
            assert copied.claim(stage) is None


@pytest.mark.parametrize(
    ("spoil", "words"),
    [
        (lambda lease: lease.write_bytes(b"\xff\xfe"), "names no driver"),
        (lambda lease: lease.write_bytes(b""), "names no driver"),
        (lambda lease: lease.write_text("../../etc/pass"), "names no driver"),
        (lambda lease: lease.mkdir(), "is no file"),
        (os.mkfifo, "is no file"),
    ],
)
def test_a_lease_that_no_driver_wrote_is_named(tmp_path, folder, spoil, words):
    stage = marked("a", tmp_path / "marks").inputs["one"]
    lease = folder / "leases" / "one" / f"{stage.folder_name}.1"
    lease.parent.mkdir(parents=True)
    spoil(lease)

    with (
        Shared(Runtime(root=tmp_path / "run", store=str(folder))) as driver,
        pytest.raises(V2PError, match=words) as error,
    ):
        driver.claim(stage)

    assert str(lease) in str(error.value)


def test_a_full_store_is_named_and_what_was_made_is_published_when_there_is_room(tmp_path, folder):
    stage, root = marked("a" * 200, tmp_path / "marks").inputs["one"], tmp_path / "run"
    make_stage(stage, Runtime(root=root))
    runtime = Runtime(root=root, store=str(folder))
    open_store(str(folder)).begin()
    soft, hard = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (100, hard))
    try:
        full = make_stage(stage, runtime)
        resource.setrlimit(resource.RLIMIT_FSIZE, (0, hard))
        with pytest.raises(V2PError, match=f"cannot write to the store {folder}"):
            Shared(runtime).__enter__()
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, (soft, hard))

    assert (full.status, full.reason) == ("failed", "error")
    assert f"cannot write to the store {folder}: a file may not grow" in full.detail
    assert make_stage(stage, runtime).status == "kept"
    assert (folder / "one" / stage.folder_name / "text").is_file()


def test_what_ends_with_nothing_made_may_be_tried_by_whoever_asks_next(tmp_path, folder):
    stage = marked("a", tmp_path / "marks").inputs["one"]
    first, second, third = (
        Shared(Runtime(root=tmp_path / name, store=str(folder))) for name in ("1", "2", "3")
    )
    with first, second, third:
        assert first.claim(stage) == "ours"
        first.ended(stage)

        assert second.claim(stage) == "ours"
        assert third.claim(stage) is None


def test_a_driver_that_asks_too_late_gets_what_was_made(tmp_path, folder):
    stage = marked("a", tmp_path / "marks").inputs["one"]
    late = Shared(Runtime(root=tmp_path / "late", store=str(folder)))
    with late:
        assert late.stored(stage) is None
        publish([stage], tmp_path / "first", str(folder))

        theirs = late.claim(stage)

    assert isinstance(theirs, Outcome)
    assert theirs.status == "kept"
    assert list((folder / "leases").rglob("*.*")) == []


@pytest.mark.slow
def test_a_file_that_changed_in_the_store_is_named_and_not_used(tmp_path, folder):
    url = str(folder)
    stages = [marked("a", tmp_path / "marks"), marked("b", tmp_path / "marks")]
    publish([s.inputs["one"] for s in stages], tmp_path / "first", url)
    bad = folder / "one" / stages[0].inputs["one"].folder_name / "text"
    content = bytearray(bad.read_bytes())
    content[0] ^= 1
    bad.write_bytes(content)

    outcomes = run(stages, tmp_path / "second", url)

    assert outcomes["two", "b"].status == "made"
    assert outcomes["one", "a"].status == outcomes["two", "a"].status == "failed"
    named = f"{url}/one/{stages[0].inputs['one'].folder_name}"
    for failed in (outcomes["one", "a"], outcomes["two", "a"]):
        assert failed.reason == "damaged"
        assert f"{named}/text has another content" in failed.detail
    assert not stages[0].inputs["one"].folder(tmp_path / "second").exists()
    assert not any((tmp_path / "second" / ".fetching").iterdir())


def test_a_record_that_changed_in_the_store_is_named_too(tmp_path, folder):
    stage = marked("a", tmp_path / "marks").inputs["one"]
    publish([stage], tmp_path / "first", str(folder))
    record = stage.folder(folder) / "record.json"
    record.write_text(record.read_text().replace("letters", "lettres"))

    failed = run([stage], tmp_path / "second", folder)["one", "a"]

    assert failed.reason == "damaged"
    assert f"{record} has another content" in failed.detail


def test_what_was_published_by_half_does_not_count(tmp_path, folder):
    url, where = str(folder), folder
    stage = marked("a", tmp_path / "marks").inputs["one"]
    publish([stage], tmp_path / "first", url)
    record = where / "one" / stage.folder_name / "record.json"
    record.unlink()
    (record.parent / "text").write_text("half")

    publish([stage], tmp_path / "second", url)
    assert run([stage], tmp_path / "third", url)["one", "a"].status == "kept"
    assert (stage.folder(tmp_path / "third") / "text").read_text() == "one a"


def test_who_publishes_second_changes_nothing(tmp_path, folder):
    url, where = str(folder), folder
    stage = marked("a", tmp_path / "marks").inputs["one"]
    alone = Runtime(root=tmp_path / "alone")
    publish([stage], tmp_path / "first", url)
    make_stage(stage, alone)
    (stage.folder(alone.root) / "deep" / "README.md").write_text("another card")
    before = files(where)

    open_store(url).publish(stage.folder(alone.root))

    assert files(where) == before


def test_a_stage_fetches_what_it_comes_from_and_no_more(tmp_path, folder):
    stages = [marked("a", tmp_path / "marks"), marked("b", tmp_path / "marks")]
    publish([s.inputs["one"] for s in stages], tmp_path / "first", str(folder))

    made = make_stage(stages[0], Runtime(root=tmp_path / "second", store=str(folder)))

    assert made.status == "made"
    assert [p.name for p in (tmp_path / "second" / "one").iterdir()] == [
        stages[0].inputs["one"].folder_name
    ]


def test_a_store_that_comes_back_is_waited_for(tmp_path, folder, caplog):
    stage = marked("a", tmp_path / "marks").inputs["one"]
    runtime = Runtime(root=tmp_path / "run", store=str(folder))
    open_store(str(folder)).begin()
    away = folder.rename(tmp_path / "away")
    threading.Timer(0.8, lambda: away.rename(folder)).start()

    assert make_stage(stage, runtime).status == "made"
    assert "does not answer" in caplog.text
    assert (stage.folder(folder) / "record.json").exists()


def test_what_went_below_the_place_of_a_disk_that_had_gone_is_written_again(tmp_path, folder):
    store, away, tries = open_store(str(folder)), tmp_path / "away", []
    store.begin()

    def back():
        shutil.rmtree(folder)
        away.rename(folder)

    def write():
        tries.append("")
        if len(tries) == 1:  # gone after we looked
            folder.rename(away)
            folder.mkdir()
            threading.Timer(0.2, back).start()
        (folder / "text").write_text("a")

    store._tried(write)

    assert len(tries) == 2
    assert (folder / "text").exists()


def test_what_was_made_while_the_store_was_away_is_published_by_the_next_run(
    tmp_path, folder, monkeypatch
):
    stage = marked("a", tmp_path / "marks").inputs["one"]
    runtime = Runtime(root=tmp_path / "run", store=str(folder))
    open_store(str(folder)).begin()
    away = folder.rename(tmp_path / "away")
    monkeypatch.setattr(store_module, "PATIENCE_S", 0.0)

    failed = make_stage(stage, runtime)
    assert failed.status == "failed"
    assert f"{folder} does not answer" in failed.detail
    assert not folder.exists()
    with pytest.raises(V2PError, match="does not answer"):
        open_store(str(folder)).read("x")
    away.rename(folder)

    with Shared(runtime) as shared:
        assert shared.stored(stage) is None
        assert make_stage(stage, runtime).status == "kept"
        stored = shared.stored(stage)
        assert stored is not None
        assert stored.status == "kept"
    assert files(folder) == files(runtime.root)
    assert (tmp_path / "marks").read_text() == "one a\n"


@pytest.mark.parametrize("place", ["s3://bucket/run", "file"])
def test_a_place_that_is_no_store_is_named(place, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    Path("file").touch()

    with pytest.raises(V2PError, match=place):
        open_store(place).begin()

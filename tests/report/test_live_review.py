"""A clip marked over HTTP and in a browser: saved at once, rebuilt, and the same as `v2p scene` makes of it."""

import json
import threading
import time
from contextlib import closing, contextmanager
from fractions import Fraction
from pathlib import Path

import av
import pytest
from browser import CHROMIUM, Browser

from v2p_data.commands.live_review import REVIEW_FILE, LiveReview
from v2p_data.commands.review import summary_of
from v2p_data.errors import V2PError
from v2p_data.pipeline.runner import Runtime, make_stage, stored_outcome
from v2p_data.report.reading import read_run
from v2p_data.report.review_server import ReviewServer
from v2p_data.stages import EngineConfig, scene_stage
from v2p_data.video.captions import find_videos
from v2p_data.video.decode import VideoConfig, read_clip

SAMPLES = Path(__file__).parents[2] / "datasets" / "sample_videos"
NAME, ITEM = "push_blue_box_left.mp4", "push_blue_box_left"
PHRASE = "blue box"
PATIENCE_S = 600.0
"""On a machine that does much else."""


def folder_of(home):
    """Return a folder with one small clip of thirty frames."""
    home.mkdir()
    clip = read_clip(find_videos(SAMPLES / NAME)[0], VideoConfig(max_side_px=320, max_frames=30))
    with av.open(str(home / NAME), "w") as out:
        stream = out.add_stream("libx264", rate=Fraction(10), options={"crf": "12"})
        stream.height, stream.width = clip.frames.shape[1:3]
        stream.pix_fmt = "yuv420p"
        for pixels in clip.frames:
            out.mux(stream.encode(av.VideoFrame.from_ndarray(pixels, format="rgb24")))
        out.mux(stream.encode(None))
    said = {"caption": "Pushing blue box from right to left", "objects": [PHRASE]}
    (home / "captions.json").write_text(json.dumps({NAME: said}))
    return home


@contextmanager
def session_of(home):
    with closing(LiveReview(home / "run", home / "videos")) as session:
        yield session


def result_of(session):
    """Return the clip once nothing is being done for it."""
    end = time.monotonic() + PATIENCE_S
    while (shown := session.clip(ITEM))["state"]:
        assert time.monotonic() < end, shown["state"]
        time.sleep(0.05)
    return shown


def middle_of(session):
    """Return the middle of the box in the first frame, from the masks that were found without a hint."""
    from v2p_data.scene.scene import Scene

    shown = result_of(session)
    scene = Scene.load(session.film(ITEM).parent)
    mask = scene.masks(scene.objects[0].name)[0]
    y, x = mask.nonzero()
    to_file = shown["size_px"][0] / mask.shape[1]
    return [float(x.mean() * to_file), float(y.mean() * to_file)]


@pytest.fixture(scope="module")
def home(tmp_path_factory):
    home = tmp_path_factory.mktemp("live")
    folder_of(home / "videos")
    (home / "run").mkdir()
    return home


@pytest.fixture(scope="module")
def click(home):
    with session_of(home) as session:
        return middle_of(session)


def test_a_click_is_saved_and_its_result_is_what_the_command_keeps(home, click):
    with session_of(home) as session:
        result_of(session)
        session.mark(ITEM, PHRASE, {"frame": 0, "click": click})
        saved = find_videos(home / "videos")[0].hints
        shown = result_of(session)

    stage = scene_stage(find_videos(home / "videos")[0], EngineConfig())
    assert saved == {PHRASE: {"frame": 0, "click": click}}
    assert shown["status"] == "accepted"
    assert len(shown["outlines"][PHRASE][0]) > 8
    stored, read = stored_outcome(stage, home / "run"), read_run(home / "run").get("scene", ITEM)
    assert stored is not None
    assert stored.status == "kept"
    assert read is not None
    assert read.folder == stage.folder(home / "run")


def test_a_scene_from_the_page_is_the_one_that_the_command_makes(home, click, tmp_path):
    stage = scene_stage(find_videos(home / "videos")[0], EngineConfig())

    outcome = make_stage(stage, Runtime(root=tmp_path))

    for name in ("scene.json", "scene.xml", f"masks/{PHRASE.replace(' ', '_')}.npz"):
        here, there = (folder / name for folder in (outcome.folder, stage.folder(home / "run")))
        assert here.read_bytes() == there.read_bytes()


def test_a_click_beside_the_object_is_refused_and_changes_nothing(home, click):
    before = (home / "videos" / "captions.json").read_bytes()
    with session_of(home) as session:
        result_of(session)
        session._ask(session._desks[ITEM]).result(PATIENCE_S)
        with pytest.raises(V2PError, match="stands out there from the table"):
            session.mark(ITEM, PHRASE, {"frame": 0, "click": [click[0], click[1] + 55]})
        with pytest.raises(V2PError, match="lies outside of the picture"):
            session.mark(ITEM, PHRASE, {"frame": 0, "click": [9999, 3]})
        with pytest.raises(V2PError, match="none of the objects"):
            session.mark(ITEM, "pot", {"frame": 0, "click": click})

    assert (home / "videos" / "captions.json").read_bytes() == before


@pytest.mark.long
def test_what_somebody_writes_into_the_captions_meanwhile_stays(home, click):
    path = home / "videos" / "captions.json"
    with session_of(home) as session:
        result_of(session)
        said = json.loads(path.read_text())
        said[NAME]["hints"]["table"] = {"frame": 0, "click": [5, 5]}
        path.write_text(json.dumps(said))
        session.mark(ITEM, PHRASE, None)
        session.mark(ITEM, PHRASE, {"frame": 0, "click": click})
        result_of(session)

    hints = json.loads(path.read_text())[NAME]["hints"]
    assert set(hints) == {"table", PHRASE}
    assert list(path.parent.glob("*.bak"))
    assert not list(path.parent.glob(".captions*.tmp"))


def test_judgements_outlive_the_server_and_the_summary_reads_them(home):
    with session_of(home) as session:
        result_of(session)
        session.judge(ITEM, "right")
        with pytest.raises(V2PError, match="a judgement is one of"):
            session.judge(ITEM, "splendid")
    with session_of(home) as session:
        shown = result_of(session)

    assert shown["judgement"] == "right"
    assert "1 accepted: right 100.0 %" in summary_of(home / "run" / REVIEW_FILE)


@pytest.mark.skipif(CHROMIUM is None, reason="this machine has no Chromium to click in")
def test_a_person_goes_through_the_folder_with_clicks_and_keys(home, click, tmp_path):
    threads_of_other_tests = threading.active_count()
    with (
        session_of(home) as session,
        ReviewServer(session, "a run") as server,
        Browser(tmp_path / "profile") as browser,
    ):
        session.mark(ITEM, PHRASE, None)
        browser.open(server.address)
        browser.wait_for("state.clip && state.clip.size_px && !state.clip.state", PATIENCE_S)
        browser.wait_for("state.image && state.image.naturalWidth > 0")
        assert browser.value("state.phrase") == PHRASE
        spot = browser.value(
            f"(() => {{ const f = fit(); return [f.frame.left + f.left + {click[0]} * f.scale, "
            f"f.frame.top + f.top + {click[1]} * f.scale]; }})()"
        )
        browser.drag(spot)
        browser.wait_for(
            "state.clip.hints['blue box'] && !document.body.dataset.sending", PATIENCE_S
        )
        browser.wait_for("!state.clip.state && state.clip.status === 'accepted'", PATIENCE_S)
        browser.wait_for("document.getElementById('film').readyState >= 2")
        browser.press("a")
        browser.wait_for("state.clip.judgement === 'right'")
        said = find_videos(home / "videos")[0].hints[PHRASE]
        assert said.get("click") == pytest.approx(click, abs=1.5)
        browser.press("b")
        browser.drag(spot, (spot[0] + 60, spot[1] + 40))
        browser.wait_for("state.clip.hints['blue box'].box", PATIENCE_S)
        browser.press("u")
        browser.wait_for("!state.clip.hints['blue box']", PATIENCE_S)
    assert PHRASE not in find_videos(home / "videos")[0].hints
    assert threading.active_count() - threads_of_other_tests < 25

"""A clip marked over HTTP and in a browser: saved at once, rebuilt, and the same as `v2p scene` makes of it."""

import base64
import hashlib
import html
import json
import re
import threading
import time
from contextlib import closing, contextmanager
from pathlib import Path

import numpy as np
import pytest
from browser import CHROMIUM, Browser

from v2p_data.cli import run as run_command
from v2p_data.commands.review import scene_stages, summary_of
from v2p_data.errors import V2PError
from v2p_data.pipeline.fingerprint import file_digest
from v2p_data.pipeline.runner import Runtime, make_stage, stored_outcome
from v2p_data.report.media import write_film
from v2p_data.report.reading import read_run
from v2p_data.report.review import PAGE_FILE, REVIEW_FILE, Review, judgements
from v2p_data.report.review_server import ReviewServer
from v2p_data.stages import EngineConfig, scene_stage
from v2p_data.video.captions import find_videos
from v2p_data.video.decode import VideoConfig, read_clip

SAMPLES = Path(__file__).parents[2] / "datasets" / "sample_videos"
NAME, ITEM = "push_blue_box_left.mp4", "push_blue_box_left"
PHRASE = "blue box"
PATIENCE_S = 600.0
"""On a machine that does much else."""
HOSTILE = "Pushing </script><script>alert('1')</script> \"cup\" <!-- & to the left"


@contextmanager
def review_of(home):
    results = read_run(home / "run").of_stage("scene")
    stages = scene_stages(results)
    with closing(Review(home / "run", find_videos(home / "videos"), stages)) as review:
        yield review


def result_of(review):
    """Return the clip once nothing is being done for it."""
    end = time.monotonic() + PATIENCE_S
    while (shown := review.clip(ITEM))["state"]:
        assert time.monotonic() < end, shown["state"]
        time.sleep(0.05)
    return shown


@pytest.fixture(scope="module")
def home(tmp_path_factory):
    """Return a folder with one small clip of thirty frames, and an empty run."""
    home = tmp_path_factory.mktemp("review")
    (home / "videos").mkdir()
    (home / "run").mkdir()
    clip = read_clip(find_videos(SAMPLES / NAME)[0], VideoConfig(max_side_px=320, max_frames=30))
    write_film(home / "videos" / NAME, clip.frames, 10.0)
    said = {"caption": "Pushing blue box from right to left", "objects": [PHRASE]}
    (home / "videos" / "captions.json").write_text(json.dumps({NAME: said}))
    return home


@pytest.fixture(scope="module")
def click(home):
    """Return the middle of the box in the first frame, from the masks that were found without a hint."""
    from v2p_data.scene.scene import Scene

    with review_of(home) as review:
        shown = result_of(review)
        scene = Scene.load(review.film(ITEM).parent)
    mask = scene.masks(scene.objects[0].name)[0]
    y, x = mask.nonzero()
    to_file = shown["size_px"][0] / mask.shape[1]
    return [float(x.mean() * to_file), float(y.mean() * to_file)]


def test_a_click_is_saved_and_its_result_is_what_the_command_keeps(home, click):
    with review_of(home) as review:
        result_of(review)
        review.mark(ITEM, PHRASE, {"frame": 0, "click": click})
        saved = find_videos(home / "videos")[0].hints
        shown = result_of(review)

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
    with review_of(home) as review:
        result_of(review)
        review._ask(find_videos(home / "videos")[0]).prepared.result(PATIENCE_S)
        with pytest.raises(V2PError, match="stands out there from the table"):
            review.mark(ITEM, PHRASE, {"frame": 0, "click": [click[0], click[1] + 55]})
        with pytest.raises(V2PError, match="lies outside of the picture"):
            review.mark(ITEM, PHRASE, {"frame": 0, "click": [9999, 3]})
        with pytest.raises(V2PError, match="none of the objects"):
            review.mark(ITEM, "pot", {"frame": 0, "click": click})

    assert (home / "videos" / "captions.json").read_bytes() == before


@pytest.mark.long
def test_what_somebody_writes_into_the_captions_meanwhile_stays(home, click):
    path = home / "videos" / "captions.json"
    with review_of(home) as review:
        result_of(review)
        said = json.loads(path.read_text())
        said[NAME]["hints"]["table"] = {"frame": 0, "click": [5, 5]}
        path.write_text(json.dumps(said))
        review.mark(ITEM, PHRASE, None)
        review.mark(ITEM, PHRASE, {"frame": 0, "click": click})
        result_of(review)

    hints = json.loads(path.read_text())[NAME]["hints"]
    assert set(hints) == {"table", PHRASE}
    assert list(path.parent.glob("*.bak"))
    assert not list(path.parent.glob(".captions*.tmp"))


def test_judgements_outlive_the_server_and_the_written_page_shows_them(home, capsys):
    with review_of(home) as review:
        result_of(review)
        review.judge(ITEM, "right")
        with pytest.raises(V2PError, match="a judgement is one of"):
            review.judge(ITEM, "splendid")
    with review_of(home) as review:
        shown = result_of(review)

    assert shown["judgement"] == "right"
    assert (
        run_command(["scene", "review", str(home / "run"), "--videos", str(home / "videos")]) == 0
    )
    assert "1 accepted: right 100.0 %" in capsys.readouterr().out


@pytest.mark.long
@pytest.mark.skipif(CHROMIUM is None, reason="this machine has no Chromium to click in")
def test_a_person_goes_through_the_folder_with_clicks_and_keys(home, click, tmp_path):
    threads_of_other_tests = threading.active_count()
    with (
        review_of(home) as review,
        ReviewServer(review) as server,
        Browser(tmp_path / "profile") as browser,
    ):
        review.mark(ITEM, PHRASE, None)
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


@pytest.mark.skipif(CHROMIUM is None, reason="this machine has no Chromium to look with")
def test_the_written_page_shows_the_film_of_each_clip_and_takes_no_mark(made, tmp_path):
    made.accepted("push", {"caption": "Pushing cup", "objects": ["cup"]})
    made.rejected("lift")
    made.page()
    with Browser(tmp_path / "profile") as browser:
        browser.open((made.root / PAGE_FILE).as_uri())
        browser.wait_for("document.getElementById('film').readyState >= 2")
        assert (
            browser.value("getComputedStyle(document.getElementById('tools')).display") == "none"
        )
        browser.press("a")
        browser.press("j")
        browser.wait_for("state.clip && state.clip.item === 'lift'")
        browser.wait_for("document.getElementById('film').readyState >= 2")
        assert "no cup was found" in browser.value("document.body.textContent")
    assert not (made.root / REVIEW_FILE).exists()


# --- the written page, from records made by hand ----------------------------------------------------------------


class Made:
    """A folder of videos and the run that was made from it."""

    def __init__(self, home, run) -> None:
        self.videos, self.root, self.run = home / "my videos", run.root, run
        self.videos.mkdir(parents=True)

    def _recorded(self, folder, entry, **more):
        """Make the video of a scene, with its caption, and the record that names both."""
        path = self.videos / f"{folder.name.rpartition('-')[0]}.mp4"
        write_film(path, np.zeros((9, 48, 64, 3), np.uint8), 10.0)
        if entry is not None:
            file = self.videos / "captions.json"
            said = json.loads(file.read_text()) if file.is_file() else {}
            file.write_text(json.dumps({**said, path.name: entry}))
        argv = ["v2p", "scene", str(self.videos), "--out", str(self.root), "--seed", "3"]
        made_from = {"caption": "as it was", "objects": ["cup"]}
        recipe = {"config": made_from, "sources": {"video": file_digest(path)}}
        provenance = {"time": "2026-01-02T03:04:05Z", "argv": argv}
        return self.run.record(folder, recipe=recipe, provenance=provenance, **more)

    def accepted(self, item, entry=None):
        return self._recorded(self.run.scene(item), entry)

    def rejected(self, item, entry=None, **words):
        given = {"reason": "object_not_found", "detail": "no cup was found", "value": 2.93}
        return self._recorded(self.run.folder("scene", item), entry, rejected={**given, **words})

    def page(self, *flags):
        assert run_command(["scene", "review", str(self.root), *map(str, flags)]) == 0
        return (self.root / PAGE_FILE).read_text()

    def clips(self, *flags):
        """Return what the page's script reads."""
        found = re.search(r'<script id="data"[^>]*>(.*?)</script>', self.page(*flags), re.S)
        return {clip["item"]: clip for clip in json.loads(found[1])["clips"]}


@pytest.fixture
def made(tmp_path, run):
    return Made(tmp_path, run)


def test_the_page_holds_what_was_understood_and_links_the_videos_beside_it(made):
    made.accepted("push", {"caption": "Pushing red cup", "objects": ["cup"]})
    made.rejected("lift")

    clips = made.clips()

    push, lift = clips["push"], clips["lift"]
    assert list(clips) == ["push", "lift"]
    assert (push["caption"], push["kind"]) == ("Pushing red cup", "lift_up")
    assert push["confidence"] == pytest.approx(0.77)
    assert push["things"] == [{"name": "a mug", "size_cm": [8.0, 8.0, 10.0], "mass_kg": 0.25}]
    assert push["film"] == "scene/push-0a1b2c3d/overlay.mp4"
    assert (lift["reason"], lift["value"], lift["film"]) == (
        "object_not_found",
        2.93,
        "../my%20videos/lift.mp4",
    )


def test_text_from_users_is_never_read_as_html(made):
    made.accepted("push", {"caption": HOSTILE, "objects": ["<b>cup</b>"]})
    made.rejected("lift", detail=HOSTILE, reason="<i>")

    page = made.page()

    assert made.clips()["push"]["caption"] == HOSTILE
    assert made.clips()["lift"]["detail"] == HOSTILE
    assert not re.search(r"<script>alert|<b>cup|<i>", page)
    assert len(re.findall(r"<script\b", page)) == 2


def test_only_the_pages_own_script_may_run(made):
    made.accepted("push")

    page = html.unescape(made.page())

    policy = re.search(r'Content-Security-Policy" content="(.*?)">', page)[1]
    script = re.search(r'<script id="app">(.*?)</script>', page, re.S)[1]
    digest = base64.b64encode(hashlib.sha256(script.encode()).digest()).decode()
    assert f"script-src 'sha256-{digest}'" in policy
    assert "default-src 'none'" in policy


def test_runs_that_lack_something_get_a_page_that_says_so(made):
    folder = made.accepted("push")
    (folder / "overlay.mp4").unlink()
    (folder / "scene.json").write_text("{")
    made.rejected("gone")
    (made.videos / "gone.mp4").unlink()

    clips = made.clips()

    assert (clips["push"]["film"], clips["push"]["things"]) == ("", [])
    assert "not at hand" in clips["gone"]["trouble"]
    assert (clips["gone"]["caption"], clips["gone"]["film"]) == ("as it was", "")


def test_a_run_whose_videos_are_elsewhere_is_shown_all_the_same(made, tmp_path):
    made.rejected("lift")
    moved = made.videos.rename(tmp_path / "moved")

    assert made.clips()["lift"]["film"] == ""
    assert made.clips("--videos", moved)["lift"]["film"] == "../moved/lift.mp4"


def test_a_folder_without_scenes_is_named(tmp_path, capsys):
    assert run_command(["scene", "review", str(tmp_path)]) == 2
    assert "holds no scenes" in capsys.readouterr().err


def test_the_summary_gives_the_share_of_right_scenes_with_its_interval():
    said = [
        *[("accepted", "right")] * 9,
        ("accepted", "wrong"),
        ("accepted", None),
        ("rejected", "wrong"),
    ]

    lines = summary_of([{"status": status, "judgement": judgement} for status, judgement in said])

    # Wilson's interval for 9 of 10, as in Brown, Cai and DasGupta 2001.
    assert lines[0] == "11 accepted: right 90.0 % [59.6, 98.2] (9 of 10), 1 not judged"
    assert lines[1].startswith("1 refused: rightly so 0.0 %")


@pytest.mark.parametrize("text", ["", "[]", "{}", '{"clips": 3}', '{"clips": [3]}', "[" * 100_000])
def test_a_file_that_is_no_review_holds_no_judgement(tmp_path, text):
    (tmp_path / REVIEW_FILE).write_text(text)

    assert judgements(tmp_path) == {}

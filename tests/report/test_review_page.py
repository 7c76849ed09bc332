"""The review page, read back as a browser would, and what its downloads do."""

import base64
import hashlib
import html
import json
import re
from fractions import Fraction

import av
import cv2
import numpy as np
import pytest

from v2p_data.cli import run
from v2p_data.commands.review import summary_of
from v2p_data.errors import V2PError
from v2p_data.pipeline.artifact import Record, write_record
from v2p_data.pipeline.fingerprint import file_digest
from v2p_data.report.review_page import stills_of
from v2p_data.video.captions import VideoItem, find_videos

NUM_FRAMES = 9
HOSTILE = "Pushing </script><script>alert('1')</script> \"cup\" <!-- & to the left"


def film(path, frames=None):
    """Write frames that go from black to white, or the given ones."""
    if frames is None:
        frames = [np.full((48, 64, 3), 28 * i, np.uint8) for i in range(NUM_FRAMES)]
    with av.open(str(path), "w") as out:
        stream = out.add_stream("libx264", rate=Fraction(10), options={"preset": "ultrafast"})
        stream.height, stream.width = frames[0].shape[:2]
        stream.pix_fmt = "yuv420p"
        for pixels in frames:
            out.mux(stream.encode(av.VideoFrame.from_ndarray(pixels, format="rgb24")))
        out.mux(stream.encode(None))
    return path


class Made:
    """A folder of videos and the run that was made from it."""

    def __init__(self, home) -> None:
        self.videos, self.root = home / "my videos", home / "run"
        self.videos.mkdir(parents=True)
        (self.root / "scene").mkdir(parents=True)

    def video(self, item, entry=None):
        path = film(self.videos / f"{item}.mp4")
        if entry is not None:
            file = self.videos / "captions.json"
            said = json.loads(file.read_text()) if file.is_file() else {}
            file.write_text(json.dumps({**said, path.name: entry}, indent=1))
        return path

    def record(self, item, rejected=None, **provenance):
        folder = self.root / "scene" / f"{item}-0a1b2c3d"
        folder.mkdir(exist_ok=True)
        video = self.videos / f"{item}.mp4"
        argv = ["v2p", "scene", str(self.videos), "--out", str(self.root), "--seed", "3"]
        write_record(
            folder,
            Record(
                stage="scene", item=item, version=1, fingerprint="0a1b2c3d", inputs={}, seconds=1.0, rejected=rejected,
                recipe={"config": {"caption": "as it was", "objects": ["cup"]}, "sources": {"video": file_digest(video)}},
                provenance={"time": "2026-01-02T03:04:05Z", "argv": argv, **provenance},
            ),
        )  # fmt: skip
        return folder

    def accepted(self, item, entry=None):
        self.video(item, entry)
        folder = self.record(item)
        film(folder / "overlay.mp4")
        scene = {
            "kind": "push_left", "confidence": 0.81, "warnings": ["a weak shadow"],
            "confidences": {"pose": {"value": 0.4, "reason": "the hand hides half of it"}},
            "objects": [{"name": "cup", "label": "red cup", "role": "manipulated", "size_m": [0.08, 0.08, 0.1], "mass_kg": 0.2}],
        }  # fmt: skip
        (folder / "scene.json").write_text(json.dumps(scene))
        return folder

    def rejected(self, item, entry=None, **words):
        self.video(item, entry)
        given = {"reason": "object_not_found", "detail": "no cup was found", "value": 2.93}
        return self.record(item, {**given, **words})

    def page(self, *flags):
        assert run(["scene", "review", str(self.root), *map(str, flags)]) == 0
        return (self.root / "review.html").read_text()

    def data(self, *flags):
        """Return what the page's script reads."""
        found = re.search(r'<script id="data"[^>]*>(.*?)</script>', self.page(*flags), re.S)
        return json.loads(found[1])

    def clips(self, *flags):
        return {clip["item"]: clip for clip in self.data(*flags)["clips"]}


@pytest.fixture
def made(tmp_path):
    return Made(tmp_path)


def grey(uri):
    data = np.frombuffer(base64.b64decode(uri.split(",", 1)[1]), np.uint8)
    return float(cv2.imdecode(data, cv2.IMREAD_COLOR).mean())


def test_an_accepted_clip_shows_what_was_understood_and_how_sure_each_stage_is(made):
    folder = made.accepted("push", {"caption": "Pushing red cup to the left"})

    clip = made.clips()["push"]

    assert (clip["status"], clip["kind"], clip["confidence"]) == ("accepted", "push_left", 0.81)
    assert clip["stages"] == [
        {"name": "pose", "value": 0.4, "reason": "the hand hides half of it"}
    ]
    assert clip["things"][0]["size_cm"] == pytest.approx([8, 8, 10])
    assert (made.root / clip["overlay"]) == folder / "overlay.mp4"


def test_a_rejected_clip_shows_its_first_and_last_frame_and_the_number_that_decided(made):
    made.rejected("lift", {"caption": "Lifting red cup up"})

    clip = made.clips()["lift"]

    assert (clip["status"], clip["reason"], clip["value"]) == (
        "rejected",
        "object_not_found",
        2.93,
    )
    assert clip["detail"] == "no cup was found"
    assert [s["frame"] for s in clip["stills"]] == [0, 2, 4, 6, 8]
    assert grey(clip["stills"][0]["uri"]) == pytest.approx(0, abs=4)
    assert grey(clip["stills"][-1]["uri"]) == pytest.approx(28 * 8, abs=4)
    assert (clip["size_px"], clip["num_frames"]) == ([64, 48], NUM_FRAMES)


def test_a_frame_that_has_a_hint_is_among_the_stills(made):
    hint = {"frame": 5, "box": [1.0, 2.0, 30.0, 40.0]}
    made.rejected("lift", {"caption": "Lifting cup", "objects": ["cup"], "hints": {"cup": hint}})

    clip = made.clips()["lift"]

    assert clip["hints"] == {"cup": hint}
    assert [s["frame"] for s in clip["stills"]] == [0, 2, 4, 5, 6, 8]


def test_text_from_users_is_never_read_as_html(made):
    made.accepted("push", {"caption": HOSTILE, "objects": ["<b>cup</b>"]})
    made.rejected("lift", detail=HOSTILE, reason="<i>")

    page = made.page()

    assert made.clips()["push"]["caption"] == HOSTILE
    assert made.clips()["lift"]["detail"] == HOSTILE
    assert "alert" in page
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


def test_the_captions_reach_the_page_as_they_are_and_in_their_order(made):
    made.rejected("z", "Lifting   cup")
    made.accepted("a", {"caption": "Pushing cup", "objects": ["cup"]})

    data = made.data()

    assert list(data["captions"].items()) == [
        ("z.mp4", "Lifting   cup"),
        ("a.mp4", {"caption": "Pushing cup", "objects": ["cup"]}),
    ]
    assert [clip["item"] for clip in data["clips"]] == ["a", "z"]


def test_runs_that_lack_something_get_a_page_that_says_so(made):
    folder = made.accepted("push")
    (folder / "overlay.mp4").unlink()
    (folder / "scene.json").write_text("{")
    path = made.rejected("torn").parents[2] / "my videos" / "torn.mp4"
    path.write_bytes(b"no film")
    made.record("torn", {"reason": "unreadable", "detail": "no video", "value": None})
    made.rejected("gone")
    (made.videos / "gone.mp4").unlink()
    made.rejected("other")
    film(made.videos / "other.mp4", [np.zeros((48, 64, 3), np.uint8)] * 12)

    clips = made.clips()

    assert (clips["push"]["overlay"], clips["push"]["things"]) == ("", [])
    assert len(clips["push"]["stills"]) == 5
    assert "no video that can be read" in clips["torn"]["trouble"]
    assert "not in the folder" in clips["gone"]["trouble"]
    assert clips["gone"]["caption"] == "as it was"
    assert "another file now" in clips["other"]["trouble"]
    assert [clips[c]["video"] for c in ("push", "torn", "gone", "other")] == [
        "push.mp4", "", "", "",
    ]  # fmt: skip


def test_a_run_without_scenes_or_whose_videos_are_elsewhere_is_shown_all_the_same(made, tmp_path):
    assert made.clips() == {}
    made.rejected("lift")
    moved = made.videos.rename(tmp_path / "moved")

    assert made.clips()["lift"]["stills"] == []
    assert len(made.clips("--videos", moved)["lift"]["stills"]) == 5


@pytest.mark.parametrize("num_clips", [100, 1000])
def test_stills_of_many_clips_fit_into_ten_megabytes_together(tmp_path, num_clips):
    rng = np.random.default_rng(0)
    noise = rng.integers(0, 256, (240, 640, 3), np.uint8).repeat(
        2, axis=0
    )  # else it looks interlaced
    frames = [np.roll(noise, 7 * i, axis=1) for i in range(6)]
    video = VideoItem(item="a", path=film(tmp_path / "a.mp4", frames), caption="x")

    stills = stills_of(video, num_clips)

    # Noise is the hardest to compress; base64 makes four letters of three bytes.
    assert sum(len(j) for j in stills.jpegs) * 4 / 3 * num_clips < 9_000_000
    assert (stills.frames[0], stills.frames[-1]) == (0, 5)


def review(*clips):
    rows = [dict(zip(("item", "status", "judgement", "note"), c, strict=False)) for c in clips]
    return json.dumps({"schema": 1, "clips": rows})


def test_the_summary_gives_the_share_of_right_scenes_with_its_interval(tmp_path):
    path = tmp_path / "review.json"
    right = [(f"a{i}", "accepted", "right") for i in range(9)]
    rest = [
        ("bad", "accepted", "wrong", "took the <hand>"),
        ("dim", "accepted", "unsure"),
        ("new", "accepted", None),
        ("no", "rejected", "wrong"),
    ]
    path.write_text(review(*right, *rest))

    words = summary_of(path)

    # Wilson's interval for 9 of 10, as in Brown, Cai and DasGupta 2001.
    assert "12 accepted: right 90.0 % [59.6, 98.2] (9 of 10), 1 unsure, 1 not judged" in words
    assert "1 refused: rightly so 0.0 %" in words
    assert "accepted bad, wrong: took the <hand>" in words


@pytest.mark.parametrize("text", ["[]", "{}", '{"clips": 3}', '{"clips": [3]}'])
def test_a_file_that_is_no_review_is_named(tmp_path, text):
    path = tmp_path / "review.json"
    path.write_text(text)

    with pytest.raises(V2PError, match=r"is no review\.json"):
        summary_of(path)


@pytest.mark.parametrize("text", ["", "[" * 100_000])
def test_a_review_that_is_no_json_is_one_sentence(tmp_path, text):
    path = tmp_path / "review.json"
    path.write_text(text)

    with pytest.raises(V2PError, match=r"review\.json.*; download it anew from the review page"):
        summary_of(path)
    with pytest.raises(V2PError, match="cannot be read"):
        summary_of(tmp_path / "nowhere.json")


CUP = {"caption": "Lifting cup", "objects": ["cup"]}


def test_hints_from_the_page_go_into_the_captions_beside_the_videos(made, tmp_path, capsys):
    made.rejected("lift", CUP)
    made.accepted("push", "Pushing red cup")
    hint = {"frame": 8, "box": [1, 2, 63, 48], "size_m": [0.08, 0.08, 0.1], "name": "mug"}
    download = tmp_path / "captions (1).json"
    download.write_text(json.dumps({"lift.mp4": {**CUP, "hints": {"cup": hint}}}))

    assert run(["scene", "review", str(made.root), "--apply", str(download)]) == 0

    said = capsys.readouterr().out
    assert find_videos(made.videos)[0].hints["cup"] == hint
    assert find_videos(made.videos)[1].caption == "Pushing red cup"
    assert f"Next: v2p scene '{made.videos}' --out {made.root} --seed 3" in said
    assert made.clips()["lift"]["hints"] == {"cup": hint}


@pytest.mark.parametrize(
    ("hint", "said"),
    [
        ({"frame": 9, "box": [1, 2, 30, 40]}, "no frame 9; the video's frames are 0 to 8"),
        ({"frame": 0, "box": [1, 2, 66, 40]}, "which is 64 x 48 px"),
        ({"frame": 0, "box": [30, 2, 1, 40]}, "x0 < x1"),
    ],
)
def test_marks_that_cannot_be_are_refused_and_nothing_is_written(
    made, tmp_path, capsys, hint, said
):
    made.rejected("lift", CUP)
    before = (made.videos / "captions.json").read_bytes()
    download = tmp_path / "review.json"
    clip = {"item": "lift", "video": "lift.mp4", "hints": {"cup": hint}}
    download.write_text(json.dumps({"clips": [clip]}))

    assert run(["scene", "review", str(made.root), "--apply", str(download)]) == 2

    assert said in capsys.readouterr().err
    assert (made.videos / "captions.json").read_bytes() == before
    assert not list(made.videos.glob("*.bak"))


def test_the_videos_own_captions_are_no_download(made, capsys):
    made.rejected("lift", CUP)
    own = made.videos / "captions.json"

    assert run(["scene", "review", str(made.root), "--apply", str(own)]) == 2

    assert "the very file that the hints go into" in capsys.readouterr().err


def test_runs_of_one_name_do_not_share_what_the_browser_keeps(tmp_path):
    here, there = Made(tmp_path / "here"), Made(tmp_path / "there")
    for made in (here, there):
        made.rejected("lift", CUP)

    assert here.root.name == there.root.name
    assert here.data()["store"] == here.data()["store"]
    assert here.data()["store"] != there.data()["store"]


def test_a_folder_without_scenes_and_flags_that_exclude_each_other_are_named(tmp_path, capsys):
    assert run(["scene", "review", str(tmp_path)]) == 2
    assert "holds no scenes" in capsys.readouterr().err
    assert run(["scene", "review", str(tmp_path), "--apply", "a", "--summary", "b"]) == 2
    assert "either --apply or --summary" in capsys.readouterr().err

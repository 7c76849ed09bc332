"""The page shows everything, survives anything, and trusts nobody's text."""

import re
from html.parser import HTMLParser

import pytest

from v2p_data.errors import V2PError
from v2p_data.report.media import PageConfig
from v2p_data.report.page import NO_BREAK, duration, percent, write_page
from v2p_data.report.reading import rate_of

HOSTILE = (
    "<script>alert(1)</script><img src=x onerror=alert(2)>\"'&{{ 7*7 }}{% raw %}\u202e</title>"
)
VOID = {"meta", "img", "br", "line", "polyline", "input", "link"}


class Outline(HTMLParser):
    """Tags, attributes and text of a page; complains about tags that are not closed."""

    def __init__(self, html: str) -> None:
        super().__init__()
        self.tags: list[tuple[str, dict[str, str | None]]] = []
        self.words: list[str] = []
        self.open: list[str] = []
        self.feed(html)
        self.close()
        assert self.open == []
        self.text = re.sub(r"\s+", " ", " ".join(self.words))

    def handle_starttag(self, tag, attrs):
        self.tags.append((tag, dict(attrs)))
        if tag not in VOID:
            self.open.append(tag)

    def handle_startendtag(self, tag, attrs):
        self.tags.append((tag, dict(attrs)))

    def handle_endtag(self, tag):
        assert self.open.pop() == tag

    def handle_data(self, data):
        if self.open[-1:] != ["style"]:
            self.words.append(data)

    def of(self, tag: str) -> list[dict[str, str | None]]:
        return [attrs for name, attrs in self.tags if name == tag]


def outline(run, cfg: PageConfig | None = None) -> Outline:
    return Outline(write_page(run.root, None, cfg).read_text())


def assert_safe(page: Outline) -> None:
    assert not page.of("script")
    assert not page.of("iframe")
    assert not page.of("link")
    for tag, attrs in page.tags:
        assert not [name for name in attrs if name.startswith("on")], tag
        for name in ("src", "href", "poster", "data", "srcset", "action"):
            assert re.match(r"data:(image|video)/|#", attrs.get(name) or "#"), (tag, name)


@pytest.fixture(scope="module")
def whole(new_run, tmp_path_factory):
    return outline(new_run(tmp_path_factory.mktemp("whole") / "run").whole())


def test_the_summary_holds_the_numbers_that_matter(whole):
    for words in (
        "3 videos went in; 2 became simulated scenes",
        "1 task was learned",
        "anna/demo holds 3 successful episodes, 180 frames",
        "15 of 20 episodes (75 %) on tasks it was trained on",
        "4 of 20 episodes (20 %) on tasks it has never seen",
    ):
        assert words in whole.text


def test_each_video_has_its_caption_objects_task_expert_and_episodes(whole):
    for words in (
        "Lifting a mug",
        "8.0 \u00d7 8.0 \u00d7 10.0",
        "noun table: mug",
        "250 g",
        "volume and density",
        "a weak shadow",
        "class LiftMug(Task):",
        "false at every reset?",
        "after 7.1 cm",
        "true in 25 % of moments",
        "2 task codes were tried",
        "1, picked",
        "Written by the model gpt-4o, picked by the audit.",
        "NameError: mug",
        "60 of 64, 95 % interval 85 % to 98 %",
        "Success while training",
        "lift_mug_0000",
        "lift_mug_0002",
        "3 episodes were kept from 5 rollouts",
        "background 0, robot 64, mug 128",
        "gripper",
    ):
        assert words in whole.text
    alts = [a["alt"] for a in whole.of("img")] + [a["aria-label"] for a in whole.of("video")]
    for start in (
        "Mesh of a mug",
        "Contact sheet",
        "The video 'lift_mug.mp4'",
        "Segmentation masks of episode lift_mug_0000",
    ):
        assert any(str(alt).startswith(start) for alt in alts)


def test_rejections_are_listed_with_reason_and_number(whole):
    for words in (
        "camera moves",
        "the camera moves by 31 px; hold it still",
        "expert not learned",
        "not successful",
        "0.25 to 0.5",
        "2 results of a stage and 2 episodes did not pass",
    ):
        assert words in whole.text


def test_the_policy_is_shown_with_intervals_and_rollouts(whole):
    for words in (
        "Training loss of demo",
        "15 of 20",
        "53 % to 89 %",
        "8 % to 42 %",
        "seen",
        "unseen",
    ):
        assert words in whole.text
    assert [v for v in whole.of("video") if "The policy tries lift_mug" in str(v["aria-label"])]


def test_time_machine_cost_and_commands_are_there(whole):
    total = 12 + 3 + 95 + 42 + 1.5 + 12 + 3 + 95 + 12 + 3 + 30 + 400 + 200

    for words in (
        f"{int(total // 60)} min {round(total % 60):02d} s of work",
        "0 calls of language models, 0 tokens",
        "mujoco 4.0.0",
        "v2p generate 'my videos'",
        "LeRobotDataset('anna/demo', root=",
        "v2p train",
        "v2p eval",
    ):
        assert words in whole.text


def test_the_page_is_accessible(whole):
    assert whole.of("html")[0]["lang"] == "en"
    assert all(a.get("alt") for a in whole.of("img"))
    assert all(a.get("aria-label") and "controls" in a for a in whole.of("video"))
    assert all(a.get("aria-label") for a in whole.of("svg") if a.get("role") == "img")
    assert all(a.get("scope") for a in whole.of("th"))
    ids = [a["id"] for _, a in whole.tags if "id" in a]
    assert len(ids) == len(set(ids))
    assert {str(a["href"])[1:] for a in whole.of("a")} <= set(ids)


def test_the_page_is_one_file_that_loads_nothing(run):
    run.whole()
    html = write_page(run.root).read_text()

    assert_safe(Outline(html))
    assert "://" not in html
    assert "@import" not in html
    assert re.findall(r"url\(", html) == []
    policy = next(a for a in Outline(html).of("meta") if a.get("http-equiv"))
    assert str(policy["content"]).startswith("default-src 'none'")


def test_hostile_text_is_shown_and_never_run(run):
    run.scene("evil", HOSTILE, video=HOSTILE)
    run.task("evil", code=HOSTILE, text=HOSTILE)
    run.rejected("expert", "evil", HOSTILE, HOSTILE)
    run.rejected("scene", "evil2", "reason", HOSTILE, recipe={"config": {"caption": HOSTILE}})
    run.record(run.folder("dataset", "d"), counts={"episodes": 1, "frames": 1, "repo_id": HOSTILE})
    run.evaluation(
        [{"task": "t", "seen": True, "successes": 1, "trials": 2, "low": 0.1, "high": 0.9}]
    )
    provenance = {
        "time": "9",
        "argv": [HOSTILE],
        "machine": HOSTILE,
        "python": HOSTILE,
        "packages": {HOSTILE: HOSTILE},
    }
    run.record(run.folder("scene", HOSTILE.replace("/", "|")), provenance=provenance)

    page = outline(run)

    assert_safe(page)
    assert page.text.count("<script>alert(1)</script>") >= 12
    shown = re.sub(r"pytest-\d+", "", page.text)  # the run's own path may hold the number
    assert "49" not in re.findall(r"\{\{ 7\*7 \}\}|49", shown)
    assert len(page.of("title")) == 1


def test_names_that_are_no_text_do_not_stop_the_page(run):
    run.scene("odd", "a lone \ud800 surrogate and a \x00 zero")

    assert "surrogate" in outline(run).text


def test_task_names_of_an_evaluation_cannot_reach_outside_its_folder(run):
    outside = run.root / "videos"
    outside.mkdir()
    run.evaluation(
        [{"task": "t", "seen": True, "successes": 1, "trials": 2, "low": 0.1, "high": 0.9}]
    )
    film = next((run.root / "evaluation").rglob("*.mp4"))
    (outside / "secret.mp4").write_bytes(film.read_bytes())
    row = {
        "task": "../../../videos",
        "seen": True,
        "successes": 1,
        "trials": 2,
        "low": 0.1,
        "high": 0.9,
    }
    run.record(film.parents[2], counts={"rows": [row]})

    assert not outline(run).of("video")


def test_an_evaluation_shows_both_rates_what_went_wrong_and_a_film_of_each_kind(run):
    row = {
        "task": "t",
        "seen": True,
        "judged": "policy",
        "successes": 3,
        "trials": 4,
        "low": 0.3,
        "high": 0.95,
    }
    at_end = {"successes": 2, "trials": 4, "low": 0.15, "high": 0.85}
    told = {"at_end": at_end, "failures": {"never_reached": 1}, "median_success_s": 2.5}
    folder = run.evaluation([row | told])
    videos = folder / "videos" / "t"
    film = (videos / "episode_0.mp4").read_bytes()
    for name in ("failure_0001", "failure_0002", "success_0000"):
        (videos / f"{name}.mp4").write_bytes(film)
    run.evaluation([row | {"judged": "expert", "seen": False, "successes": 4}], item="t-expert")

    page = outline(run)

    assert "after 2.5 s" in page.text
    assert "never reached 1" in page.text
    assert "The policy succeeds in 3 of 4 episodes (75 %)" in page.text
    alts = [str(v.get("aria-label")) for v in page.of("video")]
    assert [a.split(": ")[-1] for a in alts[:2]] == ["success_0000", "failure_0001"]


@pytest.mark.parametrize("is_its_own", [True, False])
def test_a_video_is_held_out_where_its_own_task_is_unseen_and_not_one_of_its_name(run, is_its_own):
    run.scene("t", "Lifting a can")
    run.task("t")
    (own,) = (run.root / "task").glob("t-*")
    row = {"task": "t", "seen": False, "successes": 3, "trials": 4, "low": 0.3, "high": 0.95}
    run.evaluation([row | {"folder": own.name if is_its_own else "t-ffffffff"}])

    assert ("held out to judge the policy" in outline(run).text) == is_its_own


def test_a_run_with_nothing_in_it_has_a_page(run):
    page = outline(run)

    assert "This run holds no video yet." in page.text
    assert "Nothing was rejected so far." in page.text
    assert "No policy has been judged yet." in page.text


def test_a_run_with_scenes_only_has_a_page(run):
    run.scene("lift_mug")

    page = outline(run)

    assert "1 video went in; 1 became a simulated scene, 0 of them" in page.text
    assert page.text.count("not reached") == 3


def test_a_page_is_safe_from_broken_files(run):
    run.whole()
    scene = run.folder("scene", "tip_bottle")
    (scene / "scene.json").write_text('{"schema": 1, "objects": 3}')
    (scene / "overlay.mp4").write_bytes(b"no film")
    (run.folder("scene", "lift_mug") / "mug.obj").write_text("v 1 2\nf 1 2 9\n")
    (run.folder("task", "lift_mug") / "task.json").write_text(
        '{"audit": {"checks": [3, {"share": "x"}], "score": "high"}}'
    )
    (run.folder("task", "lift_mug") / "audit.json").write_text("[1, 2]")
    (run.folder("expert", "lift_mug") / "curve.csv").write_bytes(b"\xff\xfe steps\n1,2,3")
    (run.folder("expert", "lift_mug") / "sheet.png").write_bytes(b"no picture")
    (run.folder("episodes", "lift_mug") / "episodes" / "lift_mug_0000.npz").write_bytes(
        b"no archive"
    )
    (run.folder("episodes", "lift_mug") / "rejected.jsonl").write_text("{broken\n")

    page = outline(run)

    assert "The scene's file cannot be read" in page.text
    assert "cannot be read (" in page.text
    assert "60 of 64" in page.text


def test_a_mesh_outside_the_scene_folder_is_not_read(run):
    folder = run.scene("lift_mug")
    (folder / "mug.obj").rename(run.root / "mug.obj")
    text = (folder / "scene.json").read_text()
    (folder / "scene.json").write_text(text.replace('"mug.obj"', '"../../mug.obj"'))

    assert not outline(run).of("img")


def test_overlay_pictures_stand_in_for_a_missing_film(run):
    import cv2
    import numpy as np

    folder = run.scene("lift_mug")
    (folder / "overlay.mp4").unlink()
    for name in ("overlay_first.png", "overlay_last.png"):
        cv2.imwrite(str(folder / name), np.full((30, 40, 3), 90, np.uint8))

    alts = [str(a["alt"]) for a in outline(run).of("img")]

    assert [a.rsplit(", ", 1)[1] for a in alts if "outlines" in a] == ["first frame", "last frame"]


def test_a_result_from_an_older_input_says_so(run):
    run.scene("lift_mug")
    folder = run.task("lift_mug")
    run.record(folder, inputs={"scene": "lift_mug-ffffffff"})

    assert (
        "was made from scene lift_mug-ffffffff, while the newest scene is lift_mug-0a1b2c3d"
        in outline(run).text
    )


def test_media_beyond_the_budget_are_left_out_and_named(run):
    run.whole()

    page = outline(run, PageConfig(max_media_bytes=20_000))

    assert "were left out to keep this page small" in page.text
    assert (run.root / "report.html").stat().st_size < 20_000 + 80_000


def test_videos_are_filtered_by_where_their_way_ended(run):
    run.whole()

    page = outline(run)

    ways = [
        (attrs.get("class") or "").split()[1]
        for attrs in page.of("tr")
        if "way" in (attrs.get("class") or "")
    ]
    chosen = [str(attrs["id"]).removeprefix("only-") for attrs in page.of("input")]
    assert chosen[0] == "all"
    assert sorted(chosen[1:]) == sorted(set(ways))
    assert len(chosen) > 2
    html = (run.root / "report.html").read_text()
    for way in chosen[1:]:
        assert f"main:has(#only-{way}:checked) .way:not(.{way}) {{ display: none; }}" in html
        assert f"({ways.count(way)})" in page.text
    assert_safe(page)


def test_beyond_the_limit_videos_are_in_the_table_only(run):
    for k in range(4):
        run.scene(f"clip_{k}", f"Lifting mug {k}")

    page = outline(run, PageConfig(max_shown_items=2))

    assert len(page.of("article")) == 2
    assert "Lifting mug 3" in page.text
    assert "2 further videos are in the table above only" in page.text


def test_the_page_can_go_elsewhere_and_is_written_whole(run, tmp_path):
    out = tmp_path / "page.html"

    run.scene("lift_mug")

    assert write_page(run.root, out) == out
    assert out.read_text().endswith("</html>")
    assert not (run.root / "report.html").exists()
    assert [p.name for p in tmp_path.glob("*.tmp")] == []


def test_a_page_that_finds_no_room_ends_in_a_sentence_and_leaves_the_old_one(run):
    run.scene("lift_mug")
    write_page(run.root)
    before = (run.root / "report.html").read_text()
    # Where it is written first, the kernel answers that no space is left.
    (run.root / "report.html.tmp").symlink_to("/dev/full")

    with pytest.raises(
        V2PError, match=r"report\.html: no space is left on the disk.*'v2p report "
    ):
        write_page(run.root)

    assert (run.root / "report.html").read_text() == before


@pytest.mark.parametrize(
    ("seconds", "words"),
    [
        (0.42, "0.4 s"),
        (9.96, "10 s"),
        (59.6, "1 min 00 s"),
        (190.0, "3 min 10 s"),
        (3900.0, "1 h 05 min"),
        (None, "-"),
    ],
)
def test_durations_are_words(seconds, words):
    assert duration(seconds).replace(NO_BREAK, " ") == words


def test_percentages_never_round_to_certainty():
    assert [percent(p).replace(NO_BREAK, " ") for p in (0.0, 0.004, 0.625, 0.996, 1.0)] == [
        "0 %",
        "0.4 %",
        "62 %",
        "99.6 %",
        "100 %",
    ]


@pytest.mark.parametrize(
    "data",
    [None, 3, {}, {"successes": 1, "trials": 0, "low": 0.0, "high": 1.0}, {"successes": "1"}],
)
def test_what_is_no_rate_is_none(data):
    assert rate_of(data) is None

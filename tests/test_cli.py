"""What a user gets for bad input: one sentence, exit code 2, and nothing made before is harmed."""

import errno
import json
import os
import pwd
import re
import shlex
import shutil
import subprocess
import sys
import time
from dataclasses import replace
from pathlib import Path

import pytest

from v2p_data import cli
from v2p_data.cli import parse, run
from v2p_data.commands import display
from v2p_data.commands.pace import Pace
from v2p_data.commands.pace import said as said_of
from v2p_data.commands.run import FromVideos
from v2p_data.commands.settings import changed_flags
from v2p_data.errors import V2PError
from v2p_data.stages import EngineConfig
from v2p_data.task.cache import cache_folder

SAMPLES = Path(__file__).parents[1] / "datasets" / "sample_videos"


def test_help_names_every_command_and_is_there_at_once():
    started = time.monotonic()
    shown = subprocess.run(
        [sys.executable, "-m", "v2p_data.cli", "--help"],
        capture_output=True,
        text=True,
        check=True,
    )

    assert (
        time.monotonic() - started < 5
    )  # 0.03 s on a quiet machine; this only bans heavy imports
    assert all(word in shown.stdout for word in ("generate", "train", "eval", "push", "demo"))
    assert re.search(r"\n  3 +made, but not all", shown.stdout)


def test_help_imports_no_heavy_library():
    code = (
        "import sys; from v2p_data.cli import run; run(['--help']);"
        "assert not {'torch', 'mujoco', 'lerobot', 'cv2', 'tyro'} & set(sys.modules)"
    )
    subprocess.run([sys.executable, "-c", code], check=True, capture_output=True)


def test_reading_a_command_s_options_does_not_wait_for_what_trains():
    code = (
        "import sys, v2p_data.commands.run, v2p_data.commands.show, v2p_data.commands.reward;"
        "assert not {'torchrl', 'tensordict', 'lerobot', 'transformers'} & set(sys.modules)"
    )
    subprocess.run([sys.executable, "-c", code], check=True, capture_output=True)


@pytest.mark.parametrize("loads_s", [0.0, 0.4])
def test_a_command_that_still_loads_says_so_after_a_second(loads_s):
    code = (
        "import sys, time; from v2p_data import cli; cli.FIRST_WORD_S = 0.2; sys.argv = ['v2p', 'gc'];"
        f"cli._command = lambda name: time.sleep({loads_s}) or (lambda argv: time.sleep(0.4) or 0);"
        "cli.main()"
    )
    done = subprocess.run([sys.executable, "-c", code], check=True, capture_output=True, text=True)

    assert done.stderr == ("v2p: loading libraries\n" if loads_s else "")
    assert done.stdout == ""


def test_what_takes_long_says_how_far_it_is(capsys, monkeypatch):
    monkeypatch.setattr(display, "PLAIN_EVERY_S", 0.02)

    with display.telling("drop") as progress:
        time.sleep(0.1)
        progress(0.25, "comparing every frame")
        time.sleep(0.1)
    said = capsys.readouterr().err.splitlines()
    time.sleep(0.05)

    assert said[0] == "drop: at work, 0 s so far"
    assert said[-1] == "drop: 25% comparing every frame, 0 s so far"
    assert capsys.readouterr().err == ""


@pytest.fixture
def videos(tmp_path) -> Path:
    folder = tmp_path / "videos"
    folder.mkdir()
    shutil.copy(SAMPLES / "tip_green_carton.mp4", folder / "tip_over__green_carton.mp4")
    return folder


def said(capsys, *argv: object) -> str:
    """Return the one sentence on stderr; the command must end with code 2."""
    assert run([str(a) for a in argv]) == 2
    return capsys.readouterr().err


def generate(videos: Path, out: Path, *flags: str) -> tuple[object, ...]:
    return ("generate", videos, "--out", out, "--repo-id", "me/toys", *flags)


def test_an_unknown_command_gets_a_suggestion(capsys):
    assert "Did you mean 'generate'" in said(capsys, "generat")


def test_a_mistyped_second_word_gets_a_suggestion_and_a_folder_does_not(capsys):
    assert "Did you mean 'v2p scene review'? See" in said(capsys, "scene", "reviw", "outputs/x")
    assert "mean" not in said(capsys, "scene", "my_videos")


def test_fewer_than_no_workers_are_refused(capsys, videos, tmp_path):
    message = said(capsys, "scene", videos, "--out", tmp_path / "run", "--workers", "-3")

    assert "--workers is at least 0" in message


def test_where_no_video_was_understood_the_review_page_comes_next(capsys, tmp_path):
    videos = tmp_path / "videos"
    videos.mkdir()
    (videos / "lift_up__mug.mp4").write_bytes(b"no video")

    assert run(["scene", str(videos), "--out", str(tmp_path / "run")]) == 2

    assert f"Next: v2p scene review {tmp_path / 'run'}" in capsys.readouterr().out


def test_the_next_command_keeps_the_settings(capsys, tmp_path):
    """Without them it would make everything anew, otherwise."""
    videos, out = tmp_path / "my videos", tmp_path / "run"
    videos.mkdir()
    (videos / "lift_up__mug.mp4").write_bytes(b"no video")

    run(["task", "--seed", "3", f"{videos}/", "--out", str(out), "--scene.fov-rad=1.0"])

    after = shlex.split(capsys.readouterr().out.split("Next: ")[1])
    flags = ["--scene.fov-rad=1.0", "--seed=3"]
    assert after == ["v2p", "expert", str(videos), "--out", str(out), *flags]


def test_what_a_command_was_told_is_what_the_next_one_is_told():
    usual = EngineConfig()
    told = replace(
        usual,
        seed=3,
        policy=replace(usual.policy, steps=50),
        distillation=replace(usual.distillation, takeover=(0.1, 0.5)),
    )

    flags = changed_flags(told, usual)

    takeover = ["--distillation.takeover", "0.1", "0.5"]
    assert flags == [*takeover, "--policy.steps=50", "--seed=3"]
    line = ["videos", "--out", "run", *flags, "--workers", "2"]
    assert parse(FromVideos, line, "scene").engine == told


def test_videos_that_nobody_describes_are_named(capsys, videos, tmp_path):
    (videos / "IMG_1234.mp4").write_bytes(b"no video")
    (videos / "tip_over__green_carton.mp4").write_bytes(b"no video either")

    run(["scene", str(videos), "--out", str(tmp_path / "run")])

    assert "1 of 2 videos without a caption (IMG_1234.mp4)" in capsys.readouterr().err


def test_an_unknown_option_gets_a_suggestion(capsys, videos, tmp_path):
    message = said(capsys, *generate(videos, tmp_path / "out", "--expert.num-evs", "3"))

    assert "--expert.num-evs" in message
    assert "--expert.num-envs" in message
    assert len(message.strip().splitlines()) == 1


@pytest.mark.parametrize(
    ("flags", "option"),
    [
        (("--expert.min-success", "3"), "--expert.min-success"),
        (("--scene.pitch-rad=9",), "--scene.pitch-rad"),
        (("--scene.ground.batch-size", "0"), "--scene.ground.batch-size"),
    ],
)
def test_a_value_out_of_range_is_named_as_it_was_typed(
    capsys, videos, tmp_path, flags: tuple[str, ...], option: str
):
    message = said(capsys, *generate(videos, tmp_path / "out", *flags))

    assert message.startswith(f"v2p generate: {option} must ")
    assert message.count("--help") == 1


def test_a_missing_folder_is_named(capsys, tmp_path):
    assert str(tmp_path / "nowhere") in said(
        capsys, *generate(tmp_path / "nowhere", tmp_path / "o")
    )


def test_trying_takes_one_video_and_folders_are_for_generate(capsys, tmp_path):
    for place in (tmp_path, tmp_path / "none.mp4"):
        assert run(["try", str(place), "--out", str(tmp_path / "run")]) == 2
        assert f"{place} is no video file; v2p generate takes a folder" in capsys.readouterr().err


@pytest.mark.long
def test_one_clip_becomes_episodes_by_an_expert_of_the_package(capsys, tmp_path):
    clip = shutil.copy(SAMPLES / "tip_green_carton.mp4", tmp_path / "film.mp4")
    few = "--episodes.num-episodes=4"
    out = tmp_path / "run"

    assert (
        run(["try", str(clip), "--caption", "Tipping a green carton over", "--out", str(out), few])
        == 0
    )

    said = capsys.readouterr().out
    assert "Made 4 episodes in" in said
    assert "pretrained: the package's expert of this kind" in said
    assert len(list(out.glob("episodes/*/episodes/*.npz"))) == 4


def test_an_empty_folder_says_which_endings_are_known(capsys, tmp_path):
    (tmp_path / "empty").mkdir()
    assert "mp4" in said(capsys, *generate(tmp_path / "empty", tmp_path / "out"))


def test_a_caption_for_a_missing_file_is_named(capsys, videos, tmp_path):
    (videos / "captions.json").write_text(json.dumps({"tip_ovr__green_carton.mp4": "Tipping"}))
    assert "tip_ovr__green_carton.mp4" in said(capsys, *generate(videos, tmp_path / "out"))


@pytest.mark.parametrize("repo_id", ["toys", "me/a--b", "me/a..b", "me/my toys", "-me/toys"])
def test_a_bad_repo_id_is_refused_before_any_work(capsys, videos, tmp_path, repo_id):
    out = tmp_path / "out"

    words = said(capsys, "generate", videos, "--out", out, f"--repo-id={repo_id}")

    assert f"'{repo_id}' is no repository id; it reads USER/NAME" in words
    assert not out.exists()


def test_a_folder_that_cannot_be_written_is_named(capsys, videos, tmp_path):
    (tmp_path / "file").write_text("mine")
    assert "cannot write" in said(capsys, *generate(videos, tmp_path / "file" / "out"))
    assert (tmp_path / "file").read_text() == "mine"


def test_a_dataset_is_never_written_into(capsys, videos, tmp_path):
    (tmp_path / "set" / "meta").mkdir(parents=True)
    (tmp_path / "set" / "meta" / "info.json").write_text("{}")
    assert "is a LeRobot dataset" in said(capsys, *generate(videos, tmp_path / "set"))
    assert [p.name for p in (tmp_path / "set").iterdir()] == ["meta"]


def test_a_settings_file_with_a_mistake_is_named(capsys, videos, tmp_path):
    path = tmp_path / "my.yaml"
    path.write_text("epsiodes: {}")
    message = said(capsys, *generate(videos, tmp_path / "out", "--config", str(path)))
    assert "Did you mean 'episodes'" in message


@pytest.mark.slow
def test_bad_videos_are_listed_with_their_reason_and_stop_no_other(capsys, videos, tmp_path):
    (videos / "lift_up__text.mp4").write_text("I am no video")
    whole = (SAMPLES / "lift_red_box.mp4").read_bytes()
    (videos / "lift_up__cut.mp4").write_bytes(whole[: len(whole) // 3])

    assert run(["scene", str(videos), "--out", str(tmp_path / "out")]) == 0
    words = capsys.readouterr().err
    assert "lift_up__text" in words
    assert "unreadable" in words
    assert any((tmp_path / "out" / "scene").glob("tip_over__green_carton-*/scene.json"))

    for name in ("tip_over__green_carton.mp4",):
        (videos / name).unlink()
    assert run(["scene", str(videos), "--out", str(tmp_path / "out")]) == 2
    assert any((tmp_path / "out" / "scene").glob("tip_over__green_carton-*/scene.json"))


@pytest.mark.parametrize("command", ["status", "report"])
def test_a_folder_that_is_no_run_is_named(capsys, tmp_path, command):
    assert "is no run folder" in said(capsys, command, tmp_path)


def test_only_datasets_and_policies_can_be_pushed(capsys, tmp_path):
    assert "neither" in said(capsys, "push", tmp_path, "--repo-id", "me/toys")
    assert "no LeRobot dataset" in said(capsys, "verify", tmp_path)
    assert "is no dataset of v2p generate" in said(capsys, "train", tmp_path)
    assert "no LeRobot policy" in said(capsys, "eval", tmp_path)


@pytest.mark.parametrize(
    ("number", "said"),
    [
        (errno.EROFS, "choose another place"),
        (errno.EACCES, "no permission to write"),
        (errno.ENOSPC, "no space is left"),
        (errno.EMFILE, "ulimit -n"),
    ],
)
def test_a_place_that_cannot_be_written_is_one_sentence(monkeypatch, capsys, number, said):
    def refuse(*_):
        raise OSError(number, os.strerror(number), "/some/place")

    monkeypatch.setattr(cli, "_command", lambda name: refuse)

    assert run(["status", "somewhere"]) == 2
    (line,) = capsys.readouterr().err.splitlines()
    assert line.startswith("v2p status: /some/place: ")
    assert said in line


def test_a_user_without_a_home_is_told_what_to_set(monkeypatch):
    def nobody(_):
        raise KeyError("no such user")

    for variable in ("HOME", "XDG_CACHE_HOME", "V2P_CACHE_DIR"):
        monkeypatch.delenv(variable, raising=False)
    monkeypatch.setattr(pwd, "getpwuid", nobody)

    with pytest.raises(V2PError, match="no home folder to keep files in; set V2P_CACHE_DIR to"):
        cache_folder("convex")


# (seconds since the item began, share done) of the demo's stages on two cores, and how long each took
PACES = {
    "expert a": ([(17, 0.11), (34, 0.53), (51, 0.76), (66, 0.95)], 75),
    "expert b": ([(15, 0.08), (33, 0.47), (49, 0.67), (66, 0.88), (78, 0.95)], 83),
    "distillation demo": (
        [
            (35, 0.06),
            (52, 0.18),
            (170, 0.33),
            (245, 0.42),
            (279, 0.5),
            (306, 0.6),
            (386, 0.83),
            (460, 0.92),
        ],
        471,
    ),
    "policy demo": (
        [
            (100, 0.02),
            (116, 0.14),
            (132, 0.3),
            (147, 0.44),
            (164, 0.54),
            (179, 0.66),
            (195, 0.78),
            (212, 0.94),
        ],
        223,
    ),
    "evaluation demo": ([(46, 0.24), (61, 0.42), (75, 0.61), (90, 0.75), (104, 0.86)], 121),
    "waited for": ([(600, 0.02), (620, 0.3), (650, 0.7)], 670),
    "expert that ends early": ([(60, 0.1), (230, 0.4), (420, 0.7)], 440),
}


def test_a_range_of_time_left_holds_what_was_left_and_tells_nothing_where_nobody_knows():
    told = 0
    for name, (trace, took) in PACES.items():
        pace = Pace()
        for passed, share in trace:
            left = pace.left_s(name.split()[0], name, float(passed), share)
            told += left is not None
            assert left is None or left[0] <= took - passed <= left[1], (name, passed, left)
    assert told >= 20


def test_finished_items_tell_how_long_the_next_one_takes():
    pace = Pace()
    pace.finished["expert"] = [75.0, 83.0]

    assert pace.left_s("expert", "c", 18.0, 0.16) == pytest.approx((75 / 1.5 - 18, 83 * 1.5 - 18))
    assert said_of(pace.left_s("expert", "c", 18.0, 0.16)) == ", 30 to 110 s left"
    assert said_of(pace.left_s("expert", "c", 60.0, 0.7)) == ", up to 65 s left"
    assert said_of(pace.left_s("policy", "p", 300.0, 0.25)) == ", 9 to 23 min left"
    assert said_of(pace.left_s("policy", "q", 3.0, 0.01)) == ""

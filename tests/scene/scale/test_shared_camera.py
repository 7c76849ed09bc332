"""One camera that filmed several clips: what they say of it together, and the command that asks them."""

import re
import shlex
from dataclasses import replace

import numpy as np
import pytest

from v2p_data.cli import run
from v2p_data.geometry.camera import Camera, intrinsics, look_at
from v2p_data.pipeline.artifact import Record, write_record
from v2p_data.scene.scale.shared_camera import Filmed, filmed, shared_camera
from v2p_data.scene.scene import Scene

CLIP = Filmed(
    item="a", table_width_m=0.8, width_sd=0.1, pitch_rad=0.6, focal_widths=0.9, aspect=4 / 3
)


def clips(*widths, **others):
    """Return clips that say these widths of the table, and are alike otherwise."""
    return [
        replace(CLIP, item=name, table_width_m=width, **others)
        for name, width in zip("abcdefgh", widths, strict=False)
    ]


def scene_from(height_m, pitch_rad, spread=0.1):
    eye = np.array([0.0, 0.0, height_m])
    camera = Camera(
        width_px=640,
        height_px=480,
        K=intrinsics(640, 480, 0.8),
        T_world_cam=look_at(eye, eye + np.array([np.cos(pitch_rad), 0.0, -np.sin(pitch_rad)])),
    )
    return Scene(
        title="clip",
        video="clip.mp4",
        description="Lifting cup",
        kind="lift_up",
        objects=(),
        camera=camera,
        fps=12.0,
        num_frames=40,
        confidence=0.8,
        scale_spread=spread,
    )


def test_clips_that_agree_give_the_camera_that_each_says():
    scene = scene_from(0.5, 0.7)

    camera = shared_camera([filmed(item, scene.camera, 0.1) for item in "ab"])

    assert camera.height_m == pytest.approx(0.5)
    assert camera.pitch_rad == pytest.approx(0.7)
    assert camera.fov_rad == pytest.approx(2 * np.arctan(320 / (240 / np.tan(0.4))))
    assert camera.factors == pytest.approx((1.0, 1.0))
    assert camera.strangers == ()


def test_more_clips_know_the_camera_better_but_not_without_end():
    """The same picture misleads the network in the same way each time."""
    two, eight = (shared_camera(clips(*[0.8] * n)).spread for n in (2, 8))

    assert CLIP.width_sd > two > eight > 0.04


def test_a_clip_that_is_far_off_counts_little_and_is_named():
    camera = shared_camera(clips(0.8, 0.8, 0.8, 0.8, 1.6))

    assert camera.strangers == ("e",)
    assert camera.factors[0] == pytest.approx(1.0, abs=0.03)
    assert camera.factors[4] == pytest.approx(2.0, rel=0.03)


def test_pictures_of_another_format_are_from_another_camera():
    upright = replace(CLIP, item="upright", aspect=3 / 4)

    assert shared_camera([*clips(0.8, 0.8), upright]).strangers == ("upright",)


def test_one_clip_shares_its_camera_with_nobody():
    with pytest.raises(ValueError, match="at least 2 clips, got 1"):
        shared_camera([CLIP])


# --- the command ---------------------------------------------------------------------------------------------


class Filmings:
    """A run folder with scenes."""

    def __init__(self, root) -> None:
        self.root = root
        (root / "scene").mkdir(parents=True)

    def scene(
        self,
        item,
        height_m,
        *,
        fingerprint="0a1b2c3d",
        given=None,
        time="2026-01-02",
        rejected=None,
    ):
        folder = self.root / "scene" / f"{item}-{fingerprint}"
        folder.mkdir()
        if rejected is None:
            scene_from(height_m, 0.6).save(folder)
        settings = {"camera_height_m": None, "pitch_rad": None, "fov_rad": None, **(given or {})}
        argv = ["v2p", "scene", "my videos", "--out", str(self.root), "--seed", "3"]
        record = Record(
            stage="scene",
            item=item,
            version=1,
            fingerprint=fingerprint,
            inputs={},
            seconds=1.0,
            rejected=rejected,
            recipe={"config": {"scene": settings}},
            provenance={"time": time, "argv": argv},
        )
        write_record(folder, record)

    def said(self, capsys, *words):
        code = run(["scene", "camera", str(self.root), *words])
        return code, capsys.readouterr()


@pytest.fixture
def filmings(tmp_path):
    return Filmings(tmp_path / "run")


def height_in(text):
    return float(re.search(r"--scene.camera-height-m=([0-9.]+)", text)[1])


def test_the_command_that_comes_next_is_the_one_that_made_the_run_with_the_camera_added(
    filmings, capsys
):
    filmings.scene("one", 0.5 * 1.1)
    filmings.scene("two", 0.5 / 1.1)

    code, said = filmings.said(capsys)

    after = shlex.split(said.out.split("Next: ")[1])
    assert code == 0
    assert after[:7] == ["v2p", "scene", "my videos", "--out", str(filmings.root), "--seed", "3"]
    assert [word.split("=")[0] for word in after[7:]] == [
        "--scene.camera-height-m",
        "--scene.pitch-rad",
        "--scene.fov-rad",
        "--scene.camera-spread",
    ]
    assert height_in(said.out) == pytest.approx(0.5, abs=0.001)
    assert re.search(r"one +\+10%", said.out)
    assert re.search(r"two +-9%", said.out)


def test_the_settings_are_understood(filmings, capsys, tmp_path):
    """An empty folder of videos is complained of, not the settings."""
    filmings.scene("one", 0.5)
    filmings.scene("two", 0.5)
    after = shlex.split(filmings.said(capsys)[1].out.split("Next: ")[1])
    empty = tmp_path / "empty"
    empty.mkdir()

    assert run(["scene", str(empty), *after[3:]]) == 2

    assert "empty" in capsys.readouterr().err


def test_scenes_whose_camera_was_given_say_nothing_of_it(filmings, capsys):
    """Else a guess would confirm itself, each time the command is asked."""
    filmings.scene("one", 0.5)
    filmings.scene("two", 0.5)
    for item in ("one", "two"):
        filmings.scene(
            item, 0.9, fingerprint="ffffffff", given={"camera_height_m": 0.9}, time="2026-02-02"
        )

    assert height_in(filmings.said(capsys)[1].out) == pytest.approx(0.5, abs=0.001)


def test_what_cannot_be_read_is_left_out(filmings, capsys):
    for item in ("one", "two", "old", "torn"):
        filmings.scene(item, 0.5)
    (filmings.root / "scene" / "old-0a1b2c3d" / "scene.json").write_text('{"schema": 1}')
    (filmings.root / "scene" / "torn-0a1b2c3d" / "record.json").write_text('{"stage": "sce')

    code, said = filmings.said(capsys)

    assert code == 0
    assert "2 clips from one stand" in said.out
    assert "'old' is left out" in said.err


def test_a_clip_from_elsewhere_is_named_and_can_be_left_out(filmings, capsys):
    for item in ("one", "two", "three", "four"):
        filmings.scene(item, 0.5)
    filmings.scene("far", 1.5)

    said = filmings.said(capsys)[1].out
    without = filmings.said(capsys, "--without", "far")[1].out

    assert "'far' seems to be filmed from elsewhere" in said
    *rest, warning = without.strip().splitlines()
    assert "far" not in "\n".join(rest)
    assert warning.endswith("take those of far out of it before")
    assert height_in("\n".join(rest)) == pytest.approx(0.5, abs=0.001)


def test_too_few_scenes_are_said_to_be_too_few(filmings, capsys):
    filmings.scene("one", 0.5)
    filmings.scene("two", 0.5, rejected={"reason": "no_hand", "detail": "no hand is seen"})

    code, said = filmings.said(capsys)

    assert code == 2
    assert "holds 1 scenes whose camera was guessed" in said.err


def test_a_name_that_is_no_scene_is_named(filmings, capsys):
    filmings.scene("one", 0.5)

    code, said = filmings.said(capsys, "--without", "onne")

    assert code == 2
    assert "no scene 'onne'. Did you mean 'one'?" in said.err


def test_a_folder_without_scenes_is_said_to_hold_none(tmp_path, capsys):
    assert run(["scene", "camera", str(tmp_path)]) == 2

    assert "holds no scenes" in capsys.readouterr().err

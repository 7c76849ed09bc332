from pathlib import Path

import cv2
import numpy as np
import pytest

from v2p_data.geometry.mesh import outline_points
from v2p_data.scene.config import SceneConfig
from v2p_data.scene.data_types import CameraGuess, ObjectTrack
from v2p_data.scene.fitting.camera_guess import with_measured_camera
from v2p_data.scene.fitting.object_view import hidden_around, round_body
from v2p_data.scene.fitting.placement import place
from v2p_data.scene.fitting.silhouette import camera_above
from v2p_data.scene.frames.classes import CLASSES
from v2p_data.scene.frames.segmentation import Segmentation
from v2p_data.scene.frames.working_clip import working_clip_of
from v2p_data.scene.scale.camera_height import SeenCamera
from v2p_data.scene.scale.nouns import noun_for
from v2p_data.video.clip import Clip

W, H = 320, 240
PITCH, FOV = 0.7, 1.0


def block(x: int, y: int, side: int = 36) -> np.ndarray:
    out = np.zeros((H, W), bool)
    out[y : y + side, x : x + side] = True
    return out


def filmed(frames: np.ndarray) -> Clip:
    n = len(frames)
    return Clip(
        item="drawn",
        path=Path("drawn.mp4"),
        caption="",
        objects=(),
        hints={},
        frames=frames,
        fps=12.0,
        total_frames=n,
        source_fps=12.0,
        source_frame=np.arange(n),
        times_s=np.arange(n) / 12,
        source_size_px=(W, H),
        warnings=(),
    )


def test_what_comes_later_hides_nothing_now_but_an_arm_does():
    """A red block is pushed beside a blue one; at first an arm lies on the blue one's other side."""
    places = [block(60 + 100 * min(12, max(0, i - 6)) // 12, 100) for i in range(24)]
    stands, arm = block(200, 100), block(238, 100)
    frames = np.full((24, H, W, 3), 150, np.uint8)
    frames[:, stands] = 30, 40, 200
    for frame, spot in zip(frames, places, strict=True):
        frame[spot] = 200, 30, 30
    frames[:4, arm] = 220, 170, 140
    clip = filmed(frames)
    common = {"quality": np.ones(24), "at": 0, "known_m": None, "sure": 0.9, "why": ""}
    pushed = ObjectTrack(
        phrase="red block",
        role="manipulated",
        noun=noun_for("block"),
        masks=np.stack(places),
        moves=True,
        **common,
    )
    other = ObjectTrack(
        phrase="blue block",
        role="reference",
        noun=noun_for("block"),
        masks=np.stack([stands] * 24),
        moves=False,
        **common,
    )

    hidden = hidden_around(working_clip_of(clip), (pushed, other), stands, 0)

    assert hidden[arm].mean() > 0.2
    assert not hidden[block(160, 100)].any()


def outline_of(noun, size, x: float, y: float, above: float = 0.0) -> np.ndarray:
    """Return the outline of something upright, in camera heights."""
    camera = camera_above((H, W), PITCH, FOV)
    points = outline_points(noun.form, size, noun.taper) + np.array([x, y, above + size[2] / 2])
    hull = cv2.convexHull(camera.project(points).astype(np.float32))
    return cv2.fillConvexPoly(np.zeros((H, W), np.uint8), hull.round().astype(np.int32), 1) > 0


def resting(phrase: str, role: str, masks: np.ndarray, **given) -> ObjectTrack:
    common = {
        "quality": np.ones(len(masks)),
        "at": 0,
        "known_m": None,
        "sure": 0.9,
        "why": "",
        "moves": False,
    }
    return ObjectTrack(
        phrase=phrase, role=role, noun=noun_for(phrase), masks=masks, **(common | given)
    )


def test_a_pan_is_fitted_without_its_handle():
    pan = noun_for("frying pan")
    body = outline_of(pan, (0.4, 0.4, 0.08), 1.15, 0.1)
    rows, columns = np.nonzero(body)
    handle = np.zeros_like(body)
    middle = int(rows.mean())
    handle[middle - 3 : middle + 4, columns.max() - 4 : columns.max() + 60] = True
    hidden = np.zeros_like(body)

    kept, unknown = round_body(body | handle, hidden, pan)
    bowl, nothing = round_body(body | handle, hidden, noun_for("bowl"))

    assert (kept & body).sum() > 0.97 * body.sum()
    assert unknown[handle & ~body].mean() > 0.9
    assert (bowl == body | handle).all()
    assert not nothing.any()


def test_a_lid_that_is_taken_off_lay_on_what_it_covered():
    lid, pot = noun_for("pot lid"), noun_for("pot")
    size, under = (0.36, 0.36, 0.08), (0.34, 0.34, 0.2)
    there = (1.15, 0.3)
    first = outline_of(lid, size, *there, above=under[2])
    last = outline_of(lid, size, 1.1, -0.3)
    masks = np.stack([first] * 12 + [last] * 12)
    frames = np.full((24, H, W, 3), 150, np.uint8)
    frames[:12, first] = frames[12:, last] = 200, 30, 30
    below = outline_of(pot, under, *there)
    frames[12:, below] = 30, 40, 200
    stands = np.stack([below & ~first] * 12 + [below] * 12)
    objects = (
        resting("pot lid", "manipulated", masks, moves=True),
        resting("pot", "reference", stands, at=23),
    )
    guess = CameraGuess(pitch_rad=PITCH, pitch_sd_rad=0.02, fov_rad=FOV)

    shares = np.zeros((len(frames), len(CLASSES), H, W), np.float32)
    seen = Segmentation(
        idx=np.arange(len(frames)),
        shares=shares,
        early=shares[0],
        late=shares[-1],
        camera=SeenCamera(
            pitch_rad=PITCH,
            pitch_sd_rad=0.1,
            focal_widths=1.0,
            table_width_m=0.8,
            table_width_sd=0.2,
        ),
    )

    working = working_clip_of(filmed(frames))
    placed, other = place(working, objects, "uncover", guess, 10, seen).objects

    start, stop = placed.T_world_objs[0][:3, 3], placed.T_world_objs[-1][:3, 3]
    assert placed.lifted_off
    assert start[2] - stop[2] == pytest.approx(other.first.size[2], rel=0.01)
    assert start[:2] == pytest.approx(there, abs=0.06)
    assert stop[:2] == pytest.approx((1.1, -0.3), abs=0.06)
    assert placed.first.size == pytest.approx(size, rel=0.25)


def test_a_measured_height_says_as_much_of_lengths_as_is_known_of_pitch_and_focal_length():
    """A low camera with a long lens sees what a high one with a short lens does."""
    guess = CameraGuess(pitch_rad=np.pi / 4, pitch_sd_rad=0.1, fov_rad=1.0)

    height = with_measured_camera(guess, SceneConfig(camera_height_m=0.5))
    seen_too = with_measured_camera(guess, SceneConfig(camera_height_m=0.5, fov_rad=0.9))
    whole = with_measured_camera(
        guess, SceneConfig(camera_height_m=0.5, fov_rad=0.9, pitch_rad=0.7)
    )

    assert height.height_m == seen_too.height_m == whole.height_m == 0.5
    assert whole.height_sd == pytest.approx(0.02)
    assert seen_too.height_sd == pytest.approx(np.hypot(0.02, 0.1)), "at 45 degrees"
    assert height.height_sd > 1.5 * seen_too.height_sd
    assert (whole.fov_rad, whole.pitch_rad) == (0.9, 0.7)
    assert with_measured_camera(guess, SceneConfig()) == guess

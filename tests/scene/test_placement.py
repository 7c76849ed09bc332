from pathlib import Path

import cv2
import numpy as np
import pytest

from v2p_data.geometry.mesh import outline_points
from v2p_data.scene.classes import CLASSES, HAND
from v2p_data.scene.find import Watched
from v2p_data.scene.footage import footage_of
from v2p_data.scene.gate import held_at_first
from v2p_data.scene.nouns import noun_for
from v2p_data.scene.placement import CameraGuess, _hidden, place
from v2p_data.scene.pose import camera_above
from v2p_data.scene.scale import SeenCamera
from v2p_data.scene.sight import Sighting, Sights
from v2p_data.scene.table import find_table
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
        item="drawn", path=Path("drawn.mp4"), caption="", objects=(), hints={}, frames=frames, fps=12.0,
        total_frames=n, source_fps=12.0, source_frame=np.arange(n), times_s=np.arange(n) / 12,
        source_size_px=(W, H), warnings=(),
    )  # fmt: skip


def cup_at(x: float, y: float, above: float) -> np.ndarray:
    """Return the outline of a cup so far above the table, in camera heights."""
    camera = camera_above((H, W), PITCH, FOV)
    noun = noun_for("cup")
    points = outline_points(noun.form, tuple(2 * np.array(noun.size_m)), noun.taper)
    points = points + np.array([x, y, above + noun.size_m[2]])
    hull = cv2.convexHull(camera.project(points).astype(np.float32))
    return cv2.fillConvexPoly(np.zeros((H, W), np.uint8), hull.round().astype(np.int32), 1) > 0


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
    pushed = Sighting(
        phrase="red block", role="manipulated", noun=noun_for("block"), masks=np.stack(places), moves=True, **common
    )  # fmt: skip
    other = Sighting(
        phrase="blue block", role="reference", noun=noun_for("block"), masks=np.stack([stands] * 24), moves=False,
        **common,
    )  # fmt: skip

    hidden = _hidden(footage_of(clip), (pushed, other), stands, 0)

    assert hidden[arm].mean() > 0.2
    assert not hidden[block(160, 100)].any()


@pytest.mark.parametrize(
    ("above", "by_a_hand", "held"),
    [(0.3, True, True), (0.3, False, False), (0.0, True, False)],
)
def test_a_cup_that_a_hand_holds_in_the_air_at_first_is_told_from_one_that_stands(
    above: float, by_a_hand: bool, held: bool
):
    way = [cup_at(1.15, 0.25 - 0.5 * k / 23, above * (1 - k / 23)) for k in range(24)]
    frames = np.full((24, H, W, 3), 150, np.uint8)
    for frame, outline in zip(frames, way, strict=True):
        frame[outline] = 200, 30, 30
    footage = footage_of(filmed(frames))
    thing = Sighting(
        phrase="cup", role="manipulated", noun=noun_for("cup"), masks=np.stack(way), quality=np.ones(24), moves=True,
        at=0, known_m=None, sure=0.9, why="",
    )  # fmt: skip
    guess = CameraGuess(pitch_rad=PITCH, pitch_sd_rad=0.02, fov_rad=FOV)
    shares = np.zeros((24, len(CLASSES), H, W), np.float32)
    if by_a_hand:
        x = int(np.nonzero(way[0])[1].min())
        shares[:, HAND, :100, x - 20 : x] = 1
    watched = Watched(
        idx=np.arange(24), shares=shares, early=shares[0], late=shares[-1],
        camera=SeenCamera(
            pitch_rad=PITCH, pitch_sd_rad=0.1, focal_widths=1.0, table_width_m=0.8, table_width_sd=0.2
        ),
    )  # fmt: skip
    table = find_table(footage.always, np.ones((H, W), bool))
    sights = Sights(objects=(thing,), footage=footage, table=table, watched=watched, warnings=())

    placement = place(footage, (thing,), "place_onto", guess, 10)

    assert (placement.objects[0].grown > 0.2) == (above > 0)
    assert held_at_first(sights, placement) == held

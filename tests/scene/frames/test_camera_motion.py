"""How a camera moved, from the pictures alone."""

import cv2
import numpy as np
import pytest

from v2p_data.geometry.camera import between_centres
from v2p_data.scene.frames.camera_motion import camera_motion

SIZE = (320, 240)
SPOTS = np.array([[[40.0, 60.0], [280, 60], [280, 220], [40, 220], [160, 140]]])


def cloth(seed: int = 0) -> np.ndarray:
    """Return a picture of soft spots of all sizes, wider than a frame on all sides."""
    rng = np.random.default_rng(seed)
    noise = np.zeros((400, 480))
    for size in (1.5, 3.0, 8.0):
        noise += size * cv2.GaussianBlur(rng.normal(0, 1, noise.shape), (0, 0), size)
    return np.clip(128 + 40 * noise / noise.std(), 0, 255).astype(np.uint8)


def filmed(picture: np.ndarray, H: np.ndarray) -> np.ndarray:
    """Return a frame in which the first frame's pixel x is at H x; the first frame is the picture's middle."""
    middle = np.array([[1, 0, -80], [0, 1, -80], [0, 0, 1.0]])
    return cv2.warpPerspective(picture, between_centres(H @ middle), SIZE)


def ways(n: int, far_px: float, zoom: float = 0.0) -> list[np.ndarray]:
    out = []
    for t in np.linspace(0, 1, n):
        scale, angle = 1 + zoom * t, 0.03 * np.sin(3 * t)
        c, s = scale * np.cos(angle), scale * np.sin(angle)
        shift = far_px * np.sin(3 * t)
        out.append(np.array([[c, -s, shift], [s, c, 0.4 * shift], [2e-5 * t, 0, 1]]))
    return out


def errors(found: np.ndarray, true: list[np.ndarray]) -> np.ndarray:
    """Return how far spots are off, by frame [px]."""
    return np.array(
        [
            np.linalg.norm(
                cv2.perspectiveTransform(SPOTS, a) - cv2.perspectiveTransform(SPOTS, b), axis=-1
            ).max()
            for a, b in zip(found, true, strict=True)
        ]
    )


@pytest.mark.parametrize("zoom", [0.0, 0.1])
def test_sway_and_zoom_are_found_to_a_third_of_a_pixel(zoom: float):
    true = ways(20, 30.0, zoom)
    frames = [filmed(cloth(), H) for H in true]

    motion = camera_motion(frames)

    assert motion is not None
    assert errors(motion.to_frames, true).max() < 0.35
    assert motion.linked.all()
    assert motion.zoom(*SIZE) == pytest.approx(zoom, abs=0.02)


def test_a_large_thing_that_moves_by_itself_is_not_taken_for_the_camera():
    true = ways(20, 12.0)
    frames = [filmed(cloth(), H) for H in true]
    thing = cloth(1)[:110, :130]
    for i, frame in enumerate(frames):
        frame[100:210, 20 + 7 * i : 150 + 7 * i] = thing

    motion = camera_motion(frames)

    assert motion is not None
    assert errors(motion.to_frames, true).max() < 1.0


def test_a_camera_that_stands_has_no_motion_though_a_thing_moves():
    frames = [filmed(cloth(), np.eye(3)) for _ in range(12)]
    thing = cloth(1)[:110, :130]
    for i, frame in enumerate(frames):
        frame[100:210, 20 + 12 * i : 150 + 12 * i] = thing

    assert camera_motion(frames) is None


def test_a_blurred_frame_lies_between_its_neighbours():
    true = ways(20, 20.0)
    frames = [filmed(cloth(), H) for H in true]
    frames[9] = cv2.GaussianBlur(frames[9], (0, 0), 15)

    motion = camera_motion(frames)

    assert motion is not None
    assert not motion.linked[9]
    assert errors(motion.to_frames, true)[9] < 1.0


def test_plain_pictures_say_nothing():
    assert camera_motion([np.full(SIZE[::-1], 120, np.uint8)] * 10) is None

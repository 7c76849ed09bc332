"""A clip drawn with OpenCV: a coloured box on a plain table, a skin-coloured arm that moves it, known camera."""

from collections.abc import Callable
from pathlib import Path

import cv2
import numpy as np
import pytest

from v2p_data.geometry.mesh import outline_points
from v2p_data.scene.fitting.silhouette import camera_above
from v2p_data.scene.frames.classes import CLASSES, TABLE
from v2p_data.scene.frames.segmentation import Segmentation
from v2p_data.scene.frames.working_clip import WorkingClip, working_clip_of
from v2p_data.scene.scale.camera_height import SeenCamera
from v2p_data.video.clip import Clip

SIZE_M = (0.09, 0.07, 0.05)
HEIGHT_M = 0.5
START_XY = (0.72, -0.06)
"""From the point under the camera."""
FACES = [(0, 1, 3, 2), (4, 5, 7, 6), (0, 1, 5, 4), (2, 3, 7, 6), (1, 3, 7, 5)]


def make_clip(
    move_left_m: float = 0.16,
    lift_m: float = 0.0,
    caption: str = "Pushing blue box from right to left",
    objects: tuple[str, ...] = ("blue box",),
    shake_px: float = 0.0,
    hints: dict | None = None,
    num_frames: int = 36,
    with_hand: bool = True,
    comes_at: float = 0.0,
) -> Clip:
    camera = camera_above((240, 320), 0.61, 1.01, HEIGHT_M)
    rng = np.random.default_rng(0)
    grain = cv2.GaussianBlur(rng.normal(0, 40, (240, 320)), (0, 0), 2)[..., None]
    frames = []
    for i in range(num_frames):
        t = i / (num_frames - 1)
        share = float(np.clip((t - 0.35) / 0.3, 0, 1))
        x, y = START_XY[0], START_XY[1] + move_left_m * share
        image = np.full((240, 320, 3), (188, 182, 170), np.uint8)
        image = np.clip(image + grain, 0, 255).astype(np.uint8)
        centre = np.array([x, y, SIZE_M[2] / 2 + lift_m * share])
        corners = camera.project(outline_points("box", SIZE_M) + centre)
        order = sorted(range(5), key=lambda k: k == 4)
        for k, face in zip(order, [FACES[k] for k in order], strict=True) if t >= comes_at else ():
            shade = (0.75, 1.0, 0.85, 0.8, 1.1)[k]
            colour = tuple(min(255.0, shade * c) for c in (25, 60, 190))
            cv2.fillPoly(image, [corners[list(face)].astype(np.int32)], colour, cv2.LINE_AA)
        if with_hand and (0.15 < t < 0.85 or (lift_m and t > 0.15)):
            reach = min(1.0, (t - 0.15) / 0.2, (0.85 - t) / 0.2 if not lift_m else 1.0)
            hand = np.array([x, y - 0.06, centre[2]]) + (1 - reach) * np.array([0, -0.5, 0])
            tip = camera.project(hand[None])[0]
            for a, b, width, colour in (
                (tip + np.array([9, 2]), tip + np.array([150, 70]), 24, (60, 110, 90)),
                (tip, tip + np.array([60, 28]), 16, (205, 150, 125)),
            ):
                cv2.line(image, a.astype(int).tolist(), b.astype(int).tolist(), colour, width)
        if shake_px:
            shift = np.array([[1, 0, shake_px * t], [0, 1, 0.5 * shake_px * t]])
            image = cv2.warpAffine(image, shift, (320, 240), borderMode=cv2.BORDER_REPLICATE)
        frames.append(np.clip(image + rng.normal(0, 1, image.shape), 0, 255).astype(np.uint8))
    return _clip(np.stack(frames), caption, objects, hints)


def _clip(
    frames: np.ndarray,
    caption: str = "",
    objects: tuple[str, ...] = (),
    hints: dict | None = None,
) -> Clip:
    """Return frames, twelve a second, as if they had been read from a file of their size."""
    n, h, w = frames.shape[:3]
    return Clip(
        item="drawn",
        path=Path("drawn.mp4"),
        caption=caption,
        objects=objects,
        hints=hints or {},
        frames=frames,
        fps=12.0,
        total_frames=n,
        source_fps=12.0,
        source_frame=np.arange(n),
        times_s=np.arange(n) / 12.0,
        source_size_px=(w, h),
    )


@pytest.fixture(scope="session")
def draw() -> Callable[..., Clip]:
    return make_clip


PARTS_PX, PARTS_TABLE = (90, 120), (150, 140, 120)
"""(height, width) and table colour of what `segmentation_of` draws."""
type Parts = list[tuple[np.ndarray, tuple[int, int, int], int]]
"""Per thing in one frame its mask, colour and class, drawn in order."""


@pytest.fixture(scope="session")
def segmentation_of() -> Callable[[list[Parts]], tuple[WorkingClip, Segmentation]]:
    """Return what makes a working clip of coloured masks on a table, and what a network sees of it."""

    def make(parts_by_frame: list[Parts]) -> tuple[WorkingClip, Segmentation]:
        frames, planes = [], []
        for parts in parts_by_frame:
            image = np.full((*PARTS_PX, 3), PARTS_TABLE, np.uint8)
            label = np.full(PARTS_PX, TABLE)
            for mask, colour, what in parts:
                image[mask], label[mask] = colour, what
            frames.append(image)
            planes.append(0.02 + 0.9 * (label == np.arange(len(CLASSES))[:, None, None]))
        n, (h0, w0) = len(frames), PARTS_PX
        working = working_clip_of(_clip(np.stack(frames)))
        h, w = working.shape
        rows, columns = (np.arange(h) * h0) // h, (np.arange(w) * w0) // w
        large = np.stack(planes).astype(np.float32)[:, :, rows][..., columns]
        camera = SeenCamera(
            pitch_rad=0.6,
            pitch_sd_rad=0.1,
            focal_widths=0.9,
            table_width_m=0.9,
            table_width_sd=0.2,
        )
        return working, Segmentation(
            idx=np.arange(n), shares=large, early=large[0], late=large[-1], camera=camera
        )

    return make

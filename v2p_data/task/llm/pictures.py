"""What a model is shown of a scene: first and last frame, the overlay, a contact sheet.

Only files that lie in the scene's folder are read. Pictures are scaled down and sent as JPEG data URLs.
"""

import base64
import logging
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
from jaxtyping import UInt8

from v2p_data.scene.scene import Scene
from v2p_data.task.llm.calls import DATA_URL

logger = logging.getLogger(__name__)

STILLS = (
    ("frame_first.jpg", "the first frame of the video"),
    ("frame_last.jpg", "the last frame of the video"),
    ("overlay_first.png", "the first frame, with what was understood drawn over it"),
    ("overlay_last.png", "the last frame with the manipulated object, drawn over in the same way"),
)
FILM = "overlay.mp4"
COLUMNS = 3
QUALITY = 85


@dataclass(frozen=True, kw_only=True)
class Picture:
    """One picture and what it shows."""

    shows: str
    url: str
    """`data:image/jpeg;base64,...`"""


def scene_pictures(scene: Scene, side_px: int, sheet_frames: int) -> list[Picture]:
    """Return the pictures of a scene; none for a scene without a folder or without pictures in it.

    Args:
        scene: the scene, loaded from its folder.
        side_px: longer side of a still, and of two tiles of the contact sheet [px].
        sheet_frames: moments on the contact sheet.
    """
    if scene.folder == Path():
        return []
    found: list[Picture] = []
    for name, shows in STILLS:
        path = scene.folder / name
        image = cv2.imread(str(path)) if path.is_file() else None
        if image is not None:
            found.append(_picture(shows, _fitted(np.asarray(image, np.uint8), side_px)))
    frames = _film_frames(scene.folder / FILM, sheet_frames)
    if frames:
        shows = (
            f"{len(frames)} moments of the video, evenly spaced, row by row from top left to bottom right, "
            "drawn over in the same way"
        )
        found.append(_picture(shows, _sheet([_fitted(f, side_px // 2) for f in frames])))
    return found


def _film_frames(path: Path, count: int) -> list[UInt8[np.ndarray, "h w 3"]]:
    """Return `count` evenly spaced frames, the first and the last among them, in BGR."""
    if not path.is_file():
        return []
    film = cv2.VideoCapture(str(path))
    try:
        total = int(film.get(cv2.CAP_PROP_FRAME_COUNT))
        wanted = set(np.linspace(0, total - 1, min(count, total)).round().astype(int).tolist())
        frames: list[UInt8[np.ndarray, "h w 3"]] = []
        for i in range(total):
            is_good, frame = film.read()
            if not is_good:
                break
            if i in wanted:
                frames.append(np.asarray(frame, np.uint8))
    finally:
        film.release()
    if not frames:
        logger.warning("%s cannot be read; the model gets no contact sheet", path)
    return frames


def _fitted(image: UInt8[np.ndarray, "h w 3"], side_px: int) -> UInt8[np.ndarray, "h2 w2 3"]:
    """Scale down so that the longer side is at most `side_px`; nothing is scaled up."""
    h, w = image.shape[:2]
    scale = side_px / max(h, w)
    if scale >= 1:
        return image
    size = (max(1, round(w * scale)), max(1, round(h * scale)))
    return np.asarray(cv2.resize(image, size, interpolation=cv2.INTER_AREA), np.uint8)


def _sheet(tiles: list[UInt8[np.ndarray, "h w 3"]]) -> UInt8[np.ndarray, "h2 w2 3"]:
    h, w = tiles[0].shape[:2]
    columns = min(COLUMNS, len(tiles))
    rows = -(-len(tiles) // columns)
    sheet = np.zeros((rows * h, columns * w, 3), np.uint8)
    for i, tile in enumerate(tiles):
        r, c = divmod(i, columns)
        sheet[r * h : (r + 1) * h, c * w : (c + 1) * w] = tile
    return sheet


def _picture(shows: str, image: UInt8[np.ndarray, "h w 3"]) -> Picture:
    _, data = cv2.imencode(".jpg", image, [cv2.IMWRITE_JPEG_QUALITY, QUALITY])
    return Picture(shows=shows, url=DATA_URL + base64.b64encode(data.tobytes()).decode())

"""A picture of what a dataset shows: a row of moments for each task, masks in colours that eyes can tell apart."""

from contextlib import suppress
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from jaxtyping import UInt8

from v2p_data.episodes.dataset.features import MASK_KEY
from v2p_data.episodes.dataset.tables import camera_keys, episodes_of, video_path
from v2p_data.errors import V2PError
from v2p_data.sim.render.masks import rgb_to_labels

SHEET_FILE = "media/episodes.png"
MOMENTS, ROWS = 6, 8
TILE_PX, LABEL_PX, GAP_PX = 128, 22, 3
INK, PAPER = (40, 40, 40), 255
COLOURS = np.array(
    [[242, 242, 238], [70, 80, 95], [214, 94, 40], [40, 130, 180], [90, 160, 80],
     [190, 150, 40], [140, 90, 160], [200, 110, 150], [110, 190, 190]], np.uint8,
)  # fmt: skip
"""RGB of background, robot, manipulated object, and the others."""


def write_sheet(root: Path, info: dict[str, Any], about: dict[str, Any]) -> bool:
    """Draw `media/episodes.png` of the dataset at `root`.

    Returns:
        False where there is nothing to draw: no video, or none that can be decoded here.

    Raises:
        V2PError: it cannot be written.
    """
    cameras = camera_keys(info, "video")
    if not cameras:
        return False
    camera = MASK_KEY if MASK_KEY in cameras else cameras[0]
    rows = []
    for k, task in _one_of_each(about["episodes"]):
        pictures = _moments(root, info, camera, k)
        if pictures is None:
            continue
        shown = [COLOURS[rgb_to_labels(p)] if camera == MASK_KEY else p for p in pictures]
        rows.append(_row(task, shown))
    if not rows:
        return False
    _, png = cv2.imencode(".png", np.concatenate(rows)[..., ::-1])
    write_whole(root / SHEET_FILE, png.tobytes())
    return True


def write_whole(path: Path, content: bytes) -> None:
    """Write it beside its place and rename it, so that an older one stays where this fails.

    Raises:
        V2PError: the folder cannot be written to.
    """
    temporary = path.with_name(path.name + ".tmp")
    try:
        path.parent.mkdir(exist_ok=True)
        temporary.write_bytes(content)
        temporary.replace(path)
    except OSError as error:
        with suppress(OSError):
            temporary.unlink()
        raise V2PError(
            f"cannot write {path} ({error.strerror}); make room or make the folder writable, and run the same "
            "command again"
        ) from error


def _one_of_each(episodes: list[dict[str, Any]]) -> list[tuple[int, str]]:
    """Return the number of the first episode of each task, and the instruction."""
    first: dict[tuple[str, str], int] = {}
    for k, e in enumerate(episodes):
        first.setdefault((e["item"], e["task"]), k)
    return [(k, task) for (_, task), k in list(first.items())[:ROWS]]


def _moments(
    root: Path, info: dict[str, Any], camera: str, episode: int
) -> list[UInt8[np.ndarray, "h w 3"]] | None:
    """Return pictures (RGB) from the episode's first to its last frame."""
    row = episodes_of(root).slice(episode, 1).to_pylist()[0]
    path = video_path(
        info, camera, row[f"videos/{camera}/chunk_index"], row[f"videos/{camera}/file_index"]
    )
    first = round(row[f"videos/{camera}/from_timestamp"] * info["fps"])
    wanted = {int(t) for t in np.linspace(0, row["length"] - 1, MOMENTS).round()}
    video = cv2.VideoCapture(str(root / path))
    try:
        video.set(cv2.CAP_PROP_POS_FRAMES, first)
        pictures = []
        for t in range(row["length"]):
            if not video.grab():
                return None
            if t in wanted:
                is_read, picture = video.retrieve()
                if not is_read:
                    return None
                pictures.append(np.ascontiguousarray(picture[..., ::-1]))
    finally:
        video.release()
    return pictures


def _row(
    task: str, pictures: list[UInt8[np.ndarray, "h w 3"]]
) -> UInt8[np.ndarray, "tall wide 3"]:
    sheet = np.full((TILE_PX + LABEL_PX, MOMENTS * (TILE_PX + GAP_PX), 3), PAPER, np.uint8)
    for column, picture in enumerate(pictures):
        tile = cv2.resize(picture, (TILE_PX, TILE_PX), interpolation=cv2.INTER_AREA)
        sheet[LABEL_PX:, column * (TILE_PX + GAP_PX) :][:, :TILE_PX] = tile
    words = task.encode("ascii", "replace").decode()[:100]
    cv2.putText(sheet, words, (4, 15), cv2.FONT_HERSHEY_SIMPLEX, 0.45, INK, 1, cv2.LINE_AA)
    return sheet

"""Hints: what a person marked about an object, checked alone and against the picture that it was marked in."""

import json
from collections.abc import Callable, Iterator, Mapping
from typing import Any

import numpy as np
from jaxtyping import Int

from v2p_data.errors import V2PError
from v2p_data.video.checked import check_keys, numbers, type_of, words
from v2p_data.video.clip import Crop, Hint

MIN_SIZE_M = 0.002
"""Thinner than a coin is a slip of the unit, and nothing a simulator can hold."""
MAX_SIZE_M = 1.5
"""No object on a table is longer."""
MAX_NAME = 60
"""Letters; a longer name is a sentence."""
MARK_KEYS = ("box", "click", "frame", "points", "stroke")
"""What belongs to one frame and is replaced together."""
TABLE = "table"
"""The name under which a person marks the table itself, where no object is called so."""
MIN_CROP_PX = 64
"""Smaller pictures show too little."""
CROP = "crop"
"""The name under which a person says which part of the picture counts, where no object is called so."""

_KEYS = ("box", "click", "frame", "name", "points", "size_m", "stroke")
_LARGEST_FRACTION = 1.5
"""Pixels; marks that all lie this near to the corner are shares of the picture."""


def read_hint(hint: Any, where: str) -> Hint:
    """Return one hint, checked as far as it can be without the picture.

    Raises:
        V2PError: it cannot be used; the sentence begins with `where`.
    """
    if not isinstance(hint, dict):
        raise V2PError(f"{where}: must be an object, not a {type_of(hint)}")
    check_keys(hint, _KEYS, where)
    frame = hint.get("frame", 0)
    if not isinstance(frame, int) or isinstance(frame, bool) or frame < 0:
        raise V2PError(f"{where}: 'frame' must be a frame number from 0, not {frame!r}")
    checked = Hint(frame=frame)
    if "box" in hint:
        checked["box"] = _box(hint["box"], where)
    if "points" in hint:
        checked["points"] = _spots(hint["points"], "points", 1, where)
    if "click" in hint:
        checked["click"] = _spots([hint["click"]], "click", 1, where)[0]
    if "stroke" in hint:
        checked["stroke"] = _spots(hint["stroke"], "stroke", 2, where)
    if "size_m" in hint:
        size = numbers(hint["size_m"], 3, f"{where}: 'size_m' must be [length, width, height]")
        if not all(MIN_SIZE_M <= side <= MAX_SIZE_M for side in size):
            raise V2PError(
                f"{where}: 'size_m' is in metres, each from {MIN_SIZE_M} to {MAX_SIZE_M}, got {size}"
            )
        checked["size_m"] = size
    if "name" in hint:
        name = words(hint["name"], f"{where}: 'name'")
        if len(name) > MAX_NAME:
            raise V2PError(
                f"{where}: 'name' is the object's name in a word or two, at most {MAX_NAME} letters, "
                f"not {len(name)}"
            )
        checked["name"] = name
    if len(checked) == 1:
        raise V2PError(
            f"{where}: says nothing; give a box, a click, points, a stroke, size_m or name"
        )
    return checked


def read_crop(value: Any, where: str) -> Hint:
    """Return the part of the picture that a person said counts, as a box.

    Args:
        value: `[x, y, width, height]` in pixels of the file, or a hint with a box.
        where: what a sentence begins with.

    Raises:
        V2PError: it is neither.
    """
    if isinstance(value, dict):
        return read_hint(value, where)
    x, y, w, h = numbers(value, 4, f"{where}: must be [x, y, width, height]")
    if min(x, y) < 0 or min(w, h) < MIN_CROP_PX:
        raise V2PError(
            f"{where}: [x, y, width, height] begins inside of the picture and is {MIN_CROP_PX} px wide and high or "
            f"more, in pixels of the file, not {value}"
        )
    return Hint(frame=0, box=[x, y, x + w, y + h])


def check_hints(
    hints: Mapping[str, Hint], size_px: tuple[int, int], num_frames: int, where: str
) -> None:
    """Check marks against the picture they were made in.

    Args:
        hints: by object phrase, in the file's pixels and frame numbers.
        size_px: width and height of the picture as a player shows it.
        num_frames: frames that the file holds.
        where: what a sentence begins with, such as the file's name.

    Raises:
        V2PError: a mark lies outside of the picture, or in a frame that there is not.
    """
    width, height = size_px
    for name, hint in hints.items():
        frame = hint.get("frame", 0)
        if frame >= num_frames:
            raise V2PError(
                f"{where}, hint '{name}': there is no frame {frame}; the video's frames are 0 to {num_frames - 1}"
            )
        x0, y0, x1, y1 = hint.get("box", [0, 0, width, height])
        # a box drawn to the border may round to the pixel behind it
        if x1 > width + 1 or y1 > height + 1:
            raise V2PError(
                f"{where}, hint '{name}': the box {[x0, y0, x1, y1]} reaches outside of the picture, "
                f"which is {width} x {height} px; a box is x0, y0, x1, y1 in pixels of the video as a player shows it: "
                "neither x, y, width, height nor thousandths of the picture"
            )
        for x, y in marked_spots(hint):
            if not (0 <= x <= width and 0 <= y <= height):
                raise V2PError(
                    f"{where}, hint '{name}': the point {[x, y]} lies outside of the picture, "
                    f"which is {width} x {height} px"
                )


def marked_spots(hint: Hint) -> Iterator[list[float]]:
    """Yield all single pixels that a hint marks: points, click and stroke, `[x, y]` [px]."""
    yield from hint.get("points", [])
    if "click" in hint:
        yield hint["click"]
    yield from hint.get("stroke", [])


def hints_in_clip(
    hints: Mapping[str, Hint],
    clip_px: tuple[int, int],
    shown_px: tuple[int, int],
    source_frame: Int[np.ndarray, "time"],
) -> dict[str, Hint]:
    """Return a file's hints with the clip's frame numbers and pixels.

    Args:
        hints: by object phrase, in the file's pixels and frame numbers.
        clip_px: width and height of the clip's frames.
        shown_px: width and height of the file's picture as a player shows it.
        source_frame: the file's frame number behind each of the clip's.
    """
    sx, sy = clip_px[0] / shown_px[0], clip_px[1] / shown_px[1]
    moved: dict[str, Hint] = {}
    for name, hint in hints.items():
        moved[name] = with_spots(hint, lambda x, y: [x * sx, y * sy])
        moved[name]["frame"] = int(np.abs(source_frame - hint.get("frame", 0)).argmin())
    return moved


def with_spots(hint: Hint, moved: Callable[[float, float], list[float]]) -> Hint:
    """Return the hint with all its spots moved, a box by its corners."""
    there = hint.copy()
    if "box" in hint:
        x0, y0, x1, y1 = hint["box"]
        there["box"] = [*moved(x0, y0), *moved(x1, y1)]
    if "points" in hint:
        there["points"] = [moved(x, y) for x, y in hint["points"]]
    if "click" in hint:
        there["click"] = moved(*hint["click"])
    if "stroke" in hint:
        there["stroke"] = [moved(x, y) for x, y in hint["stroke"]]
    return there


def hints_in_crop(
    hints: Mapping[str, Hint],
    crop: Crop,
    in_file_px: tuple[float, float, float, float],
    where: str,
) -> dict[str, Hint]:
    """Return hints in the pixels of a cropped picture; what of a mark reaches beyond it is moved to its edge.

    Args:
        hints: by object phrase, in the pixels of the decoded pictures.
        crop: what is left of these.
        in_file_px: the same as x0, y0, x1, y1 in the file's pixels.
        where: what a sentence begins with, such as the file's name.

    Raises:
        V2PError: the middle of a mark lies outside of what is left.
    """
    x0, y0, x1, y1 = crop.box_px
    for phrase, hint in hints.items():
        a, b, c, d = hint.get("box", [0.0] * 4)
        middles = [((a + c) / 2, (b + d) / 2)] if "box" in hint else []
        if not all(x0 <= x <= x1 and y0 <= y <= y1 for x, y in (*middles, *marked_spots(hint))):
            left, top, right, bottom = (round(v) for v in in_file_px)
            raise V2PError(
                f"{where}, hint '{phrase}': the mark lies outside of the part of the picture that is used, x {left} to "
                f'{right} and y {top} to {bottom} px; marks are in pixels of the whole file, and "hints": '
                '{"crop": [x, y, width, height]} takes another part'
            )
    return {phrase: _in_crop(hint, crop) for phrase, hint in hints.items()}


def _in_crop(hint: Hint, crop: Crop) -> Hint:
    x0, y0, x1, y1 = crop.box_px

    def inside(x: float, y: float) -> list[float]:
        return [min(max(x - x0, 0.0), x1 - x0 - 1.0), min(max(y - y0, 0.0), y1 - y0 - 1.0)]

    there = with_spots(hint, inside)
    if "box" in hint:
        # A box ends behind its last pixel.
        a, b, c, d = hint["box"]
        there["box"] = [*inside(a, b), *(v + 1.0 for v in inside(c - 1, d - 1))]
    return there


def boxes_as_read(hints: Mapping[str, Hint], where: str) -> list[str]:
    """Return in words which box was read for each object: a wrong order of its numbers shows in the size."""
    return [
        f"{where} '{name}' {x1 - x0:g} x {y1 - y0:g} px at ({x0:g}, {y0:g})"
        for name, hint in hints.items()
        if "box" in hint
        for x0, y0, x1, y1 in [hint["box"]]
    ]


def _spots(value: Any, key: str, least: int, where: str) -> list[list[float]]:
    if not isinstance(value, list) or len(value) < least:
        some = "a list of [x, y]" if least == 1 else f"a list of {least} or more [x, y]"
        raise V2PError(f"{where}: '{key}' must be {some}, not {json.dumps(value)}")
    spots = [numbers(p, 2, f"{where}: a point must be [x, y]") for p in value]
    flat = [v for spot in spots for v in spot]
    if max(flat) <= _LARGEST_FRACTION and any(v % 1 for v in flat):
        raise V2PError(
            f"{where}: '{key}' look like fractions of the picture, got {value}; "
            "a point is [x, y] in pixels"
        )
    return spots


def _box(value: Any, where: str) -> list[float]:
    box = numbers(value, 4, f"{where}: 'box' must be [x0, y0, x1, y1]")
    x0, y0, x1, y1 = box
    if max(box) <= _LARGEST_FRACTION:
        raise V2PError(
            f"{where}: 'box' {box} looks like fractions of the picture; a box is x0, y0, x1, y1 in pixels"
        )
    if not (0 <= x0 < x1 and 0 <= y0 < y1):
        meant = [x0, y0, x0 + x1, y0 + y1]
        other = f"; if {box} is x, y, width, height, write {meant}" if min(box) >= 0 else ""
        raise V2PError(
            f"{where}: 'box' needs 0 <= x0 < x1 and 0 <= y0 < y1 in pixels, got {box}{other}"
        )
    return box

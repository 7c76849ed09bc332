"""A part of a clip's pictures is cut out: the one that a person names, or what is left beside black bars."""

from dataclasses import replace

import numpy as np

from v2p_data.errors import ItemRejectedError, V2PError
from v2p_data.video.clip import Clip, Crop
from v2p_data.video.hints import CROP, MIN_CROP_PX, hints_in_crop

Box = tuple[int, int, int, int]
"""x0, y0, x1, y1 [px of the clip's frames]."""


def cropped(clip: Clip, box: Box, note: str) -> Clip:
    """Return a part of the clip's pictures; hints go along, and `Clip.crop` says which part is left.

    Raises:
        ItemRejectedError: `bad_hint`: a mark lies outside of it.
    """
    x0, y0, x1, y1 = box
    if box == (0, 0, clip.width_px, clip.height_px):
        return replace(clip, warnings=(*clip.warnings, note))
    before = clip.crop or Crop(
        box_px=(0, 0, clip.width_px, clip.height_px), full_px=(clip.width_px, clip.height_px)
    )
    left, top = before.box_px[:2]
    crop = Crop(box_px=(left + x0, top + y0, left + x1, top + y1), full_px=before.full_px)
    here = Crop(box_px=box, full_px=(clip.width_px, clip.height_px))
    shown = replace(clip, crop=crop)
    try:
        hints = hints_in_crop(clip.hints, here, shown.in_file_px, clip.path.name)
    except V2PError as error:
        raise ItemRejectedError("bad_hint", str(error)) from error
    return replace(
        shown,
        frames=np.ascontiguousarray(clip.frames[:, y0:y1, x0:x1]),
        hints=hints,
        warnings=(*clip.warnings, note),
    )


def with_named_part(clip: Clip) -> Clip:
    """Return the part of the pictures that a person named; the clip as it is where nobody named one.

    Raises:
        ItemRejectedError: `bad_hint`: it is smaller than can be understood.
    """
    said = clip.hints.get(CROP, {}).get("box")
    if said is None or CROP in clip.objects:
        return clip
    x0, y0, x1, y1 = (round(v) for v in said)
    box = max(0, x0), max(0, y0), min(clip.width_px, x1), min(clip.height_px, y1)
    rest = replace(clip, hints={p: hint for p, hint in clip.hints.items() if p != CROP})
    if min(box[2] - box[0], box[3] - box[1]) < MIN_CROP_PX // 2:
        raise ItemRejectedError(
            "bad_hint",
            f"{clip.path.name}, hint 'crop': of the picture only {box[2] - box[0]} x "
            f"{box[3] - box[1]} px are left, at the "
            f"size at which it is read; {MIN_CROP_PX // 2} or more are needed",
        )
    return cropped(rest, box, f"the part {_in_words(rest, box)} was taken, as its hint says")


def _in_words(clip: Clip, box: Box) -> str:
    """Return a box as a hint names it: x, y, width, height in the file's pixels."""
    left, top, right, bottom = clip.in_file_px
    sx, sy = (right - left) / clip.width_px, (bottom - top) / clip.height_px
    x0, y0, x1, y1 = box
    return str(
        [round(left + x0 * sx), round(top + y0 * sy), round((x1 - x0) * sx), round((y1 - y0) * sy)]
    )

"""What a person marked in one frame: a box, a click, a stroke or points."""

from collections.abc import Sequence

import numpy as np
from jaxtyping import Bool

from v2p_data.errors import ItemRejectedError, V2PError
from v2p_data.scene.frames.mask_ops import bounding_box, from_points
from v2p_data.scene.frames.working_clip import WorkingClip
from v2p_data.scene.grounding.methods.base import Mark, Method, Seen, mark_in_box
from v2p_data.scene.grounding.model_outlines import outline_at_spots
from v2p_data.scene.grounding.spot_masks import mask_at_spots
from v2p_data.video.clip import Hint
from v2p_data.video.hints import TABLE

_SURE = 0.97


class Hints(Method):
    """The marks of a clip's hints."""

    def marks(self, seen: Seen, phrases: Sequence[str] = ()) -> dict[str, Mark]:
        """Return the mark of every hint that tells a place, whatever the phrases are."""
        hints = seen.clip.hints
        if TABLE not in seen.clip.objects:  # no object: `marked_table` reads it
            hints = {phrase: hint for phrase, hint in hints.items() if phrase != TABLE}
        marks = {phrase: _mark_of(seen, phrase, hint) for phrase, hint in hints.items()}
        return {phrase: mark for phrase, mark in marks.items() if mark is not None}


def _mark_of(seen: Seen, phrase: str, hint: Hint) -> Mark | None:
    frame = hint.get("frame", 0)
    if "box" in hint:
        return mark_in_box(seen, frame, hint["box"], _SURE)
    working, i = seen.working, seen.nearest(frame)
    spots = hint["stroke"] if "stroke" in hint else [hint["click"]] if "click" in hint else []
    if not spots and "points" in hint:
        return _outlined(from_points(working.rgb[i], _scaled(hint["points"], working)), i)
    if not spots:
        return None
    scaled = _scaled(spots, working)
    outlines = outline_at_spots(working, i, scaled)
    try:
        mask = mask_at_spots(working.rgb[i], scaled, seen.segmentation.at(i), outlines)
    except V2PError as error:
        detail = f"{seen.clip.path.name}, hint '{phrase}': {error}"
        raise ItemRejectedError("bad_hint", detail) from error
    return _outlined(mask, i)


def _scaled(spots: list[list[float]], working: WorkingClip) -> list[tuple[float, float]]:
    """Return spots in the clip's pixels at working size."""
    return [(x * working.px_scale, y * working.px_scale) for x, y in spots]


def _outlined(mask: Bool[np.ndarray, "h w"], i: int) -> Mark:
    x, y, w, h = bounding_box(mask)
    inside = np.zeros(mask.shape, bool)
    inside[y : y + h, x : x + w] = True
    return Mark(mask=mask, frame=i, sure=_SURE, box=inside)

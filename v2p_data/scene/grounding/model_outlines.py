"""Outlines by a model that knows edges of objects (`frames/outliner.py`), where it was asked for.

The scene network says where something moved or stands, and this model how far an object there reaches.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool

from v2p_data.scene.backends.outlines import Spots
from v2p_data.scene.backends.segment import points_inside
from v2p_data.scene.frames.mask_ops import bounding_box, inside_box, iou, largest
from v2p_data.scene.frames.working_clip import WorkingClip

_LEAST_IOU = 0.7
"""Overlap with a true outline, as the model estimates it, from which an outline is a candidate."""
_LEAST_PX, _MOST_SHARE = 30, 0.4
"""At working size, 320 px wide; and share of the picture."""
_SAME = 0.9
"""IoU from which two outlines are one."""
_POINTS = 4
"""Asked for each region; each by itself, so that they can be on different objects."""
_IN_BOX, _FILLS = 0.8, 0.2
"""Share of an outline inside of the drawn box, and of the box in the outline, from which it is what the box means."""
_ON_HAND = 0.3
"""Share of an outline on the hand, from which it is the hand's."""


@dataclass(frozen=True, kw_only=True)
class ModelOutline:
    """One outline at working size."""

    mask: Bool[np.ndarray, "h w"]
    iou: float
    """Overlap with a true outline, as the model estimates it."""


def outlines_around(
    working: WorkingClip,
    i: int,
    region: Bool[np.ndarray, "h w"],
    hand: Bool[np.ndarray, "h w"] | None = None,
) -> list[ModelOutline]:
    """Return what the model outlines in a region of working frame `i`, the surest first.

    Empty where no such model was asked for. What is on the `hand` is left out.
    """
    if working.outliner is None or not region.any():
        return []
    x, y, w, h = bounding_box(region)
    spots = [tuple(p) for p in points_inside(region, _POINTS)]
    asked = (
        [Spots(box_xyxy=(float(x), float(y), float(x + w), float(y + h)))],
        [Spots(on=(spot,)) for spot in spots],
    )
    found = list[ModelOutline]()
    for prompts in asked:
        seen = working.outliner.at(i, prompts)
        for mask, sure in zip(
            seen.masks.reshape(-1, *region.shape), seen.ious.ravel(), strict=True
        ):
            if sure < _LEAST_IOU or not _LEAST_PX <= mask.sum() <= _MOST_SHARE * mask.size:
                continue
            whole = largest(mask)
            if hand is not None and (whole & hand).sum() > _ON_HAND * whole.sum():
                continue
            found.append(ModelOutline(mask=whole, iou=float(sure)))
    found.sort(key=lambda one: -one.iou)
    kept = list[ModelOutline]()
    for one in found:
        if all(iou(one.mask, other.mask) < _SAME for other in kept):
            kept.append(one)
    return kept


def outline_in_box(
    working: WorkingClip, i: int, box_xyxy: tuple[float, float, float, float]
) -> Bool[np.ndarray, "h w"] | None:
    """Return the outline in a box that a person drew [working px].

    None where no model was asked for, or it sees none there.
    """
    if working.outliner is None:
        return None
    seen = working.outliner.at(i, [Spots(box_xyxy=box_xyxy)])
    best = int(seen.ious[0].argmax())
    mask = seen.masks[0, best]
    inside = inside_box(box_xyxy, working.shape)
    on_it = mask.any() and (mask & inside).sum() >= _IN_BOX * mask.sum()
    if not on_it or (mask & inside).sum() < _FILLS * inside.sum():
        return None
    return mask


def outline_at_spots(
    working: WorkingClip, i: int, spots: Sequence[tuple[float, float]]
) -> list[ModelOutline]:
    """Return what the model outlines at a clicked pixel or along a stroke [working px], the surest first.

    Empty without a model.
    """
    if working.outliner is None:
        return []
    seen = working.outliner.at(i, [Spots(on=tuple(spots))])
    found = [
        ModelOutline(mask=mask, iou=float(sure))
        for mask, sure in zip(seen.masks[0], seen.ious[0], strict=True)
        if mask.any()
    ]
    return sorted(found, key=lambda one: -one.iou)

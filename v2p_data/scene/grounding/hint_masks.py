"""What somebody marked in one frame - a box, a click, a stroke or points, a detector's box - becomes an outline there."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float

from v2p_data.errors import ItemRejectedError, V2PError
from v2p_data.scene.frames.classes import MOVED, OTHER
from v2p_data.scene.frames.colour import lab_distance
from v2p_data.scene.frames.mask_ops import (
    DRAWN_OFF_PX,
    bounding_box,
    ellipse_in,
    from_box,
    from_points,
    grow,
    inside_box,
    refine,
    spans,
)
from v2p_data.scene.frames.segmentation import Segmentation
from v2p_data.scene.frames.working_clip import WorkingClip
from v2p_data.scene.grounding.model_outlines import outline_at_spots, outline_in_box
from v2p_data.scene.grounding.outlines import filled, without_table
from v2p_data.scene.grounding.spot_masks import mask_at_spots
from v2p_data.video.clip import Clip
from v2p_data.video.hints import TABLE

_HINTED_SURE = 0.97
_ELSEWHERE_LAB = 12.0
"""Where a thing is, and where it is not, a picture differs by so much and more."""
_SMALL_PX, _FILLED = 1500, 0.85
"""At working size, 320 px wide: of smaller things the network, which sees them enlarged, knows more than their colours tell. People draw
boxes tightly: of a larger outline that spans less of its box a part is missing."""
_BESIDE_PX = 3
"""At working size, 320 px wide: so far beside a box an edge may lie. People are off by a pixel or two."""
_RAN_AWAY = 0.2
"""Of the box: an outline that agrees with it so much less than before went on into something alike beside it."""
_LEAST_SPAN = 0.55
"""Of a person's box: what has a face in the table's colours is outlined without it; then the box itself says more."""


@dataclass(frozen=True, kw_only=True)
class Box:
    """Where a detector sees a phrase."""

    frame: int
    """Of the clip."""
    box_xyxy: tuple[float, float, float, float]
    """[px] of the clip's frames."""
    score: float


@dataclass(frozen=True, kw_only=True)
class HintMask:
    """A mask that a user or a detector stands for."""

    mask: Bool[np.ndarray, "h w"]
    frame: int
    """Working frame."""
    sure: float
    box: Bool[np.ndarray, "h w"]
    """What was drawn, or the box around the mask."""

    def at_end(self, working: WorkingClip) -> bool:
        return self.frame > 0.5 * (len(working.rgb) - 1)

    def on_its_way(self, working: WorkingClip) -> bool:
        """Return whether what is marked is elsewhere at the nearer end of the clip: then the mark shows how it looks, not where it ends."""
        end = -1 if self.at_end(working) else 0
        off = lab_distance(working.lab[self.frame], working.lab[end])[self.mask]
        return bool(off.size and np.median(off) > _ELSEWHERE_LAB)


def hint_masks_of(
    clip: Clip, working: WorkingClip, segmentation: Segmentation | None, boxes: Mapping[str, Box]
) -> dict[str, HintMask]:
    """Return the masks that users' boxes, clicks, strokes and points mean, and detectors' boxes, by phrase.

    Raises:
        ItemRejectedError: `bad_hint`: a click or a stroke is on no object.
    """
    out = {}
    for phrase, box in boxes.items():
        i = int(np.abs(working.frame_idx - box.frame).argmin())
        out[phrase] = _boxed(working, segmentation, i, box.box_xyxy, box.score)
    for phrase, hint in clip.hints.items():
        if phrase == TABLE and phrase not in clip.objects:
            continue  # no object: `marked_table` reads it
        i = int(np.abs(working.frame_idx - hint.get("frame", 0)).argmin())
        if "box" in hint:
            out[phrase] = _boxed(working, segmentation, i, hint["box"], _HINTED_SURE)
        elif "stroke" in hint or "click" in hint:
            spots = (
                hint["stroke"] if "stroke" in hint else [hint["click"]] if "click" in hint else []
            )
            shares = None if segmentation is None else segmentation.at(i)
            scaled = _scaled(spots, working)
            outlines = outline_at_spots(working, i, scaled)
            try:
                mask = mask_at_spots(working.rgb[i], scaled, shares, outlines)
            except V2PError as error:
                detail = f"{clip.path.name}, hint '{phrase}': {error}"
                raise ItemRejectedError("bad_hint", detail) from error
            out[phrase] = _outlined(mask, i)
        elif "points" in hint:
            out[phrase] = _outlined(
                from_points(working.rgb[i], _scaled(hint["points"], working)), i
            )
    return out


def _scaled(spots: list[list[float]], working: WorkingClip) -> list[tuple[float, float]]:
    """Return spots in the clip's pixels at working size."""
    return [(x * working.px_scale, y * working.px_scale) for x, y in spots]


def _outlined(mask: Bool[np.ndarray, "h w"], i: int) -> HintMask:
    x, y, w, h = bounding_box(mask)
    inside = np.zeros(mask.shape, bool)
    inside[y : y + h, x : x + w] = True
    return HintMask(mask=mask, frame=i, sure=_HINTED_SURE, box=inside)


def _boxed(
    working: WorkingClip,
    segmentation: Segmentation | None,
    i: int,
    box_xyxy: Sequence[float],
    sure: float,
) -> HintMask:
    """Return what a box in the clip's pixels means at working frame `i`."""
    x0, y0, x1, y1 = (v * working.px_scale for v in box_xyxy)
    box = (x0, y0, x1, y1)
    outlined = outline_in_box(working, i, box)
    if outlined is not None:
        return HintMask(mask=outlined, frame=i, sure=sure, box=inside_box(box, working.shape))
    mask = from_box(working.rgb[i], box, _thing_at(segmentation, i))
    inside = inside_box(box, working.shape)
    drawn = (max(0, round(x0)), max(0, round(y0)), round(x1), round(y1))
    if segmentation is not None:
        if mask.sum() < _SMALL_PX or spans(mask, drawn) < _FILLED:
            mask = filled(mask, segmentation.at(i), grow(inside, DRAWN_OFF_PX))
        mask = without_table(mask, segmentation.at(i))
    beside = refine(working.rgb[i], mask, never=~grow(inside, _BESIDE_PX))
    if spans(beside, drawn) > spans(mask, drawn) - _RAN_AWAY:
        mask = beside
    if segmentation is not None and spans(mask, drawn) < _LEAST_SPAN:
        mask = ellipse_in(drawn, working.shape)
    return HintMask(mask=mask, frame=i, sure=sure, box=inside)


def _thing_at(segmentation: Segmentation | None, i: int) -> Float[np.ndarray, "h w"] | None:
    if segmentation is None:
        return None
    shares = segmentation.at(i)
    return shares[MOVED] + shares[OTHER]

"""What every method of finding objects has in common: it marks in one frame what a phrase means."""

from abc import ABC, abstractmethod
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool

from v2p_data.scene.frames.classes import MOVED, OTHER
from v2p_data.scene.frames.colour import lab_distance
from v2p_data.scene.frames.mask_ops import (
    DRAWN_OFF_PX,
    ellipse_in,
    from_box,
    grow,
    inside_box,
    refine,
    spans,
)
from v2p_data.scene.frames.segmentation import Segmentation
from v2p_data.scene.frames.working_clip import WorkingClip
from v2p_data.scene.grounding.model_outlines import outline_in_box
from v2p_data.scene.grounding.outlines import filled, without_table
from v2p_data.video.clip import Clip

_ELSEWHERE_LAB = 12.0
"""Where a thing is, and where it is not, a picture differs by so much and more."""
_SMALL_PX, _FILLED = 1500, 0.85
"""At working size, 320 px wide: of smaller things the network, which sees them enlarged, knows more
than their colours tell. People draw boxes tightly: of a larger outline that spans less of its box a
part is missing."""
_BESIDE_PX = 3
"""At working size, 320 px wide: so far beside a box an edge may lie. People are off by a pixel or two."""
_RAN_AWAY = 0.2
"""Of the box: an outline that agrees with it so much less than before went on into something alike beside it."""
_LEAST_SPAN = 0.55
"""Of a person's box: what has a face in the table's colours is outlined without it; then the box itself says more."""


@dataclass(frozen=True, kw_only=True)
class Seen:
    """What a method looks at."""

    clip: Clip
    working: WorkingClip
    segmentation: Segmentation

    def nearest(self, frame: int) -> int:
        """Return the working frame nearest to a frame of the clip."""
        return int(np.abs(self.working.frame_idx - frame).argmin())


@dataclass(frozen=True, kw_only=True)
class Mark:
    """Where an object is in one frame."""

    mask: Bool[np.ndarray, "h w"]
    frame: int
    """Working frame."""
    sure: float
    box: Bool[np.ndarray, "h w"]
    """What was drawn, or the box around the mask."""

    def at_end(self, working: WorkingClip) -> bool:
        return self.frame > 0.5 * (len(working.rgb) - 1)

    def on_its_way(self, working: WorkingClip) -> bool:
        """Return whether the object is elsewhere at the nearer end of the clip: then the mark only shows its look."""
        end = -1 if self.at_end(working) else 0
        off = lab_distance(working.lab[self.frame], working.lab[end])[self.mask]
        return bool(off.size and np.median(off) > _ELSEWHERE_LAB)


class Method(ABC):
    """Says where objects of a caption are."""

    @abstractmethod
    def marks(self, seen: Seen, phrases: Sequence[str]) -> dict[str, Mark]:
        """Return the marks of the phrases that it finds.

        Raises:
            ItemRejectedError: `bad_hint`: a click or a stroke is on no object.
        """


def mark_in_box(seen: Seen, frame: int, box_xyxy: Sequence[float], sure: float) -> Mark:
    """Return what a box in a frame of the clip means, in its pixels."""
    working, i = seen.working, seen.nearest(frame)
    x0, y0, x1, y1 = (v * working.px_scale for v in box_xyxy)
    box = (x0, y0, x1, y1)
    inside = inside_box(box, working.shape)
    outlined = outline_in_box(working, i, box)
    if outlined is not None:
        return Mark(mask=outlined, frame=i, sure=sure, box=inside)
    shares = seen.segmentation.at(i)
    mask = from_box(working.rgb[i], box, shares[MOVED] + shares[OTHER])
    drawn = (max(0, round(x0)), max(0, round(y0)), round(x1), round(y1))
    if mask.sum() < _SMALL_PX or spans(mask, drawn) < _FILLED:
        mask = filled(mask, shares, grow(inside, DRAWN_OFF_PX))
    mask = without_table(mask, shares)
    beside = refine(working.rgb[i], mask, never=~grow(inside, _BESIDE_PX))
    if spans(beside, drawn) > spans(mask, drawn) - _RAN_AWAY:
        mask = beside
    if spans(mask, drawn) < _LEAST_SPAN:
        mask = ellipse_in(drawn, working.shape)
    return Mark(mask=mask, frame=i, sure=sure, box=inside)

"""An object that a hand brings: it is not on the table when the clip begins, and rests where the hand leaves it.

Such a clip is seen backwards in time: there the object lies on the table first and is then carried
off, as the network knows it. What it sees is turned back before anything follows from it.
"""

from dataclasses import replace

import cv2
import numpy as np
from jaxtyping import Bool

from v2p_data.errors import ItemRejectedError
from v2p_data.scene.data_types import ObjectTrack
from v2p_data.scene.frames.classes import MOVED
from v2p_data.scene.frames.colour import (
    histogram,
    lab_distance,
    lab_of,
    shadow,
    similarity,
)
from v2p_data.scene.frames.mask_ops import grow, solidity, tidy
from v2p_data.scene.frames.segmentation import Segmentation, hand_at, segment_clip
from v2p_data.scene.frames.working_clip import WorkingClip
from v2p_data.scene.grounding.candidates import Moved
from v2p_data.scene.grounding.methods.base import Mark
from v2p_data.scene.grounding.moved_by_network import find_brought_by_network
from v2p_data.scene.grounding.tracking import carried
from v2p_data.video.clip import Clip

_PASSED_LAB, _TOUCH_PX = 12, 5
"""Distance in Lab between the first frame and the last still, from which a pixel shows something
else; and distance in a picture 320 px wide, within which a hand holds something."""
_AS_LARGE, _AS_COLOURED, _SOLID = 0.3, 0.65, 0.6
"""Share of the object's outline, similarity of colours, and share of its convex hull that it fills,
from which what is seen elsewhere is the object itself. Edges of a person who sways fill less."""


def seen_backwards(clip: Clip, working: WorkingClip) -> Segmentation:
    """Return what the network sees in the clip when it runs backwards, in the order of the clip."""
    n = len(working.rgb)
    backwards = replace(
        working,
        rgb=working.rgb[::-1],
        lab=working.lab[::-1],
        frame_idx=len(clip.frames) - 1 - working.frame_idx[::-1],
        early=working.late,
        late=working.early,
    )
    seen = segment_clip(replace(clip, frames=clip.frames[::-1]), backwards)
    return replace(
        seen,
        idx=n - 1 - seen.idx[::-1],
        shares=np.ascontiguousarray(seen.shares[::-1]),
        early=seen.late,
        late=seen.early,
    )


def find_brought(
    working: WorkingClip, segmentation: Segmentation, phrase: str, mark: Mark | None
) -> Moved:
    """Return the object where the hand leaves it, its first outline being empty.

    Raises:
        ItemRejectedError: `object_not_found`, where nothing came to rest, or what did lay
            elsewhere in the picture before.
    """
    moved = find_brought_by_network(working, segmentation, phrase, mark and mark.mask)
    if (
        moved is None
        or (mark is not None and not mark.at_end(working))
        or _lay_elsewhere(working, segmentation, moved.last)
    ):
        raise ItemRejectedError("object_not_found", f"no hand brings '{phrase}'", None)
    return moved


def _lay_elsewhere(
    working: WorkingClip, segmentation: Segmentation, last: Bool[np.ndarray, "h w"]
) -> bool:
    """Return whether the first frame shows something like the object at another place, in no hand."""
    hand, here, bare = hand_at(segmentation, 0), working.lab[0], lab_of(working.late)
    gone = (lab_distance(here, bare) > _PASSED_LAB) & ~hand
    gone &= ~(shadow(here, bare) | shadow(bare, here))
    colours = histogram(working.late[last])
    for changed in (segmentation.at(0)[MOVED] > 0.5, gone):
        count, parts = cv2.connectedComponents(tidy(changed & ~grow(last, 3)).astype(np.uint8))
        for place in (parts == k for k in range(1, count)):
            as_large = _AS_LARGE < place.sum() / last.sum() < 1 / _AS_LARGE
            alike = similarity(histogram(working.rgb[0][place]), colours) > _AS_COLOURED
            held = (grow(place, _TOUCH_PX) & hand).any()
            if as_large and alike and not held and solidity(place) > _SOLID:
                return True
    return False


def tracked_back(
    thing: ObjectTrack,
    working: WorkingClip,
    segmentation: Segmentation,
    moved: Moved,
    every: int,
) -> ObjectTrack:
    """Return what was brought, followed from its last outline back into the hand as far as it is seen.

    The track agrees as far as what the network sees move on its way there has the object's look.
    """
    end = len(working.rgb) - 1
    tracked = carried(
        working, moved.last, end, every=every, moving=lambda i: segmentation.at(i)[MOVED]
    )
    arrived = grow(moved.last, 3)
    on_its_way = [
        similarity(histogram(working.rgb[i][seen]), moved.colour_hist)
        for i in segmentation.idx.tolist()
        if (seen := (segmentation.at(i)[MOVED] > 0.5) & ~arrived).sum()
        > _AS_LARGE * moved.last.sum()
    ]
    return replace(
        thing,
        masks=tracked.masks,
        quality=tracked.quality,
        agreement=max(on_its_way, default=0.0),
        moves=True,
        at=end,
        brought=True,
    )

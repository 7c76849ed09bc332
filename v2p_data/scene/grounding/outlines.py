"""Outlines are corrected by the scene network: table is cut off, missing parts are added, both ends are parted."""

from collections.abc import Sequence
from dataclasses import replace

import cv2
import numpy as np
from jaxtyping import Bool, Float32, UInt8

from v2p_data.scene.frames.classes import MOVED, OTHER, TABLE
from v2p_data.scene.frames.colour import histogram, likelihood
from v2p_data.scene.frames.mask_ops import grow, largest, tidy
from v2p_data.scene.frames.working_clip import WorkingClip
from v2p_data.scene.grounding.candidates import Moved

_AROUND_PX = 10
"""Width of the ring around both outlines whose colours stand for the background, in a picture 320 px wide."""
_LEAST_OWN = 0.25
"""Share of an outline outside the other outline, from which its colours tell how the object looks."""
_LEAST_WRONG = 0.1
"""Share of an outline below which a wrong part is not cut off."""
_LEAST_LEFT = 0.3
"""Share of an outline that must remain after a cut."""
_BARE_RATIO = 1.0
"""Log likelihood ratio of background over object colours, from which a pixel is background."""
_SURELY = 0.9
"""Probability from which the network adds a pixel to an outline, whatever the edges say: they may belong to print."""
_SURELY_TABLE = 0.8
"""Probability from which the network cuts a pixel off as table, whatever the edges say: they may belong to a shadow."""
_BESIDE_PX = 12
"""Reach beside an outline within which the network completes it, in a picture 320 px wide."""
_MOST_CUT = 0.6
"""Share of an outline that may be cut off as table; where more seems table, the network does not know the object."""
_LEAST_CHANGE = 0.05
"""Share of an outline below which a change is noise of the edge."""


def disjoint_ends(working: WorkingClip, moved: Moved, keep: Sequence[int] = ()) -> Moved:
    """Return both outlines, each without the other's place: the picture changes at both places.

    A pixel in both outlines is background in a picture where it has the colours of the ring around
    both outlines. The rest of the outline is compared; where hardly anything is left of it, the
    other picture.

    Args:
        working: frames.
        moved: both outlines.
        keep: 0 for a first one, 1 for a last one that is taken as it is.
    """
    masks, images = [moved.first, moved.last], [working.rgb[0], working.rgb[-1]]
    both, either = masks[0] & masks[1], masks[0] | masks[1]
    if not both.any():
        return moved
    around = grow(either, _AROUND_PX) & ~grow(either, 2)
    bare = [_log_likelihood(image, around) for image in images]
    for k, image in enumerate(images):
        if k in keep:
            continue
        own, area = masks[k] & ~both, masks[k].sum()
        tells = own.sum() > _LEAST_OWN * area
        ratio = bare[k] - (_log_likelihood(image, own) if tells else bare[1 - k])
        least = _BARE_RATIO if tells else 2 * _BARE_RATIO
        wrong = both & (cv2.GaussianBlur(ratio, (0, 0), 2) > least)
        rest = largest(tidy(masks[k] & ~wrong))
        if wrong.sum() > _LEAST_WRONG * area and rest.sum() > _LEAST_LEFT * area:
            masks[k] = rest
    first, last = masks
    return replace(moved, first=first, last=last, colour_hist=histogram(images[0][first]))


def without_shadow(
    mask: Bool[np.ndarray, "h w"], shares: Float32[np.ndarray, "5 h w"]
) -> Bool[np.ndarray, "h w"]:
    """Return a moved thing's outline completed, without what the network surely sees as table: shadows.

    Args:
        mask: the outline.
        shares: what the network sees in the picture that it was drawn in.
    """
    return _if_worth(completed(_off_sure_table(mask, shares), shares[MOVED]), mask)


def without_table(
    mask: Bool[np.ndarray, "h w"], shares: Float32[np.ndarray, "5 h w"]
) -> Bool[np.ndarray, "h w"]:
    """Return the outline without what to the network surely is bare table.

    `shares` is what it sees in the same picture.

    It may leave several parts: the root of a handle is easily taken for table.
    """
    kept = _off_sure_table(mask, shares)
    if _if_worth(kept, mask) is mask:
        return mask
    rest = tidy(kept)
    _, parts, stats, _ = cv2.connectedComponentsWithStats(rest.astype(np.uint8))
    large = np.flatnonzero(stats[:, cv2.CC_STAT_AREA] > _LEAST_CHANGE * rest.sum())
    rest &= np.isin(parts, large)
    # What is thin is gone when it is tidied.
    return rest if rest.sum() >= (1 - _MOST_CUT) * kept.sum() else kept


def _off_sure_table(
    mask: Bool[np.ndarray, "h w"], shares: Float32[np.ndarray, "5 h w"]
) -> Bool[np.ndarray, "h w"]:
    kept = mask & ~(shares[TABLE] > _SURELY_TABLE)
    return kept if kept.sum() >= (1 - _MOST_CUT) * mask.sum() else mask


def completed(
    mask: Bool[np.ndarray, "h w"], thing: Float32[np.ndarray, "h w"]
) -> Bool[np.ndarray, "h w"]:
    """Return an outline with what adjoins it and surely belongs to a thing; `thing` is how likely each pixel does."""
    whole = tidy(mask | ((thing > _SURELY) & grow(mask, _BESIDE_PX)))
    return _if_worth(largest(whole), mask) if whole.any() else mask


def filled(
    mask: Bool[np.ndarray, "h w"],
    shares: Float32[np.ndarray, "5 h w"],
    inside: Bool[np.ndarray, "h w"],
) -> Bool[np.ndarray, "h w"]:
    """Return an outline completed `inside` of the box that somebody drew around it.

    Only by what is seen as the same kind, moved or not: a moving object may hide a static one.
    """
    own = max((MOVED, OTHER), key=lambda what: float(shares[what][mask].mean()))
    return completed(mask, np.where(inside, shares[own], 0))


def _if_worth(
    new: Bool[np.ndarray, "h w"], mask: Bool[np.ndarray, "h w"]
) -> Bool[np.ndarray, "h w"]:
    """Return the new outline where it is another one, the old one where they differ by no more than an edge's noise."""
    return new if (new ^ mask).sum() > _LEAST_CHANGE * mask.sum() else mask


def _log_likelihood(
    image: UInt8[np.ndarray, "h w 3"], region: Bool[np.ndarray, "h w"]
) -> Float32[np.ndarray, "h w"]:
    """Return how likely each pixel's colour is in a region of the same picture."""
    return np.log(likelihood(histogram(image[region]), image) + 1e-6).astype(np.float32)

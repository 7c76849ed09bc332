"""An outline is carried on from frame to frame: by optical flow, by its colours, and by what the network sees move."""

from collections.abc import Callable
from dataclasses import dataclass

import cv2
import numpy as np
from jaxtyping import Bool, Float, Float32, UInt8

from v2p_data.scene.frames.colour import histogram, lab_distance, likelihood, similarity
from v2p_data.scene.frames.flow import flow_to
from v2p_data.scene.frames.mask_ops import bounding_box, convex_hull, grow, tidy
from v2p_data.scene.frames.working_clip import WorkingClip


@dataclass(frozen=True, kw_only=True)
class TrackConfig:
    """When a mask that is carried on shows the object, and what each piece of evidence weighs.

    All were set by hand on drawn clips of the tuning half and on the real clips of `docs/lab/reconstruction.md`.
    """

    same_lab: float = 6.0
    """Distance in Lab below which a smoothed pixel looks as before: noise and compression stay below."""
    lost: float = 0.4
    """Likeness, 0 to 1, below which a mask followed from one frame alone no longer shows the object."""
    rests: float = 0.4
    """Share of the first outline that must look as before while the object has not left."""
    shrunk: float = 1.25
    """Factor by which the resting part must exceed the carried mask to replace it: smaller gains
    are corrections of the outline."""
    surely_bare: float = 0.8
    """Probability of bare table, mean over a mask, above which the mask shows no object that the network knows."""
    moves: float = 0.5
    """Probability of a moving object, mean over both end outlines, from which the network can contradict a mask."""
    unseen: float = 0.05
    """Share of a mask's area that the network must see move around it; with less it contradicts the mask."""
    near: float = 0.3
    """Reach around a mask, in object extents, in which that motion counts: the network did not look at every frame."""
    hand_ratio: float = 3.0
    """Log likelihood ratio of hand over object colours above which a pixel of the last outline is hand."""
    bare: float = 0.4
    """Share of a mask that looks like the still without the object, above which the mask is background."""
    differs: float = 0.2
    """Share of the object that may look like the table under it, for `bare` to tell anything."""
    mostly: float = 0.4
    """Share of an outline that must remain without the hand."""
    little: float = 0.05
    """Share of an outline below which a hand is not cut off: as much is noise of the edge."""
    rejoin: float = 0.45
    """Share of the first area below which a carried mask is searched for anew."""
    least_px: int = 15
    """Area [px] below which a mask shows nothing."""
    far_cost: float = 0.15
    """Likeness that a mask loses over the whole clip's distance from the end it was carried from."""


CONFIG = TrackConfig()
Moving = Callable[[int], Float[np.ndarray, "h w"]]
"""Returns per working frame the probability, 0 to 1, of each pixel."""


def follow(
    working: WorkingClip,
    steps: list[int],
    start: Bool[np.ndarray, "h w"],
    colour_hist: Float[np.ndarray, "l a b"],
    anchor: int,
    moving: Moving | None,
    *,
    may_rest: bool = False,
) -> list[Bool[np.ndarray, "h w"]]:
    """Return the mask in these frames, the first of them the `anchor`.

    With `may_rest`, what of the start looks as it did belongs to the mask while most of it does:
    the object lies there still.
    """
    follower = _Follower(working, start, colour_hist, anchor, moving, may_rest=may_rest)
    return [start, *(follower.step(i) for i in steps[1:])]


class _Follower:
    """Carries one outline from frame to frame."""

    def __init__(
        self,
        working: WorkingClip,
        start: Bool[np.ndarray, "h w"],
        colour_hist: Float[np.ndarray, "l a b"],
        anchor: int,
        moving: Moving | None,
        *,
        may_rest: bool,
    ) -> None:
        h, w = working.shape
        self._working, self._start, self._hist, self._moving = working, start, colour_hist, moving
        self._may_rest = may_rest
        self._y, self._x = np.mgrid[:h, :w].astype(np.float32)
        self._before = smoothed(working.lab[anchor])
        self._home, self._area = grow(start, 2), int(start.sum())
        x, y, bw, bh = bounding_box(grow(start, 4))
        self._there = slice(y, y + bh), slice(x, x + bw)
        self._mask = start
        self._grey = cv2.cvtColor(working.rgb[anchor], cv2.COLOR_RGB2GRAY)

    def step(self, i: int) -> Bool[np.ndarray, "h w"]:
        """Return the mask in the next frame."""
        now = cv2.cvtColor(self._working.rgb[i], cv2.COLOR_RGB2GRAY)
        window = self._window()
        prior = self._carried(now, window)
        mask = self._cut(i, prior, window)
        if self._may_rest and CONFIG.shrunk * mask.sum() < self._area:
            mask = self._with_resting_part(i, mask)
        if mask.sum() < CONFIG.rejoin * self._area:
            mask = self._found_again(i, mask)
        if mask.sum() < CONFIG.least_px:
            mask = self._mask
        self._mask, self._grey = mask, now
        return mask

    def _window(self) -> tuple[slice, slice]:
        """Return rows and columns around the last mask."""
        h, w = self._working.shape
        x, y, bw, bh = bounding_box(self._mask)
        reach = int(max(24, 0.8 * max(bw, bh)))
        rows = slice(max(0, y - reach), min(h, y + bh + reach))
        return rows, slice(max(0, x - reach), min(w, x + bw + reach))

    def _carried(
        self, now: UInt8[np.ndarray, "h w"], window: tuple[slice, slice]
    ) -> Float32[np.ndarray, "i j"]:
        """Return how likely each pixel is the object by its place: the last mask carried by optical flow, blurred."""
        back = flow_to(now[window], self._grey[window])
        ch, cw = back.shape[:2]
        carried = cv2.remap(
            self._mask[window].astype(np.float32),
            self._x[:ch, :cw] + back[..., 0],
            self._y[:ch, :cw] + back[..., 1],
            cv2.INTER_LINEAR,
        )
        return np.asarray(cv2.GaussianBlur(carried, (0, 0), 2))

    def _cut(
        self, i: int, prior: Float32[np.ndarray, "i j"], window: tuple[slice, slice]
    ) -> Bool[np.ndarray, "h w"]:
        """Return the pixels that colour, place and the network take for the object, in pieces that are not small."""
        working, area = self._working, self._area
        vote = cv2.GaussianBlur(self._votes(i, prior, window).astype(np.float32), (0, 0), 1)
        smooth = smoothed(working.lab[i][window])
        still = lab_distance(smooth, self._before[window]) < CONFIG.same_lab
        floor = 0.03 if self._mask.sum() < 1.3 * area else 0.3
        allowed = (prior > floor) & ~(still & ~self._home[window])
        found = tidy((vote > 0) & allowed, 2 * int(0.1 * np.sqrt(area)) + 1)
        # The shapes we fit are convex: a gap within the hull that the flow carried along is print, not background.
        found |= convex_hull(found) & (prior > 0.5) & allowed
        count, parts, stats, _ = cv2.connectedComponentsWithStats(found.astype(np.uint8))
        mask = np.zeros(working.shape, bool)
        if count > 1:
            big = stats[1:, 4] > 0.15 * stats[1:, 4].max()
            mask[window] = np.isin(parts, 1 + np.flatnonzero(big))
        else:
            mask[window] = prior > 0.5
        return mask

    def _votes(
        self, i: int, prior: Float32[np.ndarray, "i j"], window: tuple[slice, slice]
    ) -> Float[np.ndarray, "i j"]:
        """Return per pixel what speaks for the object (above 0) or against it."""
        working = self._working
        part = working.rgb[i][window]
        around = part[prior < 0.05]
        local = histogram(around) if len(around) > 100 else working.rest_hist
        others = np.maximum(likelihood(local, part), likelihood(working.hand_hist, part))
        others = np.maximum(others, 0.7 * likelihood(working.rest_hist, part))
        ratio = np.log(likelihood(self._hist, part) + 1e-6) - np.log(others + 1e-6)
        if self._moving is None:
            return ratio + 3 * (prior - 0.35)
        return 0.35 * ratio + 2 * (prior - 0.35) + 5 * (self._moving(i)[window] - 0.5)

    def _with_resting_part(self, i: int, mask: Bool[np.ndarray, "h w"]) -> Bool[np.ndarray, "h w"]:
        """Return the mask with the part of the first outline that looks as before, where that is most of it."""
        there = self._there
        rests = np.zeros(self._working.shape, bool)
        off = lab_distance(smoothed(self._working.lab[i][there]), self._before[there])
        rests[there] = self._start[there] & (off < CONFIG.same_lab)
        if rests.sum() > max(CONFIG.rests * self._area, CONFIG.shrunk * mask.sum()):
            return mask | rests
        return mask

    def _found_again(self, i: int, mask: Bool[np.ndarray, "h w"]) -> Bool[np.ndarray, "h w"]:
        """Return the changed region that looks most like the object, or the given mask where none is better."""
        working, hist, area = self._working, self._hist, float(self._area)
        image = working.rgb[i]
        others = np.maximum(
            likelihood(working.hand_hist, image), 0.7 * likelihood(working.rest_hist, image)
        )
        ratio = np.log(likelihood(hist, image) + 1e-6) - np.log(others + 1e-6)
        changed = lab_distance(smoothed(working.lab[i]), self._before) > 7
        pixels = cv2.GaussianBlur(ratio.astype(np.float32), (0, 0), 1.5) > 0.3
        count, parts = cv2.connectedComponents(
            tidy(pixels & (changed | self._home), 7).astype(np.uint8)
        )
        best, value = mask, likeness_of(working, i, mask, hist, area) + 0.05
        for c in range(1, min(count, 40)):
            part = parts == c
            likeness = likeness_of(working, i, part, hist, area)
            if likeness > value:
                best, value = part, likeness
        return best


def smoothed(lab: Float32[np.ndarray, "h w 3"]) -> Float32[np.ndarray, "h w 3"]:
    """Return a picture without the noise of single pixels."""
    return np.asarray(cv2.GaussianBlur(lab, (0, 0), 1))


def likeness_of(
    working: WorkingClip,
    i: int,
    mask: Bool[np.ndarray, "h w"],
    colour_hist: np.ndarray,
    area: float,
) -> float:
    """Return how much a mask looks like the object, 0 to 1, by its colours and by its area [px]."""
    size = int(mask.sum())
    if size < CONFIG.least_px:
        return 0.0
    alike = similarity(colour_hist, histogram(working.rgb[i][mask]))
    return alike * float(np.exp(-0.5 * np.log(size / area) ** 2))

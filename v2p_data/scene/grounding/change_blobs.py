"""Candidates for the moved object at one end, from what changed between that end and the other one's still."""

from dataclasses import dataclass

import cv2
import numpy as np
from jaxtyping import Bool, Float, Float32, UInt8

from v2p_data.kinds import KINDS, Kind
from v2p_data.scene.frames.colour import (
    balance,
    colour_match,
    histogram,
    lab_distance,
    lab_of,
    likelihood,
    shadow,
    similarity,
    skin_prior,
)
from v2p_data.scene.frames.mask_ops import (
    bounding_box,
    convex_hull,
    edge_contrast,
    grow,
    iou,
    solidity,
    tidy,
)
from v2p_data.scene.frames.table import Table
from v2p_data.scene.frames.working_clip import WorkingClip

WHOLE = 0.8
"""Solidity from which an outline is that of one object."""
_MIN_SHARE = 0.0015
"""Least share of the picture that a moved object covers: smaller changes are noise."""
_MAX_SHARE = 0.16
"""Greatest share of the picture that a moved object covers: larger changes are a person."""
_MOST_BLOBS = 40
"""Number of blobs at one end that are kept."""
_COMPLETED = 12
"""Number of the best blobs that are joined with a larger one around them."""


@dataclass
class Blob:
    mask: np.ndarray
    area: int
    box: tuple[int, int, int, int]
    hist: np.ndarray
    score: float
    cues: dict[str, float]
    whole: np.ndarray | None = None
    """The mask with the rest of the object, once `_complete` has looked for it."""


@dataclass(frozen=True, kw_only=True)
class ChangeCues:
    """What each cue for the moved object at one end counts: their sum is a blob's score.

    All were set by hand on drawn clips of the tuning half. Colour words are the strongest, the vanishing edge is the second.
    """

    edge: float = 1.2
    """Gain for an outline that is an edge here and none in the other end's still, -1 to 1."""
    colour: float = 1.6
    """Gain for the named colour: full at 40 % of its pixels, as few objects are one colour all over."""
    border: float = -0.9
    """Loss for each side at which the picture cuts it."""
    hand: float = -0.8
    """Loss for each share of it that looks like a hand and has not the named colour."""
    fill: float = 0.5
    """Gain for each share of its bounding box that it fills."""
    solid: float = 0.4
    """Gain for each share of solidity above 0.8."""
    change: float = 0.02
    """Gain for each Lab unit by which it differs from the other end's still, up to 40."""
    fleeting: float = -0.8
    """Loss, without a colour word, for each share of it that changes at once: an arm leaves, an object stays."""
    small: float = -0.4
    """Loss for each factor e by which it covers less than 0.4 % of the picture."""
    off_table: float = -1.2
    """Loss at the start where less than half of it lies on the table."""
    from_table: float = 0.8
    """Weight of views that cut it out of the table's colour, times the share of it that changed."""


CUES = ChangeCues()


def blobs_of(
    working: WorkingClip,
    table: Table,
    words: tuple[str, ...],
    kind: Kind,
    *,
    at_end: bool,
    colour_hist: np.ndarray | None,
) -> list[Blob]:
    """Return the best candidates for the moved object at one end, those of several views of the change."""
    end = _End(working, table, words, at_end=at_end)
    h, w = working.shape
    blobs: list[Blob] = []
    for pixels, whole in end.views(colour_hist):
        for mask in connected_parts(pixels, h * w, _MIN_SHARE, _MAX_SHARE):
            share = float(end.changed[mask].mean())
            if share < 0.3 or any(iou(mask, other.mask) > 0.92 for other in blobs):
                continue
            blobs.append(end.blob(mask, kind, whole, share))
    best = sorted(blobs, key=lambda blob: -blob.score)[:_MOST_BLOBS]
    for blob in best[:_COMPLETED]:
        blob.whole = _completed(blob, best, end)
        if colour_hist is None and not words and at_end:
            blob.whole = blob.mask  # nothing tells the object from the arm yet
        elif colour_hist is not None and (blob.whole & ~blob.mask).any():
            surplus = histogram(end.image[blob.whole & ~blob.mask])
            blob.whole = blob.whole if similarity(colour_hist, surplus) > 0.5 else blob.mask
    return best


class _End:
    """What the first or the last frame shows beside the still of the other end."""

    def __init__(
        self, working: WorkingClip, table: Table, words: tuple[str, ...], *, at_end: bool
    ) -> None:
        self._working, self._table, self._words, self._at_end = working, table, words, at_end
        h, w = working.shape
        image = working.rgb[-1 if at_end else 0]
        gone = working.early if at_end else working.late
        lab, gone_lab = lab_of(image), lab_of(gone)
        smooth = cv2.GaussianBlur(lab, (0, 0), 1.0)
        difference = lab_distance(smooth, cv2.GaussianBlur(gone_lab, (0, 0), 1.0))
        changed = difference > max(7.0, 2.5 * float(np.median(difference)) + 3)
        match = colour_match(balance(image), words) if words else np.full((h, w), 0.5, np.float32)
        # A colour that the table has as well says nothing ("white" on a white table).
        self._telling = 1 - float(match[table.seen].mean()) if table.seen.any() else 1.0
        colour = (match > 0.5) if words else np.zeros((h, w), bool)
        self._shade = shadow(lab, working.lit) & ~colour
        self.skin = skin_prior(image) & grow(working.arm(image), 2)
        self.image, self._lab, self._gone_lab = image, lab, gone_lab
        self._difference, self.changed = difference, changed & ~self._shade
        self.hand, self._match, self._is_colour = working.hand(image), match, colour
        self._stays = _stays(working, lab, at_end=at_end)
        self._fleeting = self._stays < 0.05

    @property
    def colour(self) -> Bool[np.ndarray, "h w"] | None:
        """Pixels of the named colour; None where none is named."""
        return self._is_colour if self._words else None

    def views(self, colour_hist: np.ndarray | None) -> list[tuple[Bool[np.ndarray, "h w"], float]]:
        """Return several sets of pixels that may be the object, each with its weight as a cut out of the table's colour."""
        changed, colour, fleeting = self.changed, self._is_colour, self._fleeting
        arm = self.hand & ~colour
        stands_out = self._table.stands_out(self.image) & ~self._shade
        out = [
            (tidy(changed), 0.0),
            (tidy(changed & colour), 0.0),
            (tidy(changed & colour, 9), 0.0),
            (tidy(changed & ~arm), 0.0),
            (tidy(changed & ~fleeting), 0.0),
            (tidy(stands_out), CUES.from_table),
            (tidy(stands_out & ~arm), CUES.from_table),
            (tidy(stands_out & ~arm & ~fleeting), CUES.from_table),
            (tidy(stands_out & colour), CUES.from_table),
        ]
        if colour_hist is not None:
            working = self._working
            others = np.maximum(
                likelihood(working.hand_hist, self.image),
                likelihood(working.rest_hist, self.image),
            )
            alike = changed & (likelihood(colour_hist, self.image) > others)
            out += [(tidy(alike), 0.0), (tidy(alike, 9), 0.0)]
        return out

    def vanishing(self, mask: Bool[np.ndarray, "h w"]) -> float:
        """Return how much more of an edge a mask's outline is here than in the other end's still, -1 to 1."""
        here, after = edge_contrast(self._lab, mask), edge_contrast(self._gone_lab, mask)
        return (here - after) / (here + after + 4)

    def blob(self, mask: Bool[np.ndarray, "h w"], kind: Kind, whole: float, share: float) -> Blob:
        """Return a candidate with its cues; `share` of it changed, `whole` is its view's weight."""
        h, w = mask.shape
        x, y, bw, bh = bounding_box(mask)
        area = int(mask.sum())
        ring = grow(mask, 3) & ~mask
        on_table = float((mask & self._table.hull).sum() / area)
        named = 0.0
        if self._words:
            named = CUES.colour * self._telling * min(1.0, float(self._match[mask].mean()) / 0.4)
        hand, colour = self.hand, self._is_colour
        bare = float(self._table.seen[ring].mean())
        cues = {
            "edge": CUES.edge * self.vanishing(mask),
            "colour": named,
            "border": CUES.border * border_sides((x, y, bw, bh), w, h),
            "hand": CUES.hand * float(hand[mask].mean() - (colour & hand)[mask].mean()),
            "fill": CUES.fill * area / (bw * bh) + CUES.solid * (solidity(mask) - 0.8),
            "change": CUES.change * min(40.0, float(self._difference[mask].mean())),
            "fleeting": 0.0 if self._words else CUES.fleeting * float(self._fleeting[mask].mean()),
            "ragged": -float(np.std(self._stays[mask])),
            "small": CUES.small * max(0.0, float(np.log(0.004 * h * w / area))),
            "ring": 0.5 if self._at_end and KINDS[kind].touches else bare,
            "whole": (whole * share - 0.4) if whole else 0.0,
            "off table": CUES.off_table if on_table < 0.5 and not self._at_end else 0.0,
        }
        hist = histogram(self.image[mask])
        return Blob(mask, area, (x, y, bw, bh), hist, sum(cues.values()), cues)


def _stays(
    working: WorkingClip, lab: Float32[np.ndarray, "h w 3"], *, at_end: bool
) -> Float[np.ndarray, "h w"]:
    """Return the share of the clip during which each pixel keeps its colour from one end: an arm leaves at once.

    Frame by frame: all at once are a fifth of a gigabyte.
    """
    n = len(working.lab)
    moved = np.stack([lab_distance(frame, lab) > 11 for frame in working.lab])
    order = moved[::-1] if at_end else moved
    return np.where(order.any(0), order.argmax(0), n) / n


def _completed(blob: Blob, others: list[Blob], end: "_End") -> np.ndarray:
    """Return the blob joined with a larger one around it whose surplus changed as well: the rest of the object.

    Where the object's colour is known, the rest lies within the convex hull of that colour or adjoins it without being
    skin: an arm does not. Of several, the most solid with the clearest outline is taken.
    """
    best, value = blob.mask, -np.inf
    changed, hand, skin, colour = end.changed, end.hand, end.skin, end.colour
    for other in others:
        if not blob.area < other.area < 8 * blob.area or other.cues["border"] < -0.5:
            continue
        if (other.mask & blob.mask).sum() < 0.6 * blob.area:
            continue
        whole = other.mask | blob.mask
        if colour is not None:
            hull = grow(convex_hull(tidy(colour & whole) | blob.mask), 2)
            whole &= hull | _joined(whole & ~hull & ~skin, hull)
        surplus = whole & ~blob.mask
        if not surplus.any() or changed[surplus].mean() < 0.7:
            continue
        if hand[surplus].mean() > 0.2 or (colour is None and skin[surplus].mean() > 0.3):
            continue
        firm = solidity(whole)
        if firm > 0.8:
            worth = 3 * firm + end.vanishing(whole) + 0.3 * float(np.log(whole.sum() / blob.area))
            best, value = (whole, worth) if worth > value else (best, value)
    return best


def _joined(pieces: np.ndarray, core: np.ndarray) -> np.ndarray:
    """Return the pieces that lie along the core for a good part of their outline."""
    near = grow(core, 2)
    count, parts = cv2.connectedComponents(pieces.astype(np.uint8))
    keep = np.zeros_like(pieces)
    for i in range(1, count):
        part = parts == i
        if (part & near).sum() > 1.2 * np.sqrt(part.sum()):
            keep |= part
    return keep


def connected_parts(
    pixels: Bool[np.ndarray, "h w"], total: int, min_share: float, max_share: float
) -> list[Bool[np.ndarray, "h w"]]:
    count, parts, stats, _ = cv2.connectedComponentsWithStats(pixels.astype(np.uint8))
    return [
        parts == i
        for i in range(1, count)
        if min_share * total <= stats[i, cv2.CC_STAT_AREA] <= max_share * total
    ]


def has_colour(
    image: UInt8[np.ndarray, "h w 3"], words: tuple[str, ...]
) -> Bool[np.ndarray, "h w"]:
    if not words:
        return np.zeros(image.shape[:2], bool)
    match: Float32[np.ndarray, "h w"] = colour_match(balance(image), words)
    return match > 0.5


def border_sides(box: tuple[int, int, int, int], w: int, h: int) -> float:
    x, y, bw, bh = box
    return float(x <= 1) + float(x + bw >= w - 1) + float(y <= 1) + 0.3 * float(y + bh >= h - 1)

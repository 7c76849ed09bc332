"""Which pixels are the thing that moved, where it was first and last, and which are the other thing in the caption.

What moved leaves two marks in a static picture: at its origin, edges that vanish; at its destination, edges that
appear. Candidate blobs come from several views of that change and are scored by hand-set weights; colour words are the
strongest cue, the vanishing edge second. The best score is also the gate: below about 4.5 most findings were wrong.
"""

from collections.abc import Callable
from dataclasses import dataclass, field, replace

import cv2
import numpy as np
from jaxtyping import Bool, Float, Float32, UInt8

from v2p_data.kinds import KINDS, Kind
from v2p_data.scene.frames.colour import (
    balance,
    colour_match,
    colour_words,
    histogram,
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
    main_parts,
    refine,
    shrink,
    solidity,
    tidy,
)
from v2p_data.scene.frames.table import Table
from v2p_data.scene.frames.working_clip import WorkingClip

_MIN_SHARE, _MAX_SHARE = 0.0015, 0.16
"""An object's share of the picture; smaller is noise, larger is a person."""
_WHOLE = 0.8
"""Solidity from which an outline is taken for that of one thing."""
_LARGE = 0.01
"""Of the picture: the outlines of smaller things are ragged."""
_SPLIT_COST = 0.6
"""A piece of an outline must score so much better than the whole: light and print cut things into pieces, too."""
_LEAST_STANDING, _MOST_STANDING = 0.0025, 0.2
"""Shares of the picture, of a thing that stands still."""
_NECKS = (0.4, 0.6, 0.8)
_APPROACH_WEIGHT = 1.0
"""Of coming straight towards something."""


@dataclass(frozen=True, kw_only=True)
class Moved:
    """The manipulated object's two outlines at working size."""

    first: Bool[np.ndarray, "h w"]
    last: Bool[np.ndarray, "h w"]
    score: float
    """Sum of the cues, where above about 4.5 it was nearly always right; with the network their product."""
    colour_hist: Float[np.ndarray, "l a b"] = field(repr=False)
    """Colour histogram of the object."""
    cues: dict[str, float] = field(default_factory=dict)


@dataclass(frozen=True, kw_only=True)
class Found:
    """A thing that stands still, at working size."""

    mask: Bool[np.ndarray, "h w"]
    score: float
    """Above about 2 it was nearly always right."""


@dataclass
class _Blob:
    mask: np.ndarray
    area: int
    box: tuple[int, int, int, int]
    hist: np.ndarray
    score: float
    cues: dict[str, float]
    whole: np.ndarray | None = None
    """The mask with the rest of the object, once `_complete` has looked for it."""


def find_moved_by_change(
    working: WorkingClip,
    table: Table,
    phrase: str,
    kind: Kind,
    *,
    first: Bool[np.ndarray, "h w"] | None = None,
    last: Bool[np.ndarray, "h w"] | None = None,
) -> Moved | None:
    """Return the manipulated object at the first and at the last frame; None where nothing moves.

    A mask given by the user for either end is taken as it is.
    """
    words = colour_words(phrase)
    pair = _best_pair(working, table, words, kind, first, last)
    if pair is None:
        return None
    # Now that the object's look is known, the hand is everything else that moves, sleeves and dark skin as well.
    colour_hist = _colour_hist(working, pair[1], words)
    working = working.knowing(colour_hist)
    pair = _best_pair(working, table, words, kind, first, last, colour_hist) or pair
    score, a, b, cues = pair
    colour_hist = _colour_hist(working, a, words)
    return Moved(
        first=first
        if first is not None
        else outline(working, working.rgb[0], _whole(a), words, colour_hist),
        last=last
        if last is not None
        else outline(working, working.rgb[-1], _whole(b), words, colour_hist),
        score=score,
        colour_hist=colour_hist,
        cues={
            **{f"first {k}": v for k, v in a.cues.items()},
            **{f"last {k}": 0.6 * v for k, v in b.cues.items()},
            **cues,
        },
    )


def outline(
    working: WorkingClip,
    image: UInt8[np.ndarray, "h w 3"],
    blob: Bool[np.ndarray, "h w"],
    words: tuple[str, ...],
    colour_hist: Float[np.ndarray, "l a b"],
) -> Bool[np.ndarray, "h w"]:
    """Return the object's outline around a blob in any frame, the hand cut away.

    Hand is what looks more like the moving hand than like the object (`colour_hist`).
    """
    likelier = likelihood(working.hand_hist, image) > likelihood(colour_hist, image)
    never = tidy(working.hand(image) & likelier)
    shade = shadow(lab_of(image), working.lit) & blob & ~_colour(image, words)
    if shade.sum() < 0.4 * blob.sum():
        blob = blob & ~shade
    rest = blob & ~never
    if rest.sum() < 0.25 * blob.sum():
        rest, never = blob, np.zeros_like(never)
    # Print on a box may look like a hand, but a hand comes from outside.
    hull = convex_hull(main_parts(tidy(rest)))
    count, parts = cv2.connectedComponents(never.astype(np.uint8))
    for i in range(1, count):
        part = parts == i
        if (part & hull).sum() > 0.7 * part.sum():
            never &= ~part
    rest = blob & ~never
    return refine(image, main_parts(tidy(rest)) if tidy(rest).any() else rest, never)


def find_static_by_change(
    working: WorkingClip,
    table: Table,
    phrase: str,
    kind: Kind,
    moved: Moved,
    taken: Bool[np.ndarray, "h w"] | None = None,
) -> Found | None:
    """Return the thing that stays, or None where the still shows no candidate.

    For `uncover` the late still is searched, for all others the early one.
    """
    late = kind == "uncover"
    still = working.late if late else working.early
    h, w = working.shape
    words = colour_words(phrase)
    goal = moved.first if late else moved.last
    goal_zone = grow(goal, 6)
    foot = goal_zone.copy()
    top, tall = bounding_box(goal)[1::2]
    foot[: top + tall // 2] = False
    distance = cv2.distanceTransform((~goal).astype(np.uint8), cv2.DIST_L2, 5)
    before = cv2.distanceTransform((~moved.first).astype(np.uint8), cv2.DIST_L2, 5)
    ends = [np.argwhere(mask).mean(0) for mask in (moved.first, moved.last) if mask.any()]
    way = float(np.linalg.norm(ends[-1] - ends[0])) if ends else 0.0
    colour = _colour(still, words)
    quarter = max(3, len(working.lab) // 5)
    stack = working.lab[-quarter:] if late else working.lab[:quarter]
    steps = np.linalg.norm(np.diff(stack[:: max(1, quarter // 8)], axis=0), axis=-1)
    restless = (steps > 12).mean(0) > 0.15
    inner_hull = shrink(table.hull, 1)
    stands_out = table.stands_out(still) & inner_hull & ~restless
    hand = working.hand(still) & ~colour
    sets = [stands_out, stands_out & ~hand] + ([colour & ~restless] if words else [])
    lab = lab_of(still)
    occupied = grow(moved.first, 3)
    best: Found | None = None
    for pixels in sets:
        free = pixels & ~grow(moved.last, 2) if late else pixels & ~occupied
        free = free if taken is None else free & ~taken
        wholes = _parts(tidy(free, 5), h * w, _LEAST_STANDING, _MOST_STANDING)
        pieces = [part for whole in wholes for part in pieces_of(whole, _LARGE * h * w)]
        for k, mask in enumerate([*wholes, *pieces]):
            x, y, bw, bh = bounding_box(mask)
            area = int(mask.sum())
            score = -_border_sides((x, y, bw, bh), w, h) * 0.8
            score -= _SPLIT_COST if k >= len(wholes) else 0.0
            if KINDS[kind].touches or late:
                score += 3 * min(0.6, float((mask & goal_zone).sum() / goal_zone.sum()))
            if late:  # what was under the cover stands where its foot was
                score += 2.5 * float((mask & foot).sum() / area - 0.6)
            gap = float(distance[mask].min())
            if KINDS[kind].comes_near:
                nearer = float(before[mask].min()) - gap
                score += _APPROACH_WEIGHT * float(np.clip(nearer / max(8.0, way), -1, 1))
            near = 20 if KINDS[kind].ends_near or late else 60
            score -= min(gap / near, 4.0)
            ring = grow(mask, 3) & ~mask
            score += float(table.seen[ring].mean()) if ring.any() else 0.0
            score += 1.6 * float(colour[mask].mean()) if words else 0.0
            score += 0.8 * area / (bw * bh)
            # Things that touch, or pieces of one, are no thing.
            if area > _LARGE * h * w:
                score += 2 * float(np.clip(solidity(mask) - _WHOLE, -0.2, 0))
            score += 0.02 * min(40.0, edge_contrast(lab, mask))
            score -= 0.5 * max(0.0, float(np.log(0.008 * h * w / area)))
            if best is None or score > best.score:
                best = Found(mask=mask, score=score)
    if best is None:
        return None
    never = np.zeros((h, w), bool) if late else moved.first
    return replace(best, mask=_outlined(still, best.mask, never))


def _outlined(
    still: UInt8[np.ndarray, "h w 3"],
    blob: Bool[np.ndarray, "h w"],
    never: Bool[np.ndarray, "h w"],
) -> Bool[np.ndarray, "h w"]:
    """Return the outline around a thing that stands there, or the blob where there is no clear one."""
    mask = refine(still, blob, never)
    return mask if 0.5 <= mask.sum() / blob.sum() <= 1.8 else blob


def pieces_of(mask: Bool[np.ndarray, "h w"], least_px: float) -> list[Bool[np.ndarray, "h w"]]:
    """Return the parts of a mask that only a neck joins, as openings with discs of its own width leave them."""
    if mask.sum() < least_px or solidity(mask) > _WHOLE:
        return []
    inner = cv2.distanceTransform(mask.astype(np.uint8), cv2.DIST_L2, 5)
    out: list[Bool[np.ndarray, "h w"]] = []
    for share in _NECKS:
        radius = share * float(inner.max())
        count, cores = cv2.connectedComponents((inner > radius).astype(np.uint8))
        for k in range(1, count):
            outside = (cores != k).astype(np.uint8)
            near = cv2.distanceTransform(outside, cv2.DIST_L2, 5) <= radius
            if (near & mask).sum() >= least_px:
                out.append(near & mask)
    return out


def _best_pair(
    working: WorkingClip,
    table: Table,
    words: tuple[str, ...],
    kind: Kind,
    first: np.ndarray | None,
    last: np.ndarray | None,
    colour_hist: np.ndarray | None = None,
) -> tuple[float, _Blob, _Blob, dict[str, float]] | None:
    def found(given: np.ndarray | None, at_end: bool) -> list[_Blob]:
        if given is not None:
            return [_given(working.rgb[-1 if at_end else 0], given)]
        return _blobs(working, table, words, kind, at_end=at_end, colour_hist=colour_hist)

    best = None
    ends = found(last, at_end=True)
    for a in found(first, at_end=False):
        for b in ends:
            cues = _pair_cues(a, b, kind, working.shape)
            score = a.score + 0.6 * b.score + sum(cues.values())
            if best is None or score > best[0]:
                best = score, a, b, cues
    return best


def _whole(blob: _Blob) -> np.ndarray:
    return blob.mask if blob.whole is None else blob.whole


def _colour_hist(working: WorkingClip, blob: _Blob, words: tuple[str, ...]) -> np.ndarray:
    return histogram(working.rgb[0][_typical(working, _whole(blob), words)])


def _given(image: np.ndarray, mask: np.ndarray) -> _Blob:
    return _Blob(
        mask, int(mask.sum()), bounding_box(mask), histogram(image[mask]), 3.5, {"given": 3.5}
    )


def _typical(working: WorkingClip, mask: np.ndarray, words: tuple[str, ...]) -> np.ndarray:
    """Return the pixels of a blob that are surely the object: its named colour and what is printed between.

    Skin-coloured parts that hang together with something passing outside are fingers.
    """
    image = working.rgb[0]
    named = mask & _colour(image, words)
    if named.sum() < 0.15 * mask.sum():
        sure = mask & ~working.hand(image)
        return sure if sure.sum() > 0.2 * mask.sum() else mask
    passing = np.linalg.norm(lab_of(image) - lab_of(working.late), axis=-1) > 12
    outside, skin = tidy(passing & ~mask), skin_prior(image)
    sure = mask & convex_hull(tidy(named) | shrink(named, 1))
    count, parts = cv2.connectedComponents((sure & ~named).astype(np.uint8))
    for i in range(1, count):
        part = parts == i
        if skin[part].mean() > 0.5 and (grow(part, 2) & outside).sum() > 8:
            sure &= ~part
    return sure


def _blobs(
    working: WorkingClip,
    table: Table,
    words: tuple[str, ...],
    kind: Kind,
    *,
    at_end: bool,
    colour_hist: np.ndarray | None,
) -> list[_Blob]:
    h, w = working.shape
    n = len(working.rgb)
    image = working.rgb[-1 if at_end else 0]
    gone = working.early if at_end else working.late
    lab, gone_lab = lab_of(image), lab_of(gone)
    smooth = cv2.GaussianBlur(lab, (0, 0), 1.0)
    difference = np.linalg.norm(smooth - cv2.GaussianBlur(gone_lab, (0, 0), 1.0), axis=-1)
    changed = difference > max(7.0, 2.5 * float(np.median(difference)) + 3)
    hand = working.hand(image)
    match = colour_match(balance(image), words) if words else np.full((h, w), 0.5, np.float32)
    # A colour that the table has as well says nothing ("white" on a white table).
    telling = 1 - float(match[table.seen].mean()) if table.seen.any() else 1.0
    colour = (match > 0.5) if words else np.zeros((h, w), bool)
    shade = shadow(lab, working.lit) & ~colour
    skin = skin_prior(image) & grow(working.arm(image), 2)
    changed &= ~shade
    # How long a pixel keeps the look it has here: an arm leaves at once, an object when it is moved.
    # (Frame by frame: all at once are a fifth of a gigabyte.)
    moved = np.stack([np.linalg.norm(frame - lab, axis=-1) > 11 for frame in working.lab])
    order = moved[::-1] if at_end else moved
    stays = np.where(order.any(0), order.argmax(0), n) / n
    fleeting = stays < 0.05
    stands_out = table.stands_out(image) & ~shade
    views = [
        (tidy(changed), 0.0),
        (tidy(changed & colour), 0.0),
        (tidy(changed & colour, 9), 0.0),
        (tidy(changed & ~(hand & ~colour)), 0.0),
        (tidy(changed & ~fleeting), 0.0),
        (tidy(stands_out), 0.8),
        (tidy(stands_out & ~(hand & ~colour)), 0.8),
        (tidy(stands_out & ~(hand & ~colour) & ~fleeting), 0.8),
        (tidy(stands_out & colour), 0.8),
    ]
    if colour_hist is not None:
        others = np.maximum(
            likelihood(working.hand_hist, image), likelihood(working.rest_hist, image)
        )
        alike = changed & (likelihood(colour_hist, image) > others)
        views += [(tidy(alike), 0.0), (tidy(alike, 9), 0.0)]

    def vanishing(mask: np.ndarray) -> float:
        here, after = edge_contrast(lab, mask), edge_contrast(gone_lab, mask)
        return (here - after) / (here + after + 4)

    blobs: list[_Blob] = []
    for pixels, whole in views:
        for mask in _parts(pixels, h * w, _MIN_SHARE, _MAX_SHARE):
            share = float(changed[mask].mean())
            if share < 0.3 or any(iou(mask, other.mask) > 0.92 for other in blobs):
                continue
            x, y, bw, bh = bounding_box(mask)
            area = int(mask.sum())
            ring = grow(mask, 3) & ~mask
            on_table = float((mask & table.hull).sum() / area)
            cues = {
                "edge": 1.2 * vanishing(mask),
                # Few things are one colour all over: four tenths are as good as all.
                "colour": 1.6 * telling * min(1.0, float(match[mask].mean()) / 0.4)
                if words
                else 0.0,
                "border": -0.9 * _border_sides((x, y, bw, bh), w, h),
                "hand": -0.8 * float(hand[mask].mean() - (colour & hand)[mask].mean()),
                "fill": 0.5 * area / (bw * bh) + 0.4 * (solidity(mask) - 0.8),
                "change": 0.02 * min(40.0, float(difference[mask].mean())),
                "fleeting": 0.0 if words else -0.8 * float(fleeting[mask].mean()),
                "ragged": -float(np.std(stays[mask])),
                "small": -0.4 * max(0.0, float(np.log(0.004 * h * w / area))),
                "ring": 0.5 if at_end and KINDS[kind].touches else float(table.seen[ring].mean()),
                "whole": (whole * share - 0.4) if whole else 0.0,
                "off table": -1.2 if on_table < 0.5 and not at_end else 0.0,
            }
            blobs.append(
                _Blob(mask, area, (x, y, bw, bh), histogram(image[mask]), sum(cues.values()), cues)
            )
    best = sorted(blobs, key=lambda blob: -blob.score)[:40]
    for blob in best[:12]:
        blob.whole = _completed(
            blob, best, changed, hand, skin, colour if words else None, vanishing
        )
        if colour_hist is None and not words and at_end:
            blob.whole = blob.mask  # nothing tells the object from the arm yet
        elif colour_hist is not None and (blob.whole & ~blob.mask).any():
            surplus = histogram(image[blob.whole & ~blob.mask])
            blob.whole = blob.whole if similarity(colour_hist, surplus) > 0.5 else blob.mask
    return best


def _completed(
    blob: _Blob,
    others: list[_Blob],
    changed: np.ndarray,
    hand: np.ndarray,
    skin: np.ndarray,
    colour: np.ndarray | None,
    vanishing: Callable[[np.ndarray], float],
) -> np.ndarray:
    """Return the blob joined with a larger one around it whose surplus changed as well: the rest of the object.

    Where the object's colour is known, the rest lies within the convex hull of that colour or adjoins it without being
    skin: an arm does not. Of several, the most solid with the clearest outline is taken.
    """
    best, value = blob.mask, -np.inf
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
            worth = 3 * firm + vanishing(whole) + 0.3 * float(np.log(whole.sum() / blob.area))
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


def _pair_cues(a: _Blob, b: _Blob, kind: Kind, shape: tuple[int, int]) -> dict[str, float]:
    h, w = shape
    overlap = float((a.mask & b.mask).sum() / min(a.area, b.area))
    ax, ay = a.box[0] + a.box[2] / 2, a.box[1] + a.box[3] / 2
    bx, by = b.box[0] + b.box[2] / 2, b.box[1] + b.box[3] / 2
    cues = {
        "alike": 1.2 * similarity(a.hist, b.hist),
        "same size": -0.5 * abs(float(np.log(a.area / b.area))),
        "pair": -0.3 - (1.0 if overlap > 0.9 else 0.0),
    }
    move_x, move_up = (bx - ax) / w, (ay - by) / h
    if kind in ("push_left", "push_right"):
        along = move_x if kind == "push_right" else -move_x
        cues["direction"] = 0.8 * float(np.clip(along / 0.06, -1.5, 1))
    elif kind == "lift_up":
        cues["direction"] = 0.5 * float(np.clip(move_up / 0.08, -1, 1))
    return cues


def _parts(
    pixels: Bool[np.ndarray, "h w"], total: int, min_share: float, max_share: float
) -> list[Bool[np.ndarray, "h w"]]:
    count, parts, stats, _ = cv2.connectedComponentsWithStats(pixels.astype(np.uint8))
    return [
        parts == i
        for i in range(1, count)
        if min_share * total <= stats[i, cv2.CC_STAT_AREA] <= max_share * total
    ]


def _colour(image: UInt8[np.ndarray, "h w 3"], words: tuple[str, ...]) -> Bool[np.ndarray, "h w"]:
    if not words:
        return np.zeros(image.shape[:2], bool)
    match: Float32[np.ndarray, "h w"] = colour_match(balance(image), words)
    return match > 0.5


def _border_sides(box: tuple[int, int, int, int], w: int, h: int) -> float:
    x, y, bw, bh = box
    return float(x <= 1) + float(x + bw >= w - 1) + float(y <= 1) + 0.3 * float(y + bh >= h - 1)

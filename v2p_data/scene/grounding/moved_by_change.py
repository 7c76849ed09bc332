"""Which pixels are the moved object at the start and at the end, from what changed between the two.

A moved object leaves two marks in a still picture: edges that vanish where it was, and edges that appear where it goes. Candidates of both
ends (`change_blobs`) are rated by weights set by hand, and the best pair is taken. Below a score of about 4.5 most findings were wrong.
"""

from dataclasses import dataclass, field

import cv2
import numpy as np
from jaxtyping import Bool, Float, UInt8

from v2p_data.kinds import Kind
from v2p_data.scene.frames.colour import (
    colour_words,
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
    grow,
    main_parts,
    refine,
    shrink,
    tidy,
)
from v2p_data.scene.frames.table import Table
from v2p_data.scene.frames.working_clip import WorkingClip
from v2p_data.scene.grounding.change_blobs import Blob, blobs_of, has_colour


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
    outlined: tuple[int, ...] = ()
    """0 where a model that knows edges of objects drew the first outline, 1 where it drew the last: these are final."""


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
    shade = shadow(lab_of(image), working.lit) & blob & ~has_colour(image, words)
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


def _best_pair(
    working: WorkingClip,
    table: Table,
    words: tuple[str, ...],
    kind: Kind,
    first: np.ndarray | None,
    last: np.ndarray | None,
    colour_hist: np.ndarray | None = None,
) -> tuple[float, Blob, Blob, dict[str, float]] | None:
    def found(given: np.ndarray | None, at_end: bool) -> list[Blob]:
        if given is not None:
            return [_given(working.rgb[-1 if at_end else 0], given)]
        return blobs_of(working, table, words, kind, at_end=at_end, colour_hist=colour_hist)

    best = None
    ends = found(last, at_end=True)
    for a in found(first, at_end=False):
        for b in ends:
            cues = _pair_cues(a, b, kind, working.shape)
            score = a.score + 0.6 * b.score + sum(cues.values())
            if best is None or score > best[0]:
                best = score, a, b, cues
    return best


def _whole(blob: Blob) -> np.ndarray:
    return blob.mask if blob.whole is None else blob.whole


def _colour_hist(working: WorkingClip, blob: Blob, words: tuple[str, ...]) -> np.ndarray:
    return histogram(working.rgb[0][_typical(working, _whole(blob), words)])


def _given(image: np.ndarray, mask: np.ndarray) -> Blob:
    return Blob(
        mask, int(mask.sum()), bounding_box(mask), histogram(image[mask]), 3.5, {"given": 3.5}
    )


def _typical(working: WorkingClip, mask: np.ndarray, words: tuple[str, ...]) -> np.ndarray:
    """Return the pixels of a blob that are surely the object: its named colour and what is printed between.

    Skin-coloured parts that hang together with something passing outside are fingers.
    """
    image = working.rgb[0]
    named = mask & has_colour(image, words)
    if named.sum() < 0.15 * mask.sum():
        sure = mask & ~working.hand(image)
        return sure if sure.sum() > 0.2 * mask.sum() else mask
    passing = lab_distance(lab_of(image), lab_of(working.late)) > 12
    outside, skin = tidy(passing & ~mask), skin_prior(image)
    sure = mask & convex_hull(tidy(named) | shrink(named, 1))
    count, parts = cv2.connectedComponents((sure & ~named).astype(np.uint8))
    for i in range(1, count):
        part = parts == i
        if skin[part].mean() > 0.5 and (grow(part, 2) & outside).sum() > 8:
            sure &= ~part
    return sure


def _pair_cues(a: Blob, b: Blob, kind: Kind, shape: tuple[int, int]) -> dict[str, float]:
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

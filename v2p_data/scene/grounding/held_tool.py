"""What a hand holds and pushes with: something thin that reaches from the hand to what it pushes.

To the scene network a ruler looks much like a sleeve. What tells a tool is where it is and how it is made: it is not
there for good, it ends at what is pushed, it is as thin and as long as its noun says beside that, and it has other
colours than the hand around it.
"""

from collections.abc import Iterator
from dataclasses import dataclass, field

import cv2
import numpy as np
from jaxtyping import Bool, Float, Float32, UInt8

from v2p_data.scene.frames.classes import HAND, MOVED
from v2p_data.scene.frames.colour import (
    histogram,
    lab_distance,
    lab_of,
    likelihood,
    shadow,
    similarity,
)
from v2p_data.scene.frames.flow import flow_to
from v2p_data.scene.frames.mask_ops import DRAWN_OFF_PX, bounding_box, grow, iou, is_cut, tidy
from v2p_data.scene.frames.segmentation import Segmentation
from v2p_data.scene.frames.working_clip import WorkingClip
from v2p_data.scene.grounding.tool_pieces import (
    LEAST_PX,
    ToolFrame,
    ToolPiece,
    connected_pieces,
    pieces_in,
    ratings_of,
)
from v2p_data.scene.scale.camera_height import px_per_m
from v2p_data.scene.scale.nouns import Noun

_PASSING_LAB = 10.0
"""A pixel that differs so much from what is there for good shows something that passes."""
_DARKEST_SHADOW = 0.38
"""Of the bare table's lightness: what a room reflects lights even shadows; dark tools are darker."""
_HUE_LOST = 0.1
"""Lab per step of lightness: overexposed tables have lost the hue that their shadows show."""
_MOST_SHARE = 0.15
"""Greatest share of the picture that a tool covers."""
_LOOKS = 24
"""Number of frames in which the tool is searched."""
_KEPT = 8
"""Number of a frame's pieces that are kept."""
_EXTENDED = 5
"""Number of a frame's pieces that are prolonged along their line."""
_LEAST_ALIKE = 0.4
"""Likeness to the best piece of a chain, 0 to 1, below which another piece is something else."""
_LEAST_IN_BOX = 0.3
"""Overlap with a drawn box that a piece must have."""
_AS_GOOD_AS_FILLED = 0.85
"""Overlap with a drawn box from which more says nothing: people draw a little off."""
_BESIDE_BOX = 0.3
"""Exponent of all other ratings where a user drew a box."""
_MOSTLY_PASSES = 0.7
"""Share of a strip across the box that must pass, for the strip to be the tool."""
_MARKED_WORTH = 10.0
"""What a piece of the frame that a user marked adds to a chain beside its rating: the chain goes through there."""
_FILLS_WORTH = 3.0
"""What it adds where it fills the box: more than what goes over into the pieces of other frames."""
_LEAST_WORTH = 0.25
"""Root of a rating below which it is better to see nothing."""


@dataclass(frozen=True, kw_only=True)
class HeldTool:
    """A tool in the picture."""

    at: int
    """Working frame that shows it best."""
    masks: Bool[np.ndarray, "time h w"] = field(repr=False)
    """Empty where it is not seen."""
    quality: Float[np.ndarray, "time"] = field(repr=False)
    """How far to believe each mask, 0 to 1."""
    sure: float
    why: str
    """What speaks most against it."""


def find_tool(
    working: WorkingClip,
    segmentation: Segmentation,
    pushed: Bool[np.ndarray, "time h w"],
    noun: Noun,
    marked: tuple[int, Bool[np.ndarray, "h w"]] | None = None,
) -> HeldTool | None:
    """Return what pushes the thing whose masks are `pushed`, or None.

    Each frame's pieces are rated; the tool is the chain of pieces, one a frame or none, that are rated high and go over
    into one another (found as in Viterbi 1967).

    Args:
        working: frames and stills.
        segmentation: what the network sees.
        pushed: the manipulated object's visible pixels.
        noun: what the tool is.
        marked: a working frame and the box there, as a mask, in which a user says it is.
    """
    background = lab_of(_background(working, segmentation, pushed))
    metre_px = px_per_m(segmentation.camera, working.shape, float(np.nonzero(pushed[0])[0].mean()))
    usual_px = tuple(side * metre_px for side in sorted(noun.size_m)[:0:-1])
    picks = set(segmentation.idx[:: max(1, len(segmentation.idx) // _LOOKS)].tolist())
    frames = sorted(picks | ({marked[0]} if marked else set()))
    pieces = []
    for i in frames:
        frame = _frame(working, segmentation, pushed, background, i)
        box = marked[1] if marked is not None and i == marked[0] else None
        pieces.append(_best_pieces(frame, usual_px, box))
    chain = _best_chain(working, frames, pieces)
    if not chain:
        return None
    at, best = max(chain.items(), key=lambda item: item[1].rating)
    if marked is not None:
        if marked[0] not in chain or chain[marked[0]].parts["in the box"] < _LEAST_IN_BOX:
            return None
        at, best = marked[0], chain[marked[0]]
    alike = {i: _alike(piece, best) for i, piece in chain.items()}
    masks, quality = np.zeros_like(pushed), np.zeros(len(pushed))
    for i, like in alike.items():
        if like > _LEAST_ALIKE:
            masks[i], quality[i] = chain[i].mask, like
    # Poses begin where it is first seen well.
    area = best.mask.sum()
    well = [i for i in alike if alike[i] > 0.6 and _area_beside(chain[i], best) > 0.7 * area]
    weakest = min(best.parts, key=lambda part: best.parts[part])
    return HeldTool(
        at=at if marked is not None else min([at, *well]),
        masks=masks,
        quality=quality,
        sure=_sureness([chain[i].rating for i in alike if alike[i] > _LEAST_ALIKE]),
        why=f"weakest is '{weakest}' with {best.parts[weakest]:.2f}",
    )


def _sureness(ratings: list[float]) -> float:
    """Return how sure a chain is, 0 to 1: a good rating is a third, and one frame alone proves little."""
    seen = min(1.0, len(ratings) / 4)
    return float(np.clip(seen * 1.4 * np.sqrt(np.median(ratings)), 0, 1))


def _alike(piece: ToolPiece, best: ToolPiece) -> float:
    """Return how much a piece looks like the best one, 0 to 1: the picture's edge may cut it, and a hand hide some."""
    ratio = abs(float(np.log(_area_beside(piece, best) / best.mask.sum())))
    ratio = max(0.0, ratio - 0.3)
    return similarity(piece.hist, best.hist) * float(np.exp(-0.5 * (ratio / 0.6) ** 2))


def _area_beside(piece: ToolPiece, best: ToolPiece) -> float:
    """Return a piece's area, as the best one's where the picture's edge cuts it: nobody knows how large it is."""
    own, other = float(piece.mask.sum()), float(best.mask.sum())
    return max(own, other) if is_cut(piece.mask) else own


def _background(
    working: WorkingClip, segmentation: Segmentation, pushed: Bool[np.ndarray, "time h w"]
) -> UInt8[np.ndarray, "h w 3"]:
    """Return the picture without hand, tool and what is pushed: the late still, the early one where that shows any."""
    stood, stands = grow(pushed[0], 3), grow(pushed[-1], 3)
    early, late = (w[HAND] + w[MOVED] for w in (segmentation.early, segmentation.late))
    use_early = (stands | ((late > 0.3) & (early < late))) & ~stood
    return np.where(use_early[..., None], working.early, working.late)


def _frame(
    working: WorkingClip,
    segmentation: Segmentation,
    pushed: Bool[np.ndarray, "time h w"],
    background: Float32[np.ndarray, "h w 3"],
    i: int,
) -> ToolFrame:
    lab, shares = working.lab[i], segmentation.at(i)
    passing = lab_distance(lab, background) > _PASSING_LAB
    return ToolFrame(
        rgb=working.rgb[i],
        lab=lab,
        passing=passing & ~grow(pushed[i], 1),
        shaded=shadow(lab, background, darkest=_DARKEST_SHADOW, drift=_HUE_LOST),
        hand=shares[HAND],
        moved=shares[MOVED],
        pushed=pushed[i],
        away_px=cv2.distanceTransform((~pushed[i]).astype(np.uint8), cv2.DIST_L2, 5),
    )


def _best_pieces(
    frame: ToolFrame, usual_px: tuple[float, ...], box: Bool[np.ndarray, "h w"] | None
) -> list[ToolPiece]:
    """Return the best of what passes that may be a thing of its own; `usual_px` is (length, width) [px]."""
    pieces: list[ToolPiece] = []
    for passing in (frame.passing & ~frame.shaded, frame.passing):
        for mask in pieces_in(passing, frame):
            _add(pieces, frame, passing, mask, usual_px, box)
        best = sorted(pieces, key=lambda piece: -piece.rating)[:_EXTENDED]
        for piece in best:
            longer = _along(frame, passing, piece.mask, usual_px)
            _add(pieces, frame, passing, longer, usual_px, box)
    if box is not None:
        for mask in _across(frame, box, usual_px):
            _add(pieces, frame, frame.passing, mask, usual_px, box)
        inside = grow(box, DRAWN_OFF_PX)
        for piece in sorted(pieces, key=lambda piece: -piece.rating)[:_EXTENDED]:
            for part in connected_pieces(piece.mask & inside):
                _add(pieces, frame, frame.passing, part, usual_px, box)
    return sorted(pieces, key=lambda piece: -piece.rating)[:_KEPT]


def _add(
    pieces: list[ToolPiece],
    frame: ToolFrame,
    passing: Bool[np.ndarray, "h w"],
    mask: Bool[np.ndarray, "h w"],
    usual_px: tuple[float, ...],
    box: Bool[np.ndarray, "h w"] | None,
) -> None:
    """Add a piece, rated, unless it is too large or there already."""
    if mask.sum() > _MOST_SHARE * mask.size or any(
        (mask & other.mask).sum() > 0.93 * (mask | other.mask).sum() for other in pieces
    ):
        return
    parts = ratings_of(frame, passing, mask, usual_px)
    if box is not None:
        parts |= {name: part**_BESIDE_BOX for name, part in parts.items()}
        parts["in the box"] = min(1.0, _fills(mask, box) / _AS_GOOD_AS_FILLED)
    pieces.append(ToolPiece(mask=mask, parts=parts, hist=histogram(frame.rgb[mask])))


def _along(
    frame: ToolFrame,
    passing: Bool[np.ndarray, "h w"],
    mask: Bool[np.ndarray, "h w"],
    usual_px: tuple[float, ...],
) -> Bool[np.ndarray, "h w"]:
    """Return a piece with all that lies in its line and has its colours rather than the hand's: fingers cut tools in two."""
    y, x = np.nonzero(mask)
    dx, dy, x0, y0 = cv2.fitLine(
        np.stack([x, y], 1).astype(np.float32), cv2.DIST_L2, 0, 0.01, 0.01
    ).ravel()
    rows, columns = np.mgrid[: mask.shape[0], : mask.shape[1]]
    off = np.abs((columns - x0) * dy - (rows - y0) * dx)
    ahead = (columns - x0) * dx + (rows - y0) * dy
    own = ahead[mask]
    half = max(1.5, float(np.percentile(off[mask], 95)))
    room = max(0.0, 1.1 * usual_px[0] - float(np.ptp(own)))
    line = (off <= half) & (ahead > own.min() - room) & (ahead < own.max() + room) & passing
    colour_hist = histogram(frame.rgb[mask])
    hand = passing & ~mask & ~line & (frame.hand > 0.5)
    others = histogram(frame.rgb[hand])
    alike = likelihood(colour_hist, frame.rgb) > likelihood(others, frame.rgb) + 1e-5
    return mask | tidy(line & alike, 1)


def _across(
    frame: ToolFrame, box: Bool[np.ndarray, "h w"], usual_px: tuple[float, ...]
) -> Iterator[Bool[np.ndarray, "h w"]]:
    """Yield what passes along the two diagonals of the box: something straight and thin that fills it lies along one of them."""
    x, y, w, h = bounding_box(box)
    wide = max(2, round(usual_px[1]))
    half = wide / 2
    passing = grow(frame.passing, 1)
    left, right, top, low = (round(v) for v in (x + half, x + w - half, y + half, y + h - half))
    for ends in (((left, top), (right, low)), ((left, low), (right, top))):
        strip = np.zeros(box.shape, np.uint8)
        cv2.line(strip, *ends, 1, wide)
        passes = (strip > 0) & passing
        if passes.sum() >= max(LEAST_PX / 2, _MOSTLY_PASSES * strip.sum()):
            yield passes


def _best_chain(
    working: WorkingClip, frames: list[int], pieces: list[list[ToolPiece]]
) -> dict[int, ToolPiece]:
    """Return the pieces, by working frame, that are together the best."""
    total = [np.array([_worth(piece) for piece in here] + [0.0]) for here in pieces]
    came = [np.zeros(len(values), int) for values in total]
    for k in range(1, len(frames)):
        links = np.zeros((len(total[k - 1]), len(total[k])))
        flow = _flow(working, frames[k - 1], frames[k])
        for a, before in enumerate(pieces[k - 1]):
            moved = _carried(before.mask, flow)
            for b, after in enumerate(pieces[k]):
                links[a, b] = 0.5 * _likeness(before, after, moved) - 0.25
        values = total[k - 1][:, None] + links
        came[k] = values.argmax(0)
        total[k] += values.max(0)
    state, chain = int(total[-1].argmax()), {}
    for k in range(len(frames) - 1, -1, -1):
        if state < len(pieces[k]):
            chain[frames[k]] = pieces[k][state]
        state = int(came[k][state])
    return chain


def _worth(piece: ToolPiece) -> float:
    """Return what a piece adds to a chain: less than nothing where it is rated low."""
    marked = piece.parts.get("in the box")
    said = 0.0 if marked is None else _MARKED_WORTH + _FILLS_WORTH * marked
    return piece.rating**0.5 - _LEAST_WORTH + said


def _likeness(before: ToolPiece, after: ToolPiece, moved: Bool[np.ndarray, "h w"]) -> float:
    """Return how much two frames' pieces look like one thing, 0 to 1; `moved` is the first where flow takes it."""
    ratio = float(np.log(after.mask.sum() / before.mask.sum()))
    if is_cut(before.mask) or is_cut(after.mask):
        ratio /= 2
    size = float(np.exp(-0.5 * (ratio / 0.5) ** 2))
    return similarity(before.hist, after.hist) * size * (0.2 + 0.8 * iou(after.mask, moved))


def _flow(working: WorkingClip, before: int, now: int) -> Float32[np.ndarray, "h w 2"]:
    """Return from where each pixel of the later frame came."""
    grey = [cv2.cvtColor(working.rgb[i], cv2.COLOR_RGB2GRAY) for i in (now, before)]
    back = flow_to(*grey)
    y, x = np.mgrid[: back.shape[0], : back.shape[1]].astype(np.float32)
    return np.stack([x, y], -1) + back


def _carried(
    mask: Bool[np.ndarray, "h w"], flow: Float32[np.ndarray, "h w 2"]
) -> Bool[np.ndarray, "h w"]:
    return cv2.remap(mask.astype(np.float32), flow, np.empty(0), cv2.INTER_LINEAR) > 0.5


def _fills(mask: Bool[np.ndarray, "h w"], box: Bool[np.ndarray, "h w"]) -> float:
    """Return how well a mask's own bounding box agrees with a drawn one (intersection over union)."""
    own = np.zeros_like(box)
    x, y, w, h = bounding_box(mask)
    own[y : y + h, x : x + w] = True
    return iou(own, box)

"""Which pixels are the thing that moved and which are the others, from the scene network: the default way.

The network says of every pixel what it is; this module cuts that into things, takes those that fit the caption, and
says from 0 to 1 how sure that is and why not surer.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import cv2
import numpy as np
from jaxtyping import Bool, Float, Float32, Int, UInt8
from scipy.ndimage import median_filter

from v2p_data.scene.classes import HAND, LONG_SIDE_PX, MOVED, OTHER, TABLE
from v2p_data.scene.colour import (
    balance,
    colour_match,
    colour_words,
    histogram,
    lab_of,
    likelihood,
    named_colours,
    similarity,
)
from v2p_data.scene.footage import Footage, end_quarters, still_of
from v2p_data.scene.ground import Moved
from v2p_data.scene.scale import SeenCamera, table_width_m
from v2p_data.scene.segment import (
    bounding_box,
    edge_contrast,
    grow,
    is_cut,
    largest,
    refine,
    tidy,
)
from v2p_data.video.clip import Clip

MOST_FRAMES = 50
"""Frames of a clip that the network looks at; those between take the nearest one's word."""
_LIKELY, _POSSIBLE = 0.5, 0.25
_MARGIN = 0.5
"""Around what moves, as a share of its extent: room for what it may belong to, and for the hand."""
_MOST_OF_PICTURE = 0.75
_FADE_PX = 5
_MOST_ZOOM = 2.5
"""As far as the network was trained on enlarged parts."""
_GAP_PX = 7
"""Of a picture 320 px wide: parts of one thing lie as near as this."""
SWALLOWING_KINDS = ("insert", "throw_into")
"""What is moved so may be hidden at the end."""
_END_WEIGHT = {"insert": 0.4, "throw_into": 0.4, "place_onto": 0.5, "cover": 0.5}
"""How much the last outline counts: a rim, or the hand that still holds it, hides part of what was put there."""
_AROUND_PX = 10
_LEAST_OWN, _LEAST_WRONG, _LEAST_LEFT = 0.25, 0.1, 0.3
"""Shares of an outline: what must not lie in the other's place to tell how the thing looks, what is worth cutting off, and
what must be left."""
_BARE_RATIO = 1.0
"""Logarithm of how much better what lies around explains a pixel than the thing does."""
_SURELY, _SURELY_TABLE = 0.9, 0.8
"""From this on the network's word goes before the edges that an outline follows: they may be those of a shadow or of print."""
_SAME_THING = 0.5
"""Share of the smaller outline in the larger, from which both are the same thing."""
_PIECE = 0.85
"""What a piece of an outline counts: it must be clearly better than the whole."""
_MOSTLY_OTHER = 0.5
"""Share of an outline: with less of the named colour it is taken along with something else."""
_BESIDE_PX = 12
"""Of a picture 320 px wide: as far the network's word completes an outline."""
_MOST_CUT = 0.6
"""Of an outline: where the network sees more of it as table, it does not know the thing."""
_LEAST_CHANGE = 0.05
"""Of an outline: what is not worth mending."""
LEAST_SHARE = 0.0007
"""Of the picture: smaller things cannot be measured."""


@dataclass(frozen=True, kw_only=True)
class Watched:
    """What the network sees over a clip, at working size."""

    idx: Int[np.ndarray, "n"]
    """Footage frames it looked at, the first and the last among them."""
    shares: Float32[np.ndarray, "n 5 h w"]
    early: Float32[np.ndarray, "5 h w"]
    """In the still of the beginning."""
    late: Float32[np.ndarray, "5 h w"]
    """In the still of the end."""
    camera: SeenCamera

    def at(self, i: int) -> Float32[np.ndarray, "5 h w"]:
        """Return the probabilities at the footage frame nearest to `i`."""
        return self.shares[int(np.abs(self.idx - i).argmin())]


@dataclass(frozen=True, kw_only=True)
class _Blob:
    mask: Bool[np.ndarray, "h w"]
    area: int
    hist: np.ndarray
    parts: dict[str, float]
    """What its rating is the product of, each 0 to 1."""

    @property
    def rating(self) -> float:
        return float(np.prod(list(self.parts.values())))

    def weighed(self, what: str, part: float) -> "_Blob":
        """Return the blob with one factor more in its rating."""
        return replace(self, parts={**self.parts, what: part})


@dataclass(frozen=True)
class _Pair:
    """One thing at both ends of the clip."""

    first: _Blob
    last: _Blob
    parts: dict[str, float]
    """What speaks for their being the same thing, each 0 to 1."""

    @property
    def rating(self) -> float:
        return self.first.rating * self.last.rating * float(np.prod(list(self.parts.values())))


def watch(clip: Clip, footage: Footage) -> Watched:
    """Return what the network sees in the clip's frames and in its two stills.

    Where what moves is small, the network looks at it a second time, enlarged.
    """
    from v2p_data.scene.network import look  # torch takes a second to import

    n = len(footage.rgb)
    idx = np.unique(np.linspace(0, n - 1, min(n, MOST_FRAMES)).round().astype(int))
    pictures = np.concatenate([footage.rgb[idx], footage.early[None], footage.late[None]])
    seen = look(
        pictures,
        np.broadcast_to(footage.early, pictures.shape),
        np.broadcast_to(footage.late, pictures.shape),
    )
    camera = _look_closer(clip, footage, idx, seen.shares, seen.camera)
    return Watched(
        idx=idx,
        shares=seen.shares[:-2],
        early=seen.shares[-2],
        late=seen.shares[-1],
        camera=camera,
    )


def _look_closer(
    clip: Clip,
    footage: Footage,
    idx: Int[np.ndarray, "n"],
    shares: Float32[np.ndarray, "n+2 5 h w"],
    camera: SeenCamera,
) -> SeenCamera:
    """Replace the shares around what moves by what the network sees there at the clip's own resolution.

    The window keeps its size and goes along. The last two shares are those of the stills, of the beginning and the end.
    Both looks say how much of the table the picture shows; the camera comes back with both in it.
    """
    from v2p_data.scene.network import look, resized

    windows = _windows(shares[:-2, MOVED])
    if windows is None:
        return camera
    w, h = windows.size
    zoom = LONG_SIDE_PX / max(w, h)
    size = (round(footage.shape[0] * zoom), round(footage.shape[1] * zoom))

    def large(picks: Int[np.ndarray, "k"]) -> UInt8[np.ndarray, "k y x 3"]:
        frames = (clip.frames[i] for i in footage.frame_idx[picks])
        return np.stack([resized(frame, size) for frame in frames])

    n = len(footage.rgb)
    early, late = (still_of(large(np.arange(n)[quarter])) for quarter in end_quarters(n))
    pictures = np.concatenate([large(idx), early[None], late[None]])
    corners = windows.corners[[*range(len(idx)), 0, -1]]
    spots = [
        (slice(y, y + round(h * zoom)), slice(x, x + round(w * zoom)))
        for x, y in (corners * zoom).astype(int)
    ]
    near = look(
        np.stack([picture[spot] for picture, spot in zip(pictures, spots, strict=True)]),
        np.stack([early[spot] for spot in spots]),
        np.stack([late[spot] for spot in spots]),
    )
    inside = np.zeros((h, w), np.float32)
    inside[_FADE_PX:-_FADE_PX, _FADE_PX:-_FADE_PX] = 1
    inside = cv2.blur(inside, (2 * _FADE_PX - 1, 2 * _FADE_PX - 1), borderType=cv2.BORDER_CONSTANT)
    for whole, part, (x, y) in zip(shares, near.shares, corners, strict=True):
        there = whole[:, y : y + h, x : x + w]
        own = [cv2.resize(plane, (w, h), interpolation=cv2.INTER_AREA) for plane in part]
        there += inside * (np.stack(own) - there)
    below = (corners[:, 1] + h / 2 - footage.shape[0] / 2) / footage.shape[1]
    return _both(camera, near.camera, w / footage.shape[1], below)


def _both(
    whole: SeenCamera, part: SeenCamera, share: float, below: Float[np.ndarray, "n"]
) -> SeenCamera:
    """Return the camera of the whole picture, with what parts of it show of the table's width.

    The parts are `share` of the picture's width wide, and lie `below` its middle, in picture widths.
    """
    middle, *rows = (
        table_width_m(whole.pitch_rad, whole.focal_widths, 1.0, float(b)) for b in (0.0, *below)
    )
    ratio = float(np.nanmedian(rows)) / middle * share
    if not np.isfinite(ratio):
        return whole
    precise = np.array([whole.table_width_sd, part.table_width_sd]) ** -2
    logs = np.log([whole.table_width_m, part.table_width_m / ratio])
    return replace(whole, table_width_m=float(np.exp(precise @ logs / precise.sum())))


@dataclass(frozen=True, kw_only=True)
class _Windows:
    size: tuple[int, int]
    """(width, height) [px], of the picture's proportions."""
    corners: Int[np.ndarray, "n 2"]
    """Upper left, (x, y), one for each frame."""


def _windows(moved: Float32[np.ndarray, "n h w"]) -> _Windows | None:
    """Return a part of each picture around what moves in it; None where that is most of it, or nothing."""
    h, w = moved.shape[1:]
    boxes = np.full((len(moved), 4), np.nan)
    for k, plane in enumerate(moved):
        count, parts, stats, _ = cv2.connectedComponentsWithStats(
            tidy(plane > _LIKELY).astype(np.uint8)
        )
        large = [i for i in range(1, count) if stats[i, cv2.CC_STAT_AREA] > LEAST_SHARE * h * w]
        if large:
            boxes[k] = bounding_box(np.isin(parts, large))
    seen = np.flatnonzero(np.isfinite(boxes[:, 0]))
    if not len(seen):
        return None
    extent = np.maximum(boxes[seen, 2] / w, boxes[seen, 3] / h)
    wide = max(float(np.percentile(extent, 80)) * (1 + 2 * _MARGIN), 1 / _MOST_ZOOM)
    if wide > _MOST_OF_PICTURE:
        return None
    size = np.array([round(wide * w), round(wide * h)])
    centre = boxes[:, :2] + boxes[:, 2:] / 2
    every = np.arange(len(moved))
    smooth = [median_filter(np.interp(every, seen, centre[seen, c]), 5) for c in (0, 1)]
    corners = np.clip(np.stack(smooth, 1) - size / 2, 0, np.array([w, h]) - size)
    return _Windows(size=(int(size[0]), int(size[1])), corners=corners.astype(int))


def find_movers(
    footage: Footage,
    watched: Watched,
    phrase: str,
    kind: str,
    tool: str = "",
    first: Bool[np.ndarray, "h w"] | None = None,
    last: Bool[np.ndarray, "h w"] | None = None,
    goal: Bool[np.ndarray, "h w"] | None = None,
    look: Float[np.ndarray, "l a b"] | None = None,
) -> tuple[Moved, Moved | None] | None:
    """Return the manipulated object and, where the caption names one that a hand holds, the tool.

    A mask given by the user for either end is taken as it is; `goal` is what the user marked as that into, onto or over
    which it goes; `look` its colours, where the user marked it on its way. None where nothing that moved was seen.
    """
    starts = _ends(footage, watched, phrase, 0, first)
    stops = _ends(footage, watched, phrase, len(footage.rgb) - 1, last)
    if look is not None:
        starts, stops = ([_alike(blob, look) for blob in ends] for ends in (starts, stops))
    if starts and not stops and kind in SWALLOWING_KINDS:
        stops = _last_seen(footage, watched, phrase, starts[0].area)
    stops = [_hidden_end(blob, _END_WEIGHT.get(kind, 0.7)) for blob in stops]
    if goal is not None and kind in _END_WEIGHT:
        near = grow(goal, _GAP_PX)
        stops = [_at_goal(blob, near) for blob in stops]
    pairs = sorted(
        (
            _Pair(a, b, _pair_parts(a, b, kind, footage.shape))
            for a in starts
            for b in stops
        ),
        key=lambda pair: -pair.rating,
    )  # fmt: skip
    if not pairs:
        return None
    if not tool:
        return _moved(pairs, pairs[0]), None
    # The tool is what the hand holds; the object is pushed by it and lies farther from the hand.
    best = pairs[0]
    rest = [pair for pair in pairs[1:] if _is_another(pair, best)]
    if not rest:
        return _moved(pairs, best), None
    second = rest[0]
    held = [_held(footage, watched, pair.first.hist) for pair in (best, second)]
    words = [colour_words(text) for text in (phrase, tool)]
    by_colour = [
        _named(footage.rgb[0], best.first.mask, words[0]) * _named(footage.rgb[0], second.first.mask, words[1]),
        _named(footage.rgb[0], second.first.mask, words[0]) * _named(footage.rgb[0], best.first.mask, words[1]),
    ]  # fmt: skip
    if by_colour[1] * (0.3 + held[0]) > by_colour[0] * (0.3 + held[1]):
        best, second = second, best
    return _moved(pairs, best), _moved(pairs, second)


def apart(footage: Footage, moved: Moved, keep: Sequence[int] = ()) -> Moved:
    """Return the two outlines without what each has of the other's place: both change, but only one shows the thing.

    A part that both have is bare in one of them where it looks there like what lies around the two, rather than like the rest
    of that outline; where there is hardly a rest, rather than in the other picture.

    Args:
        footage: frames.
        moved: both outlines.
        keep: 0 for a first one, 1 for a last one that is taken as it is.
    """
    masks, images = [moved.first, moved.last], [footage.rgb[0], footage.rgb[-1]]
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
    return replace(moved, first=first, last=last, look=histogram(images[0][first]))


def settled(
    mask: Bool[np.ndarray, "h w"], shares: Float32[np.ndarray, "5 h w"]
) -> Bool[np.ndarray, "h w"]:
    """Return a moved thing's outline without what to the network surely is bare table, shadows above all, and completed.

    Args:
        mask: the outline.
        shares: what the network sees in the picture that it was drawn in.
    """
    return _if_worth(completed(_off_sure_table(mask, shares), shares[MOVED]), mask)


def less_table(
    mask: Bool[np.ndarray, "h w"], shares: Float32[np.ndarray, "5 h w"]
) -> Bool[np.ndarray, "h w"]:
    """Return the outline without what to the network surely is bare table; `shares` is what it sees in the same picture.

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

    Only by what is seen as the same kind, moved or not: what moves may stand before something that does not.
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


def seen_at_first(watched: Watched) -> float | None:
    """Return how much of the picture what moves covers at the beginning, where it only comes into the picture later.

    None where it is there from the beginning, or not seen at the end.
    """
    early, late = (
        float(tidy(still[MOVED] > least).mean())
        for still, least in ((watched.early, _POSSIBLE), (watched.late, _LIKELY))
    )
    return early if early < LEAST_SHARE <= late else None


def hand_at(watched: Watched, i: int) -> Bool[np.ndarray, "h w"]:
    """Return the pixels that are hand or arm at a footage frame."""
    return watched.at(i)[HAND] > _LIKELY


def passed(watched: Watched) -> Bool[np.ndarray, "h w"]:
    """Return the pixels where at some time a hand or what it moves is seen."""
    shares = watched.shares[:, HAND] + watched.shares[:, MOVED]
    return grow(shares.max(0) > _LIKELY, 3)


def table_seen(watched: Watched) -> Bool[np.ndarray, "h w"]:
    """Return the pixels that are bare table both at the beginning and at the end."""
    return (watched.early[TABLE] > _LIKELY) & (watched.late[TABLE] > _LIKELY)


def mask_of_mover(
    footage: Footage, watched: Watched, i: int, blob: Bool[np.ndarray, "h w"]
) -> Bool[np.ndarray, "h w"]:
    """Return a blob's outline at footage frame `i` at working size, the hand cut away."""
    never = grow(hand_at(watched, i) & ~blob, 1) & ~blob
    return refine(footage.rgb[i], blob, never)


def _ends(
    footage: Footage,
    watched: Watched,
    phrase: str,
    i: int,
    given: Bool[np.ndarray, "h w"] | None,
) -> list[_Blob]:
    if given is not None:
        hist = histogram(footage.rgb[i][given])
        return [_Blob(mask=given, area=int(given.sum()), hist=hist, parts={"given": 1.0})]
    moved = watched.at(i)[MOVED]
    h, w = footage.shape
    cores: list[Bool[np.ndarray, "h w"]] = []
    masks: list[Bool[np.ndarray, "h w"]] = []
    hand = hand_at(watched, i)
    for level in (_LIKELY, _POSSIBLE):
        # Print on a thing and what lies in it break it up: gaps are closed, but not over the hand.
        whole = tidy(moved > level, _GAP_PX) & ~(hand & (moved < _POSSIBLE))
        count, parts, stats, _ = cv2.connectedComponentsWithStats(whole.astype(np.uint8))
        for k in range(1, count):
            mask = parts == k
            if stats[k, cv2.CC_STAT_AREA] < LEAST_SHARE * h * w or any(
                (mask & other).any() for other in masks
            ):
                continue
            cores.append(mask)
            masks.append(mask_of_mover(footage, watched, i, largest(_grown_to(mask, moved))))
    pieces = _of_named_colour(footage.rgb[i], phrase, cores)
    blobs = _rated(footage, watched, phrase, i, masks, cores)
    cut = [mask_of_mover(footage, watched, i, piece) for piece in pieces]
    blobs += [
        blob.weighed("cut by colour", _PIECE)
        for blob in _rated(footage, watched, phrase, i, cut, pieces)
    ]
    return sorted(blobs, key=lambda blob: -blob.rating)[:8]


def _of_named_colour(
    image: UInt8[np.ndarray, "h w 3"], phrase: str, wholes: Sequence[Bool[np.ndarray, "h w"]]
) -> list[Bool[np.ndarray, "h w"]]:
    """Return what of each whole has the colour that the phrase names, where an arm may have been taken along.

    An arm reaches the picture's edge, and most of such a whole has another colour.
    """
    if not named_colours(phrase):
        return []
    match = colour_match(balance(image), colour_words(phrase)) > _LIKELY
    out = []
    for whole in wholes:
        if is_cut(whole) and (whole & match).any():
            piece = largest(tidy(whole & match, _GAP_PX))
            if LEAST_SHARE * piece.size <= piece.sum() < _MOSTLY_OTHER * whole.sum():
                out.append(piece)
    return out


def _rated(
    footage: Footage,
    watched: Watched,
    phrase: str,
    i: int,
    masks: Sequence[Bool[np.ndarray, "h w"]],
    cores: Sequence[Bool[np.ndarray, "h w"]],
) -> list[_Blob]:
    """Return what speaks for each mask being what the phrase names, at footage frame `i`, the first or one near the end.

    `cores` are what the network saw of each before its outline was refined: noise is small there.
    """
    image, moved = footage.rgb[i], watched.at(i)[MOVED]
    words = colour_words(phrase)
    match = colour_match(balance(image), words) if words else None
    lab, gone = lab_of(image), lab_of(footage.late if i == 0 else footage.early)
    return [
        _Blob(
            mask=mask,
            area=int(mask.sum()),
            hist=histogram(image[mask]),
            parts={
                "moved": min(1.0, 0.4 + 0.75 * float(moved[mask].mean())),
                "size": float(1 - np.exp(-core.mean() / 0.002)),
                "colour": _named_by(match, mask) ** (1.0 if named_colours(phrase) else 0.3),
                "whole": 0.75 if is_cut(mask) else 1.0,
                "vanishing": _vanishing(lab, gone, mask),
            },
        )
        for mask, core in zip(masks, cores, strict=True)
    ]


def rated(footage: Footage, watched: Watched, phrase: str, kind: str, moved: Moved) -> Moved:
    """Return outlines found in another way, with the cues that the network's own are judged by."""
    stop = len(footage.rgb) - 1
    (a,), (b,) = (
        _rated(footage, watched, phrase, i, [mask], [mask])
        for i, mask in ((0, moved.first), (stop, moved.last))
    )
    b = _hidden_end(b, _END_WEIGHT.get(kind, 0.7))
    pair = _Pair(a, b, _pair_parts(a, b, kind, footage.shape))
    return _moved([pair], pair)


def _last_seen(footage: Footage, watched: Watched, phrase: str, area: int) -> list[_Blob]:
    """Return the blobs of the last frame that shows half of something this large, before all is hidden."""
    for i in watched.idx[: len(watched.idx) // 3 : -1].tolist():
        blobs = _ends(footage, watched, phrase, i, None)
        if any(blob.area > area / 2 for blob in blobs):
            return blobs
    return []


def _hidden_end(blob: _Blob, weight: float) -> _Blob:
    """Return a blob of the last frame with ratings that count by this exponent."""
    return replace(blob, parts={name: part**weight for name, part in blob.parts.items()})


def _alike(blob: _Blob, look: Float[np.ndarray, "l a b"]) -> _Blob:
    """Return a blob that counts little where it has other colours than what the user marked."""
    return blob.weighed("alike what is marked", 0.2 + 0.8 * similarity(blob.hist, look))


def _at_goal(blob: _Blob, goal: Bool[np.ndarray, "h w"]) -> _Blob:
    """Return a blob of the last frame that counts little where it is not at the goal: hands uncover other things."""
    share = float((blob.mask & goal).sum()) / blob.area
    return blob.weighed("at the goal", min(1.0, 0.2 + 2 * share))


def _grown_to(
    core: Bool[np.ndarray, "h w"], moved: Float32[np.ndarray, "h w"]
) -> Bool[np.ndarray, "h w"]:
    """Return the core with what adjoins it and may be part of it, unless that would more than double it."""
    _, parts = cv2.connectedComponents(((moved > 0.35) | core).astype(np.uint8))
    labels = np.unique(parts[core])
    wider = tidy(np.isin(parts, labels[labels > 0])) | core
    return wider if wider.sum() < 2 * core.sum() else core


def _vanishing(
    lab: Float32[np.ndarray, "h w 3"],
    gone: Float32[np.ndarray, "h w 3"],
    mask: Bool[np.ndarray, "h w"],
) -> float:
    """Return whether the mask's outline is an edge here and none once the thing is gone: 0.2 to 1.

    Both where a thing was and where it goes the picture changes; only where it is there is an edge.
    """
    here, after = edge_contrast(lab, mask), edge_contrast(gone, mask)
    return float(np.clip(0.6 + 0.6 * (here - after) / (here + after + 4), 0.2, 1))


def _pair_parts(a: _Blob, b: _Blob, kind: str, shape: tuple[int, int]) -> dict[str, float]:
    ratio = abs(float(np.log(a.area / b.area)))
    weight = _END_WEIGHT.get(kind, 0.7)
    parts = {
        "alike": (0.3 + 0.7 * similarity(a.hist, b.hist)) ** weight,
        "same size": float(np.exp(-0.5 * (max(0.0, ratio - 0.4) / 0.7) ** 2)) ** weight,
    }
    spots = [np.argwhere(blob.mask).mean(0) for blob in (a, b)]
    (rise, across) = (spots[0] - spots[1]) / shape[1]
    if kind in ("push_left", "push_right"):
        along = -across if kind == "push_right" else across
        parts["direction"] = float(np.clip(0.5 + along / 0.06, 0.1, 1))
    elif kind == "lift_up":
        # What is lifted may be put down again before the clip ends.
        parts["direction"] = float(np.clip(0.8 + rise / 0.08, 0.6, 1))
    return parts


def _moved(pairs: list[_Pair], chosen: _Pair) -> Moved:
    a, b = chosen.first, chosen.last
    rival = max((pair.rating for pair in pairs if _is_another(pair, chosen)), default=0.0)
    cues = {
        **{f"first {k}": v for k, v in a.parts.items()},
        **{f"last {k}": v for k, v in b.parts.items()},
        **chosen.parts,
        "no rival": float(1 / (1 + (rival / max(chosen.rating, 1e-6)) ** 2)),
    }
    score = float(np.prod(list(cues.values())))
    return Moved(first=a.mask, last=b.mask, score=score, look=a.hist, cues=cues)


def _is_another(pair: _Pair, chosen: _Pair) -> bool:
    """Return whether a pair is another thing than the chosen one, and no part of it, at both ends."""
    ends = ((pair.first, chosen.first), (pair.last, chosen.last))
    return all((a.mask & b.mask).sum() < _SAME_THING * min(a.area, b.area) for a, b in ends)


def _held(footage: Footage, watched: Watched, hist: np.ndarray) -> float:
    """Return how much of the time a hand adjoins what looks like this (0 to 1)."""
    touches = []
    for i in watched.idx[len(watched.idx) // 4 : -(len(watched.idx) // 4) or None]:
        shares = watched.at(int(i))
        hand = shares[HAND] > _LIKELY
        if hand.sum() < 30:
            continue
        alike = (shares[MOVED] > _LIKELY) & (likelihood(hist, footage.rgb[i]) > 2e-4)
        near = grow(hand, 5) & alike
        touches.append(min(1.0, near.sum() / max(1.0, 0.25 * alike.sum())))
    return float(np.mean(touches)) if touches else 0.0


def _named(
    image: UInt8[np.ndarray, "h w 3"], mask: Bool[np.ndarray, "h w"], words: tuple[str, ...]
) -> float:
    return _named_by(colour_match(balance(image), words) if words else None, mask)


def _named_by(match: Float32[np.ndarray, "h w"] | None, mask: Bool[np.ndarray, "h w"]) -> float:
    """Return 1 for a mask of the colour its phrase names, down to 0.4; 1 where it names none."""
    if match is None or not mask.any():
        return 1.0
    return 0.4 + 0.6 * min(1.0, float(match[mask].mean()) / 0.4)

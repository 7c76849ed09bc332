"""Of several pictures in a clip the one is taken in which a bare hand is at what moves; a person may name another.

A model that knows hands decides, or our network where there is none. How much of a picture changes does not count: robots move as well.
"""

from collections.abc import Callable
from dataclasses import replace

import cv2
import numpy as np

from v2p_data.errors import ItemRejectedError, V2PError
from v2p_data.scene.frames.classes import HAND, MOVED
from v2p_data.scene.frames.colour import skin_prior
from v2p_data.scene.frames.hand_track import HandTrack
from v2p_data.scene.frames.split_screen import PaneBox, panes_of
from v2p_data.scene.frames.working_clip import WorkingClip, working_clip_of
from v2p_data.video.clip import Clip, Crop
from v2p_data.video.hints import CROP, MIN_CROP_PX, hints_in_crop

FindHands = Callable[[Clip, WorkingClip], HandTrack | None]
"""What a model that knows hands says of a clip; None without a model."""
_LEAST_HAND = 0.15
"""Share of the frames with a hand, from which a picture counts as one with a hand."""
_AS_GOOD = 0.8
"""Of the largest share: among pictures so good the largest is taken, and no part of it."""
_FRAMES = 12
_LEAST_PX = 40
"""Pixels of a working frame: smaller regions are noise."""
_REACH_PX = 6
"""Between a hand and what it moves, of a picture 320 px wide."""
_LIKELY, _POSSIBLE = 0.5, 0.3


def cropped(clip: Clip, box: PaneBox, note: str) -> Clip:
    """Return a part of the clip's pictures; hints go along, and `Clip.crop` says which part is left.

    Raises:
        ItemRejectedError: `bad_hint`: a mark lies outside of it.
    """
    x0, y0, x1, y1 = box
    if box == (0, 0, clip.width_px, clip.height_px):
        return replace(clip, warnings=(*clip.warnings, note))
    before = clip.crop or Crop(
        box_px=(0, 0, clip.width_px, clip.height_px), full_px=(clip.width_px, clip.height_px)
    )
    left, top = before.box_px[:2]
    crop = Crop(box_px=(left + x0, top + y0, left + x1, top + y1), full_px=before.full_px)
    here = Crop(box_px=box, full_px=(clip.width_px, clip.height_px))
    shown = replace(clip, crop=crop)
    try:
        hints = hints_in_crop(clip.hints, here, shown.in_file_px, clip.path.name)
    except V2PError as error:
        raise ItemRejectedError("bad_hint", str(error)) from error
    return replace(
        shown,
        frames=np.ascontiguousarray(clip.frames[:, y0:y1, x0:x1]),
        hints=hints,
        warnings=(*clip.warnings, note),
    )


def as_a_person_cropped(clip: Clip) -> Clip | None:
    """Return the part of the pictures that a person named; None where nobody named one.

    Raises:
        ItemRejectedError: `bad_hint`: it is smaller than can be understood.
    """
    said = clip.hints.get(CROP, {}).get("box")
    if said is None or CROP in clip.objects:
        return None
    x0, y0, x1, y1 = (round(v) for v in said)
    box = max(0, x0), max(0, y0), min(clip.width_px, x1), min(clip.height_px, y1)
    rest = replace(clip, hints={p: hint for p, hint in clip.hints.items() if p != CROP})
    if min(box[2] - box[0], box[3] - box[1]) < MIN_CROP_PX // 2:
        raise ItemRejectedError(
            "bad_hint",
            f"{clip.path.name}, hint 'crop': of the picture only {box[2] - box[0]} x {box[3] - box[1]} px are left, at the "
            f"size at which it is read; {MIN_CROP_PX // 2} or more are needed",
        )
    return cropped(rest, box, f"the part {_in_words(rest, box)} was taken, as its hint says")


def with_one_pane(clip: Clip, working: WorkingClip, find_hands: FindHands) -> Clip:
    """Return the picture in which a bare hand is at what moves, of several that a clip shows at once.

    An inset in that picture is halted.

    Raises:
        ItemRejectedError: `split_screen`: none of them shows a hand; with the largest share of frames that has one.
    """
    panes = panes_of(clip.frames, working)
    if not panes:
        return clip
    bare = replace(clip, hints={})
    shares = [
        hand_share(cropped(_with_insets_frozen(bare, panes, k), box, ""), find_hands)
        for k, box in enumerate(panes)
    ]
    areas = [(c - a) * (d - b) for a, b, c, d in panes]
    likely = [k for k, share in enumerate(shares) if share >= _AS_GOOD * max(shares)]
    best = max(likely, key=lambda k: areas[k])
    where = "; ".join(_in_words(clip, box) for box in panes)
    if shares[best] < _LEAST_HAND:
        raise ItemRejectedError(
            "split_screen",
            f"the clip shows {len(panes)} pictures at once, {where}, and none in which a bare hand is at what moves; "
            'name one in captions.json: "hints": {"crop": [x, y, width, height]}',
            round(shares[best], 3),
        )
    note = (
        f"the clip shows {len(panes)} pictures at once, {where}: {_in_words(clip, panes[best])} was taken, because a bare hand "
        f'touches the moving object in {shares[best]:.0%} of its frames; "hints": {{"crop": [x, y, width, height]}} takes another'
    )
    return cropped(_with_insets_frozen(clip, panes, best), panes[best], note)


def hand_share(clip: Clip, find_hands: FindHands) -> float:
    """Return the share of frames in which a bare hand is seen, and without a model that knows hands one at what moves."""
    working = working_clip_of(clip)
    hands = find_hands(clip, working)
    if hands is not None:
        return len(np.unique(hands.at)) / max(1, hands.num_sampled)
    from v2p_data.scene.frames.network import classify  # torch takes a second to import

    n = len(working.rgb)
    frames = working.rgb[np.unique(np.linspace(0, n - 1, min(n, _FRAMES)).round().astype(int))]
    early, late = (np.broadcast_to(one, frames.shape) for one in (working.early, working.late))
    shares = classify(frames, early, late).shares
    near = np.ones((2 * _REACH_PX + 1, 2 * _REACH_PX + 1), np.uint8)
    seen = 0
    for frame, share in zip(frames, shares, strict=True):
        hand = (share[HAND] > _LIKELY) & skin_prior(frame)
        reached = cv2.dilate((share[MOVED] > _POSSIBLE).astype(np.uint8), near) > 0
        seen += hand.sum() >= _LEAST_PX and (hand & reached).any()
    return seen / len(frames)


def _with_insets_frozen(clip: Clip, panes: list[PaneBox], taken: int) -> Clip:
    """Return the clip with every inset in the chosen picture frozen at its first frame."""
    x0, y0, x1, y1 = panes[taken]
    inside = [
        b
        for k, b in enumerate(panes)
        if k != taken and x0 <= b[0] and y0 <= b[1] and b[2] <= x1 and b[3] <= y1
    ]
    if not inside:
        return clip
    frames = clip.frames.copy()
    for a, b, c, d in inside:
        frames[:, b:d, a:c] = frames[:1, b:d, a:c]
    return replace(clip, frames=frames)


def _in_words(clip: Clip, box: PaneBox) -> str:
    """Return a box as a hint names it: x, y, width, height in the file's pixels."""
    left, top, right, bottom = clip.in_file_px
    sx, sy = (right - left) / clip.width_px, (bottom - top) / clip.height_px
    x0, y0, x1, y1 = box
    return str(
        [round(left + x0 * sx), round(top + y0 * sy), round((x1 - x0) * sx), round((y1 - y0) * sy)]
    )

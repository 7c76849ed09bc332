"""Clips filmed from the hand: every frame is brought to where the first one was taken from.

What does not move in the scene fills most of a picture, and a camera that sways by a few centimetres changes it by about one
homography. It is measured from corners that are followed from the first frame into every other one. What stands high above
the table keeps a little of the sway: that is why a camera that travels is still turned away.
"""

import itertools
from dataclasses import replace

import cv2
import numpy as np
from jaxtyping import Bool, Float, Float32, UInt8

from v2p_data.geometry.camera import between_centres
from v2p_data.scene.frames.working_clip import WIDTH_PX, WorkingClip, camera_shift_px, followed
from v2p_data.video.clip import Clip, Hint

MAX_SWAY = 0.1
"""Of the picture's width: where its corners went farther, the camera travelled, and things hide each other anew."""
_CORNERS = 400
_FEWEST = 20
"""Corners in agreement; with fewer, a frame goes as the one before went."""
_MOST_LOST = 0.1
"""Share of the frames that may go so: blurred ones."""
_AGREES_PX = 1.0
"""At working size."""
_CLEARLY_MORE = 1.5
"""So many times more corners must agree with a camera that moves than with one that stands, in the mean over the frames that move."""
_SPREAD = 0.35
"""Of the picture's width and height: corners in agreement that lie closer together may all be on one moving thing,"""
_ALL_AGREE = 0.95
"""unless hardly any corner moves otherwise."""
_STANDS_PX = 1.0
"""A camera whose picture moves less than this at working size stands still."""


def stabilised(clip: Clip, working: WorkingClip) -> Clip:
    """Return the clip with its frames aligned with the first one; as it is where the camera stood still or no way is found.

    What the aligned frames no longer show at their edges is filled with the first frame's pixels; hints go along.
    """
    if camera_shift_px(working) < _STANDS_PX:
        return clip
    h, w = clip.frames.shape[1:3]
    small_h, small_w = working.shape
    small = _moves(_greys(clip.frames, (small_w, small_h)))
    if small is None:
        return clip
    to_small = np.diag([small_w / w, small_h / h, 1.0])
    to_filmed = np.linalg.inv(to_small) @ small @ to_small
    edges = np.array([[[0, 0], [w, 0], [w, h], [0, h]]], np.float64)
    sway = (
        max(float(np.abs(cv2.perspectiveTransform(edges, H) - edges).max()) for H in to_filmed) / w
    )
    if sway > MAX_SWAY:
        return clip
    note = (
        f"the camera swayed by up to {sway * WIDTH_PX:.0f} px of {WIDTH_PX}: all frames were aligned with the first, and "
        "masks and overlays belong to the aligned ones"
    )
    return replace(
        clip,
        frames=_aligned(clip.frames, to_filmed),
        to_filmed=to_filmed,
        hints={phrase: _moved(hint, to_filmed, (h, w)) for phrase, hint in clip.hints.items()},
        warnings=(*clip.warnings, note),
    )


def _greys(
    frames: UInt8[np.ndarray, "time h w 3"], size: tuple[int, int]
) -> list[UInt8[np.ndarray, "b a"]]:
    how = cv2.INTER_AREA if size[0] < frames.shape[2] else cv2.INTER_LINEAR
    return [
        cv2.cvtColor(cv2.resize(frame, size, interpolation=how), cv2.COLOR_RGB2GRAY)
        for frame in frames
    ]


def _moves(grey: list[UInt8[np.ndarray, "h w"]]) -> Float[np.ndarray, "time 3 3"] | None:
    """Return per frame the homography that takes the first frame's pixels there; None where that is not clear."""
    corners = cv2.goodFeaturesToTrack(grey[0], _CORNERS, 0.005, 5)
    if corners is None or len(corners) < _FEWEST:
        return None
    moves, tellings = [np.eye(3)], []
    for image in grey[1:]:
        start = cv2.perspectiveTransform(corners, moves[-1]).astype(np.float32)
        there, sure = followed(grey[0], image, corners, start)
        here, there = corners[sure, 0] + 0.5, there[sure, 0] + 0.5
        found = _motion(here, there, image.shape)
        if found is None:
            moves.append(moves[-1])
            continue
        H, agree = found
        moves.append(H)
        went = np.linalg.norm(there - here, axis=-1)
        if went[agree].max() > _STANDS_PX:
            tellings.append((agree.sum(), (went < _AGREES_PX).sum()))
    lost = sum(one is other for one, other in itertools.pairwise(moves)) / len(moves)
    if not tellings or lost > _MOST_LOST:
        return None
    moved, stayed = np.mean(tellings, axis=0)
    return np.stack(moves) if moved > _CLEARLY_MORE * stayed else None


def _motion(
    here: Float32[np.ndarray, "n 2"], there: Float32[np.ndarray, "n 2"], shape: tuple[int, ...]
) -> tuple[Float[np.ndarray, "3 3"], Bool[np.ndarray, "n"]] | None:
    """Return how the picture moved and which corners agree; None where too few do, or perhaps all on one thing."""
    if len(here) < _FEWEST:
        return None
    H, agree = cv2.findHomography(here, there, cv2.USAC_MAGSAC, _AGREES_PX)
    if H is None:
        return None
    inside = agree[:, 0] > 0
    wide = inside.any() and _extent(here[inside], shape) >= _SPREAD
    return (
        (H, inside) if inside.sum() >= _FEWEST and (wide or inside.mean() > _ALL_AGREE) else None
    )


def _extent(points: Float32[np.ndarray, "n 2"], shape: tuple[int, ...]) -> float:
    return float((np.ptp(points, axis=0) / shape[1::-1]).min())


def _aligned(
    frames: UInt8[np.ndarray, "time h w 3"], to_filmed: Float[np.ndarray, "time 3 3"]
) -> UInt8[np.ndarray, "time h w 3"]:
    h, w = frames.shape[1:3]
    out = np.empty_like(frames)
    for own, frame, H in zip(out, frames, to_filmed, strict=True):
        own[:] = frames[0]
        cv2.warpPerspective(
            frame,
            between_centres(H),
            (w, h),
            dst=own,
            flags=cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP,
            borderMode=cv2.BORDER_TRANSPARENT,
        )
    return out


def _moved(hint: Hint, to_filmed: Float[np.ndarray, "time 3 3"], shape: tuple[int, int]) -> Hint:
    """Return a hint where the thing is in the aligned frame."""
    out = hint.copy()
    h, w = shape
    to_aligned = np.linalg.inv(to_filmed[hint.get("frame", 0)])
    if "box" in hint:
        x0, y0, x1, y1 = hint["box"]
        ends = cv2.perspectiveTransform(
            np.array([[[x0, y0], [x1, y0], [x1, y1], [x0, y1]]], np.float64), to_aligned
        )[0]
        low, high = ends.min(0).clip(0, (w, h)), ends.max(0).clip(0, (w, h))
        if (high - low).min() >= 1:
            out["box"] = [float(v) for v in (*low, *high)]
    if "points" in hint:
        points = cv2.perspectiveTransform(np.array([hint["points"]], np.float64), to_aligned)[0]
        out["points"] = points.clip(0, (w - 1, h - 1)).tolist()
    return out

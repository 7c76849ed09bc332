"""Clips filmed from the hand: every frame is brought to where the first one was taken from.

The table fills most of a picture, and a camera that sways, pans or walks by a few centimetres
changes how it looks by one homography per frame (`camera_motion.py`). What stands high above the
table keeps a little of the sway: that is why a camera that travels far is turned away.
"""

from dataclasses import replace

import cv2
import numpy as np
from jaxtyping import Float, UInt8

from v2p_data.errors import ItemRejectedError
from v2p_data.geometry.camera import between_centres
from v2p_data.scene.frames.camera_motion import STANDS_PX, camera_motion
from v2p_data.scene.frames.working_clip import WIDTH_PX, WorkingClip, camera_shift_px
from v2p_data.video.clip import Clip, Hint

MAX_TRAVEL = 0.13
"""Of the picture's width: where its middle went farther, the camera travelled, and things hide each other anew."""
MAX_ZOOM = 0.12
"""Lengths in the picture may grow or shrink by so much."""
SURE_SHARE = 0.5
"""Of `MAX_TRAVEL`: with less shift of the picture as a whole, a far way is not believed."""
_BACK = cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP
_FILL_FRAMES = 15
"""Of so many frames the nearest in time fills what a frame no longer shows."""


def stabilised(clip: Clip, working: WorkingClip) -> Clip:
    """Return the clip with its frames aligned with the first one.

    As it is where the camera stood still or no way is found.

    What the aligned frames no longer show at their edges is filled from the nearest frame that
    shows it; hints go along.

    Raises:
        ItemRejectedError: `camera_moves`: it clearly moved, and farther than can be undone.
    """
    shift_px = camera_shift_px(working)
    if shift_px < STANDS_PX:
        return clip
    h, w = clip.frames.shape[1:3]
    small_h, small_w = working.shape
    motion = camera_motion(_greys(clip.frames, (small_w, small_h)))
    if motion is None:
        return clip
    travel, zoom = motion.travel(small_w, small_h), motion.zoom(small_w, small_h)
    if travel > MAX_TRAVEL or zoom > MAX_ZOOM:
        if shift_px < SURE_SHARE * MAX_TRAVEL * WIDTH_PX:
            # Corners and edges disagree: a thing that fills a plain picture moves. `check_still` knows what moved.
            return clip
        raise ItemRejectedError(
            "camera_moves",
            f"the camera travels by {travel * WIDTH_PX:.0f} px of {WIDTH_PX} and zooms by {zoom:.0%}; at most "
            f"{MAX_TRAVEL * WIDTH_PX:.0f} px and {MAX_ZOOM:.0%} can be undone: hold it stiller, or film from a stand",
            round(travel * WIDTH_PX, 2),
        )
    to_small = np.diag([small_w / w, small_h / h, 1.0])
    to_filmed = np.linalg.inv(to_small) @ motion.to_frames @ to_small
    note = (
        f"the camera swayed by up to {travel * WIDTH_PX:.0f} px of {WIDTH_PX}: all frames were "
        "aligned with the first, and "
        "masks and overlays belong to the aligned ones"
    )
    return replace(
        clip,
        frames=_aligned(clip.frames, to_filmed),
        to_filmed=to_filmed,
        hints={
            phrase: hint_in_aligned(hint, to_filmed, (w, h)) for phrase, hint in clip.hints.items()
        },
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


def _aligned(
    frames: UInt8[np.ndarray, "time h w 3"], to_filmed: Float[np.ndarray, "time 3 3"]
) -> UInt8[np.ndarray, "time h w 3"]:
    """Return the frames as the first one's camera would show them."""
    n, h, w = frames.shape[:3]
    out = np.empty_like(frames)
    beyond = np.empty((n, h, w), bool)
    whole = np.full((h, w), 255, np.uint8)
    for own, gone, frame, H in zip(out, beyond, frames, to_filmed, strict=True):
        there = between_centres(H)
        own[:] = cv2.warpPerspective(frame, there, (w, h), flags=_BACK)
        gone[:] = cv2.warpPerspective(whole, there, (w, h), flags=_BACK) < 255
    picks = np.unique(np.linspace(0, n - 1, min(_FILL_FRAMES, n)).round().astype(int))
    shown = out[picks].copy()
    for t in range(n):
        left = beyond[t].copy()
        for k in np.argsort(np.abs(picks - t), kind="stable"):
            fills = left & ~beyond[picks[k]]
            out[t][fills] = shown[k][fills]
            left &= ~fills
            if not left.any():
                break
    return out


def hint_in_aligned(
    hint: Hint, to_filmed: Float[np.ndarray, "time 3 3"], size_px: tuple[int, int]
) -> Hint:
    """Return a hint where the object is in the aligned frame.

    Args:
        hint: in the pixels and frame numbers of the clip as it was filmed.
        to_filmed: by frame, the homography from aligned pixels to filmed ones.
        size_px: width and height of the clip's frames.
    """
    out = hint.copy()
    w, h = size_px
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
        out["points"] = _aligned_spots(hint["points"], to_aligned, size_px)
    if "click" in hint:
        out["click"] = _aligned_spots([hint["click"]], to_aligned, size_px)[0]
    if "stroke" in hint:
        out["stroke"] = _aligned_spots(hint["stroke"], to_aligned, size_px)
    return out


def _aligned_spots(
    spots: list[list[float]], to_aligned: Float[np.ndarray, "3 3"], size_px: tuple[int, int]
) -> list[list[float]]:
    w, h = size_px
    there = cv2.perspectiveTransform(np.array([spots], np.float64), to_aligned)[0]
    return there.clip(0, (w - 1, h - 1)).tolist()

"""The clip as the scene room looks at it: small frames, stills without passers-by, and the moving hand's colour.

Everything that looks at pixels works at 320 px width: the hand-written measures are tuned there, and a
five-second clip then takes seconds.
"""

from dataclasses import dataclass, field

import cv2
import numpy as np
from jaxtyping import Bool, Float, Float32, Int, UInt8

from v2p_data.scene.frames.colour import histogram, lab_distance, lab_of
from v2p_data.scene.frames.outliner import Outliner
from v2p_data.video.clip import Clip

WIDTH_PX = 320
MAX_FRAMES = 150
_LEAST_STILL = 0.8
"""Of a tile, for it to tell of the camera."""
_STILL_FRAMES = 24
"""At most so many frames make a still."""
_ROWS = 32
_THERE_AND_BACK_PX = 0.7
_FEW_CORNERS = 12
"""With fewer corners to follow nothing is said about the camera."""


@dataclass(frozen=True, kw_only=True)
class WorkingClip:
    """Frames at working size with what follows from them directly."""

    rgb: UInt8[np.ndarray, "time h w 3"]
    lab: Float32[np.ndarray, "time h w 3"]
    frame_idx: Int[np.ndarray, "time"]
    """Each working frame's index in the clip."""
    px_scale: float
    """Working pixels per clip pixel."""
    early: UInt8[np.ndarray, "h w 3"]
    """What stands still during the first quarter."""
    late: UInt8[np.ndarray, "h w 3"]
    """What stands still during the last quarter."""
    always: UInt8[np.ndarray, "h w 3"]
    """What stands still most of the time."""
    hand_hist: Float[np.ndarray, "l a b"] = field(repr=False)
    """Colour histogram of the hand; zeros until the network has seen it."""
    rest_hist: Float[np.ndarray, "l a b"] = field(repr=False)
    """Colour histogram of what does not move."""
    outliner: Outliner | None = None
    """Where a model that outlines objects was asked for."""

    @property
    def shape(self) -> tuple[int, int]:
        return self.rgb.shape[1], self.rgb.shape[2]


def working_clip_of(clip: Clip) -> WorkingClip:
    """Return at most 150 evenly spaced frames of the clip at working size, with their stills."""
    n = len(clip.frames)
    frame_idx = np.unique(np.linspace(0, n - 1, min(n, MAX_FRAMES)).round().astype(int))
    h, w = clip.frames.shape[1:3]
    size = (WIDTH_PX, max(8, round(h * WIDTH_PX / w)))
    how = cv2.INTER_AREA if w > WIDTH_PX else cv2.INTER_LINEAR
    rgb = np.stack([cv2.resize(clip.frames[i], size, interpolation=how) for i in frame_idx])
    lab = lab_of(rgb)
    first, last = end_quarters(len(rgb))
    always = still_of(rgb)
    return WorkingClip(
        rgb=rgb,
        lab=lab,
        frame_idx=frame_idx,
        px_scale=WIDTH_PX / w,
        early=still_of(rgb[first]),
        late=still_of(rgb[last]),
        always=always,
        hand_hist=histogram(np.zeros((0, 3), np.uint8)),
        rest_hist=histogram(always.reshape(-1, 3)),
    )


def end_quarters(n: int) -> tuple[slice, slice]:
    """Return the first and the last quarter of `n` frames, of which the stills are made: three frames at least."""
    quarter = max(3, n // 4)
    return slice(0, quarter), slice(-quarter, None)


def still_of(rgb: UInt8[np.ndarray, "time h w 3"]) -> UInt8[np.ndarray, "h w 3"]:
    """Return per pixel the colour that is there most of the time (mode seeking from the median)."""
    pick = np.unique(np.linspace(0, len(rgb) - 1, min(_STILL_FRAMES, len(rgb))).astype(int))
    still = np.empty(rgb.shape[1:], np.uint8)
    for top in range(0, len(still), _ROWS):  # a few rows at a time: large frames take much memory
        rows = slice(top, top + _ROWS)
        part = rgb[pick, rows]
        colours, lab = part.astype(np.float32), lab_of(part)
        centre = np.median(lab, axis=0)
        weight = np.ones(lab.shape[:3], np.float32)
        for _ in range(3):
            distance = lab_distance(lab, centre)
            weight = np.exp(-((distance / 8) ** 2)) + 1e-4
            centre = (weight[..., None] * lab).sum(0) / weight.sum(0)[..., None]
        mean = (weight[..., None] * colours).sum(0) / weight.sum(0)[..., None]
        still[rows] = np.clip(mean.round(), 0, 255)
    return still


def camera_shift_px(
    working: WorkingClip, passers_by: Bool[np.ndarray, "h w"] | None = None
) -> float:
    """Return how far the picture moved as a whole, at working size: the largest over nine frames.

    Two measures look at it and the smaller one counts, since a camera that moves shows in both:
    corners fail where most of them lie on what is moved, tiles where the picture is plain.
    `passers_by` is where things moved in front of the camera, as far as that is known: both
    measures look at the rest of the picture as well, which may be too little.
    """
    grey = [cv2.cvtColor(f, cv2.COLOR_RGB2GRAY) for f in working.rgb]
    pick = np.unique(np.linspace(0, len(grey) - 1, 9).astype(int))
    chosen = [grey[i] for i in pick]
    everywhere = np.ones(working.shape, bool)
    shifts = [
        shift
        for there in ([everywhere] if passers_by is None else [everywhere, ~passers_by])
        for shift in (_corner_shift(chosen, there), _tile_shift(chosen, there))
        if shift is not None
    ]
    return min(shifts) if shifts else 0.0


def _corner_shift(
    grey: list[UInt8[np.ndarray, "h w"]], still: Bool[np.ndarray, "h w"]
) -> float | None:
    """Return the distance that one in six corners stays below: if the camera moved, hardly any stays.

    On a bare table most corners lie on what is moved.
    """
    corners = cv2.goodFeaturesToTrack(grey[0], 250, 0.01, 6, mask=still.astype(np.uint8))
    if corners is None or len(corners) < _FEW_CORNERS:
        return None
    worst = None
    for image in grey[1:]:
        there, sure = followed(grey[0], image, corners)
        if sure.sum() >= _FEW_CORNERS:
            shifts = np.linalg.norm((there - corners)[sure, 0], axis=-1)
            worst = max(worst or 0.0, float(np.percentile(shifts, 16)))
    return worst


def followed(
    first: UInt8[np.ndarray, "h w"],
    image: UInt8[np.ndarray, "h w"],
    corners: Float32[np.ndarray, "n 1 2"],
    start: Float32[np.ndarray, "n 1 2"] | None = None,
) -> tuple[Float32[np.ndarray, "n 1 2"], Bool[np.ndarray, "n"]]:
    """Return where one picture's corners are in another, and which of them are found again on the way back.

    `start` is where they are expected, where that is known.
    """
    flags = 0 if start is None else cv2.OPTFLOW_USE_INITIAL_FLOW
    ahead, home = (np.empty(0),) * 2 if start is None else (start.copy(), corners.copy())
    there, found, _ = cv2.calcOpticalFlowPyrLK(first, image, corners, ahead, flags=flags)
    back, found_back, _ = cv2.calcOpticalFlowPyrLK(image, first, there, home, flags=flags)
    sure = (found[:, 0] > 0) & (found_back[:, 0] > 0)
    return there, sure & (np.linalg.norm((back - corners)[:, 0], axis=-1) < _THERE_AND_BACK_PX)


def _tile_shift(
    grey: list[UInt8[np.ndarray, "h w"]], still: Bool[np.ndarray, "h w"]
) -> float | None:
    """Return the median shift of six phase-correlated tiles, of those with texture."""
    h, w = grey[0].shape
    th, tw = h // 2, w // 3
    window = cv2.createHanningWindow((tw, th), cv2.CV_32F)
    worst = None
    for image in grey[1:]:
        shifts = []
        for y, x in ((r * th, c * tw) for r in range(2) for c in range(3)):
            if still[y : y + th, x : x + tw].mean() < _LEAST_STILL:
                continue
            a, b = (g[y : y + th, x : x + tw].astype(np.float32) for g in (grey[0], image))
            if a.std() < 4:
                continue
            (dx, dy), response = cv2.phaseCorrelate(a, b, window)
            if response > 0.05:
                shifts.append(float(np.hypot(dx, dy)))
        if shifts:
            worst = max(worst or 0.0, float(np.median(shifts)))
    return worst

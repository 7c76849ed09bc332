"""How a clip was edited: black bars are cut off; clips with cuts are rejected with advice.

Cross-fades are not told from fast hands and moving cameras, and are not looked for.
"""

import cv2
import numpy as np
from jaxtyping import Float32, UInt8

from v2p_data.errors import ItemRejectedError
from v2p_data.scene.frames.crop import cropped
from v2p_data.scene.frames.working_clip import WorkingClip
from v2p_data.video.clip import Clip

_SAMPLES = 24
_BLACK, _JUMP = 24, 14
"""Luma, 0 to 255: bars stay below the first, and the picture beside them is brighter by the second."""
_JUMPS = 0.5
"""Share of a bar's length at which the picture beside it is that much brighter."""
_LEAST_BAR, _LEAST_PICTURE = 0.015, 0.4
"""Of a side: thinner bars are codec noise, and a smaller picture is no video with bars."""

_Edges = Float32[np.ndarray, "y x"]
"""Edges of one frame."""
_EDGE_PX = 160
"""Width at which edges are compared."""
_SHIFT = 0.14
"""Of the picture's width: edges may have moved so far between two frames of one shot."""
_WINDOW = 3
"""Frames on each side of a cut that must show one scene: a hand that comes fast into the picture is no cut."""
_OTHER, _SAME = 0.33, 0.55
"""Correlation of edges: below the first, two pictures show different scenes; above the second, the
same one. In 35 uncut clips neighbours agree to 0.57 or more, but where a hand covers a nearly empty
picture (0.26)."""


def without_bars(clip: Clip) -> Clip:
    """Return the clip without black bars at its edges; as it is where it has none.

    Hints go along. `Clip.crop` says which part of the picture is left.
    """
    box = _picture_box(clip.frames)
    h, w = clip.frames.shape[1:3]
    if box == (0, 0, w, h):
        return clip
    x0, y0, x1, y1 = box
    note = (
        f"the picture has black bars: {x0} px left, {w - x1} right, {y0} above, {h - y1} below "
        f"(of {w} x {h}) were cut off; masks, "
        "overlays and camera belong to the rest"
    )
    return cropped(clip, box, note)


# --- bars ----------------------------------------------------------------------------------------------------


def _picture_box(frames: UInt8[np.ndarray, "time h w 3"]) -> tuple[int, int, int, int]:
    """Return x0, y0, x1, y1 of the picture between black bars."""
    n, h, w = frames.shape[:3]
    pick = np.unique(np.linspace(0, n - 1, min(n, _SAMPLES)).round().astype(int))
    brightest = np.zeros((h, w), np.uint8)
    for i in pick:
        np.maximum(brightest, frames[i].max(-1), out=brightest)
    top, bottom = _bars(brightest)
    left, right = _bars(np.ascontiguousarray(brightest[top : h - bottom].T))
    if h - top - bottom < _LEAST_PICTURE * h or w - left - right < _LEAST_PICTURE * w:
        return 0, 0, w, h
    return left, top, w - right, h - bottom


def _bars(brightest: UInt8[np.ndarray, "h w"]) -> tuple[int, int]:
    """Return how many rows at the beginning and at the end are bars."""
    return _bar(brightest), _bar(brightest[::-1])


def _bar(brightest: UInt8[np.ndarray, "h w"]) -> int:
    dark = np.percentile(brightest, 97, axis=1) < _BLACK
    if dark.all() or not dark[0]:
        return 0
    rows = int(np.argmin(dark))
    if rows < max(2, _LEAST_BAR * len(brightest)) or rows + 3 >= len(brightest):
        return 0
    inside = brightest[rows + 2].astype(int) - brightest[rows - 2].astype(int)
    # The row at the edge is a mixture of both.
    return rows + 1 if (inside > _JUMP).mean() > _JUMPS else 0


# --- cuts ----------------------------------------------------------------------------------------------------


def check_cuts(clip: Clip, working: WorkingClip) -> None:
    """Reject a clip that shows more than one shot.

    Raises:
        ItemRejectedError: `cut`, with the number that decided.
    """
    edges = _edge_spectra(working.rgb)
    cuts = cuts_of(edges)
    if not cuts:
        return
    ends = [0, *(at for at, _ in cuts), len(working.rgb)]
    k = int(np.argmax(np.diff(ends)))
    times = clip.times_s[working.frame_idx]
    start = float(times[ends[k]])
    stop = float(times[min(ends[k + 1], len(times) - 1)])
    least = min(value for _, value in cuts)
    where = ", ".join(f"{times[at]:.1f} s" for at, _ in cuts[:4])
    raise ItemRejectedError(
        "cut",
        f"the clip is cut at {where}: the edges before and after agree to {least:.2f}, one shot "
        f"has {_OTHER:.2f} or more; its longest "
        f"uncut part is from {start:.2f} to {stop:.2f} s: ffmpeg -ss {start:.2f} -to {stop:.2f} "
        f"-i {clip.path.name} uncut.mp4",
        round(least, 3),
    )


def cuts_of(edges: list[_Edges]) -> list[tuple[int, float]]:
    """Return each cut's first frame, and how much the edges before and after agree, -1 to 1."""
    n = len(edges)
    found = list[tuple[int, float]]()
    for t in range(_WINDOW, n - _WINDOW + 1):
        before, after = range(t - _WINDOW, t), range(t, t + _WINDOW)
        if _agreement(edges[before[-1]], edges[after[0]]) >= _OTHER:
            continue
        within = min(
            _agreement(edges[before[0]], edges[before[-1]]),
            _agreement(edges[after[0]], edges[after[-1]]),
        )
        across = max(_agreement(edges[i], edges[j]) for i in before for j in after)
        if across < _OTHER and within > _SAME:
            found.append((t, across))
    return _one_each(found)


def _one_each(found: list[tuple[int, float]]) -> list[tuple[int, float]]:
    """Return of neighbouring finds the clearest."""
    out = list[tuple[int, float]]()
    for at, value in sorted(found):
        if out and at - out[-1][0] <= _WINDOW:
            if value < out[-1][1]:
                out[-1] = (at, value)
        else:
            out.append((at, value))
    return out


def _edge_spectra(rgb: UInt8[np.ndarray, "time h w 3"]) -> list[_Edges]:
    """Return each frame's edges at a small size, over the usual strength nearby: mean 0, norm 1."""
    h, w = rgb.shape[1:3]
    size = (_EDGE_PX, max(8, round(h * _EDGE_PX / w)))
    out = []
    for frame in rgb:
        grey = cv2.cvtColor(frame, cv2.COLOR_RGB2GRAY)
        grey = cv2.GaussianBlur(cv2.resize(grey, size, interpolation=cv2.INTER_AREA), (0, 0), 1.0)
        grey = grey.astype(np.float32)
        strength = np.hypot(cv2.Sobel(grey, cv2.CV_32F, 1, 0), cv2.Sobel(grey, cv2.CV_32F, 0, 1))
        usual = cv2.blur(strength, (41, 41)) + 6.0
        edges = cv2.GaussianBlur(np.minimum(strength / usual, 4.0), (0, 0), 1.2)
        edges = edges - edges.mean()
        out.append((edges / max(1e-6, float(np.linalg.norm(edges)))).astype(np.float32))
    return out


def _agreement(a: _Edges, b: _Edges) -> float:
    """Return the largest correlation of two frames' edges over small shifts."""
    straight = float((a * b).sum())
    if straight >= _SAME:
        return straight
    h, w = a.shape
    reach = round(_SHIFT * w)
    inner = a[reach : h - reach, reach : w - reach]
    if min(inner.shape) < 8:
        return straight
    best = cv2.matchTemplate(b, inner, cv2.TM_CCOEFF_NORMED)
    return max(straight, float(best.max()))

"""A clip without what an editor put over it: graphics that appear, change or vanish are painted over, so that none is taken for an object."""

from dataclasses import replace

import cv2
import numpy as np
from jaxtyping import Bool, UInt8

from v2p_data.errors import ItemRejectedError
from v2p_data.scene.frames.burnt_in import Graphic, graphics_of
from v2p_data.scene.frames.mask_ops import bounding_box, grow
from v2p_data.scene.frames.working_clip import WIDTH_PX
from v2p_data.video.clip import Clip

_MARGIN_PX = 2
"""Around a graphic, in a picture 320 px wide: its soft edge."""
_THIN_PX = 6.0
"""Half the width of strokes that are filled in from around them, in a picture 320 px wide."""
_MOST_COVERED = 0.2
"""Share of the picture: under a larger graphic too little is known."""
_STILLS = 15
"""Frames without a graphic, of which the picture below it is made."""


def without_graphics(clip: Clip) -> Clip:
    """Return the clip without captions and stickers that appear, change or vanish; as it is where none does.

    Strokes as thin as letters are filled in from around them, frame by frame. Larger graphics are replaced by the pixels of frames without
    them; where no frame is without them, they no longer change.

    Raises:
        ItemRejectedError: `overlay`: a graphic covers too much of the picture, with the share that it covers.
    """
    h, w = clip.frames.shape[1:3]
    size = (WIDTH_PX, max(8, round(h * WIDTH_PX / w)))
    how = cv2.INTER_AREA if w > WIDTH_PX else cv2.INTER_LINEAR
    graphics = graphics_of(
        np.stack([cv2.resize(frame, size, interpolation=how) for frame in clip.frames]), clip.fps
    )
    if not graphics:
        return clip
    _check_covered(clip, graphics)
    frames = clip.frames.copy()
    masks = [cv2.resize(grow(g.mask, _MARGIN_PX).astype(np.uint8), (w, h)) > 0 for g in graphics]
    for graphic, mask in zip(graphics, masks, strict=True):
        _paint(frames, graphic, mask)
    covered = float(np.any(masks, axis=0).mean())
    seconds = float(np.any([g.shown for g in graphics], axis=0).sum()) / clip.fps
    note = (
        f"letters or graphics were put over the video: they appear, change or vanish on {covered:.1%} of the picture, are there for {seconds:.1f} s "
        "in all, and were painted over; an original without them is better"
    )
    return replace(clip, frames=frames, warnings=(*clip.warnings, note))


def _check_covered(clip: Clip, graphics: list[Graphic]) -> None:
    largest = max(graphics, key=lambda graphic: graphic.mask.sum())
    share = float(largest.mask.mean())
    if share <= _MOST_COVERED:
        return
    start, stop = _longest_run(~largest.shown)
    cut = (
        f"keep the part without it: ffmpeg -ss {start / clip.fps:.2f} -to {stop / clip.fps:.2f} -i {clip.path.name} part.mp4"
        if stop > start
        else "take the original without it"
    )
    raise ItemRejectedError(
        "overlay",
        f"a graphic that was put over the video covers {share:.0%} of the picture, at most {_MOST_COVERED:.0%} can be painted over; {cut}",
        round(share, 3),
    )


def _longest_run(there: Bool[np.ndarray, "time"]) -> tuple[int, int]:
    """Return the beginning and the end of the longest run of true values; zeros where there is none."""
    edges = np.flatnonzero(np.diff(np.r_[False, there, False].astype(int)))
    runs = edges.reshape(-1, 2)
    if not len(runs):
        return 0, 0
    start, stop = runs[np.diff(runs, axis=1).argmax()]
    return int(start), int(stop)


def _paint(
    frames: UInt8[np.ndarray, "time h w 3"], graphic: Graphic, mask: Bool[np.ndarray, "h w"]
) -> None:
    """Paint a graphic over in the frames that show it; `mask` is its own at the frames' size."""
    x, y, w, h = bounding_box(mask)
    pad = 12
    spot = (slice(max(0, y - pad), y + h + pad), slice(max(0, x - pad), x + w + pad))
    there = mask[spot]
    shown = np.flatnonzero(graphic.shown)
    half = cv2.distanceTransform(graphic.mask.astype(np.uint8), cv2.DIST_L2, 3)
    if float(half.max()) <= _THIN_PX:
        for t in shown:
            part = np.ascontiguousarray(frames[t][spot])
            frames[t][spot] = cv2.inpaint(part, there.astype(np.uint8), 3, cv2.INPAINT_TELEA)
        return
    without = np.flatnonzero(~graphic.shown)
    picks = without if len(without) else shown
    picks = picks[np.unique(np.linspace(0, len(picks) - 1, min(len(picks), _STILLS)).astype(int))]
    below = np.median(frames[picks][:, *spot], axis=0).astype(np.uint8)
    for t in shown:
        frames[t][spot][there] = below[there]

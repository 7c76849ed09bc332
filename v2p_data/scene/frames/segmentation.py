"""What the scene network sees in every frame of a clip, and the masks that follow from it directly."""

from dataclasses import dataclass, replace

import cv2
import numpy as np
from jaxtyping import Bool, Float, Float32, Int, UInt8
from scipy.ndimage import median_filter

from v2p_data.scene.frames.classes import HAND, LONG_SIDE_PX, MOVED, TABLE
from v2p_data.scene.frames.mask_ops import bounding_box, grow, tidy
from v2p_data.scene.frames.working_clip import WorkingClip, end_quarters, still_of
from v2p_data.scene.scale.camera_height import SeenCamera, table_width_m
from v2p_data.video.clip import Clip

_LIKELY, _POSSIBLE = 0.5, 0.25
MOST_FRAMES = 50
"""Frames of a clip that the network looks at; those between take the nearest one's word."""
_MARGIN = 0.5
"""Around what moves, as a share of its extent: room for what it may belong to, and for the hand."""
_MOST_OF_PICTURE = 0.75
_FADE_PX = 5
_MOST_ZOOM = 2.5
"""As far as the network was trained on enlarged parts."""
LEAST_SHARE = 0.0007
"""Of the picture: smaller things cannot be measured."""


@dataclass(frozen=True, kw_only=True)
class Segmentation:
    """What the network sees over a clip, at working size."""

    idx: Int[np.ndarray, "n"]
    """Working frames it looked at, the first and the last among them."""
    shares: Float32[np.ndarray, "n 5 h w"]
    early: Float32[np.ndarray, "5 h w"]
    """In the still of the beginning."""
    late: Float32[np.ndarray, "5 h w"]
    """In the still of the end."""
    camera: SeenCamera

    def at(self, i: int) -> Float32[np.ndarray, "5 h w"]:
        """Return the probabilities at the working frame nearest to `i`."""
        return self.shares[int(np.abs(self.idx - i).argmin())]


def segment_clip(clip: Clip, working: WorkingClip) -> Segmentation:
    """Return what the network sees in the clip's frames and in its two stills.

    Where the moving objects are small, the network looks at it a second time, enlarged.
    """
    from v2p_data.scene.frames.network import classify  # torch takes a second to import

    n = len(working.rgb)
    idx = np.unique(np.linspace(0, n - 1, min(n, MOST_FRAMES)).round().astype(int))
    pictures = np.concatenate([working.rgb[idx], working.early[None], working.late[None]])
    seen = classify(
        pictures,
        np.broadcast_to(working.early, pictures.shape),
        np.broadcast_to(working.late, pictures.shape),
    )
    camera = _classify_enlarged(clip, working, idx, seen.shares, seen.camera)
    return Segmentation(
        idx=idx,
        shares=seen.shares[:-2],
        early=seen.shares[-2],
        late=seen.shares[-1],
        camera=camera,
    )


def _classify_enlarged(
    clip: Clip,
    working: WorkingClip,
    idx: Int[np.ndarray, "n"],
    shares: Float32[np.ndarray, "n+2 5 h w"],
    camera: SeenCamera,
) -> SeenCamera:
    """Replace the shares around moving objects by those that the network sees there at the clip's own resolution.

    The window keeps its size and goes along. The last two shares are those of the stills, of the beginning and the end.
    Both looks say how much of the table the picture shows; the camera comes back with both in it.
    """
    from v2p_data.scene.frames.network import classify, resized

    windows = _windows(shares[:-2, MOVED])
    if windows is None:
        return camera
    w, h = windows.size
    zoom = LONG_SIDE_PX / max(w, h)
    size = (round(working.shape[0] * zoom), round(working.shape[1] * zoom))

    def large(picks: Int[np.ndarray, "k"]) -> UInt8[np.ndarray, "k y x 3"]:
        frames = (clip.frames[i] for i in working.frame_idx[picks])
        return np.stack([resized(frame, size) for frame in frames])

    n = len(working.rgb)
    early, late = (still_of(large(np.arange(n)[quarter])) for quarter in end_quarters(n))
    pictures = np.concatenate([large(idx), early[None], late[None]])
    corners = windows.corners[[*range(len(idx)), 0, -1]]
    spots = [
        (slice(y, y + round(h * zoom)), slice(x, x + round(w * zoom)))
        for x, y in (corners * zoom).astype(int)
    ]
    near = classify(
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
    below = (corners[:, 1] + h / 2 - working.shape[0] / 2) / working.shape[1]
    return _both(camera, near.camera, w / working.shape[1], below)


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
    """Return a part of each picture around the moving objects; None where that is most of it, or nothing."""
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


def share_at_first(segmentation: Segmentation) -> float | None:
    """Return the share of the picture that the moving object covers at first, where it comes in later.

    None where it is there from the beginning, or not seen at the end.
    """
    early, late = (
        float(tidy(still[MOVED] > least).mean())
        for still, least in ((segmentation.early, _POSSIBLE), (segmentation.late, _LIKELY))
    )
    return early if early < LEAST_SHARE <= late else None


def hand_at(segmentation: Segmentation, i: int) -> Bool[np.ndarray, "h w"]:
    """Return the pixels that are hand or arm at a working frame."""
    return segmentation.at(i)[HAND] > _LIKELY


def passers_by(segmentation: Segmentation) -> Bool[np.ndarray, "h w"]:
    """Return the pixels where at some time a hand or what it moves is seen."""
    shares = segmentation.shares[:, HAND] + segmentation.shares[:, MOVED]
    return grow(shares.max(0) > _LIKELY, 3)


def table_seen(segmentation: Segmentation) -> Bool[np.ndarray, "h w"]:
    """Return the pixels that are bare table both at the beginning and at the end."""
    return (segmentation.early[TABLE] > _LIKELY) & (segmentation.late[TABLE] > _LIKELY)

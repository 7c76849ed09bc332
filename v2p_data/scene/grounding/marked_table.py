"""A person's "this is the table" becomes what the network says of those pixels, in every frame that shows them bare."""

from dataclasses import replace

import cv2
import numpy as np
from jaxtyping import Bool, Float32

from v2p_data.scene.frames.classes import HAND, TABLE
from v2p_data.scene.frames.colour import lab_of
from v2p_data.scene.frames.mask_ops import tidy
from v2p_data.scene.frames.segmentation import Segmentation
from v2p_data.scene.frames.working_clip import WorkingClip
from v2p_data.scene.grounding.spot_masks import points_along
from v2p_data.video.clip import Clip, Hint
from v2p_data.video.hints import TABLE as TABLE_HINT
from v2p_data.video.hints import marked_spots

_ALIKE_LAB = 9.0
"""From the nearest colour under the marks: grain and soft shadows stay below."""
_SAME_LAB = 12.0
"""From the marked frame: a pixel that differs more shows something else there."""
_HAND = 0.5
_COLOURS = 48


def with_marked_table(
    clip: Clip, working: WorkingClip, segmentation: Segmentation
) -> Segmentation:
    """Return what the network sees, with the table where a person marked it; as it is where nobody did."""
    hint = clip.hints.get(TABLE_HINT)
    if hint is None or TABLE_HINT in clip.objects:
        return segmentation
    i = int(np.abs(working.frame_idx - hint.get("frame", 0)).argmin())
    bare = _bare_table(clip, working, hint, i)
    there = working.lab[i]
    shares = segmentation.shares.copy()
    for k, frame in enumerate(segmentation.idx):
        _mark(shares[k], bare & _is_alike(working.lab[frame], there))
    early, late = segmentation.early.copy(), segmentation.late.copy()
    for still, image in ((early, working.early), (late, working.late)):
        _mark(still, bare & _is_alike(lab_of(image), there))
    return replace(segmentation, shares=shares, early=early, late=late)


def _mark(shares: Float32[np.ndarray, "5 h w"], bare: Bool[np.ndarray, "h w"]) -> None:
    bare = bare & (shares[HAND] < _HAND)
    shares[:, bare] = 0
    shares[TABLE, bare] = 1


def _is_alike(
    lab: Float32[np.ndarray, "h w 3"], there: Float32[np.ndarray, "h w 3"]
) -> Bool[np.ndarray, "h w"]:
    return np.linalg.norm(lab - there, axis=-1) < _SAME_LAB


def _bare_table(clip: Clip, working: WorkingClip, hint: Hint, i: int) -> Bool[np.ndarray, "h w"]:
    """Return what joins the marked pixels in working frame `i` and has their colours, without marked objects."""
    scale = working.px_scale
    marked = points_along([(x * scale, y * scale) for x, y in marked_spots(hint)], working.shape)
    if "box" in hint:
        x0, y0, x1, y1 = (v * scale for v in hint["box"])
        marked += [(x, y) for y in np.linspace(y0, y1, 5) for x in np.linspace(x0, x1, 5)]
    seed = np.zeros(working.shape, np.uint8)
    for x, y in marked:
        cv2.circle(seed, (round(x), round(y)), 2, 1, -1)
    lab = lab_of(cv2.GaussianBlur(working.rgb[i], (0, 0), 1.0))
    colours = lab[seed > 0]
    colours = colours[:: max(1, len(colours) // _COLOURS)]
    nearest = np.full(working.shape, np.inf, np.float32)
    for colour in colours:
        np.minimum(nearest, np.linalg.norm(lab - colour, axis=-1), out=nearest)
    alike = tidy(nearest < _ALIKE_LAB) | (seed > 0)
    for phrase, other in clip.hints.items():
        if (
            phrase != TABLE_HINT
            and "box" in other
            and other.get("frame", 0) == hint.get("frame", 0)
        ):
            x0, y0, x1, y1 = (max(0, round(v * scale)) for v in other["box"])
            alike[y0:y1, x0:x1] = False
    _, parts = cv2.connectedComponents(alike.astype(np.uint8))
    wanted = np.unique(parts[(seed > 0) & alike])
    return np.isin(parts, wanted[wanted > 0])

"""Learned models beside the detectors: outlines, and masks carried through the clip.

Each function is for one setting and leaves everything else as it is.
"""

from collections.abc import Iterator, Sequence
from dataclasses import replace

import cv2
import numpy as np
from jaxtyping import UInt8

from v2p_data.errors import V2PError
from v2p_data.scene.backends.config import OutlineConfig, SegmentConfig
from v2p_data.scene.backends.mobile_sam_setup import installed_weights
from v2p_data.scene.data_types import ObjectTrack
from v2p_data.scene.frames.outliner import Outliner
from v2p_data.scene.frames.working_clip import WorkingClip
from v2p_data.video.clip import Clip


def outliner_of(clip: Clip, working: WorkingClip, cfg: OutlineConfig) -> Outliner | None:
    """Return the model for the clip's frames; None where none is asked for.

    Args:
        clip: the frames that are shown to the model.
        working: the same clip at working size, in whose pixels the model is asked and answers.
        cfg: settings; `auto` was written out by the preset.

    Raises:
        V2PError: the model was not set up here, or its weights cannot be read.
    """
    if cfg.backend != "mobile_sam":
        return None
    weights = cfg.weights or installed_weights()
    if weights is None:
        raise V2PError(
            "scene.outline.backend is 'mobile_sam', which was not set up here; run 'v2p setup outlines', name its file "
            "with --scene.outline.weights, or leave the option out"
        )
    # transformers takes seconds to import.
    from v2p_data.scene.backends.mobile_sam import mobile_sam

    return Outliner(mobile_sam(weights), clip.frames, working.frame_idx, working.shape)


class _Frames(Sequence[UInt8[np.ndarray, "h w 3"]]):
    """The clip's frames behind the working clip's, read one at a time."""

    def __init__(self, clip: Clip, working: WorkingClip) -> None:
        self._clip, self._idx = clip, working.frame_idx

    def __len__(self) -> int:
        return len(self._idx)

    def __getitem__(self, i: int) -> UInt8[np.ndarray, "h w 3"]:  # type: ignore[override]
        return self._clip.frames[self._idx[i]]

    def __iter__(self) -> Iterator[UInt8[np.ndarray, "h w 3"]]:
        return (self[i] for i in range(len(self)))


def segmented(
    clip: Clip, working: WorkingClip, objects: Sequence[ObjectTrack], cfg: SegmentConfig
) -> tuple[ObjectTrack, ...]:
    """Return the objects with the masks that a video model makes of what was found of them in one frame."""
    from v2p_data.scene.backends.segment import Prompt, segment_video

    h, w = clip.frames.shape[1:3]
    prompts = []
    for s in objects:
        large = cv2.resize(s.first.astype(np.uint8), (w, h), interpolation=cv2.INTER_NEAREST) > 0
        prompts.append(Prompt(frame_idx=s.at, mask=large))
    seen = segment_video(_Frames(clip, working), prompts, cfg)
    size = (working.shape[1], working.shape[0])
    out = []
    for s, masks, scores in zip(objects, seen.masks, seen.scores, strict=True):
        small = np.stack(
            [
                cv2.resize(m.astype(np.float32), size, interpolation=cv2.INTER_AREA) > 0.5
                for m in masks
            ]
        )
        if not small[s.at].any():
            small[s.at] = s.first
        quality = np.where(small.any((1, 2)), scores, 0.0)
        out.append(replace(s, masks=small, quality=quality, agreement=float(scores.mean())))
    return tuple(out)

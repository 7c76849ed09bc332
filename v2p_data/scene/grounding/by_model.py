"""A learned model or a worker finds the objects: boxes for phrases, then masks for boxes.

Each function is for one backend setting and leaves everything else as it is.
"""

from collections.abc import Iterator, Sequence
from dataclasses import replace

import cv2
import numpy as np
from jaxtyping import UInt8

from v2p_data.scene.backends.config import GroundConfig, SegmentConfig
from v2p_data.scene.data_types import ObjectTrack
from v2p_data.scene.frames.working_clip import WorkingClip
from v2p_data.scene.grounding.hint_masks import Box
from v2p_data.video.clip import Clip

DETECTORS = ("grounding_dino", "mm_grounding_dino", "owlv2", "worker")


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


def detected(
    clip: Clip, working: WorkingClip, phrases: Sequence[str], cfg: GroundConfig
) -> dict[str, Box]:
    """Return a box per phrase that the detector finds, in the first frame, or in the last where only that shows it."""
    from v2p_data.scene.backends.detect import detect  # imports transformers

    ends = [int(working.frame_idx[0]), int(working.frame_idx[-1])]
    by_picture = detect([clip.frames[i] for i in ends], phrases, cfg)
    out: dict[str, Box] = {}
    for frame, by_phrase in zip(ends, by_picture, strict=True):
        for phrase, found in zip(phrases, by_phrase, strict=True):
            if found and phrase not in out:
                best = found[0]
                out[phrase] = Box(frame=frame, box_xyxy=best.box_xyxy, score=best.score)
    return out


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

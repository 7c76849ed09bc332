"""Masks in one frame become masks in every frame, by SAM 2.

As in the paper an object is prompted by a few positive points inside its mask. The clip is
followed from the prompted frame to its end and to its start, one frame at a time. What the tracker
no longer looks back at is forgotten, so that memory does not grow with the clip.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np
import torch
from jaxtyping import Bool, Float, UInt8

from v2p_data.errors import V2PError
from v2p_data.scene.backends.checkpoint import Checkpoint, load_checkpoint
from v2p_data.scene.backends.config import SegmentConfig
from v2p_data.scene.backends.worker import WorkerRequest, run_worker


@dataclass(frozen=True, kw_only=True)
class Prompt:
    """What one object looks like in one frame."""

    frame_idx: int
    mask: Bool[np.ndarray, "h w"]


@dataclass(frozen=True, kw_only=True)
class SegmentedVideo:
    """Where every object is seen at every frame; a pixel belongs to one object at most."""

    masks: Bool[np.ndarray, "object time h w"]
    scores: Float[np.ndarray, "object time"]
    """How sure the model is that the object is seen at all, 0 to 1."""


def segment_video(
    frames: UInt8[np.ndarray, "time h w 3"] | Sequence[UInt8[np.ndarray, "h w 3"]],
    prompts: Sequence[Prompt],
    cfg: SegmentConfig,
) -> SegmentedVideo:
    """Return the masks of the prompted objects in the whole clip.

    `frames` is read one at a time, so it may be anything with a length that gives RGB frames by index.

    Raises:
        V2PError: the model cannot be loaded, or its worker fails.

    Source: Ravi et al. 2024 (SAM 2), arXiv:2408.00714.
    """
    h, w = np.asarray(frames[0]).shape[:2]
    if cfg.backend == "worker":
        return _by_worker(frames, prompts, cfg)
    checkpoint = load_checkpoint("sam2", cfg.model, cfg.device, cfg.dtype)
    masks = np.zeros((len(prompts), len(frames), h, w), bool)
    scores = np.zeros((len(prompts), len(frames)))
    for start in sorted({prompt.frame_idx for prompt in prompts}):
        which = [i for i, prompt in enumerate(prompts) if prompt.frame_idx == start]
        points = [points_inside(prompts[i].mask, cfg.num_points) for i in which]
        for step in (1, -1):
            # Backwards the tracker is shown the clip in reverse, as a clip of its own.
            stream = Stream(checkpoint, points, cfg)
            for t in range(start, len(frames) if step > 0 else -1, step):
                logits, sure = stream.next(np.asarray(frames[t]))
                masks[which, t] = _apart(logits, cfg.mask_threshold)
                scores[which, t] = sure
            if start == 0:
                break
    return SegmentedVideo(masks=masks, scores=scores)


def points_inside(mask: Bool[np.ndarray, "h w"], count: int) -> Float[np.ndarray, "count 2"]:
    """Return points well inside a mask and far from each other, u right and v down [px].

    The first is the deepest; every further one is the farthest from all before, among the pixels at least a third as
    deep. A mask with fewer pixels than points repeats some.

    Raises:
        V2PError: the mask is empty.
    """
    if not mask.any():
        raise V2PError("an empty mask has no points inside; give a mask with at least one pixel")
    depth = cv2.distanceTransform(np.pad(mask, 1).astype(np.uint8), cv2.DIST_L2, 5)[1:-1, 1:-1]
    y, x = np.nonzero(mask & (depth >= depth.max() / 3))
    spots = np.stack([x, y], axis=1) + 0.5
    chosen = [int(np.argmax(depth[y, x]))]
    distance = np.linalg.norm(spots - spots[chosen[0]], axis=1)
    while len(chosen) < count:
        chosen.append(int(np.argmax(distance)))
        distance = np.minimum(distance, np.linalg.norm(spots - spots[chosen[-1]], axis=1))
    return spots[chosen]


def _by_worker(
    frames: Sequence[np.ndarray] | np.ndarray, prompts: Sequence[Prompt], cfg: SegmentConfig
) -> SegmentedVideo:
    request = WorkerRequest(
        kind="segment",
        arrays={
            "images": np.stack([np.asarray(frames[t]) for t in range(len(frames))]),
            "boxes_xyxy": np.array([_box_of(prompt.mask) for prompt in prompts]),
            "frame_idx": np.array([prompt.frame_idx for prompt in prompts]),
        },
    )
    found = run_worker(cfg.worker, request, cfg.worker_timeout_s).arrays
    return SegmentedVideo(
        masks=found["masks"],
        scores=found["scores"].astype(np.float64),
    )


def _box_of(mask: Bool[np.ndarray, "h w"]) -> tuple[float, float, float, float]:
    """Return the box around a mask [px]."""
    y, x = np.nonzero(mask)
    return float(x.min()), float(y.min()), float(x.max() + 1), float(y.max() + 1)


class Stream:
    """Pictures that come one at a time, the first of them prompted.

    Args:
        checkpoint: of SAM 2.
        points: positive points on each object in the first picture, u right and v down [px].
        cfg: where memory is kept.
    """

    def __init__(
        self,
        checkpoint: Checkpoint,
        points: Sequence[Float[np.ndarray, "_k 2"]],
        cfg: SegmentConfig,
    ) -> None:
        self._checkpoint, self._points = checkpoint, points
        self._session = _session(checkpoint, cfg)
        config = checkpoint.model.config
        self._remembered = max(config.num_maskmem, config.max_object_pointers_in_encoder)
        self._count = 0

    def next(
        self, image: UInt8[np.ndarray, "h w 3"]
    ) -> tuple[Float[np.ndarray, "object h w"], Float[np.ndarray, "object"]]:
        """Return logits at full size, and per object how sure the model is that it is seen, 0 to 1."""
        checkpoint, session, k = self._checkpoint, self._session, self._count
        size = (image.shape[0], image.shape[1])
        if k == 0:
            for i, xy in enumerate(self._points):
                checkpoint.processor.add_inputs_to_inference_session(
                    session,
                    0,
                    [i],
                    input_points=[[xy.tolist()]],
                    input_labels=[[[1] * len(xy)]],
                    original_size=size,
                )
            # Adding an object replaces the list of those with new prompts.
            session.obj_with_new_inputs = list(range(len(self._points)))
        with torch.inference_mode():
            out = checkpoint.model(session, frame=_prepared(checkpoint, image), frame_idx=k)
        _forget(session, k, self._remembered)
        self._count += 1
        return (
            _logits(checkpoint, out.pred_masks, size),
            torch.sigmoid(out.object_score_logits.float()).reshape(-1).cpu().numpy(),
        )


def _forget(session: Any, now: int, remembered: int) -> None:
    """Drop the frame just seen and what the tracker has made of frames that it no longer looks back at."""
    session.processed_frames.pop(now)
    for outputs in session.output_dict_per_obj.values():
        outputs["non_cond_frame_outputs"].pop(now - remembered, None)


def _session(checkpoint: Checkpoint, cfg: SegmentConfig) -> Any:
    return checkpoint.processor.init_video_session(
        inference_device=checkpoint.model.device,
        inference_state_device="cpu" if cfg.offload else checkpoint.model.device,
        video_storage_device=checkpoint.model.device,
        dtype=checkpoint.model.dtype,
    )


def _prepared(checkpoint: Checkpoint, image: np.ndarray) -> torch.Tensor:
    inputs = checkpoint.processor(
        images=image, device=checkpoint.model.device, return_tensors="pt"
    )
    return inputs["pixel_values"][0].to(checkpoint.model.dtype)


def _logits(
    checkpoint: Checkpoint, pred_masks: torch.Tensor, size: tuple[int, int]
) -> Float[np.ndarray, "object h w"]:
    full = checkpoint.processor.post_process_masks(
        [pred_masks.float()], original_sizes=[list(size)], binarize=False
    )[0]
    return full[:, 0].cpu().numpy()


def _apart(
    logits: Float[np.ndarray, "object h w"], threshold: float
) -> Bool[np.ndarray, "object h w"]:
    """Return masks in which a pixel goes to the object that claims it most."""
    owner = logits.argmax(0)
    return (logits > threshold) & (owner == np.arange(len(logits))[:, None, None])

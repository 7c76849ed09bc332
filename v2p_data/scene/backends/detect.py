"""Phrases become boxes, by Grounding DINO or a worker.

Both give one table: how well each box shows each phrase. Two phrases never share one thing: "red box" and "brown box"
are told apart by the assignment of things to phrases that is best for all of them together.
"""

import re
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Float, UInt8
from scipy.optimize import linear_sum_assignment

from v2p_data.errors import V2PError
from v2p_data.scene.backends.checkpoint import load_checkpoint
from v2p_data.scene.backends.config import GroundConfig
from v2p_data.scene.backends.worker import WorkerRequest, run_worker

_MAX_TOKENS = 256
"""Grounding DINO's text length."""
_FILLER = {"a", "an", "the", "of", "and", "with", "on", "in", "to"}
"""Words that say nothing about what a box shows."""


@dataclass(frozen=True, kw_only=True)
class Detection:
    """One box that shows a phrase."""

    phrase: str
    box_xyxy: tuple[float, float, float, float]
    """Left, top, right, bottom [px] in the picture given, clipped to it."""
    score: float
    """The model's own, 0 to 1: the mean over the phrase's words."""


def detect(
    images: Sequence[UInt8[np.ndarray, "h w 3"]] | UInt8[np.ndarray, "n h w 3"],
    phrases: Sequence[str],
    cfg: GroundConfig,
) -> list[list[list[Detection]]]:
    """Return per picture, per phrase, the boxes that show it; the first is the phrase's own, then by score.

    All pictures have one size.

    The rest are alternatives that no other phrase was given. A phrase that the model finds nowhere has none.

    Raises:
        V2PError: no phrase, an empty one, too much text, or the model cannot be loaded.

    Source: Liu et al. 2023 (Grounding DINO), arXiv:2303.05499.
    """
    if not phrases or not all(re.search(r"\w", phrase) for phrase in phrases):
        raise V2PError(f"every phrase to look for needs a word, got {list(phrases)}")
    found: list[list[list[Detection]]] = []
    for start in range(0, len(images), cfg.batch_size):
        batch = list(images[start : start + cfg.batch_size])
        h, w = batch[0].shape[:2]
        for boxes, scores in _tables(batch, phrases, cfg):
            clipped = np.clip(boxes, 0, [w, h, w, h])
            inside = (clipped[:, 2:] - clipped[:, :2] >= 1).all(1)
            found.append(assign(clipped[inside], scores[inside], phrases, cfg.max_overlap))
    return found


def assign(
    boxes_xyxy: Float[np.ndarray, "n 4"],
    scores: Float[np.ndarray, "n phrase"],
    phrases: Sequence[str],
    max_overlap: float,
) -> list[list[Detection]]:
    """Return the boxes of each phrase, best first, so that no two phrases get the same thing.

    Boxes that overlap more than `max_overlap` (intersection over union) are one thing; a score of 0 rules a box out
    for a phrase. The things go to the phrases such that the sum of scores is largest.
    """
    things = _things(boxes_xyxy, scores.max(1, initial=0.0), max_overlap)
    best = np.array(
        [
            [max(things[t], key=lambda i: scores[i, p]) for t in range(len(things))]
            for p in range(len(phrases))
        ],
        int,
    ).reshape(len(phrases), len(things))
    value = np.take_along_axis(scores.T, best, axis=1) if len(things) else np.zeros(best.shape)
    rows, columns = linear_sum_assignment(-value)
    own = {int(p): int(t) for p, t in zip(rows, columns, strict=True) if value[p, t] > 0}
    answer: list[list[Detection]] = []
    for p, phrase in enumerate(phrases):
        free = [t for t in range(len(things)) if value[p, t] > 0 and t not in own.values()]
        order = sorted(free, key=lambda t: -value[p, t])
        if p in own:
            order.insert(0, own[p])
        answer.append(
            [
                Detection(
                    phrase=phrase,
                    box_xyxy=_tuple4(boxes_xyxy[best[p, t]]),
                    score=float(value[p, t]),
                )
                for t in order
            ]
        )
    return answer


def _tables(
    images: list[np.ndarray], phrases: Sequence[str], cfg: GroundConfig
) -> list[tuple[np.ndarray, np.ndarray]]:
    """Return per picture the boxes [px] and how well each shows each phrase; 0 where it does not."""
    if cfg.backend == "worker":
        return _by_worker(images, phrases, cfg)
    checkpoint = load_checkpoint(cfg.backend, cfg.model, cfg.device, "float32")
    prompt, word_spans = _prompt(phrases)
    tokenizer = checkpoint.processor.tokenizer
    offsets = tokenizer(prompt, return_offsets_mapping=True)["offset_mapping"]
    if len(offsets) > _MAX_TOKENS:
        raise V2PError(
            f"the phrases make {len(offsets)} tokens, more than the model's {_MAX_TOKENS}; look for fewer at a time"
        )
    inputs = checkpoint.processor(
        images=images, text=[prompt] * len(images), return_tensors="pt"
    ).to(checkpoint.model.device)
    inputs["pixel_values"] = inputs["pixel_values"].to(checkpoint.model.dtype)
    with torch.inference_mode():
        out = checkpoint.model(**inputs)
    tokens = torch.sigmoid(out.logits.float()).cpu().numpy()
    boxes = _corners(out.pred_boxes, *images[0].shape[:2])
    answer = []
    for box, token in zip(boxes, tokens, strict=True):
        columns = []
        for spans in word_spans:
            words = np.stack(
                [token[:, _tokens_in(span, offsets)].max(1, initial=0) for span in spans], axis=1
            )
            named = (words > cfg.text_threshold).mean(1) >= 0.5
            columns.append(
                np.where(named & (words.max(1) > cfg.box_threshold), words.mean(1), 0.0)
            )
        answer.append((box, np.stack(columns, axis=1)))
    return answer


def _by_worker(
    images: list[np.ndarray], phrases: Sequence[str], cfg: GroundConfig
) -> list[tuple[np.ndarray, np.ndarray]]:
    request = WorkerRequest(
        kind="ground", arrays={"images": np.stack(images)}, fields={"phrases": list(phrases)}
    )
    found = run_worker(cfg.worker, request, cfg.worker_timeout_s).arrays
    answer = []
    for n in range(len(images)):
        mine = np.flatnonzero((found["image_idx"] == n) & (found["scores"] > cfg.box_threshold))
        scores = np.zeros((len(mine), len(phrases)))
        scores[np.arange(len(mine)), found["phrase_idx"][mine]] = found["scores"][mine]
        answer.append((found["boxes_xyxy"][mine].astype(np.float64), scores))
    return answer


def _prompt(phrases: Sequence[str]) -> tuple[str, list[list[tuple[int, int]]]]:
    """Return "red box. brown box." and where in it the telling words of each phrase stand."""
    text = ""
    spans: list[list[tuple[int, int]]] = []
    for phrase in phrases:
        clean = _clean(phrase)
        words = [m for m in re.finditer(r"\S+", clean) if m[0] not in _FILLER]
        words = words or list(re.finditer(r"\S+", clean))
        spans.append([(len(text) + m.start(), len(text) + m.end()) for m in words])
        text += f"{clean}. "
    return text.strip(), spans


def _clean(phrase: str) -> str:
    """Return the phrase in lower case without marks, which would end it for the model."""
    return " ".join(re.sub(r"[^\w\s'-]", " ", phrase.lower()).split())


def _tokens_in(span: tuple[int, int], offsets: Sequence[tuple[int, int]]) -> list[int]:
    return [i for i, (a, b) in enumerate(offsets) if b > a and a >= span[0] and b <= span[1]]


def _corners(centred: torch.Tensor, height_px: int, width_px: int) -> np.ndarray:
    """Return left, top, right, bottom [px] of boxes given as centre and size, relative to the picture."""
    c = centred.float().cpu().numpy().astype(np.float64)
    corners = np.concatenate([c[..., :2] - c[..., 2:] / 2, c[..., :2] + c[..., 2:] / 2], axis=-1)
    return corners * np.array([width_px, height_px, width_px, height_px])


def _things(boxes: np.ndarray, strength: np.ndarray, max_overlap: float) -> list[list[int]]:
    """Return the boxes grouped around the strongest of each place, boxes without strength left out."""
    things: list[list[int]] = []
    for i in np.argsort(-strength):
        if strength[i] <= 0:
            continue
        fits = overlaps(boxes[i], boxes[[t[0] for t in things]])
        if fits.max(initial=0.0) > max_overlap:
            things[int(fits.argmax())].append(int(i))
        else:
            things.append([int(i)])
    return things


def _tuple4(values: np.ndarray) -> tuple[float, float, float, float]:
    a, b, c, d = (float(v) for v in values)
    return a, b, c, d


def overlaps(
    box: Float[np.ndarray, "4"], boxes: Float[np.ndarray, "n 4"]
) -> Float[np.ndarray, "n"]:
    """Return how far a box overlaps each of others (IoU)."""
    size = np.clip(np.minimum(box[2:], boxes[:, 2:]) - np.maximum(box[:2], boxes[:, :2]), 0, None)
    both, areas = size.prod(1), (boxes[:, 2:] - boxes[:, :2]).prod(1)
    return both / np.maximum(1e-6, (box[2:] - box[:2]).prod() + areas - both)

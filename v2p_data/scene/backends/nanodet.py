"""NanoDet: boxes of everyday things in one picture, each with how much it looks like each of 80 classes.

`nanodet_setup.py` fetches the weights. The network sees 416 x 416 px; a picture is stretched to that.

Source: RangiLyu 2021, NanoDet (Apache-2.0), the variant `nanodet-g`; Li et al. 2020 (boxes as distributions), arXiv:2006.04388.
"""

from dataclasses import dataclass, field, replace
from functools import lru_cache
from pathlib import Path

import cv2
import numpy as np
import torch
from jaxtyping import Float, Float32, Int, UInt8
from safetensors import SafetensorError
from safetensors.torch import load_file
from torch import Tensor, nn
from torch.nn.functional import interpolate, leaky_relu, max_pool2d

from v2p_data.errors import V2PError

CLASSES = tuple(
    [
        "person",
        "bicycle",
        "car",
        "motorcycle",
        "airplane",
        "bus",
        "train",
        "truck",
        "boat",
        "traffic light",
        "fire hydrant",
        "stop sign",
        "parking meter",
        "bench",
        "bird",
        "cat",
        "dog",
        "horse",
        "sheep",
        "cow",
        "elephant",
        "bear",
        "zebra",
        "giraffe",
        "backpack",
        "umbrella",
        "handbag",
        "tie",
        "suitcase",
        "frisbee",
        "skis",
        "snowboard",
        "sports ball",
        "kite",
        "baseball bat",
        "baseball glove",
        "skateboard",
        "surfboard",
        "tennis racket",
        "bottle",
        "wine glass",
        "cup",
        "fork",
        "knife",
        "spoon",
        "bowl",
        "banana",
        "apple",
        "sandwich",
        "orange",
        "broccoli",
        "carrot",
        "hot dog",
        "pizza",
        "donut",
        "cake",
        "chair",
        "couch",
        "potted plant",
        "bed",
        "dining table",
        "toilet",
        "tv",
        "laptop",
        "mouse",
        "remote",
        "keyboard",
        "cell phone",
        "microwave",
        "oven",
        "toaster",
        "sink",
        "refrigerator",
        "book",
        "clock",
        "vase",
        "scissors",
        "teddy bear",
        "hair drier",
        "toothbrush",
    ]
)
"""Of COCO, in its order."""
SIDE_PX, _STRIDES_PX, _BINS = 416, (8, 16, 32), 11
"""A side's distance from a cell's middle is the mean of a distribution over 0 to 10 strides."""
_MEAN, _SD = (103.53, 116.28, 123.675), (57.375, 57.12, 58.395)
"""Of the pictures that it was trained on, blue, green, red."""
_LEAST, _SAME, _MOST = 0.05, 0.6, 40
"""Score below which a box is dropped, overlap (IoU) from which two boxes are one, and boxes that are kept."""


@dataclass(frozen=True, kw_only=True)
class Boxes:
    """What may be things in one picture, those that look most like anything first."""

    xyxy: Float32[np.ndarray, "n 4"]
    """Left, top, right, bottom [px]."""
    scores: Float32[np.ndarray, "n 80"]
    """How much each looks like each of `CLASSES`, 0 to 1."""


class NanoDet(nn.Module):
    """The network. Layers have the numbers of their order in the published graph."""

    def __init__(self) -> None:
        super().__init__()
        sizes = [(3, 32), (32, 32), (32, 16), (16, 16), (32, 32)]
        for width, half, blocks in ((64, 32, 2), (128, 64, 2), (256, 128, 3)):
            sizes += [(width, width), *[(width, half), (half, half)] * blocks, (width, width)]
        self.convs = nn.ModuleList(
            [
                *(nn.Conv2d(a, b, 3, 2 if k in (0, 5, 11, 17) else 1, 1) for k, (a, b) in enumerate(sizes)),
                *(nn.Conv2d(a, b, 1) for a, b in ((128, 128), (256, 128), (512, 128))),
                *(nn.Conv2d(128, b, s, padding=s // 2) for _ in _STRIDES_PX for b, s in ((128, 3), (124, 1))),
            ]
        )  # fmt: skip

    def forward(self, x: Tensor) -> list[Tensor]:
        """Return scores' logits and distances per cell, for cells of 8, 16 and 32 px."""
        x = max_pool2d(self._layer(0, x), 3, 2, 1)
        x, levels = self._stage(x, 1, 1), list[Tensor]()
        for first, blocks in ((5, 2), (11, 2), (17, 3)):
            x = self._stage(x, first, blocks)
            levels.append(self.convs[25 + len(levels)](x))
        near, middle, far = levels
        middle = middle + interpolate(far, scale_factor=2.0, mode="bilinear")
        near = near + interpolate(middle, scale_factor=2.0, mode="bilinear")
        middle = middle + interpolate(near, scale_factor=0.5, mode="bilinear")
        far = far + interpolate(middle, scale_factor=0.5, mode="bilinear")
        return [
            self.convs[29 + 2 * k](self._layer(28 + 2 * k, level)).flatten(2).transpose(1, 2)
            for k, level in enumerate((near, middle, far))
        ]

    def _layer(self, k: int, x: Tensor) -> Tensor:
        return leaky_relu(self.convs[k](x), 0.1)

    def _stage(self, x: Tensor, first: int, blocks: int) -> Tensor:
        """Return what layers from number `first` on make of the input: blocks of two, then one, beside a way past them."""
        past = x = self._layer(first, x)
        for k in range(first + 1, first + 1 + 2 * blocks, 2):
            x = self._layer(k, x)
            x = torch.cat([self._layer(k + 1, x), x], 1)
        return torch.cat([self._layer(first + 1 + 2 * blocks, x), past], 1)


@lru_cache(maxsize=1)
def nanodet(weights: Path) -> NanoDet:
    """Return the network on the CPU, loaded once.

    Args:
        weights: file that `nanodet_setup.py` wrote.

    Raises:
        V2PError: the file does not hold NanoDet's weights.
    """
    network = NanoDet()
    try:
        network.load_state_dict(load_file(weights))
    except (OSError, ValueError, RuntimeError, SafetensorError) as error:
        raise V2PError(
            f"{weights} does not hold NanoDet's weights ({type(error).__name__}); delete it and run 'v2p scene detectors --setup'"
        ) from error
    return network.eval()


@torch.inference_mode()
def boxes_in(picture: UInt8[np.ndarray, "h w 3"], network: NanoDet) -> Boxes:
    """Return what may be things in an RGB picture."""
    square = cv2.resize(picture, (SIDE_PX, SIDE_PX)).astype(np.float32)[..., ::-1]
    x = torch.from_numpy(((square - _MEAN) / _SD).astype(np.float32)).permute(2, 0, 1)[None]
    scores, corners = list[np.ndarray](), list[np.ndarray]()
    for stride, out in zip(_STRIDES_PX, network(x), strict=True):
        cells = 0.5 + np.indices(2 * (SIDE_PX // stride,)).reshape(2, -1).T[:, ::-1]
        logits, bins = out[0].split([len(CLASSES), 4 * _BINS], 1)
        reach = (bins.reshape(-1, 4, _BINS).softmax(-1) @ torch.arange(float(_BINS))).numpy()
        corners.append(np.hstack([cells - reach[:, :2], cells + reach[:, 2:]]) * stride)
        scores.append(logits.sigmoid().numpy())
    size = np.array(2 * picture.shape[1::-1])
    xyxy = np.clip(np.concatenate(corners) * size / SIDE_PX, 0, size).astype(np.float32)
    return _apart(xyxy, np.concatenate(scores))


def _apart(xyxy: Float32[np.ndarray, "n 4"], scores: Float32[np.ndarray, "n 80"]) -> Boxes:
    """Return one box for all that show the same place, with the best score that any of them has for a class."""
    best = scores.max(1)
    left = np.argsort(-best)
    left = left[best[left] > _LEAST]
    kept, seen = list[int](), list[np.ndarray]()
    while len(left) and len(kept) < _MOST:
        same = overlaps(xyxy[left[0]], xyxy[left]) >= _SAME
        kept.append(int(left[0]))
        seen.append(scores[left[same]].max(0))
        left = left[~same]
    return Boxes(xyxy=xyxy[kept], scores=np.reshape(seen, (len(kept), len(CLASSES))))


def overlaps(
    box: Float[np.ndarray, "4"], boxes: Float[np.ndarray, "n 4"]
) -> Float[np.ndarray, "n"]:
    """Return how far a box overlaps each of others (IoU)."""
    size = np.clip(np.minimum(box[2:], boxes[:, 2:]) - np.maximum(box[:2], boxes[:, :2]), 0, None)
    both, areas = size.prod(1), (boxes[:, 2:] - boxes[:, :2]).prod(1)
    return both / np.maximum(1e-6, (box[2:] - box[:2]).prod() + areas - both)


@dataclass(frozen=True, kw_only=True)
class Sightings:
    """Boxes at working size in the frames of one clip; what was seen in a frame is kept."""

    network: NanoDet
    frames: UInt8[np.ndarray, "clip_time h w 3"]
    """The clip's, larger than the working ones."""
    frame_idx: Int[np.ndarray, "time"]
    """Each working frame's index among them."""
    px_scale: float
    """Working pixels per pixel of `frames`."""
    _seen: dict[int, Boxes] = field(default_factory=dict[int, Boxes])

    def at(self, i: int) -> Boxes:
        """Return what may be things in working frame `i`, in working pixels."""
        if i not in self._seen:
            seen = boxes_in(self.frames[self.frame_idx[i]], self.network)
            self._seen[i] = replace(seen, xyxy=seen.xyxy * np.float32(self.px_scale))
        return self._seen[i]

"""From pictures to vectors: what is computed once a frame (`prepare`), and what is learned (`forward`).

A label image becomes one channel per label before it is made smaller: a grey level means nothing, and averaging
labels 0 and 2 must not look like label 1, whereas averaging channels gives the share of each label in a pixel.
`prepare` has no parameters and treats each frame by itself, so its uint8 and float32 results can be kept: a trainer
computes them once a frame, a roll-out once a step.
"""

from pathlib import Path

import numpy as np
import torch
import torch.nn.functional as F  # noqa: N812 - the name everybody knows
from jaxtyping import Float, Int64, Shaped, UInt8
from torch import Tensor, nn
from torchvision.models import ResNet18_Weights, resnet18

from policies.bc.configuration_v2p_bc import V2PBCConfig

IMAGENET_MEAN = (0.485, 0.456, 0.406)
IMAGENET_STD = (0.229, 0.224, 0.225)
BACKBONE_DIM = 512
NUM_SUMS = 6
"""Area, first and second moments."""
DIRECTION_LENGTH = 1024
DIRECTIONS = np.round(
    DIRECTION_LENGTH
    * np.stack([np.cos(2 * np.pi * np.arange(16) / 16), np.sin(2 * np.pi * np.arange(16) / 16)], 1)
).astype(np.int64)
"""Sixteen directions in the image, of whole numbers, so that sums over pixels are exact."""
NUM_MOMENTS = NUM_SUMS + len(DIRECTIONS)
"""Numbers that `mask_moments` gives per label."""
LEAST_PIXELS = 4
"""A label with fewer pixels counts as absent."""

PREPARE_VERSION = 2
"""Raised when `prepare` gives other numbers for the same pictures: caches of them are made anew."""

Prepared = dict[str, Tensor]
"""`picture`: uint8 `(batch, time, channel, h, w)`; `moments`: float32 `(batch, time, label x 22)`;
either may be absent."""


def shrink(
    frames: Float[Tensor, "batch c h w"], longer_side_px: int
) -> Float[Tensor, "batch c h2 w2"]:
    """Average the frames down until their longer side has this many pixels; never enlarge."""
    height, width = frames.shape[-2:]
    scale = longer_side_px / max(height, width)
    if scale >= 1:
        return frames
    return F.interpolate(frames, size=(round(height * scale), round(width * scale)), mode="area")


def as_uint8(frames: Shaped[Tensor, "*batch h w"]) -> UInt8[Tensor, "*batch h w"]:
    """Return pictures as 0 to 255, from that or from floats in [0, 1]."""
    if frames.dtype == torch.uint8:
        return frames
    return (frames * 255).round().clamp(0, 255).to(torch.uint8)


def labels_of(
    frames: Shaped[Tensor, "batch time c h w"], greys: tuple[int, ...]
) -> UInt8[Tensor, "batch time h w"]:
    """Return the label of each pixel: the one whose grey is nearest to the first channel."""
    distances = np.abs(np.arange(256)[:, None] - np.asarray(greys)[None])
    nearest = distances.argmin(1).astype(np.uint8)
    pixels = as_uint8(frames[:, :, 0])
    if pixels.device.type == "cpu":  # four times as fast as torch's indexing
        return torch.from_numpy(nearest[pixels.numpy()])
    return torch.from_numpy(nearest).to(pixels.device)[pixels.int()]


def label_shares(
    labels: UInt8[Tensor, "batch h w"], num_labels: int, longer_side_px: int
) -> UInt8[Tensor, "batch label h2 w2"]:
    """Return one channel per label: its share of each pixel of the smaller image, 0 to 255."""
    highest = min(int(labels.max()), num_labels - 1)
    is_shrunk = longer_side_px < max(labels.shape[-2:])
    seen = [  # labels beyond the largest in the batch need no work
        as_uint8(shrink((labels == k).to(torch.float32)[:, None], longer_side_px)[:, 0])
        if is_shrunk
        else (labels == k).to(torch.uint8) * 255
        for k in range(highest + 1)
    ]
    return F.pad(torch.stack(seen, 1), (0, 0, 0, 0, 0, num_labels - len(seen)))


def mask_moments(
    labels: UInt8[Tensor, "batch h w"], num_labels: int
) -> Float[Tensor, "batch label 22"]:
    """Return place, size and outline of each label but the background; zeros where it is absent.

    Per label: centroid x, y from the image centre, in eighths of its longer side; then, in units of a quarter of that,
    root of the area, standard deviation along x, y; their correlation, doubled; and how far the label reaches from its
    centroid in 16 directions, which tells how a box is turned. All are of order one. Sums of pixels are exact, so the
    numbers do not depend on which frames are computed together.
    """
    _, height, width = labels.shape
    unit = max(height, width) / 8
    sums = pixel_sums(labels, num_labels).double()
    area, x, y, xx, yy, xy = sums[..., :NUM_SUMS].unbind(-1)
    n = area.clamp(min=1)
    cx, cy = x / n, y / n
    sx = (xx / n - cx**2).clamp(min=0).sqrt()
    sy = (yy / n - cy**2).clamp(min=0).sqrt()
    values = torch.stack(
        [
            *((cx + 0.5 - width / 2) / unit, (cy + 0.5 - height / 2) / unit),
            *(area.sqrt() / (unit / 4), sx / (unit / 4), sy / (unit / 4)),
            2 * (xy / n - cx * cy) / (sx * sy + 1),
        ],
        -1,
    )
    along = torch.from_numpy(DIRECTIONS).to(labels.device).double()
    middle = cx[..., None] * along[:, 0] + cy[..., None] * along[:, 1]
    reach = (sums[..., NUM_SUMS:] - middle) / DIRECTION_LENGTH / (unit / 4)
    out = torch.cat([values, reach], -1)
    return torch.where((area >= LEAST_PIXELS)[..., None], out, 0.0).float()


def pixel_sums(
    labels: UInt8[Tensor, "batch h w"], num_labels: int
) -> Int64[Tensor, "batch label 22"]:
    """Return sums over the pixels of each label but the background.

    Per label: their number, the sums of x, y, x^2, y^2 and x y, then the largest of `d_x x + d_y
        y` for each direction d
    of `DIRECTIONS`; pixels are counted from 0. On the CPU in one pass over the pixels, elsewhere by matrix products;
    both are exact.
    """
    if labels.device.type == "cpu":
        from policies.bc.pixel_sums import sum_pixels  # numba takes half a second to load

        out = np.zeros((len(labels), num_labels - 1, NUM_MOMENTS), np.int64)
        sum_pixels(labels.numpy(), DIRECTIONS, out)
        return torch.from_numpy(out)
    return pixel_sums_by_products(labels, num_labels)


def pixel_sums_by_products(
    labels: UInt8[Tensor, "batch h w"], num_labels: int
) -> Int64[Tensor, "batch label 22"]:
    """Return what `pixel_sums` does for labels that occur, on any device."""
    _, height, width = labels.shape
    x = torch.arange(width, device=labels.device, dtype=torch.float64)
    y = torch.arange(height, device=labels.device, dtype=torch.float64)
    along = torch.from_numpy(DIRECTIONS).to(labels.device).double()
    out: list[Tensor] = []
    for k in range(1, num_labels):
        seen = labels == k
        mask = seen.double()
        by_row, x_by_row = (mask @ torch.stack([torch.ones_like(x), x], 1)).unbind(-1)
        by_column = mask.sum(1)
        left = seen.to(torch.uint8).argmax(2).double()
        right = width - 1 - seen.flip(2).to(torch.uint8).argmax(2).double()
        ends = torch.maximum(left[..., None] * along[:, 0], right[..., None] * along[:, 0])
        ends = (ends + y[:, None] * along[:, 1]).masked_fill((by_row == 0)[..., None], -torch.inf)
        numbers = [
            by_row.sum(1),
            by_column @ x,
            by_row @ y,
            by_column @ x**2,
            by_row @ y**2,
            x_by_row @ y,
        ]
        out.append(torch.cat([torch.stack(numbers, -1), ends.amax(1).clamp(min=-1e12)], -1))
    return torch.stack(out, 1).long()


def pretrained_backbone_file() -> Path:
    """Return where torchvision keeps the pretrained ResNet18 on this machine."""
    return (
        Path(torch.hub.get_dir()) / "checkpoints" / Path(ResNet18_Weights.IMAGENET1K_V1.url).name
    )


def mask_stem(
    rgb_weight: Float[Tensor, "out 3 k k"], greys: tuple[int, ...]
) -> Float[Tensor, "out label k k"]:
    """Return first-layer filters that answer label channels as `rgb_weight` answers the normalised grey image.

    Copying a filter to every label would be blind: the channels of a pixel sum to one.
    """
    mean, std = torch.tensor(IMAGENET_MEAN), torch.tensor(IMAGENET_STD)
    as_seen = (torch.tensor(greys)[:, None] / 255 - mean) / std
    return torch.einsum("ockl,nc->onkl", rgb_weight, as_seen)


class Standardiser(nn.Module):
    """Zero mean and unit deviation by running statistics, which are fixed after the first training samples.

    The same numbers serve training and inference, unlike those of a batch normalisation in training.
    """

    mean: Tensor
    var: Tensor
    count: Tensor

    NUM_SAMPLES = 20_000
    """Training samples that the statistics are taken from."""
    MIN_STD = 0.02
    """A number that hardly varied must not blow up once it does."""
    LIMIT = 10.0

    def __init__(self, dim: int) -> None:
        super().__init__()
        self.register_buffer("mean", torch.zeros(dim))
        self.register_buffer("var", torch.ones(dim))
        self.register_buffer("count", torch.zeros((), dtype=torch.int64))

    def forward(self, x: Float[Tensor, "batch dim"]) -> Float[Tensor, "batch dim"]:
        if self.training and int(self.count) < self.NUM_SAMPLES:
            self._take(x.detach())
        std = self.var.sqrt().clamp_min(self.MIN_STD)
        return ((x - self.mean) / std).clamp(-self.LIMIT, self.LIMIT)

    def _take(self, x: Float[Tensor, "batch dim"]) -> None:
        """Take a batch into account.

        Source: Chan, Golub, LeVeque 1979, eq. 2.1.
        """
        share = len(x) / (int(self.count) + len(x))
        delta = x.mean(0) - self.mean
        var = x.var(0, correction=0)
        self.var.copy_((1 - share) * self.var + share * var + share * (1 - share) * delta**2)
        self.mean.add_(share * delta)
        self.count.add_(len(x))


class CameraEncoder(nn.Module):
    """One camera's frames become a vector.

    All frames go through the backbone at once, stacked as channels: that costs half as much as one by one, and the
    first layer sees motion. The moments of a mask join the backbone's features as they are.

    Args:
        cfg: the policy's settings.
        is_mask: whether the camera shows labels.
        weights: torchvision's pretrained ResNet18, if there is one.
    """

    mean: Tensor
    std: Tensor

    def __init__(
        self,
        cfg: V2PBCConfig,
        *,
        is_mask: bool,
        weights: dict[str, Tensor] | None,
    ) -> None:
        super().__init__()
        self.is_mask = is_mask
        self.greys = tuple(cfg.mask_greys)
        self.num_labels = cfg.num_labels or len(self.greys)
        self.input_size_px = cfg.input_size_px
        self.has_moments = is_mask and cfg.mask_moments
        self.backbone: nn.Module | None = None
        self.dim = 0
        self.standardise: Standardiser | None = None
        if self.has_moments:
            self.dim += cfg.n_obs_steps * (self.num_labels - 1) * NUM_MOMENTS
            self.standardise = Standardiser(self.dim)
        if cfg.encoder == "resnet18" or not self.has_moments:
            self.backbone = _resnet18(
                cfg.n_obs_steps, self.greys[: self.num_labels] if is_mask else None, weights
            )
            self.dim += BACKBONE_DIM
        self.register_buffer("mean", torch.tensor(IMAGENET_MEAN).view(3, 1, 1), persistent=False)
        self.register_buffer("std", torch.tensor(IMAGENET_STD).view(3, 1, 1), persistent=False)

    @torch.no_grad()
    def prepare(self, frames: Shaped[Tensor, "batch time c h w"]) -> Prepared:
        """Return all that is computed from the frames without parameters; each frame by itself.

        Args:
            frames: uint8 0 to 255, or floats in [0, 1]. Of label images the first channel is enough.
        """
        batch, time = frames.shape[:2]
        out: Prepared = {}
        if self.is_mask:
            labels = labels_of(frames, self.greys).flatten(0, 1)
            if self.backbone is not None:
                out["picture"] = label_shares(labels, self.num_labels, self.input_size_px)
            if self.has_moments:
                out["moments"] = mask_moments(labels, self.num_labels).flatten(1)
        else:
            frames = frames.flatten(0, 1)
            if frames.dtype == torch.uint8:
                frames = frames.to(torch.float32) / 255
            out["picture"] = as_uint8(shrink(frames, self.input_size_px))
        return {name: value.unflatten(0, (batch, time)) for name, value in out.items()}

    def forward(self, prepared: Prepared) -> Float[Tensor, "batch feature"]:
        """Return the features of frames that `prepare` prepared."""
        parts: list[Tensor] = []
        if self.standardise is not None:
            parts.append(self.standardise(prepared["moments"].flatten(1)))
        if self.backbone is not None:
            frames = prepared["picture"].to(self.mean.dtype) / 255
            if not self.is_mask:
                frames = (frames - self.mean) / self.std
            stacked = frames.flatten(1, 2).contiguous(memory_format=torch.channels_last)
            parts.append(self.backbone(stacked))
        return torch.cat(parts, 1)


def _resnet18(
    num_frames: int, greys: tuple[int, ...] | None, weights: dict[str, Tensor] | None
) -> nn.Sequential:
    """Return ResNet18 up to its pooled features, for stacked frames of labels or of colours."""
    net = resnet18(weights=None)
    if weights is not None:
        net.load_state_dict(weights)
    stem = net.conv1.weight.detach()
    if greys is not None:
        stem = mask_stem(stem, greys)
    net.conv1 = nn.Conv2d(stem.shape[1] * num_frames, 64, 7, stride=2, padding=3, bias=False)
    if weights is not None:
        with torch.no_grad():  # a still scene excites the layer as one frame does
            net.conv1.weight.copy_(stem.repeat(1, num_frames, 1, 1) / num_frames)
    return nn.Sequential(
        net.conv1,
        net.bn1,
        net.relu,
        net.maxpool,
        net.layer1,
        net.layer2,
        net.layer3,
        net.layer4,
        nn.AdaptiveAvgPool2d(1),
        nn.Flatten(),
    )

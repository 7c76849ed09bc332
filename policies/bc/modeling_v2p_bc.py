"""The `v2p_bc` network and policy: stacked frames, the robot's state and the task's words become an action.

Frames are stacked as channels, not run through the backbone one by one: that costs half as much, and the first
layer sees motion. Label images become one channel per label before they are made smaller: a grey level means
nothing, and averaging labels 0 and 2 must not look like label 1, whereas averaging channels gives the share of
each label in a pixel.
"""

import hashlib
import logging
import re
from collections import deque
from functools import lru_cache
from pathlib import Path
from typing import Any

import torch
import torch.nn.functional as F  # noqa: N812 - the name everybody knows
from jaxtyping import Float
from lerobot.configs.types import FeatureType
from lerobot.policies.pretrained import PreTrainedPolicy
from lerobot.policies.utils import populate_queues
from lerobot.utils.constants import ACTION
from torch import Tensor, nn
from torchvision.models import ResNet18_Weights, resnet18

from policies.bc.configuration_v2p_bc import BACKBONE_WEIGHTS, V2PBCConfig

logger = logging.getLogger(__name__)

IMAGENET_MEAN = (0.485, 0.456, 0.406)
IMAGENET_STD = (0.229, 0.224, 0.225)
BACKBONE_DIM = 512
PRETRAINED_BACKBONE_LR = 3e-5


def shrink(
    frames: Float[Tensor, "batch c h w"], longer_side_px: int
) -> Float[Tensor, "batch c h2 w2"]:
    """Average the frames down until their longer side has this many pixels; never enlarge."""
    height, width = frames.shape[-2:]
    scale = longer_side_px / max(height, width)
    if scale >= 1:
        return frames
    return F.interpolate(frames, size=(round(height * scale), round(width * scale)), mode="area")


def label_channels(
    frames: Float[Tensor, "batch time c h w"], greys: tuple[int, ...], longer_side_px: int
) -> Float[Tensor, "batch time label h2 w2"]:
    """Return one channel per label: its share of each pixel of the smaller image."""
    distances = torch.tensor([[abs(grey - value) for grey in greys] for value in range(256)])
    nearest = distances.argmin(1).to(torch.uint8).to(frames.device)
    labels = nearest[(frames[:, :, 0] * 255).round().int()]
    seen = [  # labels beyond the largest in the batch need no work
        shrink((labels == k).to(frames.dtype), longer_side_px)
        for k in range(int(labels.max()) + 1)
    ]
    return F.pad(torch.stack(seen, 2), (0, 0, 0, 0, 0, len(greys) - len(seen)))


def shifted(images: Float[Tensor, "batch c h w"], reach_px: int) -> Float[Tensor, "batch c h w"]:
    """Return each image moved by up to `reach_px` along both axes; its border fills the gap."""
    batch, _, height, width = images.shape
    padded = F.pad(images, [reach_px] * 4, mode="replicate")
    by = torch.randint(0, 2 * reach_px + 1, (2, batch, 1), device=images.device)
    rows = (by[0] + torch.arange(height, device=images.device))[:, :, None]
    columns = (by[1] + torch.arange(width, device=images.device))[:, None, :]
    sample = torch.arange(batch, device=images.device)[:, None, None]
    return padded[sample, :, rows, columns].permute(0, 3, 1, 2)


@lru_cache(maxsize=4096)
def task_words(task: str, dim: int) -> Float[Tensor, " dim"]:
    """Return the task's bag of words as a unit vector: each word adds +1 or -1 at a place its hash names."""
    bag = torch.zeros(dim)
    for word in re.findall(r"[^\W_]+", task.lower()):
        digest = hashlib.sha256(word.encode()).digest()
        bag[int.from_bytes(digest[:4], "little") % dim] += 1 if digest[4] & 1 else -1
    return F.normalize(bag, dim=0)


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


class CameraEncoder(nn.Module):
    """One camera's frames become a vector: ResNet18 on all frames at once.

    Args:
        cfg: the policy's settings.
        is_mask: whether the camera shows labels.
        weights: torchvision's pretrained ResNet18, if there is one.
    """

    mean: Tensor
    std: Tensor

    def __init__(
        self, cfg: V2PBCConfig, *, is_mask: bool, weights: dict[str, Tensor] | None
    ) -> None:
        super().__init__()
        self.is_mask = is_mask
        self.greys = tuple(cfg.mask_greys)
        self.input_size_px = cfg.input_size_px
        self.random_shift = cfg.random_shift
        net = resnet18(weights=None)
        if weights is not None:
            net.load_state_dict(weights)
        stem = net.conv1.weight.detach()
        if is_mask:
            stem = mask_stem(stem, self.greys)
        net.conv1 = nn.Conv2d(
            stem.shape[1] * cfg.n_obs_steps, 64, 7, stride=2, padding=3, bias=False
        )
        if weights is not None:
            with torch.no_grad():  # a still scene excites the layer as one frame does
                net.conv1.weight.copy_(stem.repeat(1, cfg.n_obs_steps, 1, 1) / cfg.n_obs_steps)
        self.backbone = nn.Sequential(
            net.conv1,
            net.bn1,
            net.relu,
            net.maxpool,
            net.layer1,
            net.layer2,
            net.layer3,
            net.layer4,
        )
        self.register_buffer("mean", torch.tensor(IMAGENET_MEAN).view(3, 1, 1), persistent=False)
        self.register_buffer("std", torch.tensor(IMAGENET_STD).view(3, 1, 1), persistent=False)

    def forward(self, frames: Float[Tensor, "batch time c h w"]) -> Float[Tensor, "batch feature"]:
        if self.is_mask:
            small = label_channels(frames, self.greys, self.input_size_px).flatten(1, 2)
        else:
            small = shrink(((frames - self.mean) / self.std).flatten(1, 2), self.input_size_px)
        reach_px = round(self.random_shift * max(small.shape[-2:]))
        if self.training and reach_px:
            small = shifted(small, reach_px)
        return self.backbone(small).mean((2, 3))


class BCNet(nn.Module):
    """Everything between a batch of observations and the normalised actions."""

    def __init__(self, cfg: V2PBCConfig, weights: dict[str, Tensor] | None) -> None:
        super().__init__()
        self.cfg = cfg
        self.camera_keys = list(cfg.image_features)
        self.vector_keys = [
            key
            for key, feature in (cfg.input_features or {}).items()
            if feature.type in (FeatureType.STATE, FeatureType.ENV)
        ]
        cameras = [
            CameraEncoder(cfg, is_mask=cfg.is_mask(key), weights=weights)
            for key in self.camera_keys
        ]
        self.cameras = nn.ModuleList(cameras)
        width = BACKBONE_DIM * len(cameras)
        self.state = None
        if self.vector_keys:
            features = cfg.input_features or {}
            vector_dim = sum(
                int(torch.Size(features[key].shape).numel()) for key in self.vector_keys
            )
            self.state = nn.Sequential(
                nn.Linear(vector_dim * cfg.n_obs_steps, cfg.state_dim),
                nn.ReLU(),
                nn.Linear(cfg.state_dim, cfg.state_dim),
                nn.ReLU(),
            )
            width += cfg.state_dim
        self.task = None
        if cfg.use_task:
            self.task = nn.Sequential(nn.Linear(cfg.task_words_dim, cfg.task_words_dim), nn.ReLU())
            width += cfg.task_words_dim
        assert cfg.action_feature is not None
        self.action_dim = cfg.action_feature.shape[0]
        self.head = nn.Sequential(
            nn.Linear(width, cfg.head_dim),
            nn.ReLU(),
            nn.Linear(cfg.head_dim, cfg.head_dim),
            nn.ReLU(),
            nn.Linear(cfg.head_dim, cfg.head_dim),
            nn.ReLU(),
            nn.Linear(cfg.head_dim, cfg.chunk_size * self.action_dim),
        )

    def forward(self, batch: dict[str, Any]) -> Float[Tensor, "batch step act"]:
        """Return the chunk of normalised actions for observations that carry a time axis."""
        parts = [
            camera(batch[key]) for key, camera in zip(self.camera_keys, self.cameras, strict=True)
        ]
        if self.state is not None:
            vector = torch.cat([batch[key].flatten(1) for key in self.vector_keys], 1)
            parts.append(self.state(vector))
        if self.task is not None:
            tasks = batch.get("task") or [""] * len(parts[0])
            words = torch.stack([task_words(task, self.cfg.task_words_dim) for task in tasks])
            parts.append(self.task(words.to(parts[0])))
        return self.head(torch.cat(parts, 1)).unflatten(1, (self.cfg.chunk_size, self.action_dim))


class V2PBCPolicy(PreTrainedPolicy):
    """Behaviour cloning with a Huber loss on normalised actions.

    Huber and not squares: experts trained by reinforcement saturate now and then, and single wild actions should
    not rule. LeRobot constructs this class and passes keywords (dataset statistics and the like) it does not need.

    Args:
        config: settings, with features filled in.
        start_from_pretrained: look for pretrained backbone weights; off when a checkpoint's weights follow anyway.
    """

    config_class = V2PBCConfig  # pyright: ignore[reportAssignmentType] - LeRobot annotates these as None
    name = "v2p_bc"  # pyright: ignore[reportAssignmentType]
    config: V2PBCConfig

    def __init__(
        self, config: V2PBCConfig, *, start_from_pretrained: bool = True, **_: Any
    ) -> None:
        super().__init__(config)
        config.validate_features()
        weights = self._pretrained_weights() if start_from_pretrained else None
        self.backbone_is_pretrained = weights is not None or not start_from_pretrained
        self.net = BCNet(config, weights)
        self.reset()

    @classmethod
    def from_pretrained(  # pyright: ignore[reportIncompatibleMethodOverride] - LeRobot's keywords pass through
        cls, pretrained_name_or_path: str | Path, **kwargs: Any
    ) -> "V2PBCPolicy":
        """Load a checkpoint; the ImageNet file is not looked for."""
        return super().from_pretrained(
            pretrained_name_or_path, start_from_pretrained=False, **kwargs
        )

    def _pretrained_weights(self) -> dict[str, Tensor] | None:
        if self.config.pretrained_backbone_weights is None:
            return None
        path = pretrained_backbone_file()
        if not path.is_file():
            logger.warning(
                "No pretrained ResNet18 at %s, so the backbone starts from random weights and trains at the full"
                " learning rate; put %s there for the paper's setting, or pass"
                " --policy.pretrained_backbone_weights=null to silence this.",
                path,
                BACKBONE_WEIGHTS,
            )
            return None
        return torch.load(path, map_location="cpu", weights_only=True)

    def get_optim_params(self) -> list[dict[str, Any]]:  # pyright: ignore[reportIncompatibleMethodOverride]
        """Return two groups: the backbones with their own learning rate, and everything else."""
        backbone, rest = [], []
        for name, parameter in self.named_parameters():
            (backbone if ".backbone." in name else rest).append(parameter)
        lr = self.config.optimizer_lr_backbone
        if lr is None:
            lr = (
                PRETRAINED_BACKBONE_LR if self.backbone_is_pretrained else self.config.optimizer_lr
            )
        return [{"params": rest}, {"params": backbone, "lr": lr}]

    def reset(self) -> None:
        """Forget the last episode's frames and planned actions."""
        self._seen: dict[str, deque[Tensor]] = {
            key: deque(maxlen=self.config.n_obs_steps)
            for key in [*self.net.camera_keys, *self.net.vector_keys]
        }
        self._planned: deque[Tensor] = deque(maxlen=self.config.n_action_steps)

    def forward(self, batch: dict[str, Any]) -> tuple[Tensor, dict[str, float]]:  # pyright: ignore[reportIncompatibleMethodOverride]
        """Return the loss of a training batch (observations with a time axis, a chunk of actions)."""
        target = batch[ACTION]
        loss = F.smooth_l1_loss(self.net(batch), target, reduction="none")
        padded = batch.get("action_is_pad")
        if padded is not None:  # past the episode's end there is nothing to imitate
            inside = (~padded)[..., None].to(loss.dtype).expand_as(loss)
            mean = (loss * inside).sum() / inside.sum().clamp(min=1)
        else:
            mean = loss.mean()
        return mean, {"huber": mean.item()}

    @torch.no_grad()
    def predict_action_chunk(self, batch: dict[str, Any], **_: Any) -> Tensor:
        """Return the next `chunk_size` normalised actions.

        Observations with a time axis are taken as they are; single ones join the frames seen since `reset`.
        """
        self.eval()
        stacked = batch[self.net.camera_keys[0]].ndim == 5
        return self.net(batch if stacked else self._remember(batch))

    @torch.no_grad()
    def select_action(self, batch: dict[str, Any], **_: Any) -> Tensor:
        """Return the next normalised action per environment; call once per control step."""
        self.eval()
        stacked = self._remember(batch)
        if not self._planned:
            chunk = self.net(stacked)[:, : self.config.n_action_steps]
            self._planned.extend(chunk.unbind(1))
        return self._planned.popleft()

    def _remember(self, batch: dict[str, Any]) -> dict[str, Any]:
        """Add this observation and return the last `n_obs_steps`, the first one repeated at the start."""
        self._seen = populate_queues(self._seen, batch)
        frames = {key: torch.stack(list(queue), 1) for key, queue in self._seen.items()}
        return {**frames, "task": batch.get("task")}

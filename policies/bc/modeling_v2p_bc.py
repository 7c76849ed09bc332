"""The `v2p_bc` network and policy: stacked frames, the robot's state and the task's words become an action."""

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
from lerobot.utils.constants import ACTION
from torch import Tensor, nn

from policies.bc.configuration_v2p_bc import BACKBONE_WEIGHTS, V2PBCConfig
from policies.bc.encoders import CameraEncoder, Prepared, pretrained_backbone_file
from policies.bc.heads import head_of

logger = logging.getLogger(__name__)

PRETRAINED_BACKBONE_LR = 3e-5
STATE_LIMIT = 10.0
"""Normalised robot states are clipped here: an entry that hardly varies in a dataset must not blow up elsewhere."""


@lru_cache(maxsize=4096)
def task_words(task: str, dim: int) -> Float[Tensor, " dim"]:
    """Return the task's bag of words as a unit vector: each word adds +1 or -1 at a place its hash names."""
    bag = torch.zeros(dim)
    for word in re.findall(r"[^\W_]+", task.lower()):
        digest = hashlib.sha256(word.encode()).digest()
        bag[int.from_bytes(digest[:4], "little") % dim] += 1 if digest[4] & 1 else -1
    return F.normalize(bag, dim=0)


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
            CameraEncoder(
                cfg,
                is_mask=cfg.is_mask(key),
                weights=weights,
            )
            for key in cfg.image_features
        ]
        self.cameras = nn.ModuleList(cameras)
        width = sum(camera.dim for camera in cameras)
        self.state = None
        if self.vector_keys:
            features = cfg.input_features or {}
            vector_dim = sum(
                len(range(int(torch.Size(features[key].shape).numel()))[: cfg.state_entries])
                for key in self.vector_keys
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
        self.outputs = head_of(cfg)
        self.head = nn.Sequential(
            nn.Linear(width, cfg.head_dim),
            nn.ReLU(),
            nn.Linear(cfg.head_dim, cfg.head_dim),
            nn.ReLU(),
            nn.Linear(cfg.head_dim, cfg.head_dim),
            nn.ReLU(),
            nn.Linear(cfg.head_dim, cfg.chunk_size * self.action_dim * self.outputs.width),
        )

    def prepare(self, key: str, frames: Tensor | Prepared) -> Prepared:
        """Return what a camera's encoder needs of its frames `(batch, time, c, h, w)`; see `CameraEncoder.prepare`."""
        if isinstance(frames, dict):
            return frames
        camera = self.cameras[self.camera_keys.index(key)]
        assert isinstance(camera, CameraEncoder)
        return camera.prepare(frames)

    def forward(self, batch: dict[str, Any]) -> Float[Tensor, "batch step act out"]:
        """Return what the head says of each entry of the chunk, for observations that carry a time axis.

        A camera's frames are pictures, or what `prepare` made of them.
        """
        parts = [
            camera(self.prepare(key, batch[key]))
            for key, camera in zip(self.camera_keys, self.cameras, strict=True)
        ]
        if self.state is not None:
            used = slice(self.cfg.state_entries)
            vector = torch.cat([batch[key][..., used].flatten(1) for key in self.vector_keys], 1)
            parts.append(self.state(vector.clamp(-STATE_LIMIT, STATE_LIMIT)))
        if self.task is not None:
            tasks = batch.get("task") or [""] * len(parts[0])
            words = torch.stack([task_words(task, self.cfg.task_words_dim) for task in tasks])
            parts.append(self.task(words.to(parts[0])))
        shape = (self.cfg.chunk_size, self.action_dim, self.outputs.width)
        return self.head(torch.cat(parts, 1)).unflatten(1, shape)


class V2PBCPolicy(PreTrainedPolicy):
    """Behaviour cloning of normalised actions.

    LeRobot constructs this class and passes keywords (dataset statistics and the like) it does not need.

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
        if start_from_pretrained and config.optimizer_lr_backbone is None:
            # Written down, because a checkpoint does not tell what its backbone started from.
            is_pretrained = weights is not None
            config.optimizer_lr_backbone = (
                PRETRAINED_BACKBONE_LR if is_pretrained else config.optimizer_lr
            )
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
        if self.config.pretrained_backbone_weights is None or self.config.encoder != "resnet18":
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
        if lr is None:  # a checkpoint of an older version
            lr = PRETRAINED_BACKBONE_LR
        return [{"params": rest}, {"params": backbone, "lr": lr}]

    def reset(self) -> None:
        """Forget the last episode's frames and planned actions."""
        self._seen: deque[dict[str, Any]] = deque(maxlen=self.config.n_obs_steps)
        self._planned: deque[Tensor] = deque(maxlen=self.config.n_action_steps)

    def forward(  # pyright: ignore[reportIncompatibleMethodOverride]
        self, batch: dict[str, Any], reduction: str = "mean"
    ) -> tuple[Tensor, dict[str, float]]:
        """Return the loss of a training batch (observations with a time axis, a chunk of actions).

        Args:
            batch: observations, `action`, and `action_is_pad` where a chunk reaches beyond its episode.
            reduction: `mean`, or `none` for one loss a sample.
        """
        loss = self.net.outputs.loss(self.net(batch), batch[ACTION])
        padded = batch.get("action_is_pad")
        inside = torch.ones_like(loss)
        if padded is not None:  # past the episode's end there is nothing to imitate
            inside = (~padded)[..., None].to(loss.dtype).expand_as(loss)
        if reduction == "none":
            per_sample = (loss * inside).sum((1, 2)) / inside.sum((1, 2)).clamp(min=1)
            return per_sample, {self.loss_name: per_sample.mean().item()}
        mean = (loss * inside).sum() / inside.sum().clamp(min=1)
        return mean, {self.loss_name: mean.item()}

    @property
    def loss_name(self) -> str:
        """What the loss is: of bins the cross-entropy, of regression the Huber loss."""
        return "cross_entropy" if self.config.head == "bins" else "huber"

    @torch.no_grad()
    def predict_action_chunk(self, batch: dict[str, Any], **_: Any) -> Tensor:
        """Return the next `chunk_size` normalised actions.

        Observations with a time axis are taken as they are; single ones join the frames seen since `reset`.
        """
        self.eval()
        picture = batch[self.net.camera_keys[0]]
        stacked = isinstance(picture, dict) or picture.ndim == 5
        return self.net.outputs.decode(self.net(batch if stacked else self._remember(batch)))

    @torch.no_grad()
    def select_action(self, batch: dict[str, Any], **_: Any) -> Tensor:
        """Return the next normalised action per environment; call once per control step."""
        self.eval()
        stacked = self._remember(batch)
        if not self._planned:
            chunk = self.net.outputs.decode(self.net(stacked))
            self._planned.extend(chunk[:, : self.config.n_action_steps].unbind(1))
        return self._planned.popleft()

    def _remember(self, batch: dict[str, Any]) -> dict[str, Any]:
        """Add this observation and return the last `n_obs_steps`, the first one repeated at the start."""
        now: dict[str, Any] = {
            key: self.net.prepare(key, batch[key][:, None]) for key in self.net.camera_keys
        }
        now |= {key: batch[key][:, None] for key in self.net.vector_keys}
        self._seen.append(now)
        while len(self._seen) < self.config.n_obs_steps:
            self._seen.append(now)
        stacked: dict[str, Any] = {
            key: {
                name: torch.cat([seen[key][name] for seen in self._seen], 1) for name in now[key]
            }
            for key in self.net.camera_keys
        }
        stacked |= {
            key: torch.cat([seen[key] for seen in self._seen], 1) for key in self.net.vector_keys
        }
        return {**stacked, "task": batch.get("task")}

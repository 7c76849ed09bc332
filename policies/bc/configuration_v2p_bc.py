"""Settings of the `v2p_bc` policy: the paper's behaviour cloning, what mends it, and sizes a laptop can train.

LeRobot fills `input_features` and `output_features` from the dataset. This is a LeRobot config, hence neither
frozen nor keyword-only: draccus parses it and LeRobot writes into it.
"""

from dataclasses import dataclass, field
from typing import Any, Literal

from lerobot.configs import PreTrainedConfig
from lerobot.configs.types import NormalizationMode
from lerobot.optim import AdamWConfig, CosineDecayWithWarmupSchedulerConfig

BACKBONE_WEIGHTS = "ResNet18_Weights.IMAGENET1K_V1"
"""The one set of pretrained weights this policy knows."""
LONGEST_TRAINING = 1_000_000_000
"""Steps, more than anyone trains for: LeRobot shortens a schedule to fit, but never stretches one."""
CameraInput = Literal["auto", "mask", "rgb"]
Encoder = Literal["resnet18", "none"]
PRESETS: dict[str, dict[str, Any]] = {
    "custom": {},
    "paper": {
        "n_obs_steps": 2,
        "chunk_size": 1,
        "n_action_steps": 1,
        "input_size_px": 256,
        "encoder": "resnet18",
        "mask_moments": False,
        "head": "regression",
        "pretrained_backbone_weights": BACKBONE_WEIGHTS,
        "optimizer_lr": 3e-4,
        "lr_schedule": "constant",
    },
    "small": {
        "encoder": "none",
        "mask_moments": True,
        "head": "bins",
        "pretrained_backbone_weights": None,
        "optimizer_lr": 1e-3,
    },
}
"""Per preset the settings that it fixes."""


@PreTrainedConfig.register_subclass("v2p_bc")
@dataclass
class V2PBCConfig(PreTrainedConfig):
    """An encoder of stacked frames, a state MLP, an optional task embedding, and a three-layer head."""

    preset: Literal["custom", "paper", "small"] = "custom"
    """Fixes several settings at once, over what is said of them elsewhere. `paper`: ResNet18, 256 px, regression, the
    paper's learning rates. `small`: no convolutions, moments of the masks only; trains in minutes on a CPU."""
    n_obs_steps: int = 2
    """Frames the policy sees: the current one and the ones before it; at an episode's start the first is repeated."""
    chunk_size: int = 1
    """Actions predicted at once. The paper predicts one."""
    n_action_steps: int = 1
    """Actions of a chunk that are executed before the policy looks again."""

    input_size_px: int = 256
    """Longer side of the image the backbone sees; larger images are averaged down, smaller ones stay as they are."""
    camera_input: CameraInput = "auto"
    """`mask`: grey label images, split into one channel per label. `rgb`: ordinary images. `auto`: `mask` for
    cameras with 'mask' in their name, `rgb` for the others."""
    mask_greys: tuple[int, ...] = (0, 64, 128, 192, 255, 31, 95, 159, 223)
    """Grey (0 to 255) of each label of a label image; a pixel belongs to the nearest."""
    num_labels: int | None = None
    """Labels that the network tells apart, the background included; higher ones count as none. Null: all greys. Fewer
    cost less: our trainer sets it to the labels that occur."""

    encoder: Encoder = "resnet18"
    """`resnet18`: the paper's, pooled by averaging. `none`: masks are seen by their moments only; other cameras still
    get a ResNet18."""
    mask_moments: bool = True
    """Give the head area, centroid, extent and bounding box of each label, measured at full resolution."""
    head: Literal["bins", "regression"] = "bins"
    """`bins`: a distribution over levels for each entry of the action, which can choose between opposites.
    `regression`: the paper's."""
    num_bins: int = 21
    """Levels of an action's entry from its smallest to its largest value."""

    pretrained_backbone_weights: str | None = BACKBONE_WEIGHTS
    """Of `resnet18`. Used when the file lies in torch's cache (nothing is ever downloaded); null starts from random
    weights."""
    state_entries: int | None = None
    """Entries of the robot's state that are used, from the first on. Null: all."""
    state_dim: int = 256
    """Width of the robot state's embedding."""
    head_dim: int = 512
    """Width of the head's three layers."""
    use_task: bool = True
    """Condition on the task's words, so that one policy can serve several tasks."""
    task_words_dim: int = 64
    """Length of the fixed, hashed bag of words that stands for a task."""

    optimizer_lr: float = 3e-4
    """Learning rate of everything but a pretrained backbone."""
    optimizer_lr_backbone: float | None = None
    """Learning rate of the backbone. Null: 3e-5 when its weights are pretrained, else `optimizer_lr`."""
    lr_schedule: Literal["cosine", "constant"] = "cosine"
    """`cosine`: from full down to a hundredth over the training, after a warm-up of a fiftieth; better for short
    trainings. `constant` is the paper's."""
    optimizer_weight_decay: float = 1e-4
    grad_clip_norm: float = 10.0

    normalization_mapping: dict[str, NormalizationMode] = field(
        default_factory=lambda: {
            # lerobot-train replaces image statistics by ImageNet's unless told otherwise, which would spoil masks;
            # the policy scales images itself.
            "VISUAL": NormalizationMode.IDENTITY,
            "STATE": NormalizationMode.MEAN_STD,
            "ENV": NormalizationMode.MEAN_STD,
            "ACTION": NormalizationMode.MEAN_STD,
        }
    )
    """`ACTION` follows from `head`."""

    random_shift: float = 0.0
    mask_jitter_px: float = 0.0
    moments_dropout: float = 0.0
    """Read and ignored, as the two before: noise in training, which `config.json` of older policies names."""

    def __post_init__(self) -> None:
        super().__post_init__()
        for name, value in PRESETS[self.preset].items():
            setattr(self, name, value)
        # Bins need a bounded range.
        self.normalization_mapping = {
            **self.normalization_mapping,
            "ACTION": NormalizationMode.MIN_MAX
            if self.head == "bins"
            else NormalizationMode.MEAN_STD,
        }
        if self.n_obs_steps < 1:
            raise ValueError(f"n_obs_steps is {self.n_obs_steps}; it must be 1 or more")
        if not 1 <= self.n_action_steps <= self.chunk_size:
            raise ValueError(
                f"n_action_steps is {self.n_action_steps}; it must lie between 1 and chunk_size ({self.chunk_size})"
            )
        if self.input_size_px < 32:
            raise ValueError(f"input_size_px is {self.input_size_px}; ResNet18 needs 32 or more")
        if self.num_bins < 2:
            raise ValueError(f"num_bins is {self.num_bins}; it must be 2 or more")
        if self.num_labels is not None and not 2 <= self.num_labels <= len(self.mask_greys):
            raise ValueError(
                f"num_labels is {self.num_labels}; it lies between 2 and the number of mask_greys"
                f" ({len(self.mask_greys)})"
            )
        if len(set(self.mask_greys)) < 2 or not all(0 <= grey <= 255 for grey in self.mask_greys):
            raise ValueError(
                f"mask_greys are {self.mask_greys}; they must be two or more levels from 0 to 255"
            )
        if self.pretrained_backbone_weights not in (None, BACKBONE_WEIGHTS):
            raise ValueError(
                f"pretrained_backbone_weights is '{self.pretrained_backbone_weights}';"
                f" it can be null or '{BACKBONE_WEIGHTS}'"
            )

    def is_mask(self, camera_key: str) -> bool:
        """Tell whether this camera's images are label images."""
        if self.camera_input == "auto":
            return "mask" in camera_key.rsplit(".", 1)[-1].lower()
        return self.camera_input == "mask"

    def get_optimizer_preset(self) -> AdamWConfig:
        return AdamWConfig(
            lr=self.optimizer_lr,
            weight_decay=self.optimizer_weight_decay,
            grad_clip_norm=self.grad_clip_norm,
        )

    def get_scheduler_preset(self) -> CosineDecayWithWarmupSchedulerConfig | None:
        if self.lr_schedule == "constant":
            return None
        return CosineDecayWithWarmupSchedulerConfig(
            num_warmup_steps=LONGEST_TRAINING // 50,
            num_decay_steps=LONGEST_TRAINING,
            peak_lr=1.0,
            decay_lr=0.01,
        )

    def validate_features(self) -> None:
        if not self.image_features:
            raise ValueError(
                "v2p_bc looks at images, and this dataset has none: it needs a key such as"
                " 'observation.images.mask'"
            )
        if self.action_feature is None:
            raise ValueError("v2p_bc learns actions, and this dataset has no 'action'")

    @property
    def observation_delta_indices(self) -> list[int]:
        return list(range(1 - self.n_obs_steps, 1))

    @property
    def action_delta_indices(self) -> list[int]:
        return list(range(self.chunk_size))

    @property
    def reward_delta_indices(self) -> None:
        return None

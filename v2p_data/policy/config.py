"""Settings of the policy stage, without the libraries that train."""

from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Literal

Preset = Literal["custom", "small", "paper"]
PAPER_EPOCHS = 30
PAPER_BATCH_SIZE = 1024


@dataclass(frozen=True, kw_only=True)
class PolicyConfig:
    """How the policy is made and trained; anything else goes through `lerobot-train` itself."""

    preset: Preset = "custom"
    """Fixes the network, over what is said of it below. `small`: no convolutions, moments of the masks; minutes on a
    CPU. `paper`: ResNet18 at 256 px, regression, behaviour cloning only, 30 epochs of batch 1024."""
    steps: int = 20_000
    """Gradient steps on all frames, after the distillation's."""
    epochs: int = 0
    """Passes over all frames; above 0 it decides the steps."""
    batch_size: int = 64
    """Frames a step."""
    checkpoints: int = 1
    """Moments in the second half of the training at which the policy is judged in simulation; the one that succeeds
    most is kept. 1: the end, unjudged."""
    judge_episodes: int = 32
    """Episodes a task that judge a checkpoint, on seeds of their own."""
    judge_tasks: Path | None = None
    """Folder of tasks that judge checkpoints instead of the dataset's own: of objects that nobody
    trains on, and that no evaluation reports."""

    encoder: Literal["resnet18", "none"] = "resnet18"
    """Encoder of the whole picture; see `policies/bc/configuration_v2p_bc.py`, as the next ones."""
    input_size_px: int = 256
    """Pictures are scaled to this before the network; less is faster."""
    mask_moments: bool = True
    """Give the head each label's area, centroid, extent and bounding box, at full resolution."""
    head: Literal["bins", "regression"] = "bins"
    """A distribution over levels for each entry of the action, or its mean."""
    n_obs_steps: int = 2
    """Frames the policy sees."""
    chunk_size: int = 1
    """Actions predicted at once."""
    n_action_steps: int = 1
    """Actions of a chunk that are carried out before the policy looks again."""
    state_entries: int | None = None
    """Entries of the robot's state that are used, from the first on: 7 leaves the controller's command out."""
    learning_rate: float = 3e-4
    """Learning rate of all but a pretrained backbone."""
    weight_decay: float = 1e-4
    """Weight decay of AdamW; more keeps a policy from fitting its objects too closely."""

    def __post_init__(self) -> None:
        if self.steps < 1 or self.batch_size < 1 or self.checkpoints < 1 or self.epochs < 0:
            raise ValueError(
                "steps, batch_size and checkpoints must be at least 1, epochs 0 or more"
            )
        if self.judge_tasks is not None and self.checkpoints == 1:
            raise ValueError(
                "judge_tasks choose among checkpoints, and checkpoints is 1; raise it to 2 or more"
            )
        if not 1 <= self.n_action_steps <= self.chunk_size:
            raise ValueError(
                f"n_action_steps must lie between 1 and chunk_size ({self.chunk_size}), got {self.n_action_steps}"
            )
        if self.n_obs_steps < 1:
            raise ValueError(f"n_obs_steps must be at least 1, got {self.n_obs_steps}")

    @property
    def resolved(self) -> "PolicyConfig":
        """The settings with what the preset says of the training."""
        if self.preset != "paper":
            return self
        return replace(self, epochs=PAPER_EPOCHS, batch_size=PAPER_BATCH_SIZE)

    @property
    def student(self) -> "PolicyConfig":
        """The settings that a distillation depends on: the rest is of the last training, and here as by default."""
        usual = PolicyConfig()
        return replace(
            self,
            steps=usual.steps,
            epochs=usual.epochs,
            checkpoints=usual.checkpoints,
            judge_episodes=usual.judge_episodes,
            judge_tasks=None,
        )

    def num_steps(self, num_frames: int) -> int:
        """Return the gradient steps on a table of so many frames."""
        if not self.epochs:
            return self.steps
        return max(1, self.epochs * num_frames // self.batch_size)

    def network(self) -> dict[str, Any]:
        """Return the settings of `V2PBCConfig`: what the network is, not how long it trains."""
        return {
            "preset": self.preset,
            "encoder": self.encoder,
            "input_size_px": self.input_size_px,
            "mask_moments": self.mask_moments,
            "head": self.head,
            "n_obs_steps": self.n_obs_steps,
            "chunk_size": self.chunk_size,
            "n_action_steps": self.n_action_steps,
            "state_entries": self.state_entries,
            "optimizer_lr": self.learning_rate,
            "optimizer_weight_decay": self.weight_decay,
        }

"""How demonstrations are collected, and what their pictures show."""

from dataclasses import dataclass, field
from typing import Literal

from v2p_data.episodes.rollouts import CutConfig
from v2p_data.pipeline.fingerprint import UNSAID_BY_DEFAULT
from v2p_data.sim.env.ranges import RandomizationConfig
from v2p_data.sim.render.appearance import DistractorConfig, LookConfig
from v2p_data.sim.render.masks import MASK_CAMERAS, RGB_CAMERA
from v2p_data.sim.robot.action_names import Actions
from v2p_data.sim.robot.interface import ArmInterface

Render = Literal["masks", "rgb", "both"]


@dataclass(frozen=True, kw_only=True)
class EpisodesConfig:
    """How many demonstrations are collected, and under what."""

    num_episodes: int = 100
    """Successful episodes per task; the paper's policies learn from 100."""
    batch_worlds: int = 64
    """Worlds that run at the same time; part of the recipe, because it decides which world is which."""
    max_batches: int = 10
    """After this many the task makes do with what it has."""
    min_episodes: int = 1
    """With fewer the task is rejected."""
    size_px: int = 256
    """Width and height of the pictures; even, as video must be."""
    render: Render = "masks"
    """Pictures in the dataset: exact label masks, colour pictures (close but not equal), or each
    as a camera of its own."""
    wrist: bool = False
    """Masks of a second camera too, which the hand carries: `observation.images.mask_wrist`."""
    actions: Actions = field(default="delta_tool", metadata=UNSAID_BY_DEFAULT)
    """What `action` says: the tool's step, the tool's target after it, or the joint angles of that target."""
    joint_state: bool = field(default=False, metadata=UNSAID_BY_DEFAULT)
    """Let the angles of the arm's joints [rad] follow the 11 numbers of `observation.state`."""
    cut: CutConfig = field(default_factory=CutConfig)
    randomization: RandomizationConfig = field(default_factory=RandomizationConfig)
    distractors: DistractorConfig = field(default_factory=DistractorConfig)
    """Things that stand about in the pictures; none by default."""
    look: LookConfig = field(default_factory=LookConfig)
    """Light and colours of RGB pictures; always the same by default."""

    def __post_init__(self) -> None:
        if not 1 <= self.min_episodes <= self.num_episodes:
            raise ValueError(
                f"need 1 <= min_episodes <= num_episodes, got {self.min_episodes} and {self.num_episodes}"
            )
        if self.batch_worlds < 1 or self.max_batches < 1:
            raise ValueError("batch_worlds and max_batches must be at least 1")
        if self.size_px < 16 or self.size_px % 2:
            raise ValueError(f"size_px must be even and at least 16, got {self.size_px}")
        if not self.look.is_off and self.render == "masks":
            raise ValueError("look changes RGB pictures only; set render to rgb or both")
        if self.wrist and self.render == "rgb":
            raise ValueError("the wrist's camera gives masks only; set render to masks or both")

    @property
    def interface(self) -> ArmInterface:
        """What is seen of the arm and what it is commanded."""
        return ArmInterface(actions=self.actions, joint_state=self.joint_state)

    @property
    def cameras(self) -> tuple[str, ...]:
        """Names of the cameras whose pictures are in the dataset."""
        masks = () if self.render == "rgb" else MASK_CAMERAS[: 1 + self.wrist]
        return masks if self.render == "masks" else (*masks, RGB_CAMERA)

"""The settings of a reconstruction."""

from dataclasses import dataclass, field, replace
from typing import Literal

from v2p_data.scene.backends.config import (
    DepthConfig,
    GroundConfig,
    MeshConfig,
    OutlineConfig,
    PoseConfig,
    SegmentConfig,
)

type Preset = Literal["builtin", "learned"]


@dataclass(frozen=True, kw_only=True)
class SceneConfig:
    """How a scene is rebuilt, and how sure we must be."""

    preset: Preset = "builtin"
    """`builtin` downloads nothing. `learned` takes Grounding DINO, SAM 2 and a metric depth model
    in sizes that fit this machine, for each stage whose backend is not set; 'v2p setup' lists
    them."""
    min_confidence: float = 0.52
    """Scenes below are rejected."""
    min_found: float = 0.5
    """Objects that are found less surely are rejected."""
    max_camera_shift_px: float = 3.0
    """Largest shift in a picture 320 px wide. Everything here takes the camera to stand still."""
    check_motion: bool = True
    """Reject what does not move as its caption says."""
    camera_height_m: float | None = None
    """Height of the camera above the table, where you measured it: with pitch and field of view it
    gives all sizes, which are guesses otherwise."""
    pitch_rad: float | None = None
    """How far the camera looks below the horizon, where you know it."""
    pitch_spread_rad: float = 0.14
    """How far silhouettes may pull the pitch from the expected one."""
    fov_rad: float | None = None
    """Horizontal field of view of the camera, where you know it."""
    camera_spread: float = 0.02
    """How far off what you give of the camera may be: standard deviation of the pitch in radians,
    and of the height's logarithm. 0.02 with a tape and a level; 'v2p scene camera' says how sure
    it is."""
    max_poses: int = 150
    """Poses kept per object, the first and last among them."""
    ground: GroundConfig = field(default_factory=GroundConfig)
    segment: SegmentConfig = field(default_factory=SegmentConfig)
    outline: OutlineConfig = field(default_factory=OutlineConfig)
    depth: DepthConfig = field(default_factory=DepthConfig)
    mesh: MeshConfig = field(default_factory=MeshConfig)
    pose: PoseConfig = field(default_factory=PoseConfig)

    def __post_init__(self) -> None:
        if not 0 <= self.min_confidence < 1:
            raise ValueError(f"min_confidence must lie in 0..1, got {self.min_confidence}")
        if not 0 <= self.min_found < 1:
            raise ValueError(f"min_found must lie in 0..1, got {self.min_found}")
        for name, low, high in (
            ("camera_height_m", 0.05, 5.0),
            ("pitch_rad", 0.1, 1.5),
            ("fov_rad", 0.3, 2.2),
            ("camera_spread", 0.0, 1.0),
        ):
            value = getattr(self, name)
            if value is not None and not low < value < high:
                raise ValueError(f"{name} must lie in {low}..{high}, got {value}")
        if self.max_poses < 2:
            raise ValueError(f"max_poses must be at least 2, got {self.max_poses}")

    def without_gate(self) -> "SceneConfig":
        """Return settings that turn nothing away for being unsure: for measuring, not for use."""
        return replace(self, min_confidence=0.0, min_found=0.0, check_motion=False)

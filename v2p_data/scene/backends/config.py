"""Which model does which stage of reconstruction. Settings only: nothing heavy is imported here."""

import shlex
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

type DType = Literal["float32", "float16", "bfloat16"]
type GroundBackend = Literal["network", "grounding_dino", "worker"]
type SegmentBackend = Literal["flow", "sam2", "worker"]
type OutlineBackend = Literal["auto", "none", "mobile_sam"]
type DepthBackend = Literal["none", "depth_anything", "worker"]

DEFAULT_MODELS: dict[str, str] = {
    "grounding_dino": "IDEA-Research/grounding-dino-tiny",
    "sam2": "facebook/sam2.1-hiera-small",
    "depth_anything": "depth-anything/Depth-Anything-V2-Metric-Indoor-Small-hf",
}
"""The checkpoint that an empty `model` stands for; `docs/backends.md` has the licence of each."""
MODEL_CLASSES: dict[str, tuple[str, str]] = {
    "grounding_dino": ("GroundingDinoForObjectDetection", "AutoProcessor"),
    "sam2": ("Sam2VideoModel", "Sam2VideoProcessor"),
    "depth_anything": ("DepthAnythingForDepthEstimation", "AutoImageProcessor"),
}
"""Per backend the classes of transformers that read its checkpoint: the model, the processor."""


@dataclass(frozen=True, kw_only=True)
class GroundConfig:
    """How the objects of a caption are found in a frame."""

    backend: GroundBackend = "network"
    """`network` needs no downloaded weights; `worker` asks a process of yours."""
    model: str = ""
    """Hub id or folder of a checkpoint; empty takes the backend's default."""
    device: str = "auto"
    """`auto`, `cpu`, `cuda` or `cuda:1`; `auto` takes the GPU where there is one."""
    batch_size: int = 4
    """Pictures per pass; fewer need less memory."""
    box_threshold: float = 0.3
    """Boxes the model is less sure of are dropped."""
    text_threshold: float = 0.25
    """Words of a prompt the model ties less firmly to a box do not count as named by it."""
    max_overlap: float = 0.7
    """Two phrases do not both get boxes with a larger intersection over union than this."""
    worker: str = ""
    """Command line of a worker (`docs/workers.md`); with `backend=worker` only."""
    worker_timeout_s: float = 600.0
    """After this the worker's whole process group is killed."""

    def __post_init__(self) -> None:
        _check_model(self.device, self.batch_size)
        for name in ("box_threshold", "text_threshold", "max_overlap"):
            if not 0 <= getattr(self, name) <= 1:
                raise ValueError(f"{name} must lie in 0..1, got {getattr(self, name)}")
        _check_worker(self.worker, self.worker_timeout_s, needed=self.backend == "worker")


@dataclass(frozen=True, kw_only=True)
class SegmentConfig:
    """How an object's mask is carried through the clip."""

    backend: SegmentBackend = "flow"
    """`flow` needs no downloaded weights; `worker` asks a process of yours."""
    model: str = ""
    """Hub id or folder of a checkpoint; empty takes the backend's default."""
    device: str = "auto"
    """`auto`, `cpu`, `cuda` or `cuda:1`; `auto` takes the GPU where there is one."""
    dtype: DType = "float32"
    """Weights and activations; half precision is for GPUs."""
    num_points: int = 5
    """Positive points per mask that prompt the video model; five as in the paper."""
    offload: bool = False
    """Keep what the tracker remembers in main memory instead of on the device: slower, for long clips."""
    mask_threshold: float = 0.0
    """Logit above which a pixel belongs to the object."""
    worker: str = ""
    """Command line of a worker (`docs/workers.md`); with `backend=worker` only."""
    worker_timeout_s: float = 1200.0
    """After this the worker's whole process group is killed."""

    def __post_init__(self) -> None:
        _check_model(self.device, 1)
        if self.num_points < 1:
            raise ValueError(f"num_points must be at least 1, got {self.num_points}")
        _check_worker(self.worker, self.worker_timeout_s, needed=self.backend == "worker")


@dataclass(frozen=True, kw_only=True)
class DepthConfig:
    """How far every pixel is, which fixes the camera's height, pitch and roll over the table."""

    backend: DepthBackend = "none"
    """`none` relies on usual sizes; `worker` asks a process of yours."""
    model: str = ""
    """Hub id or folder of a checkpoint with metric depth; empty takes the backend's default."""
    device: str = "auto"
    """`auto`, `cpu`, `cuda` or `cuda:1`; `auto` takes the GPU where there is one."""
    dtype: DType = "float32"
    """Weights and activations; half precision is for GPUs."""
    batch_size: int = 1
    """Pictures per pass; fewer need less memory."""
    worker: str = ""
    """Command line of a worker (`docs/workers.md`); with `backend=worker` only."""
    worker_timeout_s: float = 600.0
    """After this the worker's whole process group is killed."""

    def __post_init__(self) -> None:
        _check_model(self.device, self.batch_size)
        _check_worker(self.worker, self.worker_timeout_s, needed=self.backend == "worker")


@dataclass(frozen=True, kw_only=True)
class OutlineConfig:
    """Who outlines an object from points on it or a box around it."""

    backend: OutlineBackend = "auto"
    """`mobile_sam` needs 'v2p setup outlines' once, or `weights`; `auto` takes it where it can be used."""
    weights: Path | None = None
    """File with MobileSAM's weights (`mobile_sam.pt` as published, or safetensors); without one, what setup fetched."""


@dataclass(frozen=True, kw_only=True)
class MeshConfig:
    """Where an object's mesh comes from."""

    worker: str = ""
    """Command line of a worker that makes a mesh of a picture (InstantMesh, TripoSR); empty fits it to the outline."""
    worker_timeout_s: float = 600.0
    """After this the worker's whole process group is killed."""

    def __post_init__(self) -> None:
        _check_worker(self.worker, self.worker_timeout_s, needed=False)


@dataclass(frozen=True, kw_only=True)
class PoseConfig:
    """Where an object's pose per frame comes from."""

    worker: str = ""
    """Command line of a worker that follows a mesh through a clip (FoundationPose); empty fits poses to masks."""
    worker_timeout_s: float = 1200.0
    """After this the worker's whole process group is killed."""

    def __post_init__(self) -> None:
        _check_worker(self.worker, self.worker_timeout_s, needed=False)


def _check_model(device: str, batch_size: int) -> None:
    kind, _, index = device.partition(":")
    if kind not in ("auto", "cpu", "cuda", "mps") or (index and not index.isdigit()):
        raise ValueError(f"device must be auto, cpu, cuda, cuda:N or mps, got '{device}'")
    if batch_size < 1:
        raise ValueError(f"batch_size must be at least 1, got {batch_size}")


def _check_worker(command: str, timeout_s: float, *, needed: bool) -> None:
    if needed and not command.strip():
        raise ValueError(
            "backend=worker needs the worker's command line, e.g. worker='python worker.py'"
        )
    try:
        shlex.split(command)
    except ValueError as error:
        raise ValueError(
            f"the worker's command line cannot be read ({error}): {command}"
        ) from None
    if not timeout_s > 0:
        raise ValueError(f"worker_timeout_s must be above 0, got {timeout_s}")

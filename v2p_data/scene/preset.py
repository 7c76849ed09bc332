"""The preset of learned models: which checkpoint does which stage on this machine, and what of it must be downloaded.

Only checkpoints whose weights allow commercial use are chosen (`docs/backends.md`). A stage that was set by hand stays
as it was set. torch and huggingface_hub are imported only where they are asked.
"""

from collections.abc import Callable, Iterable
from dataclasses import dataclass, replace
from pathlib import Path

from v2p_data.scene.backends.config import DEFAULT_MODELS, OutlineConfig
from v2p_data.scene.backends.mobile_sam_setup import installed_weights, transformers_is_there
from v2p_data.scene.config import SceneConfig


@dataclass(frozen=True, kw_only=True)
class Size:
    """Checkpoints for machines with at least so much GPU memory."""

    least_gpu_gb: float
    ground: str
    segment: str
    batch_size: int
    """Pictures per pass of the detector and of the depth model."""


SIZES = (
    Size(
        least_gpu_gb=16.0,
        ground="IDEA-Research/grounding-dino-base",
        segment="facebook/sam2.1-hiera-large",
        batch_size=8,
    ),
    Size(
        least_gpu_gb=8.0,
        ground="IDEA-Research/grounding-dino-base",
        segment="facebook/sam2.1-hiera-base-plus",
        batch_size=4,
    ),
    Size(
        least_gpu_gb=0.0,
        ground="IDEA-Research/grounding-dino-tiny",
        segment="facebook/sam2.1-hiera-tiny",
        batch_size=1,
    ),
)
"""The largest first. Weights in float32 take 2.0, 1.4 and 0.95 GB; the rest of the memory is for activations."""

WEIGHTS_GB = {
    "IDEA-Research/grounding-dino-tiny": 0.69,
    "IDEA-Research/grounding-dino-base": 0.93,
    "facebook/sam2.1-hiera-tiny": 0.16,
    "facebook/sam2.1-hiera-small": 0.18,
    "facebook/sam2.1-hiera-base-plus": 0.32,
    "facebook/sam2.1-hiera-large": 0.90,
    "depth-anything/Depth-Anything-V2-Metric-Indoor-Small-hf": 0.10,
}
"""Size of the weights [GB], from their number of parameters in float32."""
NEEDED_FILES = ("config.json", "model.safetensors")
"""A checkpoint whose cache holds these counts as downloaded."""
UNWANTED_FILES = ("*.bin", "*.pt", "*.pth", "*.ckpt", "*.msgpack", "*.h5", "*.onnx")
"""The same weights in other formats."""


def gpu_memory_gb() -> float:
    """Return the memory of the first CUDA device [GB]; 0 without one."""
    import torch

    if not torch.cuda.is_available():
        return 0.0
    return torch.cuda.get_device_properties(0).total_memory / 1e9


def with_preset(cfg: SceneConfig, memory_gb: Callable[[], float] = gpu_memory_gb) -> SceneConfig:
    """Return the settings with what the preset and this machine choose written out.

    Args:
        cfg: settings; a stage with a backend of its own keeps it.
        memory_gb: of the GPU, asked only where the preset is `learned`.
    """
    if cfg.outline.backend == "auto":
        here = "mobile_sam" if mobile_sam_is_here(cfg.outline) else "none"
        cfg = replace(cfg, outline=replace(cfg.outline, backend=here))
    if cfg.preset != "learned":
        return cfg
    memory = memory_gb()
    size = next(s for s in SIZES if memory >= s.least_gpu_gb)
    ground, segment, depth = cfg.ground, cfg.segment, cfg.depth
    if ground.backend == "network":
        ground = replace(
            ground,
            backend="grounding_dino",
            model=ground.model or size.ground,
            batch_size=size.batch_size,
        )
    if segment.backend == "flow":
        segment = replace(segment, backend="sam2", model=segment.model or size.segment)
    if depth.backend == "none":
        depth = replace(
            depth,
            backend="depth_anything",
            model=depth.model or DEFAULT_MODELS["depth_anything"],
            batch_size=size.batch_size,
        )
    return replace(cfg, preset="builtin", ground=ground, segment=segment, depth=depth)


def mobile_sam_is_here(cfg: OutlineConfig) -> bool:
    """Return whether MobileSAM can be used: its weights were named or set up, and transformers is installed."""
    weights = cfg.weights or installed_weights()
    return weights is not None and transformers_is_there()


def checkpoints_of(cfg: SceneConfig) -> tuple[str, ...]:
    """Return the Hub ids and folders of all checkpoints that these settings load."""
    named = (cfg.ground, cfg.segment, cfg.depth)
    return tuple(
        stage.model or DEFAULT_MODELS[stage.backend]
        for stage in named
        if stage.backend in DEFAULT_MODELS and not stage.worker
    )


def missing(models: Iterable[str]) -> tuple[str, ...]:
    """Return those of the checkpoints that are neither a folder here nor in the Hub's cache."""
    from huggingface_hub import try_to_load_from_cache

    return tuple(
        model
        for model in models
        if not Path(model).is_dir()
        and not all(isinstance(try_to_load_from_cache(model, f), str) for f in NEEDED_FILES)
    )


def named_with_sizes(models: Iterable[str]) -> str:
    """Return a line that names checkpoints with their sizes [GB], for a person who waits for a download."""
    sizes = {model: WEIGHTS_GB.get(model) for model in models}
    words = ", ".join(
        f"{model} ({f'{gb:.2g} GB' if gb else 'size unknown'})" for model, gb in sizes.items()
    )
    known = sum(gb for gb in sizes.values() if gb)
    return f"{words}; {known:.2g} GB together" if len(sizes) > 1 else words

"""Tiny LeRobot datasets with known pictures, and tables and policies made by hand."""

from pathlib import Path
from typing import Any

import numpy as np
import torch
from lerobot.configs.types import FeatureType, PolicyFeature

from policies.bc.configuration_v2p_bc import V2PBCConfig
from policies.bc.frames import FrameTable, frames_of
from policies.bc.trainer import make_policy

MASK, FRONT, STATE = "observation.images.mask", "observation.images.front", "observation.state"
REPO_ID = "user/small"
FPS = 20
SIZE_PX = 64
GREYS = np.array([0, 64, 128], np.uint8)
TASKS = ("push the box", "lift the mug", "push the box")
LENGTHS = (7, 5, 6)


def write_dataset(
    root: Path, *, lengths: tuple[int, ...] = LENGTHS, dtype: str = "video", seed: int = 0
) -> list[np.ndarray]:
    """Write lossless masks as video, or colours as images; return the pictures `(frame, h, w, 3)`."""
    from lerobot.configs import RGBEncoderConfig
    from lerobot.datasets.lerobot_dataset import LeRobotDataset

    camera = MASK if dtype == "video" else FRONT
    shape = (SIZE_PX, SIZE_PX, 3)
    names = ["height", "width", "channels"]
    writer: Any = LeRobotDataset.create(
        REPO_ID,
        fps=FPS,
        root=root,
        features={
            camera: {"dtype": dtype, "shape": shape, "names": names},
            STATE: {"dtype": "float32", "shape": (3,), "names": None},
            "action": {"dtype": "float32", "shape": (2,), "names": None},
        },
        use_videos=dtype == "video",
        rgb_encoder=RGBEncoderConfig(vcodec="h264", crf=0, pix_fmt="yuv420p"),
    )
    rng = np.random.default_rng(seed)
    pictures: list[np.ndarray] = []
    for k, length in enumerate(lengths):
        for _ in range(length):
            if dtype == "video":
                blocks = GREYS[rng.integers(0, 3, (8, 8, 1))]
                picture = blocks.repeat(8, 0).repeat(8, 1).repeat(3, 2)
            else:
                picture = rng.integers(0, 256, shape).astype(np.uint8)
            pictures.append(picture)
            writer.add_frame(
                {
                    camera: picture,
                    STATE: rng.normal(size=3).astype(np.float32),
                    "action": rng.uniform(-1, 1, 2).astype(np.float32),
                    "task": TASKS[k],
                }
            )
        writer.save_episode()
    writer.finalize()
    return pictures


def config(
    camera: str = MASK, *, state: int = 3, size_px: int = SIZE_PX, **settings
) -> V2PBCConfig:
    """Return settings of a policy that is quick to train, with its features filled in."""
    settings = {"input_size_px": 32, "pretrained_backbone_weights": None, **settings}
    cfg = V2PBCConfig(device="cpu", head_dim=32, state_dim=16, **settings)
    cfg.input_features = {
        camera: PolicyFeature(FeatureType.VISUAL, (3, size_px, size_px)),
        STATE: PolicyFeature(FeatureType.STATE, (state,)),
    }
    cfg.output_features = {"action": PolicyFeature(FeatureType.ACTION, (2,))}
    return cfg


def policy(cfg: V2PBCConfig | None = None, *, seed: int = 0, device: str = "cpu"):
    """Return a policy and its processors, with statistics made up."""
    stats: dict[str, dict[str, Any]] = {
        STATE: {"mean": np.full(3, 0.5), "std": np.full(3, 2.0)},
        "action": {
            "min": np.full(2, -1.0),
            "max": np.full(2, 1.0),
            "mean": np.zeros(2),
            "std": np.ones(2),
        },
    }
    return make_policy(cfg or config(num_labels=3), stats, seed=seed, device=device)


def table(net, *, lengths: tuple[int, ...] = LENGTHS, seed: int = 0) -> FrameTable:
    """Return frames in which the action follows from where the object is."""
    rng = np.random.default_rng(seed)
    frames = sum(lengths)
    place = rng.integers(4, SIZE_PX - 12, (frames, 2))
    pictures = np.zeros((frames, SIZE_PX, SIZE_PX), np.uint8)
    for picture, (x, y) in zip(pictures, place, strict=True):
        picture[y : y + 8, x : x + 8] = GREYS[1]
    return frames_of(
        net=net,
        pictures={MASK: pictures},
        vectors={STATE: rng.normal(size=(frames, 3)).astype(np.float32)},
        action=(place / SIZE_PX * 2 - 1).astype(np.float32),
        task="push the box",
        lengths=lengths,
    )


def weights(net: torch.nn.Module) -> dict[str, torch.Tensor]:
    return {name: value.detach().clone() for name, value in net.state_dict().items()}


def are_equal(one: dict[str, torch.Tensor], other: dict[str, torch.Tensor]) -> bool:
    """Tell whether two sets of weights are the same to the last bit."""
    return one.keys() == other.keys() and all(torch.equal(one[k], other[k]) for k in one)

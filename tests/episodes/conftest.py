"""Staged episodes of synthetic masks, a dataset packed from them once, and a Hub on the loopback."""

import sys
from collections.abc import Callable
from pathlib import Path

import cv2
import numpy as np
import pytest

sys.path.insert(0, str(Path(__file__).parent))

from hub_server import running_hub

from v2p_data.episodes.staging import Episode
from v2p_data.seeds import rng_for

SIZE_PX = 64
NUM_FRAMES = 12


def an_episode(number: int, *, size_px: int = SIZE_PX, num_frames: int = NUM_FRAMES) -> Episode:
    """Return a disc and a square that wander over a background, with random numbers beside them."""
    rng = rng_for(3, "synthetic-episode", number)
    labels = np.zeros((num_frames, size_px, size_px), np.uint8)
    for t in range(num_frames):
        cv2.circle(labels[t], (10 + 2 * t + number, 30), 9, 1, -1)
        cv2.rectangle(labels[t], (20 + t, 35), (38 + t, 50 + number), 2, -1)
        cv2.rectangle(labels[t], (45, 5), (60, 15), 3 + number % 2, -1)
    return Episode(
        id=f"toy_{number:05d}",
        item="toy",
        task="lift the toy up" if number % 2 == 0 else "push the toy to the left",
        seed=number,
        labels=labels,
        state=rng.normal(size=(num_frames, 11)).astype(np.float32),
        action=rng.uniform(-1, 1, (num_frames, 7)).astype(np.float32),
        success=np.arange(num_frames) >= num_frames - 4,
        simulated=some_truths(num_frames, rng),
        referee=True,
        objects=("toy", "bowl", "lid"),
        params={"action_delay_ms": 12.5, "objects": {"toy": {"mass_kg": 0.1 + number / 100}}},
    )


def some_truths(num_frames: int, rng: np.random.Generator) -> dict[str, np.ndarray]:
    """Return rewards, poses and contacts of two objects, and a camera that looks straight down."""
    poses = np.zeros((num_frames, 7, 7), np.float32)
    poses[:, :2, :3] = rng.normal(size=(num_frames, 2, 3))
    poses[:, :2, 3] = 1
    touches = np.zeros((num_frames, 7, 3), bool)
    touches[num_frames // 2 :, 0] = True
    return {
        "next.reward": rng.uniform(size=num_frames).astype(np.float32),
        "privileged.object_pose": poses.reshape(num_frames, 49),
        "privileged.contact": touches.reshape(num_frames, 21),
        "camera.intrinsics": np.tile(np.float32([70, 70, 32, 32]), (num_frames, 1)),
        "camera.pose": np.tile(np.float32([0.5, 0, 1, 0, 1, 0, 0]), (num_frames, 1)),
    }


@pytest.fixture(scope="session")
def make_episode() -> Callable[..., Episode]:
    return an_episode


@pytest.fixture(scope="session")
def staged(tmp_path_factory: pytest.TempPathFactory) -> list[Path]:
    folder = tmp_path_factory.mktemp("staged")
    return [an_episode(number).save(folder) for number in range(3)]


@pytest.fixture(scope="session")
def packed(tmp_path_factory: pytest.TempPathFactory, staged: list[Path]) -> Path:
    """A dataset of three episodes. Importing LeRobot takes most of its time; do not write into it."""
    from v2p_data.episodes.dataset.writer import pack

    root = tmp_path_factory.mktemp("dataset") / "toys"
    pack(staged, "user/toys", root, provenance={"commit": "abc", "packages": {"lerobot": "0.6.1"}})
    return root


@pytest.fixture
def hub():
    with running_hub() as server:
        yield server

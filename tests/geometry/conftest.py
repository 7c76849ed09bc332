"""Rigid transforms drawn at random; MuJoCo, OpenCV and school formulas are the oracles."""

import sys
from collections.abc import Callable
from pathlib import Path

import mujoco
import numpy as np
import pytest

from v2p_data.seeds import rng_for

sys.path.insert(0, str(Path(__file__).parent))


def rigid(rng: np.random.Generator) -> np.ndarray:
    """Return a transform whose rotation MuJoCo made of a random quaternion `wxyz`."""
    quat = rng.normal(size=4)
    rotation = np.zeros(9)
    mujoco.mju_quat2Mat(rotation, quat / np.linalg.norm(quat))
    T = np.eye(4)
    T[:3, :3], T[:3, 3] = rotation.reshape(3, 3), rng.normal(size=3)
    return T


@pytest.fixture(params=range(6))
def rng(request: pytest.FixtureRequest) -> np.random.Generator:
    return rng_for(request.param, "geometry-laws")


@pytest.fixture
def draw_transform() -> Callable[[np.random.Generator], np.ndarray]:
    return rigid

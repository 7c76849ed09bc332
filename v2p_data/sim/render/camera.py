"""The camera of the training simulator: what policies see the table with, unless an episode moves it."""

import numpy as np

from v2p_data.geometry.camera import Camera, intrinsics, look_at
from v2p_data.sim.model.world import CAMERA_FOVY_DEG, CAMERA_POS, CAMERA_TARGET


def training_camera(size_px: int) -> Camera:
    """Return the camera of square pictures of `size_px` pixels; world frame: the arm's base."""
    return Camera(
        width_px=size_px,
        height_px=size_px,
        K=intrinsics(size_px, size_px, np.radians(CAMERA_FOVY_DEG)),
        T_world_cam=look_at(np.array(CAMERA_POS), np.array(CAMERA_TARGET)),
    )

"""Camera heights become metres, and the scene frame gets its origin under the manipulated object."""

from dataclasses import replace

import numpy as np
from jaxtyping import Float

from v2p_data.geometry.camera import Camera
from v2p_data.scene.data_types import Placement
from v2p_data.video.clip import Clip


def scene_origin(placement: Placement) -> Float[np.ndarray, "3"]:
    """Return the table point under the manipulated object's first position [camera heights]."""
    return placement.objects[0].first.T_world_obj[:3, 3] * np.array([1, 1, 0])


def metric_camera(camera: Camera, origin: Float[np.ndarray, "3"], height_m: float) -> Camera:
    """Return a camera given in camera heights in the scene frame and metres."""
    T = camera.T_world_cam.copy()
    T[:3, 3] = (T[:3, 3] - origin) * height_m
    return replace(camera, T_world_cam=T)


def clip_camera(clip: Clip, placement: Placement) -> Camera:
    """Return the camera of the clip's frames, in the scene frame and metres."""
    work = metric_camera(placement.camera, scene_origin(placement), placement.height_m)
    h, w = clip.frames.shape[1:3]
    K = np.diag([w / work.width_px, h / work.height_px, 1.0]) @ work.K
    return replace(work, width_px=w, height_px=h, K=K)

"""A learned model or a worker says where the camera is, and how an object lies in every frame.

Each function is for one backend setting and leaves everything else as it is.
"""

from collections.abc import Sequence
from dataclasses import replace

import cv2
import numpy as np
import trimesh
from jaxtyping import Bool, Float

from v2p_data.geometry.camera import Camera
from v2p_data.geometry.pose import transform
from v2p_data.scene.backends.config import (
    DepthConfig,
    PoseConfig,
)
from v2p_data.scene.data_types import CameraGuess, ObjectTrack
from v2p_data.scene.frames.mask_ops import grow
from v2p_data.scene.frames.working_clip import WorkingClip
from v2p_data.video.clip import Clip

_PITCH_SD_RAD = 0.04
"""What remains unsure of the pitch of a plane fitted to predicted depth."""
_HEIGHT_SD = 0.12
"""Standard deviation of the logarithm of a height from predicted metric depth."""


def camera_from_depth(
    clip: Clip,
    working: WorkingClip,
    objects: Sequence[ObjectTrack],
    guess: CameraGuess,
    cfg: DepthConfig,
    rng: np.random.Generator,
) -> CameraGuess:
    """Return the camera over the plane that the predicted depth of the first and last frame shows.

    The guess comes back unchanged where no plane that can be a table is found.
    """
    from v2p_data.scene.backends.depth import predict_depth, table_from_depth

    ends = [int(working.frame_idx[0]), int(working.frame_idx[-1])]
    depth = predict_depth([clip.frames[i] for i in ends], cfg)
    h, w = clip.frames.shape[1:3]
    fov = guess.fov_rad if depth.fov_rad is None else float(np.median(depth.fov_rad))
    f = w / 2 / np.tan(fov / 2)
    K = np.array([[f, 0, w / 2], [0, f, h / 2], [0, 0, 1.0]])
    planes = []
    for k, i in enumerate((0, len(working.rgb) - 1)):
        things = np.any([grow(s.masks[i], 3) for s in objects], axis=0)
        not_table = cv2.resize(things.astype(np.uint8), (w, h)) > 0
        plane = table_from_depth(depth.depth_m[k], K, not_table, rng=rng)
        if plane is not None:
            planes.append(plane)
    if not planes:
        return guess
    best = max(planes, key=lambda plane: plane.inlier_share)
    return replace(
        guess,
        fov_rad=fov,
        pitch_rad=best.pitch_rad,
        pitch_sd_rad=_PITCH_SD_RAD,
        height_m=best.height_m if depth.metric else None,
        height_sd=_HEIGHT_SD,
    )


def poses_by_worker(
    clip: Clip,
    working: WorkingClip,
    masks: Bool[np.ndarray, "time h w"],
    mesh: trimesh.Trimesh,
    camera: Camera,
    cfg: PoseConfig,
) -> tuple[Float[np.ndarray, "time 4 4"], Float[np.ndarray, "time"]]:
    """Return the worker's `T_world_obj` for every working frame, and how sure it is of each (0 to 1).

    `camera` is the metric one of the clip's frames.

    Raises:
        V2PError: the worker fails.
        ItemRejectedError: it refuses the object.
    """
    from v2p_data.scene.backends.worker import WorkerRequest, run_worker

    images = np.stack([clip.frames[i] for i in working.frame_idx])
    h, w = images.shape[1:3]
    large = np.stack(
        [
            cv2.resize(m.astype(np.uint8), (w, h), interpolation=cv2.INTER_NEAREST) > 0
            for m in masks
        ]
    )
    request = WorkerRequest(
        kind="pose",
        arrays={
            "images": images,
            "masks": large,
            "K": camera.K,
            "mesh_vertices": np.asarray(mesh.vertices, float),
            "mesh_faces": np.asarray(mesh.faces, int),
        },
    )
    answer = run_worker(cfg.worker, request, cfg.worker_timeout_s)
    T_cam_objs = np.asarray(answer.arrays["T_cam_objs"], float)
    poses = np.stack([camera.T_world_cam @ transform(T[:3, :3], T[:3, 3]) for T in T_cam_objs])
    return poses, np.asarray(answer.arrays["confidences"], float)

"""A worker makes an object's mesh from one picture."""

import cv2
import numpy as np
import trimesh

from v2p_data.scene.backends.config import MeshConfig
from v2p_data.scene.data_types import ObjectTrack
from v2p_data.scene.frames.working_clip import WorkingClip
from v2p_data.video.clip import Clip


def mesh_by_worker(
    clip: Clip,
    working: WorkingClip,
    s: ObjectTrack,
    size_m: tuple[float, float, float],
    cfg: MeshConfig,
) -> tuple[trimesh.Trimesh, str]:
    """Return the worker's mesh of an object and what had to be mended about it.

    It is centred on its bounding box and scaled such that its diagonal is `size_m`'s.

    Raises:
        V2PError: the worker fails.
        ItemRejectedError: it refuses the object.
    """
    from v2p_data.scene.backends.worker import WorkerRequest, run_worker

    image = clip.frames[working.frame_idx[s.at]]
    h, w = image.shape[:2]
    mask = cv2.resize(s.first.astype(np.uint8), (w, h), interpolation=cv2.INTER_NEAREST) > 0
    request = WorkerRequest(
        kind="mesh", arrays={"image": image, "mask": mask}, fields={"name": s.phrase}
    )
    answer = run_worker(cfg.worker, request, cfg.worker_timeout_s)
    assert answer.mesh is not None  # the contract of `mesh` has one
    mesh = answer.mesh.copy()
    mesh.apply_translation(-mesh.bounds.mean(0))
    mesh.apply_scale(float(np.linalg.norm(size_m) / np.linalg.norm(mesh.extents)))
    return mesh, answer.repair

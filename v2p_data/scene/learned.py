"""Where the learned models meet our steps: boxes for phrases, masks for boxes, a camera from depth, meshes, poses.

Each function is for one backend setting and leaves everything else as it is.
"""

from collections.abc import Iterator, Sequence
from dataclasses import replace

import cv2
import numpy as np
import trimesh
from jaxtyping import Bool, Float, UInt8

from v2p_data.geometry.camera import Camera
from v2p_data.geometry.pose import transform
from v2p_data.scene.backends.config import (
    DepthConfig,
    GroundConfig,
    MeshConfig,
    PoseConfig,
    SegmentConfig,
)
from v2p_data.scene.footage import Footage
from v2p_data.scene.marks import Box
from v2p_data.scene.placement import CameraGuess
from v2p_data.scene.segment import grow
from v2p_data.scene.sight import Sighting
from v2p_data.video.clip import Clip

DETECTORS = ("grounding_dino", "mm_grounding_dino", "owlv2", "worker")
_PITCH_SD_RAD = 0.04
"""What remains unsure of the pitch of a plane fitted to predicted depth."""
_HEIGHT_SD = 0.12
"""Of the logarithm of a height from predicted metric depth."""


class _Frames(Sequence[UInt8[np.ndarray, "h w 3"]]):
    """The clip's frames behind the footage's, read one at a time."""

    def __init__(self, clip: Clip, footage: Footage) -> None:
        self._clip, self._idx = clip, footage.frame_idx

    def __len__(self) -> int:
        return len(self._idx)

    def __getitem__(self, i: int) -> UInt8[np.ndarray, "h w 3"]:  # type: ignore[override]
        return self._clip.frames[self._idx[i]]

    def __iter__(self) -> Iterator[UInt8[np.ndarray, "h w 3"]]:
        return (self[i] for i in range(len(self)))


def detected(
    clip: Clip, footage: Footage, phrases: Sequence[str], cfg: GroundConfig
) -> dict[str, Box]:
    """Return a box per phrase that the detector finds, in the first frame, or in the last where only that shows it."""
    from v2p_data.scene.backends.detect import detect  # imports transformers

    ends = [int(footage.frame_idx[0]), int(footage.frame_idx[-1])]
    by_picture = detect([clip.frames[i] for i in ends], phrases, cfg)
    out: dict[str, Box] = {}
    for frame, by_phrase in zip(ends, by_picture, strict=True):
        for phrase, found in zip(phrases, by_phrase, strict=True):
            if found and phrase not in out:
                best = found[0]
                out[phrase] = Box(frame=frame, box_xyxy=best.box_xyxy, score=best.score)
    return out


def segmented(
    clip: Clip, footage: Footage, objects: Sequence[Sighting], cfg: SegmentConfig
) -> tuple[Sighting, ...]:
    """Return the objects with the masks that a video model makes of what was found of them in one frame."""
    from v2p_data.scene.backends.segment import Prompt, segment_video

    h, w = clip.frames.shape[1:3]
    prompts = []
    for s in objects:
        large = cv2.resize(s.first.astype(np.uint8), (w, h), interpolation=cv2.INTER_NEAREST) > 0
        prompts.append(Prompt(frame_idx=s.at, mask=large))
    seen = segment_video(_Frames(clip, footage), prompts, cfg)
    size = (footage.shape[1], footage.shape[0])
    out = []
    for s, masks, scores in zip(objects, seen.masks, seen.scores, strict=True):
        small = np.stack(
            [
                cv2.resize(m.astype(np.float32), size, interpolation=cv2.INTER_AREA) > 0.5
                for m in masks
            ]
        )
        if not small[s.at].any():
            small[s.at] = s.first
        quality = np.where(small.any((1, 2)), scores, 0.0)
        out.append(replace(s, masks=small, quality=quality, meets=float(scores.mean())))
    return tuple(out)


def camera_from_depth(
    clip: Clip,
    footage: Footage,
    objects: Sequence[Sighting],
    guess: CameraGuess,
    cfg: DepthConfig,
    rng: np.random.Generator,
) -> CameraGuess:
    """Return the camera over the plane that the predicted depth of the first and last frame shows.

    The guess comes back unchanged where no plane that can be a table is found.
    """
    from v2p_data.scene.backends.depth import predict_depth, table_from_depth

    ends = [int(footage.frame_idx[0]), int(footage.frame_idx[-1])]
    depth = predict_depth([clip.frames[i] for i in ends], cfg)
    h, w = clip.frames.shape[1:3]
    fov = guess.fov_rad if depth.fov_rad is None else float(np.median(depth.fov_rad))
    f = w / 2 / np.tan(fov / 2)
    K = np.array([[f, 0, w / 2], [0, f, h / 2], [0, 0, 1.0]])
    planes = []
    for k, i in enumerate((0, len(footage.rgb) - 1)):
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


def mesh_by_worker(
    clip: Clip, footage: Footage, s: Sighting, size_m: tuple[float, float, float], cfg: MeshConfig
) -> tuple[trimesh.Trimesh, str]:
    """Return the worker's mesh of an object and what had to be mended about it.

    It is centred on its bounding box and scaled such that its diagonal is `size_m`'s.

    Raises:
        V2PError: the worker fails.
        ItemRejectedError: it refuses the object.
    """
    from v2p_data.scene.backends.worker import WorkerRequest, run_worker

    image = clip.frames[footage.frame_idx[s.at]]
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


def poses_by_worker(
    clip: Clip,
    footage: Footage,
    masks: Bool[np.ndarray, "time h w"],
    mesh: trimesh.Trimesh,
    camera: Camera,
    cfg: PoseConfig,
) -> tuple[Float[np.ndarray, "time 4 4"], Float[np.ndarray, "time"]]:
    """Return the worker's `T_world_obj` for every footage frame, and how sure it is of each (0 to 1).

    `camera` is the metric one of the clip's frames.

    Raises:
        V2PError: the worker fails.
        ItemRejectedError: it refuses the object.
    """
    from v2p_data.scene.backends.worker import WorkerRequest, run_worker

    images = np.stack([clip.frames[i] for i in footage.frame_idx])
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

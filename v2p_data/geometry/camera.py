"""The pinhole camera: between pixels and the world, and between OpenCV and MuJoCo axes."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

from v2p_data.geometry.pose import apply, inverse, transform

CV_FROM_GL = np.diag([1.0, -1.0, -1.0])
"""MuJoCo and OpenGL cameras look along -z with y up; OpenCV cameras look along +z with y down."""


@dataclass(frozen=True, kw_only=True)
class Camera:
    """Intrinsics and pose. Pixel centres are at integer coordinates plus one half."""

    width_px: int
    height_px: int
    K: Float[np.ndarray, "3 3"]
    T_world_cam: Float[np.ndarray, "4 4"]

    def project(self, points_world: Float[np.ndarray, "n 3"]) -> Float[np.ndarray, "n 2"]:
        """Return pixel coordinates (u right, v down); points behind the camera give NaN."""
        p = apply(inverse(self.T_world_cam), points_world)
        uvw = p @ self.K.T
        depth = np.where(uvw[:, 2:] > 1e-9, uvw[:, 2:], np.nan)
        return uvw[:, :2] / depth

    def rays_world(self, pixels: Float[np.ndarray, "n 2"]) -> Float[np.ndarray, "n 3"]:
        """Return unit directions in the world frame through the given pixels."""
        homogeneous = np.concatenate([pixels, np.ones((len(pixels), 1))], axis=1)
        rays = homogeneous @ np.linalg.inv(self.K).T @ self.T_world_cam[:3, :3].T
        return rays / np.linalg.norm(rays, axis=1, keepdims=True)

    def on_plane(
        self, pixels: Float[np.ndarray, "n 2"], height_m: float = 0.0
    ) -> Float[np.ndarray, "n 3"]:
        """Return where the pixels' rays meet the plane z = height_m; NaN where they do not."""
        rays = self.rays_world(pixels)
        origin = self.T_world_cam[:3, 3]
        with np.errstate(divide="ignore", invalid="ignore"):
            distance = (height_m - origin[2]) / rays[:, 2:]
            return np.where(distance > 0, origin + distance * rays, np.nan)


def poses_over_table(
    camera: Camera, to_filmed: Float[np.ndarray, "time 3 3"]
) -> Float[np.ndarray, "time 4 4"]:
    """Return `T_world_cam` of each frame of a moving camera.

    Args:
        camera: of the first frame; the table is its plane z = 0.
        to_filmed: per frame the homography from the first frame's pixels on the table to the frame's own.

    The intrinsics are taken to stay. What a homography says beyond a rigid motion, such as zoom,
    is spread over the pose.

    Source: Zhang 2000, "A flexible new technique for camera calibration", section 3.1, with the
        nearest rotation by SVD.
    """
    world_to_cam = inverse(camera.T_world_cam)
    plane_to_first = camera.K @ world_to_cam[:3, [0, 1, 3]]
    B = np.linalg.inv(camera.K) @ to_filmed @ plane_to_first
    B = B / B[:, 2:, 2:]  # the origin's depth is positive; its scale follows
    B = B / np.linalg.norm(B[:, :, :2], axis=1).mean(1)[:, None, None]
    U, _, Vt = np.linalg.svd(
        np.stack([B[:, :, 0], B[:, :, 1], np.cross(B[:, :, 0], B[:, :, 1])], axis=2)
    )
    T_cam_worlds = np.tile(np.eye(4), (len(B), 1, 1))
    T_cam_worlds[:, :3, :3] = U @ Vt
    T_cam_worlds[:, :3, 3] = B[:, :, 2]
    return np.linalg.inv(T_cam_worlds)


def intrinsics(width_px: int, height_px: int, fovy_rad: float) -> Float[np.ndarray, "3 3"]:
    """Return K of a camera with square pixels, the principal point in the middle."""
    f = 0.5 * height_px / np.tan(fovy_rad / 2)
    return np.array([[f, 0, width_px / 2], [0, f, height_px / 2], [0, 0, 1.0]])


def look_at(
    eye: Float[np.ndarray, "3"], target: Float[np.ndarray, "3"]
) -> Float[np.ndarray, "4 4"]:
    """Return `T_world_cam` of an OpenCV camera at `eye` that looks at `target`, the horizon level."""
    forward = (target - eye) / np.linalg.norm(target - eye)
    right = np.cross(forward, [0.0, 0.0, 1.0])
    right = right / np.linalg.norm(right)
    down = np.cross(forward, right)
    return transform(np.stack([right, down, forward], axis=1), eye)


def mujoco_xyaxes(T_world_cam: Float[np.ndarray, "4 4"]) -> Float[np.ndarray, "6"]:
    """Return the `xyaxes` attribute of the MuJoCo camera with this pose."""
    R_gl = T_world_cam[:3, :3] @ CV_FROM_GL
    return np.concatenate([R_gl[:, 0], R_gl[:, 1]])


def between_centres(H: Float[np.ndarray, "3 3"]) -> Float[np.ndarray, "3 3"]:
    """Return a homography of pixels as OpenCV wants it: it counts from pixel centres, we from the corner."""
    half = np.array([[1, 0, 0.5], [0, 1, 0.5], [0, 0, 1]])
    return np.linalg.inv(half) @ H @ half

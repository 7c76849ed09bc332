"""Label images are carried from the robot's camera to the camera that policies were trained with.

A real camera never stands exactly at the training camera's place. Its calibrated pose says by how
much it differs. The robot's mask is drawn from its joints in the training camera itself. Objects
are carried over by the homography of a horizontal plane: exact at the plane's height, and off by
`shift * (height - plane) / (camera height - height)` elsewhere. Source: Hartley & Zisserman 2004,
section 13.1.
"""

from collections.abc import Callable

import cv2
import numpy as np
from jaxtyping import Float, UInt8

from v2p_data.deployment.silhouette import Silhouette
from v2p_data.errors import V2PError
from v2p_data.geometry.camera import Camera, between_centres
from v2p_data.geometry.pose import inverse
from v2p_data.sim.render.camera import training_camera
from v2p_data.sim.render.masks import BACKGROUND, FIRST_OBJECT, ROBOT
from v2p_data.sim.robot.robot import FINGER_TRAVEL_M
from v2p_data.twin.arm import TwinArm

PLANE_M = 0.03
"""Half the height of a thing that a gripper of 85 mm takes."""
LEAST_COVERED = 0.8
"""Share of the training picture that the robot's camera must see."""
SAME_M, SAME_PX = 1e-6, 1e-6
"""Cameras that differ by less are the same."""


class ViewTransfer:
    """Carries label images from one camera to another of the same picture size.

    Args:
        source: the robot's camera, calibrated.
        target: the camera of training.
        plane_m: height above the table at which objects are carried over exactly [m].

    Raises:
        V2PError: the source sees too little of what the target sees.
    """

    def __init__(self, source: Camera, target: Camera, plane_m: float = PLANE_M) -> None:
        self.source, self.target = source, target
        H = _of_plane(source, plane_m) @ np.linalg.inv(_of_plane(target, plane_m))
        self._homography = between_centres(H)
        everything = np.ones((source.height_px, source.width_px), np.float32)
        covered = float((self._carried(everything) > 0.5).mean())
        if covered < LEAST_COVERED:
            place = ", ".join(f"{v:.2f}" for v in target.T_world_cam[:3, 3])
            raise V2PError(
                f"the robot's camera sees {covered:.0%} of the training camera's picture, and {LEAST_COVERED:.0%} are"
                f" needed; bring it closer to ({place}) m, or calibrate it anew"
            )
        self._silhouette = Silhouette(target)

    def labels(
        self,
        labels: UInt8[np.ndarray, "h w"],
        joints_rad: Float[np.ndarray, "7"],
        fingers_m: float,
    ) -> UInt8[np.ndarray, "h w"]:
        """Return the target's label image of the same moment."""
        robot = self._silhouette.draw(joints_rad, fingers_m)
        carried = np.where(robot, ROBOT, BACKGROUND).astype(np.uint8)
        best = np.full(robot.shape, 0.5, np.float32)
        for label in np.unique(labels[labels >= FIRST_OBJECT]):
            share = self._carried((labels == label).astype(np.float32))
            mine = share > best
            carried[mine] = label
            best[mine] = share[mine]
        return carried

    def _carried(self, share: np.ndarray) -> np.ndarray:
        size = (self.target.width_px, self.target.height_px)
        flags = cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP
        return cv2.warpPerspective(share, self._homography, size, flags=flags)


def view_for(camera: Camera) -> ViewTransfer | None:
    """Return how labels of a robot's camera reach the training camera; None where they are the same.

    Raises:
        V2PError: the camera sees too little of what the training camera sees, or its pictures are not square.
    """
    if camera.height_px != camera.width_px:
        raise V2PError(
            f"the robot's pictures have {camera.width_px} x {camera.height_px} pixels; policies see square ones"
        )
    target = training_camera(camera.height_px)
    moved = np.abs(camera.T_world_cam - target.T_world_cam).max()
    if moved < SAME_M and np.abs(camera.K - target.K).max() < SAME_PX:
        return None
    return ViewTransfer(camera, target)


def allowing_for_place(arm: TwinArm) -> Callable[[], UInt8[np.ndarray, "h w"]]:
    """Return what gives the twin's true labels as `v2p deploy` carries them over to the training camera."""
    view = view_for(arm.robot.calibration())

    def labels() -> UInt8[np.ndarray, "h w"]:
        true = arm.robot.true_labels()
        if view is None:
            return true
        return view.labels(true, arm.measured.joints, arm.measured.opening * FINGER_TRAVEL_M)

    return labels


def _of_plane(camera: Camera, height_m: float) -> Float[np.ndarray, "3 3"]:
    """Return the homography from (x, y, 1) of the plane z = height_m to pixels."""
    T_cam_world = inverse(camera.T_world_cam)
    R, t = T_cam_world[:3, :3], T_cam_world[:3, 3]
    return camera.K @ np.column_stack([R[:, 0], R[:, 1], height_m * R[:, 2] + t])

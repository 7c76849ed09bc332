"""The robot's mask from joint angles and a calibrated camera: a z-buffer draws the arm that policies were trained with.

Only what a real arm reports is used. The picture tells what of the mask an object hides (`segmentation`).
"""

# pyright: reportAttributeAccessIssue=false
# mujoco's classes come from a compiled module that declares none of them.

from v2p_data.sim.render.masks import (
    ROBOT,  # before MuJoCo: the room imports it whatever MUJOCO_GL says
)

# isort: split
import mujoco
import numpy as np
from jaxtyping import Bool, Float

from v2p_data.geometry.camera import CV_FROM_GL, Camera
from v2p_data.sim.render.zbuffer import Views, ZBuffer
from v2p_data.sim.robot.arms import RobotConfig, read_arm
from v2p_data.sim.robot.robot import FINE, NUM_ARM_JOINTS, ServoConfig

NEAR_M = 0.01


class Silhouette:
    """Draws the built-in arm as a camera sees it.

    Args:
        camera: pinhole, of rectified pictures; its principal point may be anywhere.
    """

    def __init__(self, camera: Camera) -> None:
        self.model = read_arm(RobotConfig(), FINE, ServoConfig()).spec.compile()
        self.model.vis.map.znear = NEAR_M / self.model.stat.extent
        self.data = mujoco.MjData(self.model)
        height, width = camera.height_px, camera.width_px
        (fx, _, cx), (_, fy, cy) = camera.K[:2]
        # The z-buffer's principal point is its middle: a larger picture is drawn, and
        # the camera's pixels are taken of it.
        reach = 2 * int(np.ceil(max(abs(cx - width / 2) * fy / fx, abs(cy - height / 2)))) + 4
        tall, wide = height + reach, int(np.ceil(width * fy / fx)) + reach
        self.columns = np.floor((np.arange(width) + 0.5 - cx) * fy / fx + wide / 2).astype(int)
        self.rows = np.floor(np.arange(height) + 0.5 - cy + tall / 2).astype(int)
        labels = np.full(self.model.ngeom, ROBOT, np.uint8)
        self.zbuffer = ZBuffer(self.model, labels, tall, wide, num_threads=1)
        self.views = Views.empty(self.model, 1)
        self.views.cam_pos[0] = camera.T_world_cam[:3, 3]
        self.views.cam_mat[0] = (camera.T_world_cam[:3, :3] @ CV_FROM_GL).reshape(-1)
        self.views.cam_fovy_deg[0] = np.degrees(2 * np.arctan(tall / 2 / fy))

    def draw(
        self, joints_rad: Float[np.ndarray, "7"], fingers_m: float
    ) -> Bool[np.ndarray, "h w"]:
        """Return where the arm is, with both fingers `fingers_m` from closed."""
        self.data.qpos[:NUM_ARM_JOINTS] = joints_rad
        self.data.qpos[NUM_ARM_JOINTS:] = fingers_m
        mujoco.mj_kinematics(self.model, self.data)
        self.views.geom_pos[0] = self.data.geom_xpos
        self.views.geom_mat[0] = self.data.geom_xmat
        self.views.geom_size[0] = self.model.geom_size
        self.views.geom_dataid[0] = self.model.geom_dataid
        drawn = self.zbuffer.draw(self.views)[0]
        return drawn[np.ix_(self.rows, self.columns)] == ROBOT

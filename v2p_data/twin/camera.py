"""The twin's camera: a pinhole picture goes through a lens and a sensor, then is rectified by the calibration.

Three cameras: the *pinhole* that is drawn (true pose, wide), the *raw* picture of 480 px behind the true lens, and the
*rectified* picture of 256 px that a policy gets: intrinsics and orientation of the training camera, by the calibrated
lens and pose. What remains are calibration errors and where the camera really stands. Pixel centres are at integers
plus one half; OpenCV counts from centres, so maps are shifted by one half.
"""

# pyright: reportAttributeAccessIssue=false
# mujoco's classes come from a compiled module that declares none of them.

from dataclasses import dataclass
from functools import cached_property

import cv2
import mujoco
import numpy as np
from jaxtyping import Float, UInt8
from scipy.spatial.transform import Rotation

from v2p_data.geometry.camera import Camera, intrinsics
from v2p_data.geometry.pose import transform
from v2p_data.sim.model.world import World
from v2p_data.sim.render.camera import training_camera
from v2p_data.sim.render.masks import MaskRenderer
from v2p_data.twin.interface import RGB_PX
from v2p_data.twin.parameters import TwinParameters, episode_rng

RAW_PX = 480
RAW_FOVY_DEG = 54.0
"""Nominal; wider than the training camera's, so that the rectified picture has no empty border."""
PINHOLE_PX = 544
PINHOLE_FOVY_DEG = 62.0
"""Wide enough for the corners of the raw picture."""


@dataclass(frozen=True, kw_only=True)
class Lens:
    """Intrinsics of the raw picture."""

    K: Float[np.ndarray, "3 3"]
    k1: float
    k2: float

    @property
    def coefficients(self) -> Float[np.ndarray, "4"]:
        """OpenCV's `k1, k2, p1, p2`."""
        return np.array([self.k1, self.k2, 0.0, 0.0])

    def distort(self, rays: Float[np.ndarray, "n 3"]) -> Float[np.ndarray, "n 2"]:
        """Return the raw pixels of rays in the camera's frame, z forward."""
        plane = rays[:, :2] / rays[:, 2:]
        square = (plane**2).sum(1, keepdims=True)
        plane = plane * (1 + self.k1 * square + self.k2 * square**2)
        return plane * self.K[[0, 1], [0, 1]] + self.K[:2, 2]

    def undistort(self, pixels: Float[np.ndarray, "n 2"]) -> Float[np.ndarray, "n 3"]:
        """Return rays through raw pixels, with z = 1."""
        points = cv2.undistortPointsIter(
            np.ascontiguousarray(pixels[:, None]),
            self.K,
            self.coefficients,
            np.eye(3),
            np.eye(3),
            (cv2.TERM_CRITERIA_EPS | cv2.TERM_CRITERIA_COUNT, 50, 1e-9),
        )
        return np.concatenate([points[:, 0], np.ones((len(pixels), 1))], axis=1)


@dataclass(frozen=True, kw_only=True)
class Optics:
    """All cameras of a twin: what is true, what calibration says, and the maps between their pictures."""

    parameters: TwinParameters
    size_px: int = RGB_PX

    @cached_property
    def training(self) -> Camera:
        """The training simulator's camera, which the rectified picture copies up to the camera's place."""
        return training_camera(self.size_px)

    @cached_property
    def true_pose(self) -> Float[np.ndarray, "4 4"]:
        return _moved(
            self.training.T_world_cam, self.parameters.placement_m, self.parameters.placement_rad
        )

    @cached_property
    def calibrated_pose(self) -> Float[np.ndarray, "4 4"]:
        return _moved(
            self.true_pose, self.parameters.calibration_m, self.parameters.calibration_rad
        )

    @cached_property
    def true_lens(self) -> Lens:
        p = self.parameters
        K = intrinsics(RAW_PX, RAW_PX, np.radians(RAW_FOVY_DEG))
        K[[0, 1], [0, 1]] *= p.focal_scale
        K[:2, 2] += p.centre_px
        return Lens(K=K, k1=p.k1, k2=p.k2)

    @cached_property
    def calibrated_lens(self) -> Lens:
        p, true = self.parameters, self.true_lens
        K = true.K.copy()
        K[[0, 1], [0, 1]] *= p.calibration_focal_scale
        K[:2, 2] += p.calibration_centre_px
        return Lens(K=K, k1=true.k1 * p.calibration_k_scale, k2=true.k2 * p.calibration_k_scale)

    @cached_property
    def pinhole(self) -> Camera:
        """What is drawn: the true pose without a lens."""
        return Camera(
            width_px=PINHOLE_PX,
            height_px=PINHOLE_PX,
            K=intrinsics(PINHOLE_PX, PINHOLE_PX, np.radians(PINHOLE_FOVY_DEG)),
            T_world_cam=self.true_pose,
        )

    @cached_property
    def rectified(self) -> Camera:
        """The camera of the rectified picture as the calibration says."""
        return Camera(
            width_px=self.size_px,
            height_px=self.size_px,
            K=self.training.K,
            T_world_cam=transform(self.training.T_world_cam[:3, :3], self.calibrated_pose[:3, 3]),
        )

    def raw_of_rectified(self, pixels: Float[np.ndarray, "n 2"]) -> Float[np.ndarray, "n 2"]:
        """Return where the raw picture has rectified pixels, by the calibration."""
        rays = self.rectified.rays_world(pixels) @ self.calibrated_pose[:3, :3]
        return self.calibrated_lens.distort(rays)

    def pinhole_of_raw(self, pixels: Float[np.ndarray, "n 2"]) -> Float[np.ndarray, "n 2"]:
        """Return where the pinhole picture has raw pixels, by the true lens."""
        return self.true_lens.undistort(pixels) @ self.pinhole.K[:2].T

    @cached_property
    def raw_map(self) -> tuple[np.ndarray, np.ndarray]:
        """OpenCV's maps from the pinhole picture to the raw one."""
        return _maps(self.pinhole_of_raw(_pixels(RAW_PX)), RAW_PX)

    @cached_property
    def rectifying_map(self) -> tuple[np.ndarray, np.ndarray]:
        """OpenCV's maps from the raw picture to the rectified one."""
        return _maps(self.raw_of_rectified(_pixels(self.size_px)), self.size_px)

    @cached_property
    def label_rows_columns(self) -> tuple[np.ndarray, np.ndarray]:
        """Where the pinhole picture has each pixel of the rectified one: lens and calibration in one step."""
        at = self.pinhole_of_raw(self.raw_of_rectified(_pixels(self.size_px)))
        shape = (self.size_px, self.size_px)
        columns, rows = np.clip(np.floor(at).astype(int), 0, PINHOLE_PX - 1).T
        return rows.reshape(shape), columns.reshape(shape)


@dataclass(frozen=True, kw_only=True)
class Posture:
    """Where everything is at one moment, as `MaskRenderer` draws it."""

    qpos: Float[np.ndarray, "q"]

    def write(self, model: mujoco.MjModel, data: mujoco.MjData, index: int) -> None:
        """Put the positions into a model's data."""
        del index  # there is one
        data.qpos[:] = self.qpos
        mujoco.mj_kinematics(model, data)
        mujoco.mj_comPos(model, data)
        mujoco.mj_camlight(model, data)


class TwinCamera:
    """Takes pictures of the twin.

    Args:
        world: of the twin, to be drawn.
        optics: its cameras.
    """

    def __init__(self, world: World, optics: Optics) -> None:
        self.optics = optics
        self._drawer = MaskRenderer(world, PINHOLE_PX, num_threads=1)
        p = optics.parameters
        rows, columns = (np.mgrid[0:RAW_PX, 0:RAW_PX] + 0.5) / (RAW_PX / 2) - 1
        falloff = 1 - p.vignette * (rows**2 + columns**2) / 2
        self._gain = (falloff[..., None] * p.exposure * np.array(p.white_balance)).astype(
            np.float32
        )
        self.begin(0)

    def begin(self, seed: int) -> None:
        """Begin the noise and the exposure of an episode."""
        self._rng = episode_rng(seed, "camera")
        # A noise field per episode, cut elsewhere for each picture: drawing 700,000 numbers takes 8 ms.
        self._noise = self._rng.standard_normal((RAW_PX + 64, RAW_PX + 64, 3), np.float32)
        self._exposure = np.float32(
            1 + self.optics.parameters.exposure_jitter * self._rng.normal()
        )

    def picture(self, qpos: Float[np.ndarray, "q"]) -> UInt8[np.ndarray, "h w 3"]:
        """Return the rectified picture.

        Raises:
            V2PError: there is no OpenGL.
        """
        raw = self.raw_picture(qpos)
        return cv2.remap(raw, *self.optics.rectifying_map, cv2.INTER_LINEAR)

    def raw_picture(self, qpos: Float[np.ndarray, "q"]) -> UInt8[np.ndarray, "h w 3"]:
        """Return the picture as the sensor gives it: distorted, noisy, from a JPEG.

        Raises:
            V2PError: there is no OpenGL.
        """
        p = self.optics.parameters
        ideal = self._drawer.draw_rgb(Posture(qpos=qpos), 0)
        seen = cv2.remap(
            ideal, *self.optics.raw_map, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE
        )
        light = cv2.GaussianBlur(seen, (0, 0), p.blur_px).astype(np.float32)
        light *= self._gain * self._exposure
        row, column = self._rng.integers(0, 64, 2)
        noise = self._noise[row : row + RAW_PX, column : column + RAW_PX]
        # Shot noise: the variance in electrons is their number; 255 grey levels are the full well.
        light += noise * np.sqrt(
            light * np.float32(255 / p.full_well) + np.float32(p.read_noise**2)
        )
        grey = np.clip(light + 0.5, 0, 255).astype(np.uint8)
        quality = [cv2.IMWRITE_JPEG_QUALITY, round(p.jpeg_quality)]
        coded = cv2.imencode(".jpg", grey[..., ::-1], quality)[1]
        decoded = np.asarray(cv2.imdecode(coded, cv2.IMREAD_COLOR))
        return np.ascontiguousarray(decoded[..., ::-1])

    def labels(self, qpos: Float[np.ndarray, "q"]) -> UInt8[np.ndarray, "h w"]:
        """Return the true labels of the rectified picture's pixels, as `sim.masks` has them; needs no OpenGL."""
        return self._drawer.draw(Posture(qpos=qpos), 0)[self.optics.label_rows_columns]

    def close(self) -> None:
        """Free the graphics memory."""
        self._drawer.close()


def _moved(
    T_world_cam: Float[np.ndarray, "4 4"], shift_m: tuple[float, ...], turn_rad: tuple[float, ...]
) -> Float[np.ndarray, "4 4"]:
    """Return a pose shifted along the world's axes and turned about the camera's own."""
    turn = Rotation.from_rotvec(turn_rad).as_matrix()
    return transform(T_world_cam[:3, :3] @ turn, T_world_cam[:3, 3] + shift_m)


def _pixels(size_px: int) -> Float[np.ndarray, "n 2"]:
    """Return the centres of a square picture's pixels, row by row."""
    rows, columns = np.mgrid[0:size_px, 0:size_px] + 0.5
    return np.stack([columns.ravel(), rows.ravel()], axis=1)


def _maps(source: Float[np.ndarray, "n 2"], size_px: int) -> tuple[np.ndarray, np.ndarray]:
    """Return OpenCV's fixed-point maps that fetch each pixel from `source`."""
    x, y = (source - 0.5).astype(np.float32).reshape(size_px, size_px, 2).transpose(2, 0, 1)
    return cv2.convertMaps(np.ascontiguousarray(x), np.ascontiguousarray(y), cv2.CV_16SC2)

"""The camera of a drawn clip: where it stands and what its sensor does to the picture."""

# mujoco's classes come from a compiled module that declares none of them.
# pyright: reportAttributeAccessIssue=false

import os
import sys
from dataclasses import dataclass
from typing import Any

import cv2
import mujoco
import numpy as np
from jaxtyping import Float, UInt8

from v2p_data.errors import V2PError
from v2p_data.geometry.camera import Camera, intrinsics
from v2p_data.geometry.pose import transform


@dataclass(frozen=True, kw_only=True)
class View:
    """The camera, heading along +x, as a person sitting at the table sees."""

    height_m: float = 0.45
    pitch_rad: float = 0.61
    """Below the horizon."""
    roll_rad: float = 0.0
    back_m: float = 0.58
    """From the world's origin back to the point under the camera."""
    side_m: float = 0.0
    """How far the camera stands to the left of the world's origin."""
    fovy_rad: float = 0.75
    width_px: int = 640
    height_px: int = 480

    def camera(self) -> Camera:
        """Return the camera that this describes."""
        c, s = np.cos(self.pitch_rad), np.sin(self.pitch_rad)
        level = np.array([[0, -1.0, 0], [-s, 0, -c], [c, 0, -s]]).T
        r, q = np.cos(self.roll_rad), np.sin(self.roll_rad)
        rolled = level @ np.array([[r, -q, 0], [q, r, 0], [0, 0, 1.0]])
        T_world_cam = transform(rolled, np.array([-self.back_m, self.side_m, self.height_m]))
        K = intrinsics(self.width_px, self.height_px, self.fovy_rad)
        return Camera(
            width_px=self.width_px, height_px=self.height_px, K=K, T_world_cam=T_world_cam
        )


@dataclass(frozen=True, kw_only=True)
class Sensor:
    """What light goes through on its way to the file."""

    noise: float = 1.5
    """Standard deviation of the noise, of 255."""
    exposure: float = 0.4
    """Share of the time between two frames in which the shutter is open: motion blur."""
    defocus_px: float = 0.0
    """Standard deviation of the blur."""
    gamma: float = 1.0
    tint: tuple[float, float, float] = (1.0, 1.0, 1.0)
    """White balance."""
    drift: float = 0.0
    """How much the automatic exposure wanders over the clip, of 1."""
    flicker: float = 0.0
    """Brightness from frame to frame, of 1."""
    crf: int = 21
    """Quality of the H.264 stream; more is worse."""


def random_sensor(rng: np.random.Generator) -> Sensor:
    """Return a sensor with everything drawn at random."""
    return Sensor(
        noise=float(rng.uniform(0.3, 5.0)),
        exposure=float(rng.uniform(0.1, 0.8)),
        defocus_px=float(rng.choice([0.0, rng.uniform(0.4, 1.1)])),
        gamma=float(rng.uniform(0.7, 1.15)),
        tint=(float(rng.normal(1, 0.05)), 1.0, float(rng.normal(1, 0.05))),
        drift=float(rng.choice([0.0, rng.uniform(0.0, 0.12)])),
        flicker=float(rng.choice([0.0, rng.uniform(0.0, 0.015)])),
        crf=int(rng.integers(18, 33)),
    )


def developed(
    picture: Float[np.ndarray, "h w 3"], sensor: Sensor, moment: float, rng: np.random.Generator
) -> UInt8[np.ndarray, "h w 3"]:
    """Return what the sensor makes of a picture (float32, 0 to 255).

    Args:
        picture: what falls on the sensor.
        sensor: the sensor.
        moment: when in the clip, 0 to 1.
        rng: for noise and flicker.
    """
    if sensor.defocus_px:
        picture = cv2.GaussianBlur(picture, (0, 0), sensor.defocus_px)
    gain = 1 + sensor.drift * np.sin(2.5 * moment + 1) + sensor.flicker * rng.normal()
    levels = np.arange(256) / 255.0
    curves = [255 * (levels * g * gain).clip(0, 1) ** sensor.gamma for g in sensor.tint]
    table = np.stack(curves, -1)[None].astype(np.float32)
    image = cv2.LUT(picture.clip(0, 255).astype(np.uint8), table)
    if sensor.noise:
        h, w = image.shape[:2]
        # one field of noise, rolled by chance: drawing a new one costs more than the picture
        field = _noise_field(h, w)
        field = np.roll(field, tuple(int(k) for k in rng.integers(0, (h, w))), (0, 1))
        image = image + sensor.noise * field
    return image.round().clip(0, 255).astype(np.uint8)


_FIELDS: dict[tuple[int, int], Float[np.ndarray, "h w 3"]] = {}


def _noise_field(h: int, w: int) -> Float[np.ndarray, "h w 3"]:
    if (h, w) not in _FIELDS:
        _FIELDS.clear()
        _FIELDS[h, w] = (
            np.random.default_rng(h * 10000 + w).normal(0, 1, (h, w, 3)).astype(np.float32)
        )
    return _FIELDS[h, w]


class Drawer:
    """Draws camera `view` of a model without a window."""

    def __init__(self, model: mujoco.MjModel, labels: UInt8[np.ndarray, "geom"]) -> None:
        width, height = model.vis.global_.offwidth, model.vis.global_.offheight
        self._model, self._labels = model, labels
        self._context = gl_context(width, height)
        self._context.make_current()
        self._drawer = mujoco.MjrContext(model, mujoco.mjtFontScale.mjFONTSCALE_100.value)
        mujoco.mjr_setBuffer(mujoco.mjtFramebuffer.mjFB_OFFSCREEN.value, self._drawer)
        self._scene = mujoco.MjvScene(model, maxgeom=2 * model.ngeom + 50)
        self._option = mujoco.MjvOption()
        self._camera = mujoco.MjvCamera()
        self._camera.type = mujoco.mjtCamera.mjCAMERA_FIXED
        self._camera.fixedcamid = model.camera("view").id
        self._rect = mujoco.MjrRect(0, 0, width, height)

    def picture(self, data: mujoco.MjData) -> UInt8[np.ndarray, "h w 3"]:
        """Return the picture."""
        return self._draw(data, segmentation=False)

    def mask(self, data: mujoco.MjData) -> UInt8[np.ndarray, "h w"]:
        """Return labels."""
        codes = self._draw(data, segmentation=True).astype(np.int32)
        shown = codes[..., 0] + (codes[..., 1] << 8) + (codes[..., 2] << 16)
        labels = np.zeros(self._scene.ngeom + 1, np.uint8)
        for k in range(self._scene.ngeom):
            geom = self._scene.geoms[k]
            if geom.objtype == int(mujoco.mjtObj.mjOBJ_GEOM):
                labels[geom.segid + 1] = self._labels[geom.objid]
        return labels[shown]

    def _draw(self, data: mujoco.MjData, *, segmentation: bool) -> UInt8[np.ndarray, "h w 3"]:
        self._context.make_current()
        mujoco.mjv_updateScene(
            self._model,
            data,
            self._option,
            None,
            self._camera,
            mujoco.mjtCatBit.mjCAT_ALL.value,
            self._scene,
        )
        self._scene.flags[mujoco.mjtRndFlag.mjRND_SEGMENT] = segmentation
        self._scene.flags[mujoco.mjtRndFlag.mjRND_IDCOLOR] = segmentation
        self._scene.flags[mujoco.mjtRndFlag.mjRND_SHADOW] = not segmentation
        mujoco.mjr_render(self._rect, self._scene, self._drawer)
        pixels = np.empty((self._rect.height, self._rect.width, 3), np.uint8)
        mujoco.mjr_readPixels(pixels, None, self._rect, self._drawer)
        return pixels[::-1].copy()

    def __enter__(self) -> "Drawer":
        return self

    def __exit__(self, *_: object) -> None:
        self._context.make_current()
        self._drawer.free()
        self._context.free()


def gl_context(width: int, height: int) -> Any:
    """Return an OpenGL context: EGL on Linux, for MuJoCo would look for a window where MUJOCO_GL is unset.

    Raises:
        V2PError: there is no OpenGL.
    """
    try:
        if sys.platform == "linux" and os.environ.get("MUJOCO_GL", "egl").lower() in {"egl", ""}:
            from mujoco.egl import GLContext
        else:
            from mujoco.rendering.classic.gl_context import GLContext
        return GLContext(width, height)
    except (ImportError, AttributeError, OSError, RuntimeError) as error:
        raise V2PError(
            "drawing clips needs OpenGL without a screen and there is none; on Debian or Ubuntu: "
            f"apt-get install -y libegl1 libgl1 ({type(error).__name__}: {error})"
        ) from error

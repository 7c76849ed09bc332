"""Segmentation masks of saved moments, from the camera `view`.

A label image is uint8: 0 background and table, 1 robot, 2 the manipulated object, 3.. the others in scene
order. A z-buffer on all cores draws it (`zbuffer`). Pictures for people need OpenGL (EGL, also in software). As video,
labels become greys: with R = G = B the
chroma is constant, so 4:2:0 loses nothing, and each grey below survives the way through limited-range luma unchanged.
"""

# pyright: reportAttributeAccessIssue=false
# mujoco's classes come from a compiled module that declares none of them.

import copy
import os
import sys
from collections.abc import Sequence
from functools import cache
from typing import Any, Protocol, runtime_checkable

import mujoco
import numpy as np
from jaxtyping import UInt8

from v2p_data.errors import V2PError
from v2p_data.sim.model.world import CAMERA, World, build_world
from v2p_data.sim.robot.arms import Robot, robot_from_json
from v2p_data.sim.robot.robot import FINE
from v2p_data.task.task import TaskBundle

MASK_CAMERA, WRIST_CAMERA = "mask", "mask_wrist"
MASK_CAMERAS = MASK_CAMERA, WRIST_CAMERA
"""In the order in which their label images lie below each other."""
RGB_CAMERA = "rgb"
"""The table's camera in colour."""
PALETTE = (0, 64, 128, 192, 255, 31, 95, 158, 222)
"""Grey level of each label."""
BACKGROUND, ROBOT, FIRST_OBJECT = 0, 1, 2
SCENERY_M = 0.5
"""What stands still beside an arm and reaches farther than this from its middle is a floor, a wall or a table."""
GL_HINT = "install it with 'apt-get install libegl1 libgl1-mesa-dri'"

_GREYS = np.asarray(PALETTE, np.uint8)
_LABELS = np.abs(np.arange(256)[:, None] - np.asarray(PALETTE)[None]).argmin(1).astype(np.uint8)

WRIST_POS_M = np.array([0.11, 0.0, -0.07])
"""Of the wrist's camera in the tool's frame: x to the side, y from finger to finger, z where the fingers point."""
WRIST_TARGET_M = np.array([0.0, 0.0, 0.05])
WRIST_FOVY_DEG = 80.0


def labels_to_rgb(labels: UInt8[np.ndarray, "*batch h w"]) -> UInt8[np.ndarray, "*batch h w 3"]:
    """Return labels as greys, R = G = B."""
    if labels.size and labels.max() >= len(PALETTE):
        raise ValueError(f"label {labels.max()} has no grey; labels go up to {len(PALETTE) - 1}")
    return np.repeat(_GREYS[labels][..., None], 3, axis=-1)


def rgb_to_labels(rgb: UInt8[np.ndarray, "*batch h w 3"]) -> UInt8[np.ndarray, "*batch h w"]:
    """Return the label whose grey is nearest to the red channel."""
    return _LABELS[rgb[..., 0]]


def label_names(objects: tuple[str, ...]) -> dict[int, str]:
    """Return the meaning of each label in a scene with these objects."""
    return {BACKGROUND: "background", ROBOT: "robot"} | {
        FIRST_OBJECT + k: name for k, name in enumerate(objects)
    }


def geom_labels(world: World) -> UInt8[np.ndarray, "geom"]:
    """Return the label of every geom.

    What stands still in an arm's file is background where it is a plane, or large and no part of the arm's bodies.

    Raises:
        V2PError: the scene has more objects than there are greys.
    """
    if len(world.objects) + FIRST_OBJECT > len(PALETTE):
        raise V2PError(
            f"scene '{world.scene.title}' has {len(world.objects)} objects; "
            f"masks tell at most {len(PALETTE) - FIRST_OBJECT} apart"
        )
    model, body = world.model, world.model.geom_bodyid
    arm = model.body_rootid[model.dof_bodyid[world.robot.arm_dofs.start]]
    beside = (model.geom_rbound > SCENERY_M) & (model.body_rootid[body] != arm)
    is_plane = model.geom_type == mujoco.mjtGeom.mjGEOM_PLANE.value
    is_scenery = (model.body_weldid[body] == 0) & (beside | is_plane)
    is_scenery[model.geom("table").id] = True
    labels = np.where(is_scenery, BACKGROUND, ROBOT).astype(np.uint8)
    for k, obj in enumerate(world.objects):
        labels[list(obj.geom_ids)] = FIRST_OBJECT + k
    return labels


class WristCamera:
    """A camera that moves with the tool, beside the hand, and looks between the fingers from above.

    +y of the tool is up.

    Args:
        robot: whose tool carries it.
    """

    def __init__(self, robot: Robot) -> None:
        self.robot = robot
        ahead = WRIST_TARGET_M - WRIST_POS_M
        ahead /= np.linalg.norm(ahead)
        right = np.cross(ahead, (0.0, 1.0, 0.0))
        self._axes = np.stack([right, np.cross(right, ahead), -ahead], axis=1)
        """MuJoCo's: right, up, backwards."""

    def move(self, model: mujoco.MjModel, data: mujoco.MjData, camera: int) -> None:
        """Put camera `camera` where the wrist's is; a snapshot's next `write` puts it back."""
        arm, dofs = self.robot.arm, self.robot.arm_dofs
        tool = self.robot.tool_state(data.qpos[arm][None], data.qvel[dofs][None])
        data.cam_xpos[camera] = tool.pos[0] + tool.rotation[0] @ WRIST_POS_M
        data.cam_xmat[camera] = (tool.rotation[0] @ self._axes).ravel()
        model.cam_fovy[camera] = WRIST_FOVY_DEG


@runtime_checkable
class Moment(Protocol):
    """Saved states of a batch of worlds, enough to draw them (`batch_env.Snapshot`)."""

    def write(self, model: mujoco.MjModel, data: mujoco.MjData, index: int) -> None:
        """Put world `index` into a model and its data and compute positions, ready to be drawn."""
        ...


class MaskRenderer:
    """Draws saved moments on a private copy of the model.

    Args:
        source: the task, or its world where it is built already.
        size_px: width and height of the image, or (height, width).
        num_threads: for the z-buffer, 0 for all cores; changes no result.
        wrist: below the label image of the table's camera comes that of the wrist's, of the same size.
    """

    def __init__(
        self,
        source: TaskBundle | World,
        size_px: int | tuple[int, int] = 256,
        *,
        num_threads: int = 0,
        wrist: bool = False,
    ) -> None:
        world = source if isinstance(source, World) else _world_of(source)
        self.size_px = size_px
        self.labels = geom_labels(world)
        self._model = world.model
        self._shape = (size_px, size_px) if isinstance(size_px, int) else size_px
        self._num_threads = num_threads
        self._wrist = WristCamera(world.robot) if wrist else None
        self._painter: _ZPainter | None = None
        self._pictures: _GLPainter | None = None
        self._no_gl = ""

    def draw(self, snapshot: Moment, index: int) -> UInt8[np.ndarray, "h w"]:
        """Return the label image of world `index` of the snapshot."""
        return self.draw_many([(snapshot, index)])[0]

    def draw_many(self, moments: Sequence[tuple[Moment, int]]) -> UInt8[np.ndarray, "n h w"]:
        """Return the label images of worlds of snapshots; several at once keep all cores busy."""
        if self._painter is None:  # late: who wants pictures alone needs nothing compiled
            self._painter = _ZPainter(
                self._model, self.labels, self._shape, self._num_threads, self._wrist
            )
        return self._painter.draw(moments)

    def draw_rgb(self, snapshot: Moment, index: int) -> UInt8[np.ndarray, "h w 3"]:
        """Return a picture for people.

        Raises:
            V2PError: there is no OpenGL.
        """
        if self._pictures is None and not self._no_gl:
            try:
                self._pictures = _GLPainter(self._model, self._shape)
            except _NoGLError as error:
                self._no_gl = str(error)
        if self._pictures is None:
            asked = os.environ.get("MUJOCO_GL")
            unset = f"unset MUJOCO_GL, which asks for '{asked}', or " if asked else ""
            raise V2PError(
                f"pictures need OpenGL and there is none ({self._no_gl}); {unset}{GL_HINT}"
            )
        return self._pictures.draw(snapshot, index)

    def close(self) -> None:
        """Free the graphics memory."""
        if self._pictures is not None:
            self._pictures.close()
        self._painter = self._pictures = None

    def __enter__(self) -> "MaskRenderer":
        return self

    def __exit__(self, *_: object) -> None:
        self.close()


def _world_of(bundle: TaskBundle) -> World:
    return build_world(bundle.scene, FINE, robot=robot_from_json(bundle.robot))


class _NoGLError(Exception):
    pass


class _ZPainter:
    def __init__(
        self,
        model: mujoco.MjModel,
        labels: np.ndarray,
        shape: tuple[int, int],
        num_threads: int,
        wrist: WristCamera | None,
    ) -> None:
        from v2p_data.sim.render.zbuffer import Views, ZBuffer  # numba takes half a second to load

        self.model = copy.copy(model)
        self.data = mujoco.MjData(self.model)
        self.camera = self.model.camera(CAMERA).id
        self.views, self.wrist = Views, wrist
        self.zbuffer = ZBuffer(self.model, labels, *shape, num_threads=num_threads)

    def draw(self, moments: Sequence[tuple[Moment, int]]) -> np.ndarray:
        count = 1 if self.wrist is None else 2
        views = [self.views.empty(self.model, len(moments)) for _ in range(count)]
        for k, (snapshot, index) in enumerate(moments):
            snapshot.write(self.model, self.data, index)
            views[0].note(k, self.model, self.data, self.camera)
            if self.wrist is not None:
                self.wrist.move(self.model, self.data, self.camera)
                views[1].note(k, self.model, self.data, self.camera)
        drawn = [self.zbuffer.draw(each) for each in views]
        return drawn[0] if self.wrist is None else np.concatenate(drawn, axis=1)


class _GLPainter:
    def __init__(self, model: mujoco.MjModel, shape: tuple[int, int]) -> None:
        self.height_px, self.width_px = shape
        self.model = copy.copy(model)
        self.model.vis.global_.offheight, self.model.vis.global_.offwidth = shape
        self.model.vis.quality.offsamples = 0
        self.data = mujoco.MjData(self.model)
        self.context = _gl_context(self.width_px, self.height_px)
        self.context.make_current()
        self.drawer = mujoco.MjrContext(self.model, mujoco.mjtFontScale.mjFONTSCALE_100.value)
        mujoco.mjr_setBuffer(mujoco.mjtFramebuffer.mjFB_OFFSCREEN.value, self.drawer)
        self.scene = mujoco.MjvScene(self.model, maxgeom=2 * self.model.ngeom + 50)
        self.option = mujoco.MjvOption()
        self.camera = mujoco.MjvCamera()
        self.camera.type = mujoco.mjtCamera.mjCAMERA_FIXED
        self.camera.fixedcamid = self.model.camera(CAMERA).id
        self.rect = mujoco.MjrRect(0, 0, self.width_px, self.height_px)

    def draw(self, snapshot: Moment, index: int) -> np.ndarray:
        self.context.make_current()
        snapshot.write(self.model, self.data, index)
        mujoco.mjv_updateScene(
            self.model,
            self.data,
            self.option,
            None,
            self.camera,
            mujoco.mjtCatBit.mjCAT_ALL.value,
            self.scene,
        )
        mujoco.mjr_render(self.rect, self.scene, self.drawer)
        pixels = np.empty((self.height_px, self.width_px, 3), np.uint8)
        mujoco.mjr_readPixels(pixels, None, self.rect, self.drawer)
        return pixels[::-1].copy()

    def close(self) -> None:
        self.context.make_current()
        self.drawer.free()
        self.context.free()


@cache
def has_opengl() -> bool:
    """Tell whether colour pictures can be drawn here."""
    try:
        _gl_context(16, 16).free()
    except _NoGLError:
        return False
    return True


def _gl_context(width_px: int, height_px: int) -> Any:
    """Return an OpenGL context, by EGL on Linux unless MUJOCO_GL asks for something else.

    MuJoCo itself would look for a window where MUJOCO_GL is unset.
    """
    try:
        if sys.platform == "linux" and os.environ.get("MUJOCO_GL", "egl").lower() in {"egl", ""}:
            from mujoco.egl import GLContext
        else:
            from mujoco.rendering.classic.gl_context import GLContext
        return GLContext(width_px, height_px)
    except (ImportError, AttributeError, OSError, RuntimeError) as error:
        raise _NoGLError(f"{type(error).__name__}: {error}") from error

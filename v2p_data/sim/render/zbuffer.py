"""Label images by a compiled z-buffer on the processor, without OpenGL.

What is drawn is what MuJoCo's OpenGL renderer draws: the same geoms, round ones as the same polyhedra, meshes with
their own faces, front faces only, cut off at the same near plane. Labels are drawn and nothing else, so that one
integer per pixel holds both: its distance in the upper bits, its label in the lowest. The larger integer is the nearer
one, whatever came first; hence the result depends neither on the order of the geoms nor on the number of threads.
Frames are shared out among threads, which run outside Python's lock.
"""

# pyright: reportAttributeAccessIssue=false
# mujoco's classes come from a compiled module that declares none of them.

from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from typing import Any

import mujoco
import numpy as np
from jaxtyping import Float, Int, UInt8

from v2p_data.errors import V2PError
from v2p_data.processes import num_cores
from v2p_data.sim.render.polyhedra import Polyhedra, polyhedra
from v2p_data.sim.render.raster import LABEL_BITS, paint

FRAMES_AT_ONCE = 16
"""At most that many a thread takes at a time: sharing them out costs nothing, and no thread waits long for the last."""
TURNS = 4
"""That often each thread takes some, if there are enough."""
FAR_M = 1e3
"""Half the side of a plane without end."""
_TYPE = mujoco.mjtGeom


@dataclass(frozen=True, kw_only=True)
class Views:
    """Where everything is in some frames, in the world frame [m]."""

    geom_pos: Float[np.ndarray, "n geom 3"]
    geom_mat: Float[np.ndarray, "n geom 9"]
    geom_size: Float[np.ndarray, "n geom 3"]
    geom_dataid: Int[np.ndarray, "n geom"]
    cam_pos: Float[np.ndarray, "n 3"]
    cam_mat: Float[np.ndarray, "n 9"]
    """Axes of the camera in columns: right, up, backwards."""
    cam_fovy_deg: Float[np.ndarray, "n"]

    @staticmethod
    def empty(model: mujoco.MjModel, count: int) -> "Views":
        """Return room for `count` frames."""
        return Views(
            geom_pos=np.empty((count, model.ngeom, 3)),
            geom_mat=np.empty((count, model.ngeom, 9)),
            geom_size=np.empty((count, model.ngeom, 3)),
            geom_dataid=np.empty((count, model.ngeom), np.int32),
            cam_pos=np.empty((count, 3)),
            cam_mat=np.empty((count, 9)),
            cam_fovy_deg=np.empty(count),
        )

    def note(self, k: int, model: mujoco.MjModel, data: mujoco.MjData, camera: int) -> None:
        """Fill frame `k` with what model and data say, after `mj_kinematics` and `mj_camlight`."""
        self.geom_pos[k] = data.geom_xpos
        self.geom_mat[k] = data.geom_xmat
        self.geom_size[k] = model.geom_size
        self.geom_dataid[k] = model.geom_dataid
        self.cam_pos[k] = data.cam_xpos[camera]
        self.cam_mat[k] = data.cam_xmat[camera]
        self.cam_fovy_deg[k] = model.cam_fovy[camera]


class ZBuffer:
    """Draws the geoms of one model.

    Args:
        model: what is drawn; positions, sizes, meshes and the camera come with each frame.
        labels: of each geom, at most 15; geoms with label 0 hide what is behind them.
        height_px, width_px: of the images.
        num_threads: 0 for all cores; changes no result.

    Raises:
        V2PError: a visible geom is of a kind that is not drawn here, or there are too many labels.
    """

    def __init__(
        self,
        model: mujoco.MjModel,
        labels: UInt8[np.ndarray, "geom"],
        height_px: int,
        width_px: int,
        *,
        num_threads: int = 0,
    ) -> None:
        if labels.size and labels.max() >= 1 << LABEL_BITS:
            raise V2PError(
                f"label {labels.max()} is too large: a pixel has room for labels up to "
                f"{(1 << LABEL_BITS) - 1}"
            )
        self.height_px, self.width_px = height_px, width_px
        self.num_threads = num_threads or num_cores()
        self.geoms = np.flatnonzero(_visible(model))
        self.labels = labels[self.geoms].astype(np.int32)
        self.near_m = float(model.vis.map.znear * model.stat.extent)
        self.kinds = model.geom_type[self.geoms]
        self.shapes: Polyhedra = polyhedra(model)
        unknown = set(self.kinds.tolist()) - set(self.shapes.of_type) - {int(_TYPE.mjGEOM_MESH)}
        if unknown:
            names = ", ".join(sorted(_TYPE(k).name.removeprefix("mjGEOM_") for k in unknown))
            raise V2PError(
                f"masks cannot show geoms of type {names}; make them of boxes, cylinders, spheres or meshes"
            )

    def draw(self, views: Views) -> UInt8[np.ndarray, "n h w"]:
        """Return the label of what each pixel's centre sees; 0 where there is nothing."""
        count = len(views.cam_pos)
        frames = self._frames(views)
        images = np.empty((count, self.height_px, self.width_px), np.uint8)
        step = min(FRAMES_AT_ONCE, max(1, count // (TURNS * self.num_threads)))
        starts = iter(range(0, count, step))

        def work() -> None:
            for first in starts:  # shared: each thread takes the next ones
                rows = slice(first, first + step)
                paint(
                    *self.shapes.arrays,
                    self.labels,
                    self.near_m,
                    *(f[rows] for f in frames),
                    images[rows],
                )

        # This thread draws too, so that on a busy machine nothing waits for the others. They are new at each call: kept
        # ones would be dead in a forked process.
        helpers = min(self.num_threads, -(-count // step)) - 1
        with ThreadPoolExecutor(max(1, helpers)) as pool:
            tasks = [pool.submit(work) for _ in range(helpers)]
            work()
            for task in tasks:
                task.result()
        return images

    def _frames(self, views: Views) -> tuple[np.ndarray, ...]:
        """Return per frame and geom its shape, its place before the camera, and the camera's focal length [px]."""
        at = self.geoms
        size, dataid = views.geom_size[:, at], views.geom_dataid[:, at]
        shape = np.empty(dataid.shape, np.int32)
        stretch = np.zeros((*dataid.shape, 4))
        for kind in np.unique(self.kinds):
            of = self.kinds == kind
            if kind == _TYPE.mjGEOM_MESH:
                shape[:, of] = self.shapes.of_mesh[dataid[:, of]]
                stretch[:, of, :3] = 1.0
            else:
                shape[:, of] = self.shapes.of_type[int(kind)]
                stretch[:, of] = _stretch(int(kind), size[:, of])
        focal_px = self.height_px / 2 / np.tan(np.radians(views.cam_fovy_deg) / 2)
        frames = (
            shape,
            stretch,
            views.geom_pos[:, at],
            views.geom_mat[:, at].reshape(*dataid.shape, 3, 3),
            views.cam_pos,
            views.cam_mat.reshape(-1, 3, 3),
            focal_px,
        )
        # Of one memory layout always, because each is compiled for.
        return tuple(np.ascontiguousarray(f) for f in frames)


def _stretch(kind: int, size: Float[np.ndarray, "n k 3"]) -> Float[np.ndarray, "n k 4"]:
    """Return by how much a unit shape is stretched along x, y, z, and its ends are moved apart along z."""
    radius, half = size[..., 0], size[..., 1]
    none = np.zeros_like(radius)
    if kind == _TYPE.mjGEOM_SPHERE:
        rows = [radius, radius, radius, none]
    elif kind == _TYPE.mjGEOM_CAPSULE:
        rows = [radius, radius, radius, half]
    elif kind == _TYPE.mjGEOM_CYLINDER:
        rows = [radius, radius, half, none]
    elif kind == _TYPE.mjGEOM_PLANE:
        rows = [np.where(s > 0, s, FAR_M) for s in (radius, half)] + [none, none]
    else:
        rows = [*np.moveaxis(size, -1, 0), none]
    return np.stack(rows, axis=-1)


def _visible(model: mujoco.MjModel) -> np.ndarray:
    """Return which geoms MuJoCo shows; its abstract scene needs no OpenGL."""
    data = mujoco.MjData(model)
    mujoco.mj_forward(model, data)
    scene = mujoco.MjvScene(model, maxgeom=2 * model.ngeom + 50)
    mujoco.mjv_updateScene(
        model,
        data,
        mujoco.MjvOption(),
        None,
        mujoco.MjvCamera(),
        mujoco.mjtCatBit.mjCAT_ALL.value,
        scene,
    )
    shown: Any = np.zeros(model.ngeom, bool)
    for geom in scene.geoms[: scene.ngeom]:
        if geom.objtype == mujoco.mjtObj.mjOBJ_GEOM:
            shown[geom.objid] = True
    return shown

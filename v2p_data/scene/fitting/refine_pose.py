"""The last pose once more, with the object's own mesh, which tells where a handle or a beak points.

Places and turns come from the fit of a primitive (`placement.py`); the mesh was made from the
first outline (`shapes/shape.py`). How well it covers the last one says, too, whether both show the
same object.
"""

from dataclasses import dataclass

import numpy as np
import trimesh
from jaxtyping import Float
from scipy.optimize import minimize
from scipy.spatial.transform import Rotation

from v2p_data.geometry.camera import Camera
from v2p_data.geometry.pose import angle_between, transform
from v2p_data.scene.shapes.silhouette_view import SilhouetteCrop, SilhouetteView, middle_of

_LEAST_PX = 80
"""Fewest pixels of the last outline; a smaller one has no form."""
_MOST_HIDDEN = 0.4
"""Hidden share of the mesh's silhouette from which on the primitive's pose stays."""
_GAIN = 0.01
"""By how much the outline must be covered better than from the primitive's pose, in units of IoU."""
_HOLD = 0.02
"""What turning round costs, in units of IoU: things that are moved mostly keep their yaw."""
_SAME_REST = 0.9
"""Cosine between the own z axes of two poses that rest alike."""
_ALIGNED_ROUNDS, _ITERATIONS = 2, 60
_FIRST_STEPS = (0.05, 0.05, 0.2)
"""First steps of the search: two in units of the mesh's diagonal, one in radians."""


@dataclass(frozen=True, kw_only=True)
class Refit:
    """A mesh over an outline."""

    T_world_mesh: Float[np.ndarray, "4 4"]
    iou: float
    """Overlap of the silhouette with the mask, where the object could be seen."""


def refine_pose(
    view: SilhouetteView,
    T_first: Float[np.ndarray, "4 4"],
    mesh: trimesh.Trimesh,
    camera: Camera,
    *,
    in_air: bool,
) -> Refit | None:
    """Return the pose in which the mesh covers an outline best, near one that a primitive's fit gave.

    It moves along the table, or across the view for what is held in the air, and turns about the upright axis.

    Args:
        view: the outline and the mesh's pose by the primitive [m].
        T_first: the mesh's pose at first: an object that lies as it lay then mostly keeps its yaw.
        mesh: in its own frame [m].
        camera: of the mask.
        in_air: whether the object does not rest on anything.

    Returns:
        None where the outline is too small or too much of the mesh is hidden to tell.
    """
    crop, T_usual = SilhouetteCrop(view, camera), view.T_world_obj
    if view.mask.sum() < _LEAST_PX:
        return None
    if crop.hidden_share(crop.drawn(mesh, T_usual)) > _MOST_HIDDEN:
        return None
    ways = np.eye(3)[:, 1:] if in_air else np.eye(3)[:, :2]
    reach = float(np.linalg.norm(mesh.extents))
    held = T_first[:3, :3] if float(T_first[:3, 2] @ T_usual[:3, 2]) > _SAME_REST else None

    def rated(T: Float[np.ndarray, "4 4"]) -> tuple[float, Refit]:
        iou = crop.iou(crop.drawn(mesh, T))
        turn = 0.0 if held is None else angle_between(T[:3, :3], held)
        return 1 - iou + _HOLD * (1 - np.cos(turn)) / 2, Refit(T_world_mesh=T, iou=iou)

    def best_near(T: Float[np.ndarray, "4 4"]) -> tuple[float, Refit]:
        def moved(v: Float[np.ndarray, "3"]) -> Float[np.ndarray, "4 4"]:
            out = _turned(T, float(v[2]))
            out[:3, 3] += reach * ways @ v[:2]
            return out

        simplex = np.vstack([np.zeros(3), np.diag(_FIRST_STEPS)])
        options = {"maxiter": _ITERATIONS, "fatol": 0.0005, "initial_simplex": simplex}
        found = minimize(
            lambda v: rated(moved(v))[0], np.zeros(3), method="Nelder-Mead", options=options
        )
        return rated(moved(found.x))

    starts = [T_usual]
    if not _is_round(mesh, T_usual):
        starts += [_turned(T_usual, yaw) for yaw in np.radians(range(30, 360, 30))]
        starts += [] if held is None else [transform(held, T_usual[:3, 3])]
    tried = sorted(
        (rated(_aligned(crop, mesh, T, ways)) for T in starts), key=lambda pair: pair[0]
    )
    found = [best_near(pose.T_world_mesh) for _, pose in tried[:2]]
    cost, best = min((*found, *tried[:2]), key=lambda pair: pair[0])
    usual_cost, usual = rated(T_usual)
    return best if cost < usual_cost - _GAIN else usual


def warped_trajectory(
    poses: Float[np.ndarray, "pose 4 4"], T_last: Float[np.ndarray, "4 4"]
) -> Float[np.ndarray, "pose 4 4"]:
    """Return the poses, the last one replaced and those before changed the more the farther on their way they are."""
    steps = np.linalg.norm(np.diff(poses[:, :3, 3], axis=0), axis=1)
    share = np.concatenate([[0.0], steps.cumsum()]) / max(float(steps.sum()), 1e-9)
    turn = Rotation.from_matrix(T_last[:3, :3] @ poses[-1, :3, :3].T).as_rotvec()
    out = poses.copy()
    out[:, :3, :3] = Rotation.from_rotvec(share[:, None] * turn).as_matrix() @ poses[:, :3, :3]
    out[:, :3, 3] += share[:, None] * (T_last[:3, 3] - poses[-1, :3, 3])
    out[-1] = T_last
    return out


def _is_round(mesh: trimesh.Trimesh, T_world_mesh: Float[np.ndarray, "4 4"]) -> bool:
    """Return whether turning it on the table changes nothing."""
    x, y, _ = mesh.extents
    return abs(float(np.log(x / y))) < 0.02 and abs(float(T_world_mesh[2, 2])) > 0.9


def _turned(T: Float[np.ndarray, "4 4"], yaw: float) -> Float[np.ndarray, "4 4"]:
    turn = Rotation.from_euler("z", yaw).as_matrix()
    return transform(turn @ T[:3, :3], T[:3, 3])


def _aligned(
    crop: SilhouetteCrop,
    mesh: trimesh.Trimesh,
    T: Float[np.ndarray, "4 4"],
    ways: Float[np.ndarray, "3 2"],
) -> Float[np.ndarray, "4 4"]:
    """Return the pose moved such that the silhouette's middle lies on the mask's."""
    out = T.copy()
    for _ in range(_ALIGNED_ROUNDS):
        drawn = crop.drawn(mesh, out)
        if not drawn.any():
            break
        onto = np.column_stack([crop.matrix[:, :3] @ ways, crop.matrix @ np.append(out[:3, 3], 1)])
        ends = [np.append(middle_of(picture), 1.0) for picture in (drawn, crop.mask)]
        spots = np.linalg.lstsq(onto, np.stack(ends).T, rcond=None)[0]
        here, there = (spots[:2] / spots[2]).T
        out[:3, 3] += ways @ (there - here)
    return out

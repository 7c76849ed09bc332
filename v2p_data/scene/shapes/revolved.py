"""The largest body of revolution that an outline leaves room for: the neck of a bottle, the bulge of a bowl."""

import numpy as np
from jaxtyping import Bool, Float
from scipy.ndimage import gaussian_filter1d

from v2p_data.geometry.mesh import lathe, lathe_parts, wall_m
from v2p_data.geometry.pose import transform
from v2p_data.geometry.raster import fill, in_parts
from v2p_data.scene.scale.nouns import Noun
from v2p_data.scene.shapes.mesh_hypothesis import MeshHypothesis, Size
from v2p_data.scene.shapes.silhouette_view import SilhouetteCrop, SilhouetteView

_RINGS, _RADII, _AROUND = 48, 44, 30
_MAX_RADIUS = 0.8
"""Share of the fitted diameter up to which rings are tried."""
_BEYOND = 0.35
"""Share of the fitted height: a profile may go on that far beyond the primitive."""
_RIM = 0.12
"""Of its height, what is open at the top does not close again so near to its rim: corners of
outlines come out round."""
_RING_INSIDE = 0.94
"""Share of a ring's points that must lie in the mask: a disc half a percent too large has 6 % outside."""


def revolution(
    view: SilhouetteView, crop: SilhouetteCrop, size_m: Size, noun: Noun
) -> MeshHypothesis | None:
    """Return what the outline leaves of a body of revolution about the fit's z: at each height the largest disc in it.

    The silhouette of such a body is the union of its discs' silhouettes, so nothing larger can be right. Discs at the
    ends that other discs cover are dropped: the smallest body wins.
    """
    T, (diameter, _, height) = view.T_world_obj, size_m
    up = float(T[2, 2])
    low, high = (-height / 2 - _BEYOND * height, height / 2 + _BEYOND * height)
    if up > 0.9:
        low = -height / 2
    elif up < -0.9:
        high = height / 2
    z = np.linspace(low, high, _RINGS)
    radii = np.linspace(0, _MAX_RADIUS * diameter, _RADII)
    side = T[:3, :3].T @ np.cross(T[:3, 2], T[:3, 3] - crop.camera.T_world_cam[:3, 3])
    side = np.array([side[0], side[1], 0.0]) / max(float(np.hypot(side[0], side[1])), 1e-9)
    carved = [
        (shift, _carved(crop, T, z, radii, shift * diameter * side))
        for shift in (0.0, -0.03, 0.03, -0.07, 0.07)
    ]
    shift, radius = max(carved, key=lambda c: float((c[1] ** 2).sum()) * (1 - 0.1 * abs(c[0])))
    rows = np.flatnonzero(radius > 0.08 * float(radius.max()))
    if len(rows) < 4 or radius.max() <= 0:
        return None
    centre = T[:3, 3] + T[:3, :3] @ (shift * diameter * side)
    discs = _discs(crop, transform(T[:3, :3], centre), z[rows], radius[rows])
    first, last = _needed(
        crop, discs, z[rows], fitted=height / 2, bottom=up <= 0.9, top=up >= -0.9
    )
    first, last = int(rows[first]), int(rows[last])
    if last - first < 3:
        return None
    z, radius = z[first : last + 1], radius[first : last + 1]
    radius = gaussian_filter1d(radius, 1.0, mode="nearest")
    if noun.hollow:
        radius = _with_rim(z, radius)
    middle = (z[0] + z[-1]) / 2
    profile = np.c_[np.maximum(radius, 1e-3 * diameter), z - middle]
    wide, tall = 2 * float(radius.max()), float(z[-1] - z[0])
    wall = wall_m((wide, wide, 2 * tall)) if noun.hollow else 0.0
    move = transform(np.eye(3), shift * diameter * side + np.array([0.0, 0.0, middle]))
    return MeshHypothesis(
        kind="revolution",
        mesh=lathe(profile, wall),
        parts=lathe_parts(profile, wall),
        T_obj_shape=move,
    )


def _carved(
    crop: SilhouetteCrop,
    T_world_obj: Float[np.ndarray, "4 4"],
    z: Float[np.ndarray, "k"],
    radii: Float[np.ndarray, "j"],
    shift: Float[np.ndarray, "3"],
) -> Float[np.ndarray, "k"]:
    """Return the largest radius at each height for which no ring about the shifted axis leaves the mask."""
    angles = np.linspace(0, 2 * np.pi, _AROUND, endpoint=False)
    x, y = np.cos(angles), np.sin(angles)
    rings = np.empty((len(z), len(radii), _AROUND, 3))
    rings[..., 0] = radii[None, :, None] * x + shift[0]
    rings[..., 1] = radii[None, :, None] * y + shift[1]
    rings[..., 2] = z[:, None, None] + shift[2]
    world = rings @ T_world_obj[:3, :3].T + T_world_obj[:3, 3]
    fits = crop.looked_up(crop.may, world).mean(axis=2) >= _RING_INSIDE
    seen = (
        crop.looked_up(crop.mask, world).mean(axis=2) >= 0.5
    )  # a ring behind the hand says nothing
    reach = np.cumprod(fits, axis=1).sum(axis=1)
    sure = (np.cumprod(fits, axis=1) * seen).any(axis=1)
    return np.where((reach > 1) & sure, radii[np.maximum(reach - 1, 0)], 0.0)


def _with_rim(z: Float[np.ndarray, "k"], radius: Float[np.ndarray, "k"]) -> Float[np.ndarray, "k"]:
    """Return the radii of a vessel, its rim at the last, as wide there as just below."""
    below = np.flatnonzero(z < z[-1] - _RIM * (z[-1] - z[0]))
    out = radius.copy()
    out[below[-1] :] = np.maximum(out[below[-1] :], radius[below[-1]])
    return out


def _discs(
    crop: SilhouetteCrop,
    T_world_obj: Float[np.ndarray, "4 4"],
    z: Float[np.ndarray, "k"],
    radius: Float[np.ndarray, "k"],
) -> Bool[np.ndarray, "k i j"]:
    """Return the silhouette of each disc, at its height and of its radius along the axis of a pose."""
    angles = np.linspace(0, 2 * np.pi, _AROUND, endpoint=False)
    ring = np.stack([np.cos(angles), np.sin(angles), np.zeros(_AROUND)], axis=1)
    discs = []
    for height, wide in zip(z, radius, strict=True):
        points = wide * ring + np.array([0.0, 0.0, height])
        pixels = crop.pixels(points @ T_world_obj[:3, :3].T + T_world_obj[:3, 3])
        picture = np.zeros(crop.mask.shape, np.uint8)
        if np.isfinite(pixels).all():
            fill(picture, in_parts(pixels))
        discs.append(picture > 0)
    return np.array(discs)


def _needed(
    crop: SilhouetteCrop,
    stack: Bool[np.ndarray, "k i j"],
    z: Float[np.ndarray, "k"],
    *,
    fitted: float,
    bottom: bool,
    top: bool,
) -> tuple[int, int]:
    """Return the first and last disc without which the silhouette would lack something, or the body its fitted height.

    `fitted` is half that height: the base of a bowl that lies on its mouth is seen within the
      outline, which does not need it.
    """
    covers = stack.sum(axis=0)
    allowed = 0.006 * float(crop.mask.sum())
    first, last = 0, len(z) - 1
    for end, step in ((last, -1), (first, 1)):
        if not (top if step < 0 else bottom):
            continue
        k, lost, left = end, 0.0, covers.copy()
        while 0 <= k < len(z) and abs(z[k]) > fitted:
            left = left - stack[k]
            lost = float(((left == 0) & (covers > 0) & crop.mask).sum())
            if lost > allowed:
                break
            k += step
        if step < 0:
            last = max(k, 0)
        else:
            first = min(k, len(z) - 1)
    return first, max(last, first)

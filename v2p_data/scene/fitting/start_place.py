"""Where a task starts whose object a hand brings: a place on the table beside its goal, chosen, since the clip shows none.

Lengths are camera heights unless a name says otherwise.
"""

from collections.abc import Iterator
from dataclasses import replace

import numpy as np
from jaxtyping import Float

from v2p_data.errors import ItemRejectedError
from v2p_data.geometry.camera import Camera
from v2p_data.geometry.mesh import outline_points
from v2p_data.geometry.pose import transform
from v2p_data.kinds import KINDS, Kind
from v2p_data.scene.data_types import Fit, GroundedObjects, PlacedObject, Placement
from v2p_data.scene.fitting.shape_fit import lowest
from v2p_data.scene.frames.mask_ops import grow

_GAPS_M = (0.10, 0.06, 0.15, 0.20)
"""Free table between the object and its goal; the first is tried first."""
_APART_M = 0.02
"""Least free table between the object and any other one."""
_WAYS = 16
"""Directions from the goal that are tried, those nearest to where the hand came from first."""
_EDGE_PX = 2.0
"""Margin of the picture, 320 px wide."""
_ON_TABLE_PX = 6
"""So far beside what was seen as table there is table too."""
_CHOSEN_SURE = 0.1
"""Confidence, 0 to 1, of a pose that nobody saw."""


def with_start_place(grounded: GroundedObjects, placement: Placement, kind: Kind) -> Placement:
    """Return the placement with a first pose for the object that is brought.

    Raises:
        ItemRejectedError: `not_there_at_first`, where the picture shows no free table for it.
    """
    thing, *others = placement.objects
    rest = thing.last.T_world_obj
    height = lowest(thing.last.size, grounded.objects[0].noun.form, rest[:3, :3])
    spots = [
        transform(rest[:3, :3], np.array([*spot, height]))
        for spot in _free_spots(grounded, placement, kind)
    ]
    for whole in (True, False):  # what is large may reach out of the picture
        for T in spots:
            if _is_on_table(grounded, placement, T, whole=whole):
                return replace(placement, objects=(_starting_at(thing, T, grounded), *others))
    raise ItemRejectedError(
        "not_there_at_first",
        f"a hand brings '{grounded.objects[0].phrase}', and the picture shows no free table beside its goal: film from farther away",
        None,
    )


def _free_spots(
    grounded: GroundedObjects, placement: Placement, kind: Kind
) -> Iterator[Float[np.ndarray, "2"]]:
    """Yield places on the table where the object stands clear of the others, the best first."""
    thing, *others = placement.objects
    per_m, own = 1 / placement.height_m, _radius(thing.last)
    ends_at = thing.last.T_world_obj[:2, 3]
    came = _came_from(grounded, placement.camera) - ends_at
    came /= max(1e-9, float(np.linalg.norm(came)))
    stones = [(one.first.T_world_obj[:2, 3], _radius(one.first)) for one in others]
    goal = stones[0][1] if stones and KINDS[kind].touches else 0.0
    # What comes to rest beside the other comes from its far side, and not through it.
    away = ends_at - stones[0][0] if stones and not goal else np.zeros(2)
    turns = sorted(np.arange(_WAYS) * 2 * np.pi / _WAYS, key=np.cos, reverse=True)
    for gap_m in _GAPS_M:
        for turn in turns:
            c, s = np.cos(turn), np.sin(turn)
            way = np.array([[c, -s], [s, c]]) @ came
            spot = ends_at + way * (own + max(own, goal) + gap_m * per_m)
            apart = [float(np.linalg.norm(spot - xy)) - own - radius for xy, radius in stones]
            if way @ away >= 0 and min(apart, default=1.0) > _APART_M * per_m:
                yield spot


def _starting_at(
    thing: PlacedObject, T: Float[np.ndarray, "4 4"], grounded: GroundedObjects
) -> PlacedObject:
    end = len(grounded.working.rgb) - 1
    return replace(
        thing,
        first=replace(thing.first, T_world_obj=T),
        frames=(0, end),
        T_world_objs=np.stack([T, thing.last.T_world_obj]),
        confidences=(_CHOSEN_SURE, float(np.clip(thing.last.iou, 0, 1))),
        observed=("full", "full"),
        T_world_seen=thing.last.T_world_obj,
    )


def _radius(fit: Fit) -> float:
    """Return half the width of what a shape covers on the table, at its widest."""
    across = np.abs(fit.T_world_obj[:2, :3]) @ np.array(fit.size)
    return float(across.max()) / 2


def _came_from(grounded: GroundedObjects, camera: Camera) -> Float[np.ndarray, "2"]:
    """Return the table's point where the object is seen first on its way; the one nearest to the camera where it never is."""
    s = grounded.objects[0]
    seen = [i for i in range(len(s.masks)) if s.masks[i].any()]
    y, x = np.nonzero(s.masks[seen[0]])
    spot = camera.on_plane(np.array([[x.mean() + 0.5, y.mean() + 0.5]]))[0, :2]
    return spot if len(seen) > 1 and np.isfinite(spot).all() else np.zeros(2)


def _is_on_table(
    grounded: GroundedObjects, placement: Placement, T: Float[np.ndarray, "4 4"], *, whole: bool
) -> bool:
    """Return whether the object's foot would be on what is seen as table; `whole`: and all of it in the picture.

    A table that reaches the picture's edge goes on beyond it.
    """
    camera, noun, fit = placement.camera, grounded.objects[0].noun, placement.objects[0].last
    table = grow(grounded.table.hull, _ON_TABLE_PX)
    foot = camera.project(T[None, :3, 3] * np.array([1, 1, 0]))[0]
    if not np.isfinite(foot).all():
        return False
    x, y = np.clip(foot, 0, np.array(table.shape[::-1]) - 1).astype(int)
    if not table[y, x]:
        return False
    points = outline_points(noun.form, fit.size, noun.taper) @ T[:3, :3].T + T[:3, 3]
    px = camera.project(points)
    edge = np.array([camera.width_px, camera.height_px]) - _EDGE_PX
    return not whole or bool((px > _EDGE_PX).all() and (px < edge).all())

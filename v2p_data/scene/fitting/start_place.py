"""Where a task starts whose object a hand brings: a chosen place on the table beside its goal.

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
from v2p_data.scene.data_types import Fit, GroundedObjects, Placement
from v2p_data.scene.fitting.shape_fit import lowest
from v2p_data.scene.frames.mask_ops import grow

_GAPS_M, _APART_M = (0.10, 0.06, 0.15, 0.20), 0.02
"""Free table between the object and its goal, the first tried first; and least free table between
the object and any other one."""
_WAYS = 16
"""Directions from the goal that are tried, those nearest to where the hand came from first."""
_EDGE_PX, _ON_TABLE_PX = 2.0, 6
"""Margin of a picture 320 px wide; and so far beside what was seen as table there is table too."""
_CHOSEN_SURE = 0.1
"""Confidence, 0 to 1, of a pose that nobody saw."""


def with_start_place(grounded: GroundedObjects, placement: Placement, kind: Kind) -> Placement:
    """Return the placement with a first pose for the object that is brought.

    Raises:
        ItemRejectedError: `not_there_at_first`, where the picture shows no free table for it.
    """
    thing, *others = placement.objects
    rest, size, noun = thing.last.T_world_obj, thing.last.size, grounded.objects[0].noun
    points = outline_points(noun.form, size, noun.taper) @ rest[:3, :3].T
    spots = [
        np.array([*xy, lowest(size, noun.form, rest[:3, :3])])
        for xy in _free_spots(grounded, placement, kind)
    ]
    if not spots:
        raise ItemRejectedError(
            "not_there_at_first",
            f"there is no free table in the picture where '{grounded.objects[0].phrase}' could "
            "start: film from farther away",
            None,
        )
    # What is large may reach out of the picture everywhere: then the first one is taken.
    spot = max(spots, key=lambda spot: _is_in_picture(points + spot, placement.camera))
    T = transform(rest[:3, :3], spot)
    started = replace(
        thing,
        first=replace(thing.first, T_world_obj=T),
        frames=(0, len(grounded.working.rgb) - 1),
        T_world_objs=np.stack([T, rest]),
        confidences=(_CHOSEN_SURE, float(np.clip(thing.last.iou, 0, 1))),
        observed=("full", "full"),
        T_world_seen=rest,
    )
    return replace(placement, objects=(started, *others))


def _free_spots(
    grounded: GroundedObjects, placement: Placement, kind: Kind
) -> Iterator[Float[np.ndarray, "2"]]:
    """Yield places on what is seen as table where the object stands clear of the others, the best first.

    A table that reaches the picture's edge goes on beyond it.
    """
    thing, *others = placement.objects
    per_m, own = 1 / placement.height_m, _radius(thing.last)
    ends_at = thing.last.T_world_obj[:2, 3]
    first_seen = next(mask for mask in grounded.objects[0].masks if mask.any())
    middle_px = np.argwhere(first_seen).mean(0)[None, ::-1] + 0.5
    came = np.nan_to_num(placement.camera.on_plane(middle_px)[0, :2] - ends_at)
    came /= max(1e-9, float(np.linalg.norm(came)))
    stones = [(one.first.T_world_obj[:2, 3], _radius(one.first)) for one in others]
    goal = stones[0][1] if stones and KINDS[kind].touches else 0.0
    # What comes to rest beside the other comes from its far side, and not through it.
    away = ends_at - stones[0][0] if stones and not goal else np.zeros(2)
    table = grow(grounded.table.hull, _ON_TABLE_PX)
    turns = sorted(np.arange(_WAYS) * 2 * np.pi / _WAYS, key=np.cos, reverse=True)
    for gap_m in _GAPS_M:
        for turn in turns:
            c, s = np.cos(turn), np.sin(turn)
            way = np.array([[c, -s], [s, c]]) @ came
            spot = ends_at + way * (own + max(own, goal) + gap_m * per_m)
            apart = [float(np.linalg.norm(spot - xy)) - own - radius for xy, radius in stones]
            foot = placement.camera.project(np.array([[*spot, 0.0]]))[0]
            if (
                way @ away >= 0
                and min(apart, default=1.0) > _APART_M * per_m
                and np.isfinite(foot).all()
                and table[tuple(np.clip(foot[::-1], 0, np.array(table.shape) - 1).astype(int))]
            ):
                yield spot


def _radius(fit: Fit) -> float:
    """Return half the width of what a shape covers on the table, at its widest."""
    return float((np.abs(fit.T_world_obj[:2, :3]) @ np.array(fit.size)).max()) / 2


def _is_in_picture(points: Float[np.ndarray, "n 3"], camera: Camera) -> bool:
    px = camera.project(points)
    edge = np.array([camera.width_px, camera.height_px]) - _EDGE_PX
    return bool((px > _EDGE_PX).all() and (px < edge).all())

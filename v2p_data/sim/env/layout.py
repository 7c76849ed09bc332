"""Where objects stand at the start of an episode: as in the video, shifted, turned and apart."""

from itertools import combinations

import numpy as np
from jaxtyping import Bool, Float

from v2p_data.errors import ItemRejectedError
from v2p_data.kinds import KINDS, TaskKind
from v2p_data.scene.scene import Scene
from v2p_data.sim.env.ranges import RandomizationConfig

WORKSPACE_CENTRE_M = (0.5, 0.0)
OBJECT_LOW_M = (0.37, -0.28)
OBJECT_HIGH_M = (0.66, 0.28)
"""Objects' centres lie in this part of the table, which the gripper reaches pointing down."""
PUSH_ROOM_M = 0.15
"""Free way that push tasks get on the side they push to."""
BEYOND_LOW_M = (0.90, -0.12)
BEYOND_HIGH_M = (1.0, 0.12)
"""Where a container stands that things are thrown into: beyond the gripper's reach (0.72 m)."""
PLACEMENT_TRIES = 100


def drawn_layouts(
    scene: Scene,
    radius: Float[np.ndarray, "n object"],
    pair: tuple[int, int] | None,
    cfg: RandomizationConfig,
    rng: np.random.Generator,
) -> Float[np.ndarray, "n object 2"]:
    """Return x and y of all objects' centres [m], drawn until they lie within reach and do not touch.

    The layout follows the video: reference objects keep their direction from the manipulated one, at a
    distance that fits. Push tasks leave `PUSH_ROOM_M` free on the side they push to.

    Args:
        scene: the layout of the video.
        radius: of the circles about their centres that hold the objects [m].
        pair: cover and what it covers, if the task is about covering.
        cfg: ranges of the draw.
        rng: where the draws come from.

    Raises:
        ItemRejectedError: the objects do not fit on the table together.
    """
    n, count = radius.shape
    pair = pair if KINDS[scene.kind].starts_over else None  # else they start apart
    xy = np.zeros((n, count, 2))
    todo = np.arange(n)
    for attempt in range(PLACEMENT_TRIES):
        loosen = 1.0 + 2.0 * attempt / PLACEMENT_TRIES if attempt >= 10 else 1.0
        spot, good = _drawn(scene, radius[todo], pair, loosen, cfg, rng)
        good &= _are_apart(spot, radius[todo], pair)
        xy[todo[good]] = spot[good]
        todo = todo[~good]
        if not len(todo):
            return xy
    names = ", ".join(o.name for o in scene.objects)
    raise ItemRejectedError(
        "no_room",
        f"{names} do not fit on the table of scene '{scene.title}' within the robot's reach "
        f"without touching, in {PLACEMENT_TRIES} tries",
        float(len(todo)),
    )


def _drawn(
    scene: Scene,
    r: Float[np.ndarray, "m object"],
    pair: tuple[int, int] | None,
    loosen: float,
    cfg: RandomizationConfig,
    rng: np.random.Generator,
) -> tuple[Float[np.ndarray, "m object 2"], Bool[np.ndarray, "m"]]:
    """Return one draw of all centres, and in which worlds they lie on the reachable part of the table."""
    m, count = r.shape
    kind = KINDS[scene.kind]
    offsets = scene_offsets(scene)
    low, high = _placement_boxes(kind, count)
    centre = np.array([WORKSPACE_CENTRE_M[0], (low[0, 1] + high[0, 1]) / 2])
    spot = np.zeros((m, count, 2))
    for k in range(1, count):
        offset = offsets[k]
        distance = np.linalg.norm(offset) * rng.uniform(*cfg.layout_distance_scale, m)
        angle = np.arctan2(offset[1], offset[0]) + loosen * rng.uniform(
            -cfg.layout_angle_rad, cfg.layout_angle_rad, m
        )
        nearest = r[:, 0] + r[:, k] + 0.02
        distance = np.clip(distance, nearest, np.maximum(nearest, 0.28))
        if pair is not None and k == max(pair):
            distance = np.zeros(m)
        spot[:, k] = distance[:, None] * np.stack([np.cos(angle), np.sin(angle)], axis=1)
    shift = rng.uniform(-cfg.object_pos_m, cfg.object_pos_m, (m, 2)) * min(loosen, 1.5)
    middle = (spot.max(1) + spot.min(1)) / 2 if count > 1 else np.zeros((m, 2))
    spot += (centre + shift - middle)[:, None]
    # The whole group moves back into the box where it can.
    over = np.maximum(spot - high, 0).max(1) - np.maximum(low - spot, 0).max(1)
    spot -= over[:, None]
    if kind.other_starts == "beyond_reach" and count > 1:
        spot[:, 0] = centre + shift
        spot[:, 1:] = rng.uniform(BEYOND_LOW_M, BEYOND_HIGH_M, (m, 1, 2))
    return spot, ((spot >= low - 1e-9) & (spot <= high + 1e-9)).all((1, 2))


def _are_apart(
    spot: Float[np.ndarray, "m object 2"],
    r: Float[np.ndarray, "m object"],
    pair: tuple[int, int] | None,
) -> Bool[np.ndarray, "m"]:
    """Return in which worlds no two objects touch, cover and covered aside."""
    apart = np.ones(len(spot), bool)
    for a, b in combinations(range(spot.shape[1]), 2):
        if pair not in {(a, b), (b, a)}:
            gap = np.linalg.norm(spot[:, a] - spot[:, b], axis=1) - r[:, a] - r[:, b]
            apart &= gap > 0.005
    return apart


def scene_offsets(scene: Scene) -> Float[np.ndarray, "object 2"]:
    """Return where each object stood at first in the video, relative to the manipulated one [m]."""
    first = np.array([o.first_pose[:2] if o.poses_world else np.zeros(2) for o in scene.objects])
    offsets = first - first[0]
    for k in range(1, len(offsets)):
        if np.linalg.norm(offsets[k]) < 1e-3:
            offsets[k] = (0.15, 0.0)
    return offsets


def _placement_boxes(kind: TaskKind, count: int) -> tuple[np.ndarray, np.ndarray]:
    """Return per object the lowest and highest x and y of its centre [m]."""
    low, high = np.tile(OBJECT_LOW_M, (count, 1)), np.tile(OBJECT_HIGH_M, (count, 1))
    if kind.side > 0:
        high[:, 1] -= PUSH_ROOM_M
    elif kind.side < 0:
        low[:, 1] += PUSH_ROOM_M
    elif kind.other_starts == "beyond_reach":
        low[1:], high[1:] = BEYOND_LOW_M, BEYOND_HIGH_M
    elif kind.other_starts == "far_side":
        low[1:, 0] += 0.1  # what is in front of it must be within reach, too
    return low, high

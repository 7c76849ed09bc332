"""How an object lies between the pads: by how much to turn until they fit, and its extents as the gripper sees them.

Policies are shown this because a network learns it badly from rotation matrices: the turn repeats every 180
degrees and jumps from one pair of sides to the other. Arrays have the worlds last.
"""

import numpy as np
from jaxtyping import Float

GRIPS_UP_TO_M = 0.078
"""Sides narrower than this fit between the open pads with some room."""
LEVEL = 0.5
"""An own axis lies flat enough to be gripped along while its vertical part is below this."""
TOO_WIDE, NARROW_IS_BETTER, NOT_LEVEL = 300.0, 3.0, 1000.0
"""Costs in radians per metre: a side is chosen by how far to turn and by how wide it is."""


def turn_to_grip(
    closing: Float[np.ndarray, "3 env"],
    rotation: Float[np.ndarray, "3 3 env"],
    size: Float[np.ndarray, "3 env"],
    *,
    is_round: bool,
) -> Float[np.ndarray, "env"]:
    """Return by how much to turn the gripper about the vertical [rad] until the pads fit over an object.

    Args:
        closing: the direction in which the pads close, a unit vector in the world frame.
        rotation: column k is the object's own axis k in the world frame.
        size: full extents along its own axes [m].
        is_round: about its own z axis; while upright it needs no turn.

    Returns:
        Angles within +-pi/2, positive anticlockwise seen from above.
    """
    heading = np.arctan2(closing[1], closing[0])
    if is_round:
        axis = np.arctan2(rotation[1, 2], rotation[0, 2]) + np.pi / 2
        return np.where(np.abs(rotation[2, 2]) < 0.7, _within(axis - heading), 0.0)
    turns = _within(np.arctan2(rotation[1], rotation[0]) - heading)
    costs = (
        np.abs(turns)
        + TOO_WIDE * np.maximum(size - GRIPS_UP_TO_M, 0)
        + NARROW_IS_BETTER * size
        + NOT_LEVEL * (np.abs(rotation[2]) > LEVEL)
    )
    turn = np.where(costs[1] < costs[0], turns[1], turns[0])
    return np.where(costs[2] < np.minimum(costs[0], costs[1]), turns[2], turn)


def grip_features(
    tool: Float[np.ndarray, "3 3 env"],
    rotation: Float[np.ndarray, "3 3 env"],
    size: Float[np.ndarray, "3 env"],
    *,
    is_round: bool,
) -> Float[np.ndarray, "4 env"]:
    """Return the turn in quarter turns, then the extents of its box along the gripper's axes [m]."""
    turn = turn_to_grip(tool[:, 1], rotation, size, is_round=is_round)
    relative = np.abs((tool[:, :, None] * rotation[:, None]).sum(0))
    extents = (relative * size[None]).sum(1)
    return np.concatenate([turn[None] / (np.pi / 2), extents])


def _within(angle: np.ndarray) -> np.ndarray:
    return angle - np.pi * np.round(angle / np.pi)

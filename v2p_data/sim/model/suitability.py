"""Does a scene suit the robot? Asked before anything is compiled; each fault has its own sentence.

What a task must grasp is looked at as it stands on the table: the gripper points down and comes from any side, so
one of its parts has to fit between the pads in some horizontal direction, at some height.
"""

import logging
import math
from collections.abc import Sequence

import numpy as np
from jaxtyping import Float
from scipy.spatial.transform import Rotation

from v2p_data.errors import ItemRejectedError
from v2p_data.kinds import KINDS
from v2p_data.scene.scene import Scene, SceneObject
from v2p_data.sim.robot.robot import FINGER_TRAVEL_M

MAX_STANDING_SIZE_M = 0.45
"""Size of objects that stay where they are: trays, boxes beside the motion."""
MAX_SIZE_M = 0.35
MIN_SIZE_M = 0.015
MIN_STATED_M = 5e-4
"""Thinner than a thick sheet of paper: a mistake, not an object."""
MIN_THICKNESS_M = 0.01
"""Thinner extents are thickened to this: the coarse time step cannot hold them apart."""
MAX_MASS_KG = 3.0
MIN_MASS_KG = 1e-4
GRIP_MARGIN_M = 0.002
"""What must be left between the open pads and what they take."""
_DIRECTIONS = 36
_LEVELS = 6

logger = logging.getLogger(__name__)


def check_names(scene: Scene, reserved: Sequence[str]) -> None:
    """Demand that objects can be told apart by names that task code can use.

    Raises:
        ItemRejectedError: `no_objects` or `object_name`.
    """
    if not scene.objects:
        raise ItemRejectedError(
            "no_objects",
            f"scene '{scene.title}' has no object; it needs the manipulated one first",
            0.0,
        )
    seen: set[str] = set(reserved)
    for obj in scene.objects:
        if not obj.name.isidentifier() or obj.name in seen:
            why = "is taken already" if obj.name in seen else "is no identifier"
            raise ItemRejectedError(
                "object_name",
                f"the name '{obj.name}' of an object of scene '{scene.title}' {why}; names are letters, digits and "
                f"underscores, each used once, and none of {', '.join(sorted(reserved))}",
            )
        seen.add(obj.name)


def checked_size(obj: SceneObject, scene: Scene) -> tuple[float, float, float]:
    """Return the object's extents, the thin ones thickened.

    Raises:
        ItemRejectedError: size or mass is impossible, or beyond this robot and its table.
    """
    where = f"'{obj.name}' of scene '{scene.title}'"
    size = tuple(float(s) for s in obj.size_m)
    if len(size) != 3 or not all(math.isfinite(s) and s >= MIN_STATED_M for s in size):
        raise ItemRejectedError(
            "size_impossible",
            f"{where} has the extents {size} m; three lengths of at least {MIN_STATED_M * 1000} mm are wanted",
            min(size, default=0.0),
        )
    largest = max(size)
    limit = MAX_SIZE_M if obj is scene.manipulated else MAX_STANDING_SIZE_M
    if largest > limit:
        hint = (
            f"; in millimetres it would be {largest:.0f} mm: are the extents in metres?"
            if largest > 5
            else ""
        )
        raise ItemRejectedError(
            "object_too_large",
            f"{where} is {largest:.2f} m large; at most {limit} m fits into the robot's workspace{hint}",
            largest,
        )
    if largest < MIN_SIZE_M:
        raise ItemRejectedError(
            "object_too_small",
            f"{where} is {largest * 1000:.0f} mm large; below {MIN_SIZE_M * 1000:.0f} mm it cannot be simulated",
            largest,
        )
    if not obj.mass_kg >= MIN_MASS_KG:
        raise ItemRejectedError(
            "mass_impossible",
            f"{where} weighs {obj.mass_kg} kg; at least {MIN_MASS_KG * 1000} g can be simulated",
            obj.mass_kg,
        )
    if obj.mass_kg > MAX_MASS_KG:
        raise ItemRejectedError(
            "object_too_heavy",
            f"{where} weighs {obj.mass_kg:.1f} kg; the robot carries at most {MAX_MASS_KG} kg",
            obj.mass_kg,
        )
    x, y, z = (max(s, MIN_THICKNESS_M) for s in size)
    if min(size) < MIN_THICKNESS_M:
        logger.warning(
            "%s is only %.1f mm thick and is thickened to %.0f mm: the simulation cannot hold thinner things apart",
            where,
            min(size) * 1000,
            MIN_THICKNESS_M * 1000,
        )
    return x, y, z


def check_grasp(
    obj: SceneObject,
    scene: Scene,
    corners: Sequence[Float[np.ndarray, "_ 3"]],
    rest_quat: tuple[float, float, float, float],
    opening_m: float = 2 * FINGER_TRAVEL_M,
) -> None:
    """Demand that the gripper can take the manipulated object, where the task needs that.

    Args:
        obj: the object.
        scene: names the kind of task.
        corners: per convex part its corner points, in the object's frame.
        rest_quat: how it stands on the table.
        opening_m: distance between the open pads.

    Raises:
        ItemRejectedError: `not_graspable`.
    """
    if obj is not scene.manipulated or not KINDS[scene.kind].must_grasp:
        return
    R = Rotation.from_quat(rest_quat, scalar_first=True).as_matrix()
    width = min(narrowest_m(points @ R.T) for points in corners)
    if width > opening_m - GRIP_MARGIN_M:
        off = (
            f" (its lengths may be off by {scene.scale_spread:.0%})" if scene.scale_spread else ""
        )
        raise ItemRejectedError(
            "not_graspable",
            f"'{obj.name}' of scene '{scene.title}' is at least {width * 1000:.0f} mm wide from every side, and the "
            f"gripper opens by {opening_m * 1000:.0f} mm; the task '{scene.kind}' must take hold of it; if it "
            f"is smaller in truth{off}, give its size_m in metres among the hints of the clip's caption",
            width,
        )


def narrowest_m(points: Float[np.ndarray, "n 3"]) -> float:
    """Return the smallest horizontal width that pads find on the upper half of a convex solid."""
    low, top = points[:, 2].min(), points[:, 2].max()
    angle = np.arange(_DIRECTIONS) * np.pi / _DIRECTIONS
    across = np.stack([np.cos(angle), np.sin(angle)])
    narrowest = np.inf
    # Higher up, what narrows so much that it would be narrower there slips out of the pads.
    for height in np.linspace((low + top) / 2, low + 0.75 * (top - low), _LEVELS):
        above, below = points[points[:, 2] >= height], points[points[:, 2] <= height]
        # Lines between all corners on both sides of the level cut it inside the solid's outline.
        share = (height - below[:, 2]) / np.maximum(above[:, None, 2] - below[:, 2], 1e-12)
        cut = below[:, :2] + share[..., None] * (above[:, None, :2] - below[:, :2])
        widths = np.ptp(cut.reshape(-1, 2) @ across, axis=0)
        narrowest = min(narrowest, float(widths.min()))
    return narrowest

"""From actions to Cartesian targets, with the action scale and the leashes that the experts were trained with.

The simulator's own settings are read, so that both arms take the same steps. World frame: base at the origin,
+x forward, +y left, +z up.
"""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float
from scipy.spatial.transform import Rotation

from v2p_data.sim.env.batch_env import SimConfig
from v2p_data.sim.robot.robot import QUAT_DOWN, TARGET_HIGH_M, TARGET_LOW_M

DOWN = Rotation.from_quat(QUAT_DOWN, scalar_first=True)


@dataclass(frozen=True, kw_only=True)
class ToolPose:
    """Where the tool is, or shall be."""

    pos: Float[np.ndarray, "3"]
    rotation: Rotation
    opening: float
    """0 closed, 1 open."""

    def state(self, target: "ToolPose") -> Float[np.ndarray, "11"]:
        """Return `observation.state` of a tool that is commanded to `target`.

        Position [m], rotation vector from straight down [rad], opening; then the command: target position minus
        position [m], target opening.
        """
        return np.concatenate(
            [
                self.pos,
                (DOWN.inv() * self.rotation).as_rotvec(),
                [self.opening],
                target.pos - self.pos,
                [target.opening],
            ]
        )


def next_target(
    target: ToolPose,
    measured: ToolPose,
    action: Float[np.ndarray, "7"],
    cfg: SimConfig,
    finger_travel_m: float,
) -> ToolPose:
    """Return the target after one action.

    Args:
        target: the target so far.
        measured: where the tool is; the target stays near it.
        action: delta position, delta rotation (world axes), gripper, each in [-1, 1]; clipped.
        cfg: action scale and leashes.
        finger_travel_m: travel of one finger of this gripper.
    """
    action = np.clip(action, -1.0, 1.0)
    pos = target.pos + action[:3] * cfg.position_step_m
    pos = np.clip(pos, measured.pos - cfg.position_leash_m, measured.pos + cfg.position_leash_m)
    pos = np.clip(pos, TARGET_LOW_M, TARGET_HIGH_M)
    rotation = Rotation.from_rotvec(action[3:6] * cfg.rotation_step_rad) * target.rotation
    rotation = near(rotation, measured.rotation, cfg.rotation_leash_rad)
    opening = max(
        target.opening - action[6] * cfg.finger_step_m / finger_travel_m,
        measured.opening - cfg.finger_leash_m / finger_travel_m,
    )
    return ToolPose(
        pos=pos,
        rotation=_upright(rotation, cfg.tilt_limit_rad),
        opening=float(np.clip(opening, 0.0, 1.0)),
    )


def near(rotation: Rotation, anchor: Rotation, limit_rad: float) -> Rotation:
    """Return `rotation`, turned back towards `anchor` where it is further away than the limit."""
    apart = (rotation * anchor.inv()).as_rotvec()
    angle = float(np.linalg.norm(apart))
    if angle <= limit_rad:
        return rotation
    return Rotation.from_rotvec(apart * (limit_rad / angle)) * anchor


def _upright(rotation: Rotation, limit_rad: float) -> Rotation:
    """Return `rotation`, leaned back where the tool's axis is further than the limit from straight down."""
    axis = rotation.apply([0.0, 0.0, 1.0])
    over = float(np.arccos(np.clip(-axis[2], -1.0, 1.0))) - limit_rad
    if over <= 0:
        return rotation
    back = np.cross(axis, [0.0, 0.0, -1.0])
    return Rotation.from_rotvec(back / max(float(np.linalg.norm(back)), 1e-12) * over) * rotation

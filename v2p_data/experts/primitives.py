"""Scripted motions from which a teacher of any task is put together: reach, grasp, carry, release, push, swing.

Each primitive looks at the present state of all worlds only (`Moment`) and gives the action of this step; none
remembers anything. A policy that sees the same state can therefore imitate it, and it can take over anywhere,
also where a learner has gone astray. Positions in the world frame [m]; directions are unit vectors.
"""

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Bool, Float

from v2p_data.geometry.rotation import matrices
from v2p_data.scene.scene import hollow_floor_m
from v2p_data.sim.env.observation import value_of
from v2p_data.sim.model.suitability import GRIP_MARGIN_M
from v2p_data.sim.model.world import ObjectModel, hollow_wall_m
from v2p_data.sim.robot.grips import turn_to_grip
from v2p_data.sim.robot.robot import FINGERTIP_BELOW_TCP_M, TARGET_HIGH_M, TARGET_LOW_M

Points = Float[np.ndarray, "env 3"]
Plane = Float[np.ndarray, "env 2"]
Numbers = Float[np.ndarray, "env"]
Flags = Bool[np.ndarray, "env"]
Actions = Float[np.ndarray, "env 7"]

FINGER_DEPTH_M = 0.035
"""How deep fingers reach down an object that is taller than this."""
FINGER_HALF_M = 0.012
"""Half the width of the closed gripper, along and across."""
PALM_HALF_M = 0.045
PALM_ABOVE_TCP_M = 0.055
HOVER_M = 0.03
"""Room under the fingertips on the way."""
OPEN, CLOSE = -1.0, 1.0


@dataclass(frozen=True, kw_only=True)
class Body:
    """One object in every world."""

    model: ObjectModel
    pos: Points
    rotation: Float[np.ndarray, "env 3 3"]
    vel: Points
    size: Points
    start: Points
    grasped: Flags
    touched: Flags

    @property
    def half(self) -> Points:
        """Half the extents along its own axes, as it shows itself along world axes: its bounding box."""
        return (np.abs(self.rotation) * self.size[:, None]).sum(2) / 2

    @property
    def top(self) -> Numbers:
        return self.pos[:, 2] + self.half[:, 2]

    @property
    def lowest(self) -> Numbers:
        return self.pos[:, 2] - self.half[:, 2]

    def reach(self, direction: Plane) -> Numbers:
        """Return how far it extends from its centre along horizontal unit directions [m]."""
        if self.model.is_round or self.model.kind == "sphere":
            upright = np.abs(self.rotation[:, 2, 2]) > 0.7
            box = self._box_reach(direction)
            return np.where(upright, self.size[:, :2].max(1) / 2, box)
        return self._box_reach(direction)

    def _box_reach(self, direction: Plane) -> Numbers:
        along = np.einsum("ei,eij->ej", direction, self.rotation[:, :2])
        return (np.abs(along) * self.size).sum(1) / 2


@dataclass(frozen=True, kw_only=True)
class Moment:
    """The present state of all worlds."""

    tool: Points
    target: Points
    """Where the tool is being pulled to."""
    rotation: Float[np.ndarray, "env 3 3"]
    vel: Points
    width: Numbers
    """Between the pads [m]."""
    bodies: tuple[Body, ...]
    step_m: float
    """Displacement of the target at action 1."""
    turn_rad: float
    opening_m: float
    """Between the open pads."""

    @staticmethod
    def of(
        states: Mapping[str, torch.Tensor],
        objects: tuple[ObjectModel, ...],
        *,
        step_m: float,
        turn_rad: float,
        opening_m: float,
    ) -> "Moment":
        """Read the moment from what task code and policies see."""

        def get(key: str) -> np.ndarray:
            return states[key].numpy().astype(np.float64)

        tool = get("eef_pos")
        bodies = tuple(
            Body(
                model=o,
                pos=get(f"{o.name}_pos"),
                rotation=_rotations(get(f"{o.name}_quat")),
                vel=get(f"{o.name}_vel_linear"),
                size=get(f"{o.name}_size"),
                start=get(f"{o.name}_start_pos"),
                grasped=get(f"{o.name}_grasped") > 0.5,
                touched=get(f"{o.name}_touched") > 0.5,
            )
            for o in objects
        )
        return Moment(
            tool=tool,
            target=tool + value_of(get("base_observation"), "target_ahead"),
            rotation=_rotations(get("eef_quat")),
            vel=get("eef_vel_linear"),
            width=get("gripper_width"),
            bodies=bodies,
            step_m=step_m,
            turn_rad=turn_rad,
            opening_m=opening_m,
        )

    def by_wall(self, body: Body) -> Flags:
        """Tell whether the gripper takes the object by a wall: it is open above, and the pads do not span it."""
        widest = self.opening_m - GRIP_MARGIN_M
        return body.model.opens_up & (body.size[:, :2].min(1) > widest)

    def holds(self, body: Body) -> Flags:
        """Tell whether the gripper has the object between its pads."""
        reach = np.where(self.by_wall(body), body.size[:, :2].max(1) / 2 + 0.03, 0.06)
        return body.grasped & (np.linalg.norm((self.tool - body.pos)[:, :2], axis=1) < reach)

    def go(
        self, to: Points, gripper: Numbers | float, yaw: Numbers | float = 0.0, speed: float = 1.0
    ) -> Actions:
        """Return the action that moves the target to a point, at most at `speed`, turning by `yaw` [rad].

        The gripper is kept pointing down.
        """
        low, high = np.asarray(TARGET_LOW_M), np.asarray(TARGET_HIGH_M)
        wanted = np.clip(to, low, high)
        action = np.zeros((len(self.tool), 7))
        action[:, :3] = np.clip((wanted - self.target) / self.step_m, -speed, speed)
        axis = self.rotation[:, :, 2]
        # axis x (0, 0, -1): the rotation that brings the tool's axis back to straight down.
        action[:, 3] = np.clip(-0.5 * axis[:, 1] / self.turn_rad, -1, 1)
        action[:, 4] = np.clip(0.5 * axis[:, 0] / self.turn_rad, -1, 1)
        action[:, 5] = np.clip(0.5 * np.asarray(yaw) / self.turn_rad, -1, 1)
        action[:, 6] = gripper
        return action


def grasp(m: Moment, body: Body) -> Actions:
    """Go over the object, turn, descend around it and close; for worlds that do not hold it yet."""
    yaw = turn_to_grasp(m, body)
    point = grasp_point(m, body, yaw)
    off = np.linalg.norm((point - m.tool)[:, :2], axis=1)
    tips = m.tool[:, 2] - FINGERTIP_BELOW_TCP_M
    above = body.top + FINGERTIP_BELOW_TCP_M + HOVER_M
    others = np.max([b.top for b in m.bodies], axis=0) + FINGERTIP_BELOW_TCP_M + 0.02
    above = above + _ramp(off, 0.05, 0.1) * np.maximum(others - above, 0)
    misfit = np.maximum(_ramp(off, 0.008, 0.03), _ramp(np.abs(yaw), 0.08, 0.3))
    is_at_depth = (off < 0.02) & (m.tool[:, 2] < point[:, 2] + 0.012)
    misfit = np.where(is_at_depth, misfit, np.maximum(misfit, _ramp(-m.width, -0.078, -0.06)))
    # Sideways only where the fingertips are clear of the object.
    clear = _ramp(tips - body.top, 0.0, HOVER_M)
    free = np.where(off > 0.09, 1.0, np.maximum(clear, 1 - misfit))[:, None]
    to = np.concatenate(
        [
            m.tool[:, :2] + (point - m.tool)[:, :2] * free,
            (point[:, 2] + misfit * (above - point[:, 2]))[:, None],
        ],
        axis=1,
    )
    return m.go(to, np.where(is_at_depth, CLOSE, OPEN), yaw)


def grasp_point(m: Moment, body: Body, yaw: Numbers) -> Points:
    """Return where the tool's centre should be once it has turned by `yaw` [rad].

    In the object's middle, less deep where it is tall; or around the nearer of two walls, above the floor.
    """
    point = body.pos.copy()
    deepest = np.maximum(body.top - FINGER_DEPTH_M, body.pos[:, 2])
    by_wall = m.by_wall(body)
    heading = np.arctan2(m.rotation[:, 1, 1], m.rotation[:, 0, 1]) + yaw
    across = np.stack([np.cos(heading), np.sin(heading)], axis=1)
    across *= np.where(((m.tool - body.pos)[:, :2] * across).sum(1) < 0, -1, 1)[:, None]
    middle = body.reach(across) - hollow_wall_m(body.size[:, :2].min(1)) / 2
    point[:, :2] += across * (by_wall * middle)[:, None]
    floor = body.lowest + hollow_floor_m(body.size[:, 2]) + FINGERTIP_BELOW_TCP_M + 0.003
    deepest = np.where(by_wall, np.maximum(body.top - FINGER_DEPTH_M, floor), deepest)
    point[:, 2] = np.maximum(deepest, TARGET_LOW_M[2])
    return point


def turn_to_grasp(m: Moment, body: Body) -> Numbers:
    """Return by how much to turn [rad] so that the pads close over a side that fits between them."""
    return turn_to_grip(
        m.rotation[:, :, 1].T,
        body.rotation.transpose(1, 2, 0),
        body.size.T,
        is_round=body.model.is_round or body.model.kind == "sphere",
    )


def raise_up(m: Moment, body: Body, height_m: float) -> Actions:
    """Hold an object `height_m` above its start."""
    to = m.tool.copy()
    to[:, :2] += np.clip((body.start - body.pos)[:, :2], -0.01, 0.01)
    to[:, 2] += body.start[:, 2] + height_m - body.pos[:, 2]
    return m.go(to, CLOSE)


def carry(
    m: Moment,
    body: Body,
    goal: Points,
    *,
    clearance_m: Numbers,
    near_m: float = 0.012,
    turn: Numbers | float = 0.0,
) -> Actions:
    """Take a held object to `goal`: up to where its lowest point is at `clearance_m`, across, down.

    Args:
        m: the moment.
        body: what is held.
        goal: of the object's centre.
        clearance_m: of the object's lowest point above the table while it is not yet over the goal.
        near_m: how exactly over the goal it must be before it goes down.
        turn: by how much to turn on the way [rad].
    """
    off = goal - body.pos
    away = np.linalg.norm(off[:, :2], axis=1)
    aside = _ramp(away, near_m, 2 * near_m)
    lowest = goal[:, 2] - body.half[:, 2]
    height = lowest + aside * (np.maximum(clearance_m, lowest) - lowest)
    # Across only once it is high enough; a little early is fine, as the way up takes time.
    free = _ramp(body.lowest - clearance_m, -0.03, -0.01)
    free = np.maximum(free, 1 - _ramp(away, 2 * near_m, 3 * near_m))
    to = m.tool.copy()
    to[:, :2] += off[:, :2] * free[:, None]
    to[:, 2] += height - body.lowest
    return m.go(to, CLOSE, aside * np.asarray(turn))


def release(m: Moment, body: Body) -> Actions:
    """Open, and leave upwards once nothing is touched any more."""
    to = m.tool.copy()
    to[:, 2] = np.where(
        body.touched, m.tool[:, 2], np.maximum(m.tool[:, 2] + 0.05, body.top + 0.06)
    )
    return m.go(to, OPEN)


def push(
    m: Moment,
    body: Body,
    direction: Plane,
    remaining_m: Numbers,
    *,
    height_m: Numbers | None = None,
    avoid: Body | None = None,
) -> Actions:
    """Go behind an object with closed fingers and push it, slower towards the end, then leave it.

    Args:
        m: the moment.
        body: what is pushed.
        direction: in which.
        remaining_m: how far it still has to go; where negative, the gripper withdraws.
        height_m: of the tool's centre while pushing; low by default.
        avoid: another object to stay above on the way.
    """
    if height_m is None:
        # Low, but with the palm above it, unless that would topple it.
        under_palm = np.minimum(body.top - PALM_ABOVE_TCP_M + 0.008, 0.55 * body.top)
        height_m = np.maximum(np.clip(body.half[:, 2], TARGET_LOW_M[2], 0.025), under_palm)
    low = height_m
    offset = (m.tool - body.pos)[:, :2]
    along = (offset * direction).sum(1)
    across = offset - along[:, None] * direction
    aside = np.linalg.norm(across, axis=1)
    is_palm = low + PALM_ABOVE_TCP_M < body.top
    behind = body.reach(direction) + np.where(is_palm, PALM_HALF_M, FINGER_HALF_M)
    tips = m.tool[:, 2] - FINGERTIP_BELOW_TCP_M
    top = body.top if avoid is None else np.maximum(body.top, avoid.top)
    is_behind = (along < -behind + 0.012) & (aside < 0.02)
    pushes = np.where(is_behind, 1 - _ramp(m.tool[:, 2] - low, 0.01, 0.03), 0.0)[:, None]
    is_done = remaining_m < 0
    # Behind it, a little away, first.
    spot = body.pos[:, :2] - direction * (behind + 0.014)[:, None]
    off = np.linalg.norm(spot - m.tool[:, :2], axis=1)
    above = top + FINGERTIP_BELOW_TCP_M + 0.02
    is_beside = (avoid is None) & (np.maximum(aside - behind, -along - behind) > 0.005)
    misfit = np.maximum(
        _ramp(aside, 0.008, 0.022), _ramp(np.abs(along + behind + 0.014), 0.014, 0.03)
    )
    free = np.maximum(_ramp(tips - top, 0.0, 0.015), 1 - misfit)
    to = m.tool.copy()
    to[:, :2] += (spot - m.tool[:, :2]) * np.where(is_beside, 1.0, free)[:, None]
    to[:, 2] = low + misfit * (np.where(off > 0.15, np.maximum(above, m.tool[:, 2]), above) - low)
    pace = np.clip(remaining_m / 0.04, 0.3, 1.0)[:, None]
    forward = m.tool.copy()
    # Ahead, and back onto the line through the object.
    forward[:, :2] += direction * 0.03 * pace - across * 0.8
    forward[:, 2] = low
    away = m.tool.copy()
    away[:, :2] -= direction * 0.04
    away[:, 2] = np.where(along < -behind - 0.01, top + 0.05, m.tool[:, 2])
    to = to + pushes * (forward - to)
    to = np.where(is_done[:, None], away, to)
    return m.go(to, CLOSE)


def swing(m: Moment, body: Body, goal: Points, *, elevation_rad: float, lead_s: float) -> Actions:
    """Throw a held object at `goal`: draw back, swing along a line that rises, let go where it will fly there.

    Args:
        m: the moment.
        body: what is held.
        goal: where it should come down.
        elevation_rad: of the line.
        lead_s: from the command to open until the object is free.
    """
    aim = (goal - body.pos)[:, :2]
    away = np.linalg.norm(aim, axis=1)
    direction = aim / np.maximum(away, 1e-6)[:, None]
    forward = (m.vel[:, :2] * direction).sum(1)
    far_back = (m.tool[:, 0] < SWING_FROM_M[0] + 0.03) & (m.tool[:, 2] > SWING_FROM_M[2] - 0.06)
    is_swinging = far_back | (forward > 0.25)
    line = np.concatenate(
        [direction * np.cos(elevation_rad), np.full((len(aim), 1), np.sin(elevation_rad))], axis=1
    )
    ahead = m.tool + line * 0.2
    back = np.tile(np.asarray(SWING_FROM_M), (len(aim), 1))
    back[:, 1] = np.clip(m.tool[:, 1], -0.15, 0.15)
    to = np.where(is_swinging[:, None], ahead, back)
    pos = body.pos + m.vel * lead_s
    fall = np.maximum(pos[:, 2] - goal[:, 2], 0.0)
    flight = (m.vel[:, 2] + np.sqrt(m.vel[:, 2] ** 2 + 2 * 9.81 * fall)) / 9.81
    reach = forward * (lead_s + flight)
    lets_go = is_swinging & (reach > away - 0.01) & (forward > 0.4)
    return m.go(to, np.where(lets_go, OPEN, CLOSE))


SWING_FROM_M = (0.38, 0.0, 0.24)
"""Where a swing starts."""


def choose(condition: Flags, then: Actions, otherwise: Actions) -> Actions:
    """Return one action or the other, per world."""
    return np.where(condition[:, None], then, otherwise)


def _ramp(value: Numbers, low: float | Numbers, high: float | Numbers) -> Numbers:
    """Return 0 below `low`, 1 above `high`, and a slope between: a learner cannot imitate a step well."""
    return np.clip((value - low) / (np.asarray(high) - low), 0.0, 1.0)


def _rotations(quat_wxyz: Float[np.ndarray, "env 4"]) -> Float[np.ndarray, "env 3 3"]:
    return np.ascontiguousarray(np.moveaxis(matrices(quat_wxyz.T), -1, 0))

"""The formulas of `batch_env` and `states` on torch tensors of any device, for `warp_env`.

A policy is trained on one backend and judged on the other: `tests/sim/test_tensor_states.py` holds both to the
same values. There it is numpy with the worlds last, which is fastest on a CPU; here rows are worlds.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass

import torch
from jaxtyping import Float

from v2p_data.sim import grips
from v2p_data.sim.robot import FINGER_TRAVEL_M, TARGET_HIGH_M, TARGET_LOW_M
from v2p_data.sim.states import (
    _OBJECT_COLUMNS,
    _ROBOT_COLUMNS,
    NEARLY_OPEN_M,
    OBJECT_SLOTS,
    OBSERVATION_LIMIT,
    PROGRESS_COLUMN,
)
from v2p_data.task.task import BASE_OBSERVATION_DIM


@dataclass(frozen=True, kw_only=True)
class SeenTensors:
    """`states.Observed` as tensors, with the tool's state in it; rows are worlds."""

    tool_pos: Float[torch.Tensor, "env 3"]
    tool_rotation: Float[torch.Tensor, "env 3 3"]
    tool_quat: Float[torch.Tensor, "env 4"]
    tool_vel_linear: Float[torch.Tensor, "env 3"]
    tool_vel_angular: Float[torch.Tensor, "env 3"]
    fingers: Float[torch.Tensor, "env 2"]
    object_qpos: Float[torch.Tensor, "env object 7"]
    object_qvel: Float[torch.Tensor, "env object 6"]
    object_size: Float[torch.Tensor, "env object 3"]
    start_pose: Float[torch.Tensor, "env object 7"]
    touches: Float[torch.Tensor, "env object 2"]
    target_pos: Float[torch.Tensor, "env 3"]
    target_finger: Float[torch.Tensor, "env"]
    last_action: Float[torch.Tensor, "env 7"]
    progress: Float[torch.Tensor, "env"]


def named_states(
    robot: Float[torch.Tensor, "env 16"],
    objects: Float[torch.Tensor, "env object 26"],
    base: Float[torch.Tensor, "env obs"],
    names: list[str],
) -> dict[str, torch.Tensor]:
    """Return the columns of the three blocks by the names that task code knows, as views."""
    states = {key: robot[:, columns] for key, columns in _ROBOT_COLUMNS.items()}
    states["base_observation"] = base
    for k, name in enumerate(names):
        for key, columns in _OBJECT_COLUMNS.items():
            states[f"{name}_{key}"] = objects[:, k, columns]
    return states


def robot_block(seen: SeenTensors) -> Float[torch.Tensor, "env 16"]:
    """Return the columns that `named_states` names for the robot."""
    return torch.cat(
        [
            seen.tool_pos,
            seen.tool_quat,
            seen.tool_vel_linear,
            seen.tool_vel_angular,
            seen.fingers.sum(1, keepdim=True),
            torch.zeros_like(seen.progress[:, None]),
            seen.progress[:, None],
        ],
        dim=1,
    )


def object_block(seen: SeenTensors) -> Float[torch.Tensor, "env object 26"]:
    """Return the columns that `named_states` names for each object."""
    rotation = matrices(seen.object_qpos[..., 3:])
    spin = (rotation @ seen.object_qvel[..., 3:, None])[..., 0]
    touching = seen.touches.sum(2, keepdim=True)
    has_closed = seen.fingers.sum(1)[:, None, None] < 2 * FINGER_TRAVEL_M - NEARLY_OPEN_M
    return torch.cat(
        [
            seen.object_qpos,
            seen.object_qvel[..., :3],
            spin,
            seen.object_size,
            seen.start_pose,
            rotation[..., 2, 2, None],
            ((touching > 1.5) & has_closed).to(spin.dtype),
            (touching > 0.5).to(spin.dtype),
        ],
        dim=2,
    )


def base_observation(
    seen: SeenTensors, is_round: Sequence[bool]
) -> Float[torch.Tensor, "env obs"]:
    """Return what `states` describes as the base observation.

    Args:
        seen: the worlds.
        is_round: per object, whether it is round about its own z axis.
    """
    pos, slots = seen.tool_pos, min(len(is_round), OBJECT_SLOTS)
    out = pos.new_zeros(len(pos), BASE_OBSERVATION_DIM)
    out[:, 0:3] = (pos - _vector(pos, (0.5, 0.0, 0.15))) * 5
    out[:, 3:6] = seen.tool_rotation[:, :, 0]
    out[:, 6:9] = seen.tool_rotation[:, :, 1]
    out[:, 9:11] = seen.fingers / FINGER_TRAVEL_M
    out[:, 11:14] = (seen.target_pos - pos) * 20
    out[:, 14] = seen.target_finger / FINGER_TRAVEL_M
    out[:, 15:22] = seen.last_action * 0.5
    gripper_axes = seen.tool_rotation.mT
    rotation = matrices(seen.object_qpos[:, :slots, 3:])
    centre = _vector(pos, (0.5, 0.0, 0.05))
    for k in range(slots):
        place = seen.object_qpos[:, k, :3]
        rel = place - pos
        relative = gripper_axes @ rotation[:, k]
        parts = (
            rel * 10,
            (gripper_axes @ rel[:, :, None])[:, :, 0] * 10,
            relative[:, :, 0],
            relative[:, :, 1],
            rotation[:, k, :, 2],
            (place - centre) * 5,
            seen.object_qvel[:, k, :3],
        )
        out[:, 22 + 21 * k : 43 + 21 * k] = torch.cat(parts, dim=1)
        out[:, 64 + 3 * k : 67 + 3 * k] = seen.object_size[:, k] * 15
        out[:, 73 + 3 * k : 76 + 3 * k] = (place - seen.start_pose[:, k, :3]) * 5
        out[:, 80 + 4 * k : 84 + 4 * k] = grip_features(
            seen.tool_rotation, rotation[:, k], seen.object_size[:, k], is_round=is_round[k]
        )
    out[:, 70:72] = seen.touches[:, 0]
    if slots > 1:
        out[:, 88:90] = seen.touches[:, 1]
    out[:, PROGRESS_COLUMN] = seen.progress
    out[:, 79] = float(slots > 1)
    return out.clamp_(-OBSERVATION_LIMIT, OBSERVATION_LIMIT)


def grip_features(
    tool: Float[torch.Tensor, "env 3 3"],
    rotation: Float[torch.Tensor, "env 3 3"],
    size: Float[torch.Tensor, "env 3"],
    *,
    is_round: bool,
) -> Float[torch.Tensor, "env 4"]:
    """Return `grips.grip_features`, scaled as the base observation has them."""
    heading = torch.atan2(tool[:, 1, 1], tool[:, 0, 1])
    if is_round:
        axis = torch.atan2(rotation[:, 1, 2], rotation[:, 0, 2]) + torch.pi / 2
        lies = rotation[:, 2, 2].abs() < 0.7
        turn = torch.where(lies, _within(axis - heading), torch.zeros_like(heading))
    else:
        turns = _within(torch.atan2(rotation[:, 1], rotation[:, 0]) - heading[:, None])
        costs = (
            turns.abs()
            + grips._TOO_WIDE * (size - grips.GRIPS_UP_TO_M).clamp_min(0)
            + grips._NARROW_IS_BETTER * size
            + grips._NOT_LEVEL * (rotation[:, 2].abs() > grips.LEVEL)
        )
        turn = turns.gather(1, costs.argmin(1, keepdim=True))[:, 0]
    extents = ((tool.mT @ rotation).abs() * size[:, None]).sum(2)
    return torch.cat([turn[:, None] / (torch.pi / 2), extents * 10], dim=1)


def moved_position(
    target: Float[torch.Tensor, "env 3"],
    action: Float[torch.Tensor, "env 3"],
    tool_pos: Float[torch.Tensor, "env 3"],
    *,
    step_m: float,
    leash_m: float,
) -> Float[torch.Tensor, "env 3"]:
    """Return the tool's wanted position, on its leash and within the box of targets."""
    moved = target + action * step_m
    moved = torch.minimum(torch.maximum(moved, tool_pos - leash_m), tool_pos + leash_m)
    return torch.minimum(
        torch.maximum(moved, _vector(moved, TARGET_LOW_M)), _vector(moved, TARGET_HIGH_M)
    )


def moved_rotation(
    target: Float[torch.Tensor, "env 4"],
    action: Float[torch.Tensor, "env 3"],
    tool_quat: Float[torch.Tensor, "env 4"],
    *,
    step_rad: float,
    leash_rad: float,
    tilt_rad: float,
) -> Float[torch.Tensor, "env 4"]:
    """Return the tool's wanted orientation, on its leash and leaning no further than its limit."""
    quat = product(_exp(action * step_rad), target)
    return _limit_tilt(_leashed(quat, tool_quat, leash_rad), tilt_rad)


def matrices(quat_wxyz: Float[torch.Tensor, "*batch 4"]) -> Float[torch.Tensor, "*batch 3 3"]:
    """Return rotation matrices of unit quaternions."""
    w, x, y, z = quat_wxyz.unbind(-1)
    rows = (
        (1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)),
        (2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)),
        (2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)),
    )
    return torch.stack([torch.stack(row, dim=-1) for row in rows], dim=-2)


def product(
    a: Float[torch.Tensor, "env 4"], b: Float[torch.Tensor, "env 4"]
) -> Float[torch.Tensor, "env 4"]:
    """Return the quaternion products `a b`."""
    w1, x1, y1, z1 = a.unbind(1)
    w2, x2, y2, z2 = b.unbind(1)
    return torch.stack(
        [
            w1 * w2 - x1 * x2 - y1 * y2 - z1 * z2,
            w1 * x2 + x1 * w2 + y1 * z2 - z1 * y2,
            w1 * y2 - x1 * z2 + y1 * w2 + z1 * x2,
            w1 * z2 + x1 * y2 - y1 * x2 + z1 * w2,
        ],
        dim=1,
    )


def _within(angle: torch.Tensor) -> torch.Tensor:
    return torch.remainder(angle + torch.pi / 2, torch.pi) - torch.pi / 2


def _exp(rotvec: torch.Tensor) -> torch.Tensor:
    half = rotvec.norm(dim=1, keepdim=True) / 2
    return torch.cat([half.cos(), 0.5 * torch.sinc(half / torch.pi) * rotvec], dim=1)


def _leashed(quat: torch.Tensor, anchor: torch.Tensor, limit_rad: float) -> torch.Tensor:
    """Return `quat`, turned back towards `anchor` where it is further than the limit away; normalised.

    The angle between them comes from the sine: in float32 the arc cosine is off by 0.03 degrees near zero.
    """
    quat = quat / quat.norm(dim=1, keepdim=True)
    dot = (quat * anchor).sum(1, keepdim=True)
    near = quat * torch.where(dot < 0, -1.0, 1.0)
    half = torch.atan2((near - anchor * dot.abs()).norm(dim=1, keepdim=True), dot.abs())
    part = limit_rad / 2
    sine = half.sin().clamp_min(1e-6)
    back = ((half - part).sin() * anchor + math.sin(part) * near) / sine
    return torch.where(half > part, back, quat)


def _limit_tilt(quat: torch.Tensor, limit_rad: float) -> torch.Tensor:
    """Return `quat`, leaned back where its z axis is further than the limit from straight down."""
    w, x, y, z = quat.unbind(1)
    axis_x, axis_y = 2 * (x * z + w * y), 2 * (y * z - w * x)
    axis_z = 1 - 2 * (x * x + y * y)
    level = torch.hypot(axis_x, axis_y)
    over = torch.atan2(level, -axis_z) - limit_rad
    back = torch.stack([-axis_y, axis_x, torch.zeros_like(axis_x)], dim=1)
    back = back / level.clamp_min(1e-12)[:, None]
    leaned = product(_exp(back * over.clamp_min(0)[:, None]), quat)
    return torch.where((over > 0)[:, None], leaned, quat)


def _vector(like: torch.Tensor, values: tuple[float, ...]) -> torch.Tensor:
    return torch.tensor(values, dtype=like.dtype, device=like.device)

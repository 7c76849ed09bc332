"""The formulas of `batch_env` and `states` on torch tensors of any device, for `warp_env`.

A policy is trained on one backend and judged on the other: `tests/sim/test_tensor_states.py` holds both to the
same values. There it is numpy with the worlds last, which is fastest on a CPU; here rows are worlds.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import torch
from jaxtyping import Float

from v2p_data.geometry.rotation_torch import exp, limited_to, matrices, product, tilt_limited
from v2p_data.sim.env.observation import (
    COLUMNS,
    GRIP_COLUMNS,
    LIMIT,
    OBJECT_CENTRE_M,
    OBJECT_SLOTS,
    SCALES,
    TOOL_CENTRE_M,
)
from v2p_data.sim.env.states import NEARLY_OPEN_M
from v2p_data.sim.robot import grips
from v2p_data.sim.robot.robot import FINGER_TRAVEL_M, TARGET_HIGH_M, TARGET_LOW_M
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
    pos, slots = seen.tool_pos, min(len(is_round), len(OBJECT_SLOTS))
    out = pos.new_zeros(len(pos), BASE_OBSERVATION_DIM)

    def put(name: str, value: torch.Tensor) -> None:
        out[:, COLUMNS[name]] = value

    put("tool_pos", pos - _vector(pos, TOOL_CENTRE_M))
    put("tool_axis_x", seen.tool_rotation[:, :, 0])
    put("tool_axis_y", seen.tool_rotation[:, :, 1])
    put("fingers", seen.fingers)
    put("target_ahead", seen.target_pos - pos)
    put("target_finger", seen.target_finger[:, None])
    put("last_action", seen.last_action)
    put("progress", seen.progress[:, None])
    out[:, COLUMNS["has_other"]] = float(slots > 1)
    gripper_axes = seen.tool_rotation.mT
    rotation = matrices(seen.object_qpos[:, :slots, 3:])
    for k, slot in enumerate(OBJECT_SLOTS[:slots]):
        place = seen.object_qpos[:, k, :3]
        away = place - pos
        relative = gripper_axes @ rotation[:, k]
        put(f"{slot}_away", away)
        put(f"{slot}_away_in_gripper", (gripper_axes @ away[:, :, None])[:, :, 0])
        put(f"{slot}_axis_x", relative[:, :, 0])
        put(f"{slot}_axis_y", relative[:, :, 1])
        put(f"{slot}_up", rotation[:, k, :, 2])
        put(f"{slot}_pos", place - _vector(pos, OBJECT_CENTRE_M))
        put(f"{slot}_vel", seen.object_qvel[:, k, :3])
        put(f"{slot}_size", seen.object_size[:, k])
        put(f"{slot}_moved", place - seen.start_pose[:, k, :3])
        put(f"{slot}_touches", seen.touches[:, k])
        out[:, GRIP_COLUMNS[k]] = grip_features(
            seen.tool_rotation, rotation[:, k], seen.object_size[:, k], is_round=is_round[k]
        )
    scales = torch.from_numpy(SCALES).to(out.device, out.dtype)
    return (out * scales).clamp_(-LIMIT, LIMIT)


def grip_features(
    tool: Float[torch.Tensor, "env 3 3"],
    rotation: Float[torch.Tensor, "env 3 3"],
    size: Float[torch.Tensor, "env 3"],
    *,
    is_round: bool,
) -> Float[torch.Tensor, "env 4"]:
    """Return `grips.grip_features`."""
    heading = torch.atan2(tool[:, 1, 1], tool[:, 0, 1])
    if is_round:
        axis = torch.atan2(rotation[:, 1, 2], rotation[:, 0, 2]) + torch.pi / 2
        lies = rotation[:, 2, 2].abs() < 0.7
        turn = torch.where(lies, _within(axis - heading), torch.zeros_like(heading))
    else:
        turns = _within(torch.atan2(rotation[:, 1], rotation[:, 0]) - heading[:, None])
        costs = (
            turns.abs()
            + grips.TOO_WIDE * (size - grips.GRIPS_UP_TO_M).clamp_min(0)
            + grips.NARROW_IS_BETTER * size
            + grips.NOT_LEVEL * (rotation[:, 2].abs() > grips.LEVEL)
        )
        turn = turns.gather(1, costs.argmin(1, keepdim=True))[:, 0]
    extents = ((tool.mT @ rotation).abs() * size[:, None]).sum(2)
    return torch.cat([turn[:, None] / (torch.pi / 2), extents], dim=1)


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
    quat = product(exp(action * step_rad), target)
    return tilt_limited(limited_to(quat, tool_quat, leash_rad), tilt_rad)


def _within(angle: torch.Tensor) -> torch.Tensor:
    return torch.remainder(angle + torch.pi / 2, torch.pi) - torch.pi / 2


def _vector(like: torch.Tensor, values: tuple[float, ...]) -> torch.Tensor:
    return torch.tensor(values, dtype=like.dtype, device=like.device)

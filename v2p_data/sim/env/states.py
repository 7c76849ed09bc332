"""What task code and policies see: the tensors of `task.task.ROBOT_STATES` and `OBJECT_STATES`.

One block of float32 arrays per control step; the tensors are views into it, so building the dict copies
nothing. Rows of worlds that start anew are overwritten in place, hence a dict is valid until the next step
or reset. The numbers are worked out with the worlds last, along which numpy is fastest, and then turned over into
rows of worlds: torch's norm over the last axis is ten times slower on columns.
"""

from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Float

from v2p_data.geometry.rotation import matrices
from v2p_data.sim.env.observation import (
    COLUMNS,
    GRIP_COLUMNS,
    IN_SLOT,
    LIMIT,
    MOVED_COLUMNS,
    OBJECT_CENTRE_M,
    OBJECT_SLOTS,
    PROGRESS_COLUMN,
    SCALES,
    SIZE_COLUMNS,
    SLOT_COLUMNS,
    SLOT_WIDTH,
    TOOL_CENTRE_M,
    TOUCH_COLUMNS,
)
from v2p_data.sim.model.world import World
from v2p_data.sim.robot.grips import grip_features
from v2p_data.sim.robot.robot import ToolState
from v2p_data.task.task import BASE_OBSERVATION_DIM

NUM_ROBOT_COLUMNS = 16
NUM_OBJECT_COLUMNS = 26
ROBOT_COLUMNS = {
    "eef_pos": slice(0, 3),
    "eef_quat": slice(3, 7),
    "eef_vel_linear": slice(7, 10),
    "eef_vel_angular": slice(10, 13),
    "gripper_width": 13,
    "table_height": 14,
    "progress": 15,
}
OBJECT_COLUMNS = {
    "pos": slice(0, 3),
    "quat": slice(3, 7),
    "vel_linear": slice(7, 10),
    "vel_angular": slice(10, 13),
    "size": slice(13, 16),
    "start_pos": slice(16, 19),
    "start_quat": slice(19, 23),
    "up": 23,
    "grasped": 24,
    "touched": 25,
}


NEARLY_OPEN_M = 0.001
"""Both pads also touch what is wedged between fully open fingers; without this margin that pays as a grasp."""


@dataclass(frozen=True, kw_only=True)
class Observed:
    """The simulation's state from which a block is filled; rows are worlds."""

    tool: ToolState
    fingers: Float[np.ndarray, "env 2"]
    """Travel of the fingers [m]."""
    object_qpos: Float[np.ndarray, "env object 7"]
    object_qvel: Float[np.ndarray, "env object 6"]
    """Linear in the world frame, angular in the object's frame, as MuJoCo has it."""
    object_size: Float[np.ndarray, "env object 3"]
    start_pose: Float[np.ndarray, "env object 7"]
    touches: Float[np.ndarray, "env object 2"]
    """1 where the left, right pad touches the object."""
    target_pos: Float[np.ndarray, "env 3"]
    target_finger: Float[np.ndarray, "env"]
    last_action: Float[np.ndarray, "env 7"]
    progress: Float[np.ndarray, "env"]


class StateBlock:
    """Float32 arrays for one moment of all worlds.

    Args:
        world: names the objects.
        num_envs: number of worlds.
    """

    def __init__(self, world: World, num_envs: int) -> None:
        self._names = [o.name for o in world.objects]
        self._is_round = [o.is_round or o.kind == "sphere" for o in world.objects]
        self._holds_below_m = 2 * world.robot.finger_travel_m - NEARLY_OPEN_M
        width = NUM_ROBOT_COLUMNS + NUM_OBJECT_COLUMNS * len(self._names)
        self._columns = np.zeros((width, num_envs), np.float32)
        self._base = np.zeros((BASE_OBSERVATION_DIM, num_envs), np.float32)
        self._rows = torch.zeros(num_envs, width)
        self._base_tensor = torch.from_numpy(self._base)
        self._copied_rows = torch.zeros_like(self._rows)
        self._copied_base = torch.zeros_like(self._base_tensor)
        self._tensors = self._views(self._rows, self._base_tensor)
        self._copied = self._views(self._copied_rows, self._copied_base)

    def fill(self, rows: slice | np.ndarray, seen: Observed) -> None:
        """Overwrite `rows`, all or listed ones, with what was seen of them."""
        columns, base = self._columns, self._base
        if not isinstance(rows, slice):
            columns = np.zeros((len(columns), len(rows)), np.float32)
            base = np.zeros((len(base), len(rows)), np.float32)
        robot = columns[:NUM_ROBOT_COLUMNS]
        objects = columns[NUM_ROBOT_COLUMNS:].reshape(len(self._names), NUM_OBJECT_COLUMNS, -1)
        with np.errstate(over="ignore", invalid="ignore"):  # of worlds that broke down
            _fill(robot, objects, base, seen, self._is_round, self._holds_below_m)
        if isinstance(rows, slice):
            self._rows.copy_(torch.from_numpy(columns.T))
        else:
            self._rows.numpy()[rows] = columns.T
            self._base[:, rows] = base

    def tensors(self) -> dict[str, torch.Tensor]:
        """Return the states as views; new dict, shared memory."""
        return dict(self._tensors)

    def copies(self) -> dict[str, torch.Tensor]:
        """Return the states as views of other memory, which the next call writes anew: for task code to keep."""
        self._copied_rows.copy_(self._rows)
        self._copied_base.copy_(self._base_tensor)
        return dict(self._copied)

    def _views(self, rows: torch.Tensor, base: torch.Tensor) -> dict[str, torch.Tensor]:
        objects = rows[:, NUM_ROBOT_COLUMNS:].view(len(rows), len(self._names), NUM_OBJECT_COLUMNS)
        return named_states(rows[:, :NUM_ROBOT_COLUMNS], objects, base.T, self._names)


def named_states(
    robot: Float[torch.Tensor, "env 16"],
    objects: Float[torch.Tensor, "env object 26"],
    base: Float[torch.Tensor, "env obs"],
    names: list[str],
) -> dict[str, torch.Tensor]:
    """Return the columns of the three blocks by the names that task code knows, as views."""
    states = {key: robot[:, columns] for key, columns in ROBOT_COLUMNS.items()}
    states["base_observation"] = base
    for k, name in enumerate(names):
        for key, columns in OBJECT_COLUMNS.items():
            states[f"{name}_{key}"] = objects[:, k, columns]
    return states


def _fill(
    robot: Float[np.ndarray, "16 env"],
    objects: Float[np.ndarray, "object 26 env"],
    base: Float[np.ndarray, "90 env"],
    seen: Observed,
    is_round: list[bool],
    holds_below_m: float,
) -> None:
    """Write all numbers of some worlds."""
    tool = seen.tool
    fingers = seen.fingers.T.astype(np.float32)
    opening = fingers[0] + fingers[1]
    robot[0:3] = tool.pos.T
    robot[3:7] = tool.quat_wxyz.T
    robot[7:10] = tool.vel_linear.T
    robot[10:13] = tool.vel_angular.T
    robot[13] = opening
    robot[14] = 0.0
    robot[15] = seen.progress

    touches = seen.touches.transpose(1, 2, 0).astype(np.float32)
    touching = touches[:, 0] + touches[:, 1]
    velocity = seen.object_qvel.transpose(1, 2, 0).astype(np.float32)
    objects[:, 0:7] = seen.object_qpos.transpose(1, 2, 0)
    rotation = matrices(objects[:, 3:7])
    objects[:, 7:10] = velocity[:, :3]
    np.sum(rotation * velocity[:, None, 3:], axis=2, out=objects[:, 10:13])
    objects[:, 13:16] = seen.object_size.transpose(1, 2, 0)
    objects[:, 16:23] = seen.start_pose.transpose(1, 2, 0)
    objects[:, 23] = rotation[:, 2, 2]
    objects[:, 24] = (touching > 1.5) & (opening < holds_below_m)
    objects[:, 25] = touching > 0.5
    _fill_base(base, robot, objects[: len(OBJECT_SLOTS)], rotation[: len(OBJECT_SLOTS)], seen)
    base[COLUMNS["fingers"]] = fingers
    tool_axes = tool.rotation.transpose(1, 2, 0).astype(np.float32)
    for k in range(min(len(OBJECT_SLOTS), len(objects))):
        base[TOUCH_COLUMNS[k]] = touches[k]
        base[GRIP_COLUMNS[k]] = grip_features(
            tool_axes, rotation[k], objects[k, 13:16], is_round=is_round[k]
        )
    base *= SCALES[:, None]
    np.clip(base, -LIMIT, LIMIT, out=base)


def _fill_base(
    base: Float[np.ndarray, "90 env"],
    robot: Float[np.ndarray, "16 env"],
    objects: Float[np.ndarray, "slot 26 env"],
    rotation: Float[np.ndarray, "slot 3 3 env"],
    seen: Observed,
) -> None:
    """Write the terms of `observation.TERMS` without their scales, except fingers, touches and grips."""
    slots, n = len(objects), base.shape[-1]
    axes = seen.tool.rotation.transpose(2, 1, 0).astype(np.float32)
    pos = objects[:, 0:3]
    np.subtract(robot[0:3], _TOOL_CENTRE, out=base[COLUMNS["tool_pos"]])
    base[COLUMNS["tool_axis_x"]] = axes[0]
    base[COLUMNS["tool_axis_y"]] = axes[1]
    base[COLUMNS["target_ahead"]] = (seen.target_pos - seen.tool.pos).T
    base[COLUMNS["target_finger"]] = seen.target_finger
    base[COLUMNS["last_action"]] = seen.last_action.T
    slot = base[SLOT_COLUMNS].reshape(len(OBJECT_SLOTS), SLOT_WIDTH, n)[:slots]
    away = pos - robot[0:3]
    slot[:, IN_SLOT["away"]] = away
    np.sum(axes * away[:, None], axis=2, out=slot[:, IN_SLOT["away_in_gripper"]])
    relative = np.sum(axes[:, :, None] * rotation[:, None, :, :2], axis=2)
    slot[:, IN_SLOT["axis_x"]] = relative[:, :, 0]
    slot[:, IN_SLOT["axis_y"]] = relative[:, :, 1]
    slot[:, IN_SLOT["up"]] = rotation[:, :, 2]
    np.subtract(pos, _OBJECT_CENTRE, out=slot[:, IN_SLOT["pos"]])
    slot[:, IN_SLOT["vel"]] = objects[:, 7:10]
    base[SIZE_COLUMNS].reshape(len(OBJECT_SLOTS), 3, n)[:slots] = objects[:, 13:16]
    base[PROGRESS_COLUMN] = seen.progress
    moved = base[MOVED_COLUMNS].reshape(len(OBJECT_SLOTS), 3, n)[:slots]
    np.subtract(pos, objects[:, 16:19], out=moved)
    base[COLUMNS["has_other"]] = float(slots > 1)


_TOOL_CENTRE = np.array([TOOL_CENTRE_M], np.float32).T
_OBJECT_CENTRE = np.array([OBJECT_CENTRE_M], np.float32).T

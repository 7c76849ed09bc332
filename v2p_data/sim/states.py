"""What task code and policies see: the tensors of `task.task.ROBOT_STATES` and `OBJECT_STATES`.

One block of float32 arrays per control step; the tensors are views into it, so building the dict copies
nothing. Rows of worlds that start anew are overwritten in place, hence a dict is valid until the next step
or reset.
"""

from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Float

from v2p_data.sim.robot import FINGER_TRAVEL_M, ToolState
from v2p_data.sim.world import World
from v2p_data.task.task import BASE_OBSERVATION_DIM

OBSERVATION_LIMIT = 5.0
OBJECT_SLOTS = 2
"""Objects that the base observation describes: the manipulated one, then the first other."""

_ROBOT_COLUMNS = {
    "eef_pos": slice(0, 3),
    "eef_quat": slice(3, 7),
    "eef_vel_linear": slice(7, 10),
    "eef_vel_angular": slice(10, 13),
    "gripper_width": 13,
    "table_height": 14,
    "progress": 15,
}
_OBJECT_COLUMNS = {
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


HOLDS_BELOW_M = 0.084
"""Both pads also touch what is wedged between fully open fingers; without this bound that pays as a grasp."""


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
        self._robot = np.zeros((num_envs, 16), np.float32)
        self._objects = np.zeros((num_envs, len(self._names), 26), np.float32)
        self._base = np.zeros((num_envs, BASE_OBSERVATION_DIM), np.float32)

    def fill(self, rows: slice | np.ndarray, seen: Observed) -> None:
        """Overwrite `rows` with what was seen of them."""
        tool, pose = seen.tool, seen.object_qpos
        count = pose.shape[1]
        rotation = matrices(pose[:, :, 3:])
        # Written in one go: a robot block and an object block per world.
        self._robot[rows] = np.concatenate(
            [
                tool.pos,
                tool.quat_wxyz,
                tool.vel_linear,
                tool.vel_angular,
                seen.fingers.sum(1, keepdims=True),
                np.zeros((len(pose), 1)),
                seen.progress[:, None],
            ],
            axis=1,
            dtype=np.float32,
        )
        spin = np.matmul(rotation, seen.object_qvel[:, :, 3:, None])[..., 0]
        touching = seen.touches.sum(2, keepdims=True)
        has_closed = seen.fingers.sum(1)[:, None, None] < HOLDS_BELOW_M
        up = rotation[:, :, 2, 2, None]
        self._objects[rows] = np.concatenate(
            [
                pose,
                seen.object_qvel[:, :, :3],
                spin,
                seen.object_size,
                seen.start_pose,
                up,
                (touching > 1.5) & has_closed,
                touching > 0.5,
            ],
            axis=2,
            dtype=np.float32,
        )
        self._base[rows] = _base_observation(seen, rotation[:, : min(count, OBJECT_SLOTS)])

    def tensors(self) -> dict[str, torch.Tensor]:
        """Return the states as views; new dict, shared memory."""
        robot = torch.from_numpy(self._robot)
        objects = torch.from_numpy(self._objects)
        states = {key: robot[:, columns] for key, columns in _ROBOT_COLUMNS.items()}
        states["base_observation"] = torch.from_numpy(self._base)
        for k, name in enumerate(self._names):
            block = objects[:, k]
            for key, columns in _OBJECT_COLUMNS.items():
                states[f"{name}_{key}"] = block[:, columns]
        return states


def _base_observation(
    seen: Observed, rotation: Float[np.ndarray, "env slot 3 3"]
) -> Float[np.ndarray, "env obs"]:
    """Return the 80 numbers every policy sees, each of order one, clipped to +-5.

    22 of the robot (tool position, two axes of its rotation, fingers, how far its target is ahead, last
    action); 21 of each of two objects (position from the tool in world and gripper axes, relative rotation,
    up axis, position on the table, velocity); then sizes (6), touches of the manipulated object (2),
    progress (1), displacement from the start of both objects (6), and whether there is a second object (1).
    """
    n, slots = rotation.shape[:2]
    tool = seen.tool
    out = np.zeros((n, BASE_OBSERVATION_DIM), np.float32)
    out[:, 0:3] = (tool.pos - (0.5, 0.0, 0.15)) * 5
    out[:, 3:6] = tool.rotation[:, :, 0]
    out[:, 6:9] = tool.rotation[:, :, 1]
    out[:, 9:11] = seen.fingers / FINGER_TRAVEL_M
    out[:, 11:14] = (seen.target_pos - tool.pos) * 20
    out[:, 14] = seen.target_finger / FINGER_TRAVEL_M
    out[:, 15:22] = seen.last_action * 0.5
    gripper_axes = tool.rotation.transpose(0, 2, 1)
    for k in range(slots):
        pos = seen.object_qpos[:, k, :3]
        rel = pos - tool.pos
        relative = np.matmul(gripper_axes, rotation[:, k])
        column = 22 + 21 * k
        out[:, column : column + 3] = rel * 10
        out[:, column + 3 : column + 6] = np.matmul(gripper_axes, rel[:, :, None])[:, :, 0] * 10
        out[:, column + 6 : column + 9] = relative[:, :, 0]
        out[:, column + 9 : column + 12] = relative[:, :, 1]
        out[:, column + 12 : column + 15] = rotation[:, k, :, 2]
        out[:, column + 15 : column + 18] = (pos - (0.5, 0.0, 0.05)) * 5
        out[:, column + 18 : column + 21] = seen.object_qvel[:, k, :3]
        out[:, 64 + 3 * k : 67 + 3 * k] = seen.object_size[:, k] * 15
        out[:, 73 + 3 * k : 76 + 3 * k] = (pos - seen.start_pose[:, k, :3]) * 5
    out[:, 70:72] = seen.touches[:, 0]
    out[:, 72] = seen.progress
    out[:, 79] = float(slots > 1)
    return np.clip(out, -OBSERVATION_LIMIT, OBSERVATION_LIMIT, out=out)


def matrices(quat_wxyz: Float[np.ndarray, "*batch 4"]) -> Float[np.ndarray, "*batch 3 3"]:
    """Return rotation matrices of unit quaternions."""
    w, x, y, z = np.moveaxis(quat_wxyz, -1, 0)
    out = np.empty((*quat_wxyz.shape[:-1], 3, 3))
    out[..., 0, 0] = 1 - 2 * (y * y + z * z)
    out[..., 0, 1] = 2 * (x * y - w * z)
    out[..., 0, 2] = 2 * (x * z + w * y)
    out[..., 1, 0] = 2 * (x * y + w * z)
    out[..., 1, 1] = 1 - 2 * (x * x + z * z)
    out[..., 1, 2] = 2 * (y * z - w * x)
    out[..., 2, 0] = 2 * (x * z - w * y)
    out[..., 2, 1] = 2 * (y * z + w * x)
    out[..., 2, 2] = 1 - 2 * (x * x + y * y)
    return out
